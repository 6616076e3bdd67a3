"""Likelihood of a recording of 3D joints, with checks of units, axes and gaps."""

from __future__ import annotations

import math
import warnings

import numpy as np

from probmotion.motion.occlusion import joints_at_rate, joints_on_skeleton
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.likelihoods import Joints3D, entry_noise
from probmotion.posteriors.protocols import MotionPrior
from probmotion.validation import check_count, check_positive, check_shape

__all__ = ["noisy_joints"]

# Minimum component of the mean direction along an axis of a body that is aligned with the axis.
_UPRIGHT = 0.8
# Plausible lengths of the longest chain of bones, metres; pelvis to ankle is 0.5 for a
# three-year-old, pelvis to wrist 1.15 for an adult.
_SIZES = (0.5, 3.0)
_UNITS = {"millimetres": 0.001, "centimetres": 0.01, "inches": 0.0254, "kilometres": 1000.0}
# Quantile over frames of the lowest joint's height; its maximum distance from the floor, metres.
_LOW, _FAR = 0.05, 0.5
# Relative tolerance: accepts rounded frame times (0.03333 s), but separates 29.97 and 30 fps.
_SAME_RATE = 5e-4


def noisy_joints(
    joints: np.ndarray,
    skeleton: Skeleton,
    fps: float,
    *,
    prior: MotionPrior,
    noise: float,
    confidence: np.ndarray | None = None,
    degrees_of_freedom: float | None = None,
    resample: bool = False,
    longest_gap: int | None = None,
) -> Joints3D:
    """Return the likelihood of recorded joints, with the prior's skeleton and frame rate.

    NaN joints count as occluded. Joints are never translated or rescaled, and only resampled on
    request. The floor of the prior, if any (Motion-DVAE: Y = 0), should be that of the recording.

    Parameters
    ----------
    joints : ndarray, (L, J, 3)
        Metres, Y up; NaN where a joint was not observed.
    skeleton : Skeleton
        Skeleton of the joints, mapped to the prior's by
        :func:`~probmotion.motion.occlusion.joints_on_skeleton`.
    fps : float
        Frames per second.
    prior : MotionPrior
        Prior with the target ``skeleton`` and ``fps``; the recording may have more frames.
    noise : float
        Standard deviation (Student-t: scale) of a coordinate of confidence 1, metres.
    confidence : ndarray, (L, J), optional
        Multiplier of the precision, 1 by default; 0 marks an occluded joint.
    degrees_of_freedom : float, optional
        Degrees of freedom of Student-t noise; Gaussian by default.
    resample : bool
        Resample to the prior's frame rate with :func:`~probmotion.motion.occlusion.joints_at_rate`.
    longest_gap : int, optional
        Least number of consecutive fully occluded frames, at the prior's rate, to reject; by
        default the window of the prior's networks or, without networks, its ``frames``.

    Warns
    -----
    UserWarning
        If frames are fully occluded, or unit, noise, floor or up axis look implausible.

    Raises
    ------
    ValueError
        If a joint is infinite or partly NaN, all joints are occluded for ``longest_gap`` frames,
        the frame rate differs without ``resample``, the skeleton lacks a joint of the prior, or
        an argument is invalid.
    """
    for name, value, kind in (("skeleton", skeleton, Skeleton), ("prior", prior, MotionPrior)):
        if not isinstance(value, kind):
            raise ValueError(f"{name} must be a {kind.__name__}, got {type(value).__name__}")
    joints = np.asarray(joints, dtype=np.float64)
    check_shape("joints", joints, ("L", skeleton.n_joints, 3))
    if len(joints) == 0:
        raise ValueError("joints must have at least one frame, got 0")
    check_positive("fps", fps)
    seen = _observed(joints, skeleton)
    entries = entry_noise(noise, confidence, degrees_of_freedom, seen.shape)
    weight = np.where(seen, entries.confidence, 0.0)
    joints, weight = joints_on_skeleton(joints, weight, skeleton, prior.skeleton)
    if abs(fps - prior.fps) > _SAME_RATE * prior.fps:
        if not resample:
            raise ValueError(
                f"fps must be the prior's {prior.fps:g}, got {fps:g}; pass resample=True to "
                "interpolate linearly in time"
            )
        joints, weight = joints_at_rate(joints, weight, fps, prior.fps)
    if longest_gap is None:
        longest_gap = getattr(getattr(prior, "settings", None), "frames", prior.frames)
    check_count("longest_gap", longest_gap)
    _check_frames(weight, longest_gap)
    if _plausible_size(joints, weight, prior.skeleton):
        if noise > 1:
            warnings.warn(
                f"noise is {noise:g} m, larger than a body; is it in metres?", stacklevel=2
            )
        floor = getattr(prior, "floor", None)
        if floor is not None:
            _check_floor(joints, weight, floor)
    _check_upright(joints, weight, prior.skeleton)
    return Joints3D(joints, noise, weight, degrees_of_freedom, prior.skeleton, prior.fps)


def _observed(joints: np.ndarray, skeleton: Skeleton) -> np.ndarray:
    """Return the mask of observed joints (L, J); raise if one is infinite or partly NaN."""
    unknown = np.isnan(joints)
    infinite = np.isinf(joints).any(axis=-1)
    invalid = infinite | (unknown.any(axis=-1) & ~unknown.all(axis=-1))
    if invalid.any():
        frame, joint = np.argwhere(invalid)[0]
        got = "infinite values" if infinite[frame, joint] else "NaN in only some coordinates"
        raise ValueError(
            f"joints must be finite, or all NaN where occluded, got {got} at frame {frame}, joint "
            f"{joint} ({skeleton.joint_names[joint]})"
        )
    return ~unknown.any(axis=-1)


def _check_frames(confidence: np.ndarray, longest_gap: int) -> None:
    """Warn about fully occluded frames; raise if ``longest_gap`` of them are consecutive."""
    occluded = ~(confidence > 0).any(axis=1)
    if occluded.all():
        raise ValueError("joints must be observed in at least one frame, got none")
    edges = np.flatnonzero(np.diff(occluded, prepend=False, append=False)).reshape(-1, 2)
    for start, stop in edges.tolist():
        if stop - start >= longest_gap:
            raise ValueError(
                f"joints must be observed once in any {longest_gap} consecutive frames, got none "
                f"in the {stop - start} frames from frame {start}"
            )
    if occluded.any():
        warnings.warn(
            f"all joints are occluded in {occluded.sum()} of {len(confidence)} frames; only the "
            "prior constrains them",
            stacklevel=3,
        )


def _plausible_size(joints: np.ndarray, confidence: np.ndarray, skeleton: Skeleton) -> bool:
    """Warn and return False if the longest chain of bones is implausible in metres."""
    size = _longest_chain(joints, confidence, skeleton)
    least, most = _SIZES
    if size is None or least <= size <= most:
        return True
    if size == 0:
        raise ValueError("joints must be distinct, got all joints at one point")
    middle = math.sqrt(least * most)
    unit = min(_UNITS, key=lambda name: abs(math.log(size * _UNITS[name] / middle)))
    guess = f"; are these {unit}?" if least <= size * _UNITS[unit] <= most else ""
    warnings.warn(
        f"the longest chain of bones is {size:.4g} long, implausible in metres{guess}",
        stacklevel=3,
    )
    return False


def _check_floor(joints: np.ndarray, confidence: np.ndarray, floor: float) -> None:
    """Warn if the lowest joints (feet, or knees if feet are occluded) are far from the floor."""
    heights = np.where(confidence > 0, joints[..., 1], np.inf).min(axis=1)
    lowest = np.quantile(heights[np.isfinite(heights)], _LOW)
    if abs(lowest - floor) > _FAR:
        warnings.warn(
            f"the lowest joints are at {lowest:.2g} m, far from the prior's floor at {floor:g}; is "
            "Y up and the floor at that height?",
            stacklevel=3,
        )


def _check_upright(joints: np.ndarray, confidence: np.ndarray, skeleton: Skeleton) -> None:
    """Warn if the body's mean direction is aligned with an axis other than +Y."""
    names = skeleton.canonical_names
    if not {"neck", "left_ankle", "right_ankle"} <= set(names):
        return
    neck, *ankles = (names.index(name) for name in ("neck", "left_ankle", "right_ankle"))
    seen = (confidence[:, [neck, *ankles]] > 0).all(axis=1)
    if not seen.any():
        return
    bodies = joints[seen, neck] - joints[seen][:, ankles].mean(axis=1)
    size = np.linalg.norm(bodies, axis=-1, keepdims=True)
    direction = (bodies / np.where(size > 0, size, 1.0)).mean(axis=0)
    axis = int(np.abs(direction).argmax())
    if abs(direction[axis]) > _UPRIGHT and not (axis == 1 and direction[1] > 0):
        sign = "" if direction[axis] > 0 else "-"
        warnings.warn(
            f"the body is aligned with {sign}{'XYZ'[axis]}, but Y must be up; is it lying down?",
            stacklevel=3,
        )


def _longest_chain(joints: np.ndarray, confidence: np.ndarray, skeleton: Skeleton) -> float | None:
    """Return the largest sum of median bone lengths from a root; None if no bone is observed."""
    length = np.zeros(skeleton.n_joints)
    any_seen = False
    for joint in skeleton.topological_order:
        parent = skeleton.parents[joint]
        if parent < 0:
            continue
        seen = (confidence[:, [joint, parent]] > 0).all(axis=1)
        length[joint] = length[parent]
        if seen.any():
            any_seen = True
            bones = joints[seen, joint] - joints[seen, parent]
            length[joint] += np.median(np.linalg.norm(bones, axis=-1))
    return float(length.max()) if any_seen else None
