"""One cycle of a periodic motion, repeated for as long as wanted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from probmotion.geometry.rotations import matrix_to_vector, vector_to_matrix
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count

__all__ = ["repeated_cycle"]


def repeated_cycle(cycle: Motion, frames: int) -> Motion:
    """Return a cycle of a periodic motion, repeated to a number of frames.

    The last frame of a cycle is the first of the next, moved along and turned about the vertical
    as the root was from the cycle's beginning to its end. What the pose misses of that is made up
    for evenly over the cycle, every joint turning what hangs from it as one rigid piece (at the
    root, the trunk on its own): bones keep their lengths.

    Parameters
    ----------
    cycle : Motion
        At least three frames of one body.
    frames : int
        Frames of the result.

    Raises
    ------
    ValueError
        If there are fewer than three frames, or several roots.
    """
    check_count("frames", frames)
    if len(cycle.skeleton.roots) != 1:
        raise ValueError(f"cycle has {len(cycle.skeleton.roots)} roots, expected one body")
    if cycle.frames < 3:
        raise ValueError(f"cycle has {cycle.frames} frames, expected at least 3")
    period = cycle.frames - 1
    root = cycle.skeleton.roots[0]
    turn = _turn_about_vertical(cycle.positions[0], cycle.positions[-1], root)
    offsets = _closed(cycle, vector_to_matrix(turn))
    steps = np.diff(cycle.positions[:, root], axis=0)
    steps[:, 1] -= steps[:, 1].mean()
    number, frame = np.divmod(np.arange(frames), period)
    turns = vector_to_matrix(number[:, None] * turn)
    travel = np.einsum("lij,lj->li", turns, steps[frame])
    path = cycle.positions[0, root] + np.cumsum(travel, axis=0) - travel
    along = np.einsum("lij,lkj->lki", turns, offsets[frame])
    positions = np.empty((frames, cycle.skeleton.n_joints, 3))
    for joint in cycle.skeleton.topological_order:
        parent = cycle.skeleton.parents[joint]
        positions[:, joint] = path if parent < 0 else positions[:, parent] + along[:, joint]
    return replace(cycle, positions=positions, rotations=None, rest_offsets=None)


def _turn_about_vertical(first: np.ndarray, last: np.ndarray, root: int) -> np.ndarray:
    """Return the rotation vector about Y that brings the first pose nearest the last, (3,)."""
    start, end = (
        (pose[:, 2] - pose[root, 2]) + 1j * (pose[:, 0] - pose[root, 0]) for pose in (first, last)
    )
    return np.array([0.0, np.angle((start.conj() * end).sum()), 0.0])


def _closed(cycle: Motion, turn: np.ndarray) -> np.ndarray:
    """Return the joints' offsets, (L, J, 3), whose last frame is the first, turned."""
    skeleton, positions = cycle.skeleton, cycle.positions
    parents = np.array(skeleton.parents)
    offsets = positions - positions[:, np.maximum(parents, 0)]
    elapsed = np.arange(cycle.frames)[:, None] / (cycle.frames - 1)
    for piece in _rigid_pieces(skeleton):
        missing = _rotation_between(offsets[-1, piece], offsets[0, piece] @ turn.T)
        even = vector_to_matrix(elapsed * missing)
        offsets[:, piece] = np.einsum("lij,lkj->lki", even, offsets[:, piece])
    return offsets


def _rigid_pieces(skeleton: Skeleton) -> list[list[int]]:
    """Return the joints by what turns them: the parent, or the trunk where that is the root."""
    root = skeleton.roots[0]
    pieces: dict[tuple[int, bool], list[int]] = {}
    for joint, parent in skeleton.bones:
        central = skeleton.mirrored_order[joint] == joint
        trunk = parent == root and central and joint in skeleton.parents
        pieces.setdefault((parent, trunk), []).append(joint)
    return list(pieces.values())


def _rotation_between(some: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the rotation vector that turns vectors nearest to others, (n, 3), (n, 3) → (3,)."""
    if len(some) == 1:
        # The shortest turn: a single bone says nothing about twist.
        axis = np.cross(some[0], others[0])
        sine = np.linalg.norm(axis)
        angle = np.arctan2(sine, some[0] @ others[0])
        return axis * (angle / sine if sine > 0 else 0.0)
    left, _, right = np.linalg.svd(others.T @ some)
    left[:, 2] *= np.linalg.det(left @ right)
    return matrix_to_vector(left @ right)
