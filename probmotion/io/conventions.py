"""Units and axes of motion files: conversion to metres and Y up, and checks of both."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

from probmotion.io.errors import MotionFileError, MotionFileWarning
from probmotion.motion.motion import JointTrack, Motion
from probmotion.motion.plausibility import body_size, is_mirrored, stands_along

__all__ = [
    "UNITS",
    "Z_UP_TO_Y_UP",
    "check_sides",
    "check_size",
    "check_up",
    "gaps_filled",
    "in_metres",
    "reflected",
    "y_up",
]

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
"""Metres per unit."""

Z_UP_TO_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Rotation (x, y, z) → (x, z, -y)."""

_SIZE_RANGE = (0.3, 3.0)  # metres
_TYPICAL_SIZE = 1.6


def in_metres(motion: Motion, unit: str) -> Motion:
    """Return a motion given in ``unit``, one of :data:`UNITS`, in metres."""
    scale, skeleton, offsets = UNITS[unit], motion.skeleton, motion.rest_offsets
    if skeleton.radii is not None:
        skeleton = replace(skeleton, radii=tuple(scale * radius for radius in skeleton.radii))
    return replace(
        motion,
        positions=motion.positions * scale,
        skeleton=skeleton,
        rest_offsets=None if offsets is None else offsets * scale,
    )


def y_up(motion: Motion) -> Motion:
    """Return a motion given with Z up, rotated about x to Y up."""
    rotations, offsets = motion.rotations, motion.rest_offsets
    if rotations is not None and offsets is not None:
        # Other joints are relative to their parents.
        roots = list(motion.skeleton.roots)
        rotations, offsets = rotations.copy(), offsets.copy()
        rotations[:, roots] = Z_UP_TO_Y_UP @ rotations[:, roots]
        offsets[roots] = offsets[roots] @ Z_UP_TO_Y_UP.T
    positions = motion.positions @ Z_UP_TO_Y_UP.T
    return replace(motion, positions=positions, rotations=rotations, rest_offsets=offsets)


def reflected(motion: Motion) -> Motion:
    """Return a motion given in left-handed axes, with x reflected."""
    mirror = np.diag([-1.0, 1.0, 1.0])
    rotations, offsets = motion.rotations, motion.rest_offsets
    return replace(
        motion,
        positions=motion.positions @ mirror,
        rotations=None if rotations is None else mirror @ rotations @ mirror,
        rest_offsets=None if offsets is None else offsets @ mirror,
    )


def gaps_filled(track: JointTrack) -> Motion:
    """Return a crude motion without gaps, for the checks below.

    Gaps are interpolated linearly in time; a joint never seen is the mean of its neighbours.
    """
    joints, seen, skeleton = track.joints.copy(), track.seen, track.skeleton
    known = [joint for joint in range(skeleton.n_joints) if seen[:, joint].any()]
    time = np.arange(track.frames)
    for joint in known:
        at = seen[:, joint]
        for axis in range(3):
            joints[:, joint, axis] = np.interp(time, time[at], joints[at, joint, axis])
    for joint in set(range(skeleton.n_joints)) - set(known):
        adjacent = [sum(bone) - joint for bone in skeleton.bones if joint in bone]
        neighbours = [other for other in adjacent if other in known] or known
        joints[:, joint] = joints[:, neighbours].mean(axis=1)
    return Motion(joints, skeleton, track.fps, name=track.name)


def check_size(motion: Motion, path: Path) -> None:
    """Raise unless the largest body is 0.3 to 3 m large."""
    size = body_size(motion.positions, motion.skeleton)
    least, most = _SIZE_RANGE
    if not size or least <= size <= most:
        return
    unit = min(UNITS, key=lambda name: abs(math.log(size * UNITS[name] / _TYPICAL_SIZE)))
    raise MotionFileError(
        f"{path}: bodies must be {least:g} to {most:g} m large, got {size:.4g}; pass "
        f"unit={unit!r} (--unit {unit}) if that is their unit"
    )


def check_up(motion: Motion, path: Path) -> None:
    """Raise if bodies stand along Z."""
    if stands_along(motion.positions, motion.skeleton) == 2:
        raise MotionFileError(
            f"{path}: Y must be up, got bodies that stand along Z; pass up='z' (--up z), or "
            "up='y' (--up y) if they lie down"
        )


def check_sides(motion: Motion, path: Path) -> None:
    """Warn if left joints are on a body's right."""
    if is_mirrored(motion.positions, motion.skeleton):
        warnings.warn(
            f"{path}: left joints are on the body's right, as in left-handed axes; pass "
            "mirror=True (--mirror) to reflect x",
            MotionFileWarning,
            stacklevel=3,
        )
