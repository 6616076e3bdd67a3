"""Plausibility of bodies: size, axis along which they stand, and left and right sides."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from probmotion.motion.skeleton import Skeleton

__all__ = ["body_size", "is_mirrored", "stands_along"]

_MIN_JOINTS = 5  # minimum number of joints of a body
_MAX_FRAMES = 200  # frames are sampled from longer motions
_MIN_TORSO_COMPONENT = (
    0.8  # minimum component along an axis of the direction from the feet to the top
)
_MIN_THIGH_COMPONENT = 0.5  # minimum component of the direction from the knees to the hips
_MIN_UPRIGHT_FRACTION = 0.9  # minimum fraction of upright frames
_MIN_KNEE_BEND = (
    0.02  # minimum distance of a knee from the line between hip and ankle, of the body size
)
_MIN_MIRRORED_FRACTION = 0.5  # minimum fraction of the facing vectors that indicate mirrored sides

_TOPS = ("head_top", "head", "neck", "upper_neck", "chest", "nose")
_FEET = ("ankle", "foot", "toe")
# Pairs of joints (back, front) of a foot.
_SOLES = (("ankle", "big_toe"), ("ankle", "toe"), ("ankle", "foot"), ("heel", "foot"))


def body_size(positions: np.ndarray, skeleton: Skeleton) -> float | None:
    """Return the size of the largest body; None without bodies of five joints or more.

    The size is the median over frames of the largest distance between two joints.
    """
    sizes = []
    for joints, _ in _bodies(positions, skeleton):
        squares = [((pose[:, None] - pose) ** 2).sum(axis=-1).max() for pose in joints]
        sizes.append(float(np.sqrt(np.median(squares))))
    return max(sizes, default=None)


def stands_along(positions: np.ndarray, skeleton: Skeleton) -> int | None:
    """Return the axis, 0 to 2, along which every body stands with its head in +axis; else None.

    A body stands along an axis if the direction from its feet to its head, or neck or chest, is
    within 37° of the axis, and its thighs within 60°, in nine of ten frames. It may also lie
    stretched. Quadrupeds do not count.
    """
    axes = set()
    for joints, names in _upright_bodies(positions, skeleton):
        top = next((joints[:, names.index(name)] for name in _TOPS if name in names), None)
        limbs = [_sides(joints, names, parts) for parts in (_FEET, ("knee",), ("hip",))]
        feet, knees, hips = (None if limb is None else limb.mean(axis=0) for limb in limbs)
        if top is None or feet is None or knees is None or hips is None:
            return None
        upright = (_unit(top - feet) > _MIN_TORSO_COMPONENT) & (
            _unit(hips - knees) > _MIN_THIGH_COMPONENT
        )
        upright = upright.mean(axis=0)
        axes.add(int(upright.argmax()) if upright.max() >= _MIN_UPRIGHT_FRACTION else None)
    return axes.pop() if len(axes) == 1 else None


def is_mirrored(positions: np.ndarray, skeleton: Skeleton) -> bool:
    """Return whether the left joints of a body are on its right.

    A body faces in the direction of its feet or, without joints of the feet, of its bent knees.
    Quadrupeds do not count.
    """
    return any(
        _has_swapped_sides(joints, names) for joints, names in _upright_bodies(positions, skeleton)
    )


def _has_swapped_sides(joints: np.ndarray, names: Sequence[str]) -> bool:
    hips = _sides(joints, names, ("hip",))
    top = next((joints[:, names.index(name)] for name in ("neck", "chest") if name in names), None)
    ahead = _facing(joints, names)
    if hips is None or top is None or ahead is None:
        return False
    up, left = top - hips.mean(axis=0), hips[0] - hips[1]
    agreement = (np.cross(_unit(up), ahead) * _unit(left)).sum(axis=-1)
    total = np.linalg.norm(ahead, axis=-1).sum()
    return bool(agreement.sum() < -_MIN_MIRRORED_FRACTION * total)


def _facing(joints: np.ndarray, names: Sequence[str]) -> np.ndarray | None:
    """Return the direction in which a body faces, (L, 3); None if unknown."""
    for back, front in _SOLES:
        soles = [_sides(joints, names, (part,)) for part in (back, front)]
        if soles[0] is not None and soles[1] is not None:
            return (soles[1] - soles[0]).sum(axis=0)
    hip, knee, ankle = (_sides(joints, names, (part,)) for part in ("hip", "knee", "ankle"))
    if hip is None or knee is None or ankle is None:
        return None
    shin = _unit(ankle - hip)
    bend = knee - hip
    bend = bend - (bend * shin).sum(axis=-1, keepdims=True) * shin
    length = float(np.linalg.norm(ankle - hip, axis=-1).mean())
    if np.linalg.norm(bend, axis=-1).mean() < _MIN_KNEE_BEND * length:
        return None
    return bend.sum(axis=0)


def _sides(joints: np.ndarray, names: Sequence[str], parts: Sequence[str]) -> np.ndarray | None:
    """Return the left and right joints of the first of ``parts`` that exists, (2, L, 3)."""
    for part in parts:
        pair = [f"left_{part}", f"right_{part}"]
        if {*pair} <= {*names}:
            return np.stack([joints[:, names.index(name)] for name in pair])
    return None


def _upright_bodies(
    positions: np.ndarray, skeleton: Skeleton
) -> Iterator[tuple[np.ndarray, tuple[str, ...]]]:
    """Yield the bodies that are not quadrupeds."""
    for joints, names in _bodies(positions, skeleton):
        if not any(name == "tail" or name.endswith("paw") for name in names):
            yield joints, names


def _bodies(
    positions: np.ndarray, skeleton: Skeleton
) -> Iterator[tuple[np.ndarray, tuple[str, ...]]]:
    """Yield the positions and canonical joint names of every body."""
    some = positions[:: -(-len(positions) // _MAX_FRAMES)]
    for root in skeleton.roots:
        joints = [j for j in range(skeleton.n_joints) if j == root or root in skeleton.ancestors(j)]
        if len(joints) >= _MIN_JOINTS:
            yield some[:, joints], skeleton.subset(joints).canonical_names


def _unit(vectors: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0, length, 1.0)
