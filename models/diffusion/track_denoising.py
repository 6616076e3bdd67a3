"""Cleaning a 2D track with a 2D motion diffusion model.

A detection is the true keypoint plus an error of standard deviation σ: up to a factor, a noisy
motion at the level where √((1−ᾱ)/ᾱ) is σ, of which the denoiser's estimate is the posterior mean.
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

# Detections farther than so many deviations of the data from its mean, in root mean square, are in
# pixels or millimetres, or not centred: metres are within a few.
_FARTHEST = 20.0


def denoise_track(
    track: KeypointTrack,
    prior: MotionDiffusion,
    *,
    noise: float,
    threshold: float = 0.3,
    rounds: int = 10,
) -> KeypointTrack:
    """Return the track as the prior believes it to be.

    A joint that is believed moves by at most ``noise``, in root mean square over its frames and
    axes: so far goes the exact posterior mean, and an imperfect network may go no farther.

    Joints below the threshold are not believed at all. They start at the prior's mean and take
    the denoiser's estimate, at levels that fall from as much noise as signal to the detector's,
    while what was seen stays as it was: a heuristic fill, not a draw.

    Parameters
    ----------
    track : KeypointTrack
        Prepared: metres, centred as the prior's data were, its joints and frame rate.
    prior : MotionDiffusion
        What cleans it.
    noise : float
        σ, standard deviation of a confident detection, metres.
    threshold : float
        Least confidence of a detection that is believed.
    rounds : int
        Noise levels on the way to the detector's, where some joint is not believed.

    Returns
    -------
    KeypointTrack
        Every joint in every frame; confidence 1 where it was believed, and as it came elsewhere.

    Raises
    ------
    ValueError
        If joints or frame rate are not the prior's, no joint is confident, detections are so far
        from the prior's mean that they cannot be in metres about the root, a number is out of
        range, or the noise is beyond the levels that the prior has learnt.
    """
    check_positive("noise", noise)
    check_count("rounds", rounds)
    _check_track(track, prior)
    believed = (track.confidence >= threshold) & (track.confidence > 0)
    if not believed.any():
        raise ValueError(
            f"track {track.name or 'unnamed'} has no joint of confidence {threshold:g} or more, "
            "expected some"
        )
    _check_metres(track, prior, believed)
    seen = np.where(believed[..., None], track.keypoints, prior.standards.mean) / prior.scale
    target = noise / prior.scale
    last = prior.settings.schedule.alpha_bar[-1]
    if target > (most := math.sqrt((1 - last) / last)):
        raise ValueError(
            f"noise is {noise:g}, expected at most {most * prior.scale:.3g} metres, the most that "
            "the prior has learnt"
        )
    levels = np.array([target])
    if not believed.all():
        levels = np.geomspace(max(1.0, target), target, rounds)
    clean = seen
    for sigma in levels:
        given = np.where(believed[..., None], seen, clean)
        clean = _denoise(prior, given, float(sigma))
    clean = _drawn_back(clean, seen, believed, target)
    confidence = np.where(believed, 1.0, track.confidence)
    return replace(track, keypoints=clean * prior.scale, confidence=confidence)


def _drawn_back(
    clean: np.ndarray, seen: np.ndarray, believed: np.ndarray, sigma: float
) -> np.ndarray:
    """Return the estimate, drawn towards detections as far as the network errs more than they.

    The posterior mean is, in mean square, nearer than σ to a detection: σ² − v with posterior
    variance v. If r², a joint's mean square distance, is more, the network has an error of its own.
    Were that independent of the detection's, it would be r² − σ², and the best combination would
    take the share σ²/r² of the estimate; as estimates lean on detections, less would be best.
    """
    off = np.where(believed[..., None], seen - clean, 0.0)
    count = 2 * np.maximum(believed.sum(axis=0), 1)
    squares = (off**2).sum(axis=(0, 2)) / count
    share = sigma**2 / np.maximum(squares, sigma**2)
    return np.where(believed[..., None], seen - share[:, None] * off, clean)


def _denoise(prior: MotionDiffusion, keypoints: np.ndarray, sigma: float) -> np.ndarray:
    """Return the estimate of a track of any length, (L, J, 2), normalised units.

    Longer ones go through in windows that overlap by half, blended by weights that fall to the
    windows' ends, so that there is no seam.
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


def _check_track(track: KeypointTrack, prior: MotionDiffusion) -> None:
    if track.skeleton.canonical_names != prior.skeleton.canonical_names:
        raise ValueError(
            f"track is of the joints {', '.join(track.skeleton.joint_names)}, expected the prior's,"
            f" {', '.join(prior.skeleton.joint_names)}"
        )
    if abs(track.fps - prior.fps) > 1e-6 * prior.fps:
        raise ValueError(
            f"track is at {track.fps:g} frames per second, expected the prior's {prior.fps:g}; "
            "resample it"
        )
    if track.frames < 2:
        raise ValueError("track has 1 frame, expected at least 2")


def _check_metres(track: KeypointTrack, prior: MotionDiffusion, believed: np.ndarray) -> None:
    off = (track.keypoints - prior.standards.mean)[believed]
    distance = math.sqrt((off**2).mean())
    if distance > (most := _FARTHEST * prior.scale):
        raise ValueError(
            f"track {track.name or 'unnamed'} spans {distance:.3g} along an axis about the prior's "
            f"mean, in root mean square, expected metres about the root, at most {most:.3g}"
        )
