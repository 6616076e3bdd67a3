"""How far joints turn: soft ranges of rotation vectors, by what a joint is called.

The numbers are ours: round values wide enough for motion capture of walks, dances and jumps and
for trotting dogs, so that what they forbid is a body bent the wrong way. They are no anatomy.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

__all__ = ["range_of"]

Box = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
"""Least and greatest X, Y and Z of a rotation vector, radians, for the left side of the body."""

_UNKNOWN: Box = ((-1.2, 1.2), (-1.2, 1.2), (-1.2, 1.2))
# About X, positive is to swing what hangs down backwards, and to bow what stands up. About Z,
# positive is to lift a left limb that hangs down sideways.
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
_SAME = {
    "lower_spine": "spine",
    "chest": "spine",
    "upper_neck": "neck",
    "lower_neck": "neck",
    "head": "neck",
    "nose": "neck",
    "palm": "wrist",
    "foot": "ankle",
}
# A hinge: where along Z people's lower limb goes, and how far it bends from straight.
_HINGES: Mapping[str, tuple[float, float]] = {"knee": (-1.0, 2.7), "elbow": (1.0, 2.7)}
_SIDEWAYS = 0.5
"""Radians that a hinge turns about what is square to its axis: it also takes up errors."""
_IN_LINE = 0.15
"""Radians below which two bones are in line: mean poses from 2D are no more exact than that."""


def range_of(
    name: str, animal: bool, above: np.ndarray, below: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the greatest rotation vector of a joint, (3,) each, radians.

    Rotation vectors are from the rest pose. A knee or an elbow is a hinge: its axis is square to
    the two bones that meet there, and it turns back until they are in line and no further. Where
    the rest pose has them in line, the axis is square to them and to Z, as X is to what hangs down:
    people's shins then go backwards, their forearms forwards. Animals' go both ways, since names
    do not tell their elbows and knees from wrists and hocks.

    Parameters
    ----------
    name : str
        Canonical, ``left_knee``; right ones have the mirror image of the left ones' range. Others
        than the table has may turn 1.2 radians about every axis.
    animal : bool
        Four-legged.
    above, below : ndarray, (3,)
        The bone that ends at the joint and the one that begins there, in the rest pose. The body
        looks along +Z, +X is its left.
    """
    part = name.removeprefix("left_").removeprefix("right_")
    if part in _HINGES:
        return _hinge(part, animal, above, below)
    table = _ANIMALS if animal else _PEOPLE
    lower, upper = np.array(table.get(_SAME.get(part, part), _UNKNOWN)).T
    if name.startswith("right_"):
        # The mirror image of (x, y, z) is (x, −y, −z).
        lower, upper = np.array([lower[0], *-upper[1:]]), np.array([upper[0], *-lower[1:]])
    return lower, upper


def _hinge(
    part: str, animal: bool, above: np.ndarray, below: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    way, far = _HINGES[part]
    across = np.cross(above, below)
    # Positive turns about the axis bend the hinge more; −bent is where it is straight.
    bent = float(np.arctan2(np.linalg.norm(across), above @ below))
    least = -bent
    if bent > _IN_LINE:
        axis = across / np.linalg.norm(across)
    else:
        axis = np.cross(above, [0.0, 0.0, way])
        size = float(np.linalg.norm(axis))
        # Of what points along Z itself, up is the way of an elbow.
        alone = size < _IN_LINE * np.linalg.norm(above)
        axis = np.array([-way, 0.0, 0.0]) if alone else axis / size
        bent = float(np.arctan2(across @ axis, above @ below))
        least = -bent - far if animal else -bent
    ends = np.stack([least * axis, (far - bent) * axis])
    spare = _SIDEWAYS * np.sqrt(np.maximum(0.0, 1 - axis**2))
    return ends.min(axis=0) - spare, ends.max(axis=0) + spare
