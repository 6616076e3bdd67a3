"""Retargeting and resampling of joint positions with occlusion.

:class:`~probmotion.motion.motion.Motion` does not accept NaN. These functions replace its methods
``retarget`` and ``resample`` for arrays with occluded joints.
"""

from __future__ import annotations

import numpy as np

from probmotion.motion.resampling import resample
from probmotion.motion.retargeting import counterpart
from probmotion.motion.skeleton import Skeleton

__all__ = ["joints_at_rate", "joints_on_skeleton"]

_MIDPOINTS = {"pelvis": ("left_hip", "right_hip"), "neck": ("left_shoulder", "right_shoulder")}


def joints_on_skeleton(
    joints: np.ndarray, confidence: np.ndarray, source: Skeleton, target: Skeleton
) -> tuple[np.ndarray, np.ndarray]:
    """Retarget joints to another skeleton by their own names, else by canonical names.

    The midpoint of the hips replaces a missing ``pelvis``, the midpoint of the shoulders a missing
    ``neck``. Joints a and b of confidences w have precisions w/σ², so their midpoint has confidence
    4 w_a w_b / (w_a + w_b), or 0 if a or b is occluded. Error correlations are ignored.

    Parameters
    ----------
    joints : ndarray, (L, J, 3)
        Joint positions, metres; NaN where occluded.
    confidence : ndarray, (L, J)
        Confidence of each joint, 0 where occluded.
    source, target : Skeleton
        Skeletons of the given and of the returned joints.

    Returns
    -------
    joints : ndarray, (L, J', 3)
        Joint positions, metres; NaN where occluded.
    confidence : ndarray, (L, J')
        Confidence of each joint, 0 where occluded.

    Raises
    ------
    ValueError
        If joints of ``target`` have no counterpart; the message lists them.
    """
    joints = np.where(confidence[..., None] > 0, joints, np.nan)
    if source == target:
        return joints, confidence
    all_by_own_names = set(target.joint_names) <= set(source.joint_names)
    matched: list[tuple[np.ndarray, np.ndarray]] = []
    missing: list[str] = []
    for name, canonical in zip(target.joint_names, target.canonical_names, strict=True):
        ends = [counterpart(source, end, end) for end in _MIDPOINTS.get(canonical, ())]
        joint = source.joint_names.index(name) if all_by_own_names else None
        joint = counterpart(source, name, canonical) if joint is None else joint
        if joint is not None:
            matched.append((joints[:, joint], confidence[:, joint]))
        elif ends and None not in ends:
            matched.append(_midpoint(joints, confidence, [end for end in ends if end is not None]))
        else:
            missing.append(name)
    if missing:
        raise ValueError(
            f"skeleton must contain the prior's joints {', '.join(missing)}, got only "
            f"{', '.join(source.joint_names)}"
        )
    points, weights = zip(*matched, strict=True)
    return np.stack(points, axis=1), np.stack(weights, axis=1)


def joints_at_rate(
    joints: np.ndarray, confidence: np.ndarray, fps: float, new_fps: float
) -> tuple[np.ndarray, np.ndarray]:
    """Resample joints to another frame rate by linear interpolation between frames.

    Frame times are those of :func:`~probmotion.motion.resampling.resample`. A joint is occluded if
    it is occluded in a frame of nonzero weight. Interpolation between frames of precisions w₁/σ²
    and w₂/σ² with weights 1 − a and a results in confidence 1 / ((1 − a)²/w₁ + a²/w₂).

    Parameters
    ----------
    joints : ndarray, (L, J, 3)
        Joint positions, metres; ignored where occluded.
    confidence : ndarray, (L, J)
        Confidence of each joint, 0 where occluded.
    fps, new_fps : float
        Frames per second of the given and of the returned joints.

    Returns
    -------
    joints : ndarray, (L', J, 3)
        Joint positions, metres; NaN where occluded.
    confidence : ndarray, (L', J)
        Confidence of each joint, 0 where occluded.
    """
    frames = len(confidence)
    clock = np.arange(frames, dtype=np.float64)[:, None, None]
    time = resample(clock, None, fps, new_fps)[0][:, 0, 0]
    before = np.minimum(np.floor(time + 1e-9).astype(int), frames - 1)
    after = np.minimum(before + 1, frames - 1)
    fraction = np.maximum(time - before, 0.0)[:, None]
    fraction = np.where(fraction < 1e-9, 0.0, fraction)
    filled = np.where(confidence[..., None] > 0, joints, 0.0)
    terms = ((1 - fraction, before), (fraction, after))
    interpolated = sum(weight[..., None] * filled[frame] for weight, frame in terms)
    with np.errstate(divide="ignore", invalid="ignore"):
        variance = sum(
            np.where(weight > 0, weight**2 / confidence[frame], 0.0) for weight, frame in terms
        )
    precision = np.where(np.isfinite(variance), 1 / np.maximum(variance, 1e-300), 0.0)
    return np.where(precision[..., None] > 0, interpolated, np.nan), precision


def _midpoint(
    joints: np.ndarray, confidence: np.ndarray, ends: list[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the midpoint (L, 3) of two joints and its confidence (L,)."""
    first, second = (confidence[:, end] for end in ends)
    total = first + second
    product = np.where((first > 0) & (second > 0), 4 * first * second, 0.0)
    weight = product / np.where(total > 0, total, 1.0)
    return joints[:, ends].mean(axis=1), weight
