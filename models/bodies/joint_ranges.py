"""Soft joint-rotation limits, looked up by joint name.

The limits are hand-chosen, not anatomical: round numbers, wide enough for motion capture of walks,
dances and jumps and of trotting dogs. They exclude joints that bend the wrong way.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

__all__ = ["range_of"]

Box = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
"""Minimum and maximum X, Y and Z of a rotation vector, radians, for joints on the left side."""

_UNKNOWN: Box = ((-1.2, 1.2), (-1.2, 1.2), (-1.2, 1.2))  # For joints without an entry.
# Positive X swings a hanging limb backwards and bows an upright trunk. Positive Z lifts a hanging
# left limb sideways.
_PEOPLE: Mapping[str, Box] = {
    "trunk": ((-0.8, 1.5), (-0.9, 0.9), (-0.8, 0.8)),
    "spine": ((-0.8, 1.2), (-0.8, 0.8), (-0.7, 0.7)),
    "neck": ((-0.9, 1.0), (-1.2, 1.2), (-0.8, 0.8)),
    "collar": ((-0.6, 0.6), (-0.7, 0.7), (-0.6, 0.8)),
    "shoulder": ((-2.8, 1.3), (-1.6, 1.6), (-1.2, 2.6)),
    "hip": ((-2.2, 1.1), (-1.0, 1.0), (-0.7, 1.3)),
    "ankle": ((-1.0, 1.0), (-0.7, 0.7), (-0.7, 0.7)),
    "wrist": ((-1.2, 1.2), (-1.0, 1.0), (-1.2, 1.2)),
}
_ANIMALS: Mapping[str, Box] = {
    "trunk": ((-0.8, 0.8), (-0.8, 0.8), (-0.5, 0.5)),
    "spine": ((-0.8, 0.8), (-0.8, 0.8), (-0.5, 0.5)),
    "neck": ((-1.2, 1.2), (-1.2, 1.2), (-0.8, 0.8)),
    "shoulder": ((-1.4, 1.4), (-0.5, 0.5), (-0.6, 0.8)),
    "hip": ((-1.4, 1.4), (-0.5, 0.5), (-0.6, 0.8)),
    "ankle": ((-1.5, 1.5), (-0.5, 0.5), (-0.5, 0.5)),
    "wrist": ((-1.8, 1.8), (-0.5, 0.5), (-0.5, 0.5)),
}
_SAME_LIMITS = {  # Joints with the limits of another joint.
    "lower_spine": "spine", "chest": "spine", "upper_neck": "neck", "lower_neck": "neck",
    "head": "neck", "nose": "neck", "palm": "wrist", "foot": "ankle",
}  # fmt: skip
# Hinges: sign of the Z direction in which human limbs bend, and maximum flexion in radians.
_HINGES: Mapping[str, tuple[float, float]] = {"knee": (-1.0, 2.7), "elbow": (1.0, 2.7)}
_HINGE_TOLERANCE = 0.5
"""Tolerance of a hinge about directions perpendicular to its axis, radians."""
_COLLINEAR_ANGLE = 0.15
"""Angle below which two bones count as collinear, radians: the accuracy of poses from 2D."""


def range_of(
    name: str, animal: bool, above: np.ndarray, below: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the minimum and maximum rotation vector of a joint from the rest pose, (3,), radians.

    A knee or elbow is a hinge whose axis is perpendicular to its two bones; it extends until they
    are collinear. If they are collinear in the rest pose, the axis is perpendicular to them and Z
    (the X axis for a hanging limb): human shins then bend backwards and human forearms forwards.
    Animal limbs bend both ways, because the joint names of animals do not distinguish elbows and
    knees from wrists and hocks.

    ``name`` is canonical, e.g. ``left_knee``; right joints have the mirrored limits of left ones.
    Joints without an entry may rotate 1.2 radians about every axis. ``above`` and ``below`` are the
    bones that end and begin at the joint in the rest pose; the body faces +Z and its left is +X.
    """
    part = name.removeprefix("left_").removeprefix("right_")
    if part in _HINGES:
        return _hinge(part, animal, above, below)
    table = _ANIMALS if animal else _PEOPLE
    lower, upper = np.array(table.get(_SAME_LIMITS.get(part, part), _UNKNOWN)).T
    if name.startswith("right_"):
        # A rotation vector (x, y, z) is mirrored to (x, −y, −z).
        lower, upper = np.array([lower[0], *-upper[1:]]), np.array([upper[0], *-lower[1:]])
    return lower, upper


def _hinge(
    part: str, animal: bool, above: np.ndarray, below: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    direction, max_flexion = _HINGES[part]
    across = np.cross(above, below)
    # Positive rotations about the axis bend the hinge further; it is straight at −bent.
    bent = float(np.arctan2(np.linalg.norm(across), above @ below))
    min_angle = -bent
    if bent > _COLLINEAR_ANGLE:
        axis = across / np.linalg.norm(across)
    else:
        axis = np.cross(above, [0.0, 0.0, direction])
        size = float(np.linalg.norm(axis))
        # For bones along Z the direction is ambiguous: elbows bend upwards.
        ambiguous = size < _COLLINEAR_ANGLE * np.linalg.norm(above)
        axis = np.array([-direction, 0.0, 0.0]) if ambiguous else axis / size
        bent = float(np.arctan2(across @ axis, above @ below))
        min_angle = -bent - max_flexion if animal else -bent
    ends = np.stack([min_angle * axis, (max_flexion - bent) * axis])
    tolerance = _HINGE_TOLERANCE * np.sqrt(np.maximum(0.0, 1 - axis**2))
    return ends.min(axis=0) - tolerance, ends.max(axis=0) + tolerance
