"""Lifts of the annotations of consecutive frames, smoothed over time.

Every frame has the exact posterior of its own keypoints under an :class:`AnnotationPrior`. Its mean
jumps from frame to frame where keypoints are noisy or the view is ambiguous; people do not. Means
are therefore averaged over time with Gaussian weights, over a longer time in depth than in the
image. Standard deviations are averaged too, but not reduced: errors of depth last for seconds.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d

from probmotion.models.unseen_depth.annotation_prior import AnnotationPrior
from probmotion.seeds import RandomNumbers
from probmotion.validation import check_count, check_positive, check_shape

__all__ = ["SmoothedLifts", "smoothed_lifts"]

_IMAGE = 0.07  # standard deviation of the weights in the image, seconds
_DEPTH = 0.4  # in depth
_LEAST_SEEN = 2  # joints of a frame that is lifted


class SmoothedLifts(NamedTuple):
    """Posterior of the poses of L frames, in the axes of their still camera.

    ``positions`` (L, J, 3) are means, metres: x right, y up, both in place; z towards the viewer,
    relative to the mean depth of the joints. ``sd`` (L, J, 3) are standard deviations, metres, and
    ``draws`` (n, L, J, 3) motions with these means and standard deviations.
    """

    positions: np.ndarray
    sd: np.ndarray
    draws: np.ndarray


def smoothed_lifts(
    prior: AnnotationPrior, keypoints: np.ndarray, fps: float, rng: RandomNumbers, n_draws: int
) -> SmoothedLifts:
    """Return the poses of the frames of a video.

    Draws are the smoothed means plus deviations of frames' own draws from their means, averaged
    over time with weights that preserve their covariances. In frames that show fewer than two
    joints, means are interpolated, and the variances of the whole video are added.

    Parameters
    ----------
    prior : AnnotationPrior
        Prior over the poses.
    keypoints : ndarray, (L, J, 2)
        Keypoints, x right, y up, metres; NaN where missing.
    fps : float
        Frames per second.
    rng : RandomNumbers
        Random numbers of the draws.
    n_draws : int
        Number of draws.

    Raises
    ------
    ValueError
        If no frame shows two joints.
    """
    check_shape("keypoints", keypoints, ("L", prior.n_joints, 2))
    check_positive("fps", fps)
    check_count("n_draws", n_draws)
    shown = np.flatnonzero((~np.isnan(keypoints).any(axis=-1)).sum(axis=1) >= _LEAST_SEEN)
    if not len(shown):
        raise ValueError(f"keypoints must show {_LEAST_SEEN} joints in one frame, got none")
    lifts = prior.lift(keypoints[shown])
    deviations = prior.sample_lifts(keypoints[shown], rng, n_draws) - lifts.positions
    frames = len(keypoints)
    positions = _interpolated(lifts.positions, shown, frames)
    variances = _interpolated(lifts.sd**2, shown, frames)
    blind = np.setdiff1d(np.arange(frames), shown)
    variances[blind] += lifts.positions.var(axis=0)
    noise = np.empty((n_draws, *positions.shape))
    noise[:, shown] = deviations
    noise[:, blind] = np.sqrt(variances[blind]) * rng.standard_normal(
        (n_draws, len(blind), *positions.shape[1:])
    )
    for axis, seconds in enumerate((_IMAGE, _IMAGE, _DEPTH)):
        positions[..., axis] = gaussian_filter1d(
            positions[..., axis], seconds * fps, axis=0, mode="nearest"
        )
    # Squares of the weights are the weights of the draws' variances: Gaussian too, and √2 narrower.
    # Around the ends, both are averaged as if the video were repeated.
    sd = np.sqrt(gaussian_filter1d(variances, _DEPTH * fps / np.sqrt(2), axis=0, mode="wrap"))
    noise = gaussian_filter1d(noise, _DEPTH * fps, axis=1, mode="wrap")
    impulse = np.zeros(frames)
    impulse[0] = 1.0
    weights = gaussian_filter1d(impulse, _DEPTH * fps, mode="wrap")
    return SmoothedLifts(positions, sd, positions + noise / np.linalg.norm(weights))


def _interpolated(values: np.ndarray, shown: np.ndarray, frames: int) -> np.ndarray:
    """Return values (m, J, 3) of the frames ``shown`` (m,) in all frames, (L, J, 3)."""
    at = np.interp(np.arange(frames), shown, np.arange(len(shown)))
    before = np.floor(at).astype(int)
    after = np.minimum(before + 1, len(shown) - 1)
    part = (at - before)[:, None, None]
    result: np.ndarray = (1 - part) * values[before] + part * values[after]
    return result
