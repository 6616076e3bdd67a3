"""Repetition of one cycle of a periodic motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from probmotion.geometry.rotations import matrix_to_vector, vector_to_matrix
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count

__all__ = ["repeated_cycle"]


def repeated_cycle(cycle: Motion, frames: int) -> Motion:
    """Return a motion of ``frames`` frames that repeats one cycle.

    Each repetition starts where the previous one ends, translated horizontally and rotated about
    the vertical. The remaining mismatch between first and last pose is distributed evenly over the
    cycle by rotating rigid groups of bones, which preserves bone lengths. Raises ``ValueError`` if
    the cycle has fewer than 3 frames or several roots.
    """
    check_count("frames", frames)
    if len(cycle.skeleton.roots) != 1:
        raise ValueError(f"cycle must have one root, got {len(cycle.skeleton.roots)}")
    if cycle.frames < 3:
        raise ValueError(f"cycle must have at least 3 frames, got {cycle.frames}")
    period = cycle.frames - 1
    root = cycle.skeleton.roots[0]
    turn = _turn_about_vertical(cycle.positions[0], cycle.positions[-1], root)
    offsets = _closed(cycle, vector_to_matrix(turn))
    steps = np.diff(cycle.positions[:, root], axis=0)
    steps[:, 1] -= steps[:, 1].mean()
    repetition, frame = np.divmod(np.arange(frames), period)
    turns = vector_to_matrix(repetition[:, None] * turn)
    travel = np.einsum("lij,lj->li", turns, steps[frame])
    path = cycle.positions[0, root] + np.cumsum(travel, axis=0) - travel
    rotated = np.einsum("lij,lkj->lki", turns, offsets[frame])
    positions = np.empty((frames, cycle.skeleton.n_joints, 3))
    for joint in cycle.skeleton.topological_order:
        parent = cycle.skeleton.parents[joint]
        positions[:, joint] = path if parent < 0 else positions[:, parent] + rotated[:, joint]
    return replace(cycle, positions=positions, rotations=None, rest_offsets=None)


def _turn_about_vertical(first: np.ndarray, last: np.ndarray, root: int) -> np.ndarray:
    """Return the rotation vector about Y that best aligns the first pose with the last."""
    start, end = (
        (pose[:, 2] - pose[root, 2]) + 1j * (pose[:, 0] - pose[root, 0]) for pose in (first, last)
    )
    return np.array([0.0, np.angle((start.conj() * end).sum()), 0.0])


def _closed(cycle: Motion, turn: np.ndarray) -> np.ndarray:
    """Return offsets from parents (L, J, 3), corrected so that the last equal the rotated first."""
    skeleton, positions = cycle.skeleton, cycle.positions
    parents = np.array(skeleton.parents)
    offsets = positions - positions[:, np.maximum(parents, 0)]
    elapsed = np.arange(cycle.frames)[:, None] / (cycle.frames - 1)
    for group in _rigid_groups(skeleton):
        correction = _rotation_between(offsets[-1, group], offsets[0, group] @ turn.T)
        gradual = vector_to_matrix(elapsed * correction)
        offsets[:, group] = np.einsum("lij,lkj->lki", gradual, offsets[:, group])
    return offsets


def _rigid_groups(skeleton: Skeleton) -> list[list[int]]:
    """Return groups of joints that share a parent; at the root, the trunk is a separate group."""
    root = skeleton.roots[0]
    groups: dict[tuple[int, bool], list[int]] = {}
    for joint, parent in skeleton.bones:
        central = skeleton.mirrored_order[joint] == joint
        trunk = parent == root and central and joint in skeleton.parents
        groups.setdefault((parent, trunk), []).append(joint)
    return list(groups.values())


def _rotation_between(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the rotation vector (3,) that best aligns ``source`` with ``target``, (n, 3)."""
    if len(source) == 1:
        # Shortest rotation: a single bone does not determine the twist.
        axis = np.cross(source[0], target[0])
        sine = np.linalg.norm(axis)
        angle = np.arctan2(sine, source[0] @ target[0])
        return axis * (angle / sine if sine > 0 else 0.0)
    left, _, right = np.linalg.svd(target.T @ source)
    left[:, 2] *= np.linalg.det(left @ right)
    return matrix_to_vector(left @ right)
