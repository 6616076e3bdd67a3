"""Denoising of a 2D track with a 2D motion diffusion model.

A detection is the true keypoint plus an error of standard deviation σ. Up to a factor, detections
are a noisy motion at the level with √((1−ᾱ)/ᾱ) = σ; the denoiser estimates the posterior mean.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from probmotion.geometry.cameras import Cameras
from probmotion.models.diffusion.motion_diffusion import MotionDiffusion
from probmotion.motion.motion import KeypointTrack
from probmotion.validation import check_count, check_positive

__all__ = ["denoise_track"]

# Maximum root mean square of detections, in units of the prior's scale. Larger values indicate
# pixels, millimetres or tracks that are not centred.
_MAX_RMS = 20.0


def denoise_track(
    track: KeypointTrack,
    prior: MotionDiffusion,
    *,
    noise: float,
    threshold: float = 0.3,
    rounds: int = 10,
) -> KeypointTrack:
    """Return a denoised copy of a track.

    Visible joints, with a confidence of at least ``threshold``, move by at most ``noise`` in root
    mean square over frames and axes, the bound for an exact posterior mean. Other joints are filled
    in: they start at the prior's mean and follow the denoiser at decreasing noise levels, with the
    visible joints fixed. Their positions are heuristic estimates, not posterior draws.

    Parameters
    ----------
    track : KeypointTrack
        Prepared track with the prior's joints, frame rate and centring; metres.
    prior : MotionDiffusion
        Prior that provides the denoiser.
    noise : float
        Standard deviation σ of the errors of visible joints, metres.
    threshold : float
        Minimum confidence of a visible joint.
    rounds : int
        Number of noise levels for filling in joints.

    Returns
    -------
    KeypointTrack
        All joints in all frames; the confidence of visible joints is 1, that of others unchanged.

    Raises
    ------
    ValueError
        If joints or frame rate differ from the prior's, no joint is confident, detections are not
        in metres relative to the root, a number is out of range, or the noise exceeds the prior's
        highest level.
    """
    check_positive("noise", noise)
    check_count("rounds", rounds)
    visible = (track.confidence >= threshold) & (track.confidence > 0)
    _check_track(track, prior, visible, threshold)
    seen = np.where(visible[..., None], track.keypoints, prior.standards.mean) / prior.scale
    target = noise / prior.scale
    last = prior.settings.schedule.alpha_bar[-1]
    limit = math.sqrt((1 - last) / last)
    if target > limit:
        raise ValueError(
            f"noise must be at most {limit * prior.scale:.3g} m, the prior's highest level, got "
            f"{noise:g}"
        )
    clean = seen
    levels = [target] if visible.all() else np.geomspace(max(1.0, target), target, rounds)
    for sigma in levels:
        filled = np.where(visible[..., None], seen, clean)
        clean = _denoise(prior, filled, float(sigma))
    clean = _limit_deviation(clean, seen, visible, target)
    confidence = np.where(visible, 1.0, track.confidence)
    return replace(track, keypoints=clean * prior.scale, confidence=confidence)


def _limit_deviation(
    clean: np.ndarray, seen: np.ndarray, visible: np.ndarray, sigma: float
) -> np.ndarray:
    """Return the estimate, moved towards detections where it deviates by more than σ.

    The mean square deviation of the posterior mean from a detection is σ² − v, with v the posterior
    variance. A value r² above σ² indicates an error of the network. If this error were independent,
    its variance would be r² − σ², and σ²/r² the optimal weight of the estimate.
    """
    deviation = np.where(visible[..., None], seen - clean, 0.0)
    count = 2 * np.maximum(visible.sum(axis=0), 1)
    squares = (deviation**2).sum(axis=(0, 2)) / count
    weight = sigma**2 / np.maximum(squares, sigma**2)
    return np.where(visible[..., None], seen - weight[:, None] * deviation, clean)


def _denoise(prior: MotionDiffusion, keypoints: np.ndarray, sigma: float) -> np.ndarray:
    """Return the estimate for a track of any length, (L, J, 2), normalised units.

    Long tracks are processed in half-overlapping windows, blended by triangular weights.
    """
    alpha_bar = 1 / (1 + sigma**2)
    noisy = math.sqrt(alpha_bar) * keypoints
    frames = len(keypoints)
    window = min(frames, prior.settings.frames)
    starts = np.unique([*range(0, frames - window + 1, max(1, window // 2)), frames - window])
    views = np.stack([noisy[start : start + window] for start in starts])
    camera = Cameras.ring(1)
    clean = prior.denoise(views[:, None], alpha_bar, camera)[:, 0]
    ramp = np.minimum(np.arange(window) + 1.0, window - np.arange(window))
    total, weight = np.zeros_like(keypoints), np.zeros(frames)
    for start, part in zip(starts, clean, strict=True):
        total[start : start + window] += ramp[:, None, None] * part
        weight[start : start + window] += ramp
    return total / weight[:, None, None]


def _check_track(
    track: KeypointTrack, prior: MotionDiffusion, visible: np.ndarray, threshold: float
) -> None:
    name = f"track {track.name or 'unnamed'}"
    if track.skeleton.canonical_names != prior.skeleton.canonical_names:
        raise ValueError(
            f"track must have the prior's joints {', '.join(prior.skeleton.joint_names)}, got "
            f"{', '.join(track.skeleton.joint_names)}"
        )
    if abs(track.fps - prior.fps) > 1e-6 * prior.fps:
        raise ValueError(
            f"track must have the prior's {prior.fps:g} frames per second, got {track.fps:g}; "
            "resample it"
        )
    if track.frames < 2:
        raise ValueError("track must have at least 2 frames, got 1")
    if not visible.any():
        raise ValueError(
            f"{name} must have a joint with a confidence of {threshold:g} or more, got none"
        )
    distance = math.sqrt(((track.keypoints - prior.standards.mean)[visible] ** 2).mean())
    if distance > _MAX_RMS * prior.scale:
        raise ValueError(
            f"{name} must be in metres relative to the root, at most "
            f"{_MAX_RMS * prior.scale:.3g} m in root mean square, got {distance:.3g}"
        )
