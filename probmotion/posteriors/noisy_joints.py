"""A user's recording of 3D joints as evidence for a prior: every doubt about it is said."""

from __future__ import annotations

import math
import warnings

import numpy as np

from probmotion.motion.occlusion import joints_at_rate, joints_on_skeleton
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.likelihoods import Joints3D
from probmotion.posteriors.protocols import MotionPrior
from probmotion.validation import check_count, check_finite, check_positive, check_shape

__all__ = ["noisy_joints"]

# Mean cosine with an axis from which a body is thought to stand along it.
_UPRIGHT = 0.8
_SIZES = (0.5, 3.0)
"""Metres, the longest chain of bones. A person of ``person14`` has .95 (a child of three .5) from
the pelvis to an ankle and 1.15 to a wrist; a joint more or less at the ends changes little."""
_UNITS = {"millimetres": 0.001, "centimetres": 0.01, "inches": 0.0254, "kilometres": 1000.0}
_LOW, _FAR = 0.05, 0.5
"""The share of frames whose lowest joints may be noise, and metres from the floor that are far."""
_SAME_RATE = 5e-4
"""Of the rate: files round frame times (0.0333 s), but 29.97 and 30 a second are two rates."""


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
    """Return what a recording says to a prior: its joints, on its skeleton and at its rate.

    A joint that is NaN is hidden. Nothing is moved, rescaled, filled in or, unasked, resampled:
    where the prior knows a floor, as a Motion-DVAE does at Y = 0, the recording's has to be there.

    Parameters
    ----------
    joints : ndarray, (L, J, 3)
        Metres, Y up. NaN where a joint was not seen.
    skeleton : Skeleton
        Whose joints they are; see
        :func:`~probmotion.motion.occlusion.joints_on_skeleton` for one that is not the prior's.
    fps : float
        Frames per second.
    prior : MotionPrior
        Its ``skeleton``, ``fps`` and ``frames`` are what the evidence is made for; the recording
        may be longer than ``frames``.
    noise : float
        Standard deviation (Student-t: scale) of a coordinate of confidence 1, metres.
    confidence : ndarray, (L, J), optional
        Multiplies the precision; 0 hides a joint; 1 by default.
    degrees_of_freedom : float, optional
        Student-t noise with this many; Gaussian by default.
    resample : bool
        Bring a recording of another rate to the prior's, by
        :func:`~probmotion.motion.occlusion.joints_at_rate`.
    longest_gap : int, optional
        Frames, at the prior's rate, for which no joint at all may be seen are fewer than this; by
        default the window of the prior's networks where it has such, else its ``frames``.

    Returns
    -------
    Joints3D
        With the prior's skeleton and rate.

    Warns
    -----
    UserWarning
        If no joint is seen in some frames, the body is of no size in metres, or it is and the
        noise is above a metre or the lowest joints are far from the prior's floor, or the body
        stands along another axis than Y.

    Raises
    ------
    ValueError
        If a joint is infinite or NaN in some coordinates only, no joint is seen for
        ``longest_gap`` frames, the rate is another and ``resample`` is not asked for, the prior's
        skeleton has a joint that cannot be taken from the recording, or a shape, a number or a
        type does not fit.
    """
    for name, value, kind in (("skeleton", skeleton, Skeleton), ("prior", prior, MotionPrior)):
        if not isinstance(value, kind):
            raise ValueError(f"{name} must be a {kind.__name__}, got {type(value).__name__}")
    check_positive("noise", noise)
    joints = np.asarray(joints, dtype=np.float64)
    check_shape("joints", joints, ("L", skeleton.n_joints, 3))
    if len(joints) == 0:
        raise ValueError("joints has no frame, expected at least one")
    check_positive("fps", fps)
    seen = _seen_joints(joints, skeleton)
    weight = np.ones(seen.shape) if confidence is None else np.array(confidence, dtype=np.float64)
    check_shape("confidence", weight, seen.shape)
    check_finite("confidence", weight)
    if weight.min() < 0:
        raise ValueError(f"confidence is {weight.min():g} at its least, expected 0 or more")
    weight = np.where(seen, weight, 0.0)
    joints, weight = joints_on_skeleton(joints, weight, skeleton, prior.skeleton)
    if abs(fps - prior.fps) > _SAME_RATE * prior.fps:
        if not resample:
            raise ValueError(
                f"fps is {fps:g}, expected {prior.fps:g}, the prior's; give resample=True to "
                "interpolate the joints linearly in time"
            )
        joints, weight = joints_at_rate(joints, weight, fps, prior.fps)
    window = getattr(getattr(prior, "settings", None), "frames", prior.frames)
    gap = window if longest_gap is None else longest_gap
    check_count("longest_gap", gap)
    _check_frames(weight, gap)
    if _check_size(joints, weight, prior.skeleton):
        _check_noise(noise)
        _check_floor(joints, weight, getattr(prior, "floor", None))
    _check_upright(joints, weight, prior.skeleton)
    return Joints3D(joints, noise, weight, degrees_of_freedom, prior.skeleton, prior.fps)


def _seen_joints(joints: np.ndarray, skeleton: Skeleton) -> np.ndarray:
    """Return which joints are seen (L, J); one that is infinite or partly NaN is an error."""
    unknown = np.isnan(joints)
    for problem, where in (
        ("is infinite", np.isinf(joints).any(axis=-1)),
        ("is NaN in some coordinates but not in all", unknown.any(-1) & ~unknown.all(-1)),
    ):
        if where.any():
            frame, joint = np.argwhere(where)[0]
            raise ValueError(
                f"joints {problem} at frame {frame}, joint {joint} "
                f"({skeleton.joint_names[joint]}), expected three finite numbers, or three NaN for "
                "a joint that is hidden"
            )
    return ~unknown.any(axis=-1)


def _check_frames(confidence: np.ndarray, longest_gap: int) -> None:
    """Warn of frames without a joint; raise where there are as many as a window in a row."""
    empty = np.logical_not((confidence > 0).any(axis=1))
    frames = len(confidence)
    if empty.all():
        raise ValueError("joints are hidden in every frame, expected some to be seen")
    edges = np.flatnonzero(np.diff(empty, prepend=False, append=False)).reshape(-1, 2)
    for start, stop in edges.tolist():
        if stop - start >= longest_gap:
            raise ValueError(
                f"joints are all hidden in the {stop - start} frames from frame {start}, expected "
                f"one to be seen in any {longest_gap} frames"
            )
    if empty.any():
        warnings.warn(
            f"joints are all hidden in {empty.sum()} of {frames} frames, where the prior "
            "alone says what the motion is",
            stacklevel=3,
        )


def _check_size(joints: np.ndarray, confidence: np.ndarray, skeleton: Skeleton) -> bool:
    """Warn, and return False, if the longest chain of bones has no size of a body in metres."""
    size = _longest_chain(joints, confidence, skeleton)
    if size is None or _SIZES[0] <= size <= _SIZES[1]:
        return True
    middle = math.sqrt(_SIZES[0] * _SIZES[1])
    if size == 0:
        raise ValueError("joints are all in one place, expected the joints of a body")
    unit = min(_UNITS, key=lambda name: abs(math.log(size * _UNITS[name] / middle)))
    guess = f"; are these {unit}?" if _SIZES[0] <= size * _UNITS[unit] <= _SIZES[1] else ""
    warnings.warn(
        f"joints has a body whose longest chain of bones is {size:.4g} long, which is no size in "
        f"metres{guess}",
        stacklevel=3,
    )
    return False


def _check_noise(noise: float) -> None:
    """Warn if noise is in another unit than the joints, which are in metres."""
    if noise > 1:
        warnings.warn(
            f"noise is {noise:g} m, more than a body is wide; is it in metres, as the joints are?",
            stacklevel=3,
        )


def _check_floor(joints: np.ndarray, confidence: np.ndarray, floor: float | None) -> None:
    """Warn if no foot comes near the prior's floor; a lowest joint may be an ankle or a knee."""
    if floor is None:
        return
    heights = np.where(confidence > 0, joints[..., 1], np.inf).min(axis=1)
    lowest = np.quantile(heights[np.isfinite(heights)], _LOW)
    if abs(lowest - floor) > _FAR:
        warnings.warn(
            f"the lowest joints are at {lowest:.2g} m, and the prior's floor is at {floor:g}; is "
            f"the world's Y up, its floor at {floor:g}?",
            stacklevel=3,
        )


def _check_upright(joints: np.ndarray, confidence: np.ndarray, skeleton: Skeleton) -> None:
    """Warn if the neck is along another axis from the ankles than Y, all the time."""
    names = skeleton.canonical_names
    if not {"neck", "left_ankle", "right_ankle"} <= set(names):
        return
    neck, *ankles = (names.index(name) for name in ("neck", "left_ankle", "right_ankle"))
    seen = (confidence[:, [neck, *ankles]] > 0).all(axis=1)
    if not seen.any():
        return
    bodies = joints[seen, neck] - joints[seen][:, ankles].mean(axis=1)
    size = np.linalg.norm(bodies, axis=-1, keepdims=True)
    along = (bodies / np.where(size > 0, size, 1.0)).mean(axis=0)
    axis = int(np.abs(along).argmax())
    if abs(along[axis]) > _UPRIGHT and not (axis == 1 and along[1] > 0):
        sign = "" if along[axis] > 0 else "-"
        warnings.warn(
            f"joints has a body that stands along {sign}{'XYZ'[axis]}, expected Y to be up; does "
            "it lie?",
            stacklevel=3,
        )


def _longest_chain(joints: np.ndarray, confidence: np.ndarray, skeleton: Skeleton) -> float | None:
    """Return the largest sum of median bone lengths from a root down, None if no bone is seen."""
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
            bones = np.linalg.norm(joints[seen, joint] - joints[seen, parent], axis=-1)
            length[joint] += np.median(bones)
    return float(length.max()) if any_seen else None
