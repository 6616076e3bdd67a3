"""Classical filters for noisy 3D joint positions: baselines without a body model."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.signal import savgol_filter

from probmotion.validation import check_count, check_finite, check_positive, check_shape

__all__ = [
    "filled_between",
    "fit_acceleration",
    "kalman_smooth",
    "log_marginal_likelihood",
    "savitzky_golay",
]

_POSITION_SD = 10.0  # prior sd of the first position about the mean observation, m
_VELOCITY_SD = 10.0  # prior sd of the first velocity, m/s
_MIN_ACCELERATION, _MAX_ACCELERATION = 1e-3, 1e3  # range of the fitted √q, m/s^1.5


def savitzky_golay(
    joints: np.ndarray,
    seen: np.ndarray,
    *,
    fps: float,
    window_seconds: float = 0.5,
    order: int = 3,
) -> np.ndarray:
    """Smooth joint coordinates with local polynomials (Savitzky and Golay 1964).

    Missing entries are first interpolated linearly over time (:func:`filled_between`) and have
    the same weight as observed entries. Within half a window of an end the polynomial of the
    outermost window is used (SciPy's ``mode="interp"``).

    Parameters
    ----------
    joints : ndarray, (L, J, 3)
        Positions, metres; unobserved entries are ignored and may be NaN.
    seen : ndarray of bool, (L, J)
        Whether an entry is observed.
    fps : float
        Frames per second.
    window_seconds : float
        Window length, rounded to the nearest odd number of frames.
    order : int
        Degree of the polynomial, at least 0.

    Returns
    -------
    ndarray, (L, J, 3)
        Smoothed positions, metres.

    Raises
    ------
    ValueError
        If a joint is never observed, an observed entry is not finite, the window is longer than the
        motion, or ``order`` is not less than the number of frames of the window.
    """
    check_positive("fps", fps)
    check_positive("window_seconds", window_seconds)
    check_count("order", order, least=0)
    seen = np.asarray(seen, dtype=bool)
    joints = _seen_joints(joints, seen, "seen")
    frames = 2 * round((window_seconds * fps - 1) / 2) + 1
    if frames > len(joints):
        raise ValueError(
            f"window_seconds must be at most the motion's {len(joints)} frames at {fps:g} fps, "
            f"got {window_seconds:g} ({frames} frames)"
        )
    if order >= frames:
        raise ValueError(f"order must be less than the window's {frames} frames, got {order}")
    return savgol_filter(filled_between(joints, seen), frames, order, axis=0, mode="interp")


def kalman_smooth(
    joints: np.ndarray,
    confidence: np.ndarray,
    *,
    noise: float,
    fps: float,
    acceleration: float | np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the posterior of each joint under a constant-velocity model with white acceleration.

    Coordinates are independent. With white acceleration of spectral density q = acceleration²,
    a time step d multiplies the state (position, velocity) by F and adds noise of covariance Q,

        F = [1 d; 0 1],  Q = q [d³/3 d²/2; d²/2 d].

    Observations have Gaussian noise of variance noise² / confidence. The prior of the first frame
    is Gaussian: position about the mean of the observations (sd 10 m), velocity about 0 (10 m/s).
    The Kalman filter and the Rauch–Tung–Striebel smoother (Rauch, Tung and Striebel 1965, "Maximum
    likelihood estimates of linear dynamic systems") give the exact posterior.

    Parameters
    ----------
    joints : ndarray, (L, J, 3)
        Positions, metres; entries of confidence 0 are ignored and may be NaN.
    confidence : ndarray, (L, J)
        Factor of the precision (inverse variance) of an entry; 0 for a missing entry.
    noise : float
        Standard deviation of a coordinate of confidence 1, metres.
    fps : float
        Frames per second.
    acceleration : float or ndarray, (J,), optional
        √q for all joints or for each joint, m/s^1.5; :func:`fit_acceleration` by default.

    Returns
    -------
    mean, deviation : ndarray, (L, J, 3)
        Posterior means and standard deviations of the positions, metres.

    Raises
    ------
    ValueError
        If shapes disagree, a joint is never observed, an observed entry is not finite, or another
        argument is out of range.
    """
    if acceleration is None:
        acceleration = fit_acceleration(joints, confidence, noise=noise, fps=fps)
    problem = _Problem.of(joints, confidence, noise, fps, acceleration)
    passes = _forward(problem)
    mean, covariance = passes.mean[-1], passes.covariance[-1]
    means, variances = np.empty_like(problem.joints), np.empty(problem.variance.shape)
    means[-1], variances[-1] = mean[:, 0], covariance[:, 0, 0]
    for frame in range(len(means) - 2, -1, -1):
        # Smoother gain G: Gᵀ = P⁻¹ F C, with filtered covariance C and predicted covariance P.
        predicted = passes.predicted_covariance[frame + 1]
        moved = problem.step @ passes.covariance[frame]
        gain = np.swapaxes(np.linalg.solve(predicted, moved), -1, -2)
        mean = passes.mean[frame] + gain @ (mean - passes.predicted[frame + 1])
        change = gain @ (covariance - predicted) @ np.swapaxes(gain, -1, -2)
        covariance = passes.covariance[frame] + change
        means[frame], variances[frame] = mean[:, 0], covariance[:, 0, 0]
    deviation = np.sqrt(variances)[..., None]
    return means + problem.centre, np.broadcast_to(deviation, means.shape).copy()


def log_marginal_likelihood(
    joints: np.ndarray,
    confidence: np.ndarray,
    *,
    noise: float,
    fps: float,
    acceleration: float | np.ndarray,
) -> np.ndarray:
    """Return log p(observations) of each joint, (J,); arguments as in :func:`kalman_smooth`."""
    problem = _Problem.of(joints, confidence, noise, fps, acceleration)
    return _forward(problem).log_marginal_likelihood


def fit_acceleration(
    joints: np.ndarray, confidence: np.ndarray, *, noise: float, fps: float
) -> np.ndarray:
    """Return the maximum-likelihood √q of each joint (:func:`kalman_smooth`), (J,), m/s^1.5.

    Maximises :func:`log_marginal_likelihood` between 0.001 and 1000 m/s^1.5 by Brent's method on
    the logarithm of √q. The result for a joint at rest is close to the lower bound.
    """
    joints, confidence = np.asarray(joints), np.asarray(confidence)
    _Problem.of(joints, confidence, noise, fps, 1.0)  # validates the input

    def cost(exponent: float, joint: slice) -> float:
        problem = _Problem.of(joints[:, joint], confidence[:, joint], noise, fps, 10.0**exponent)
        return -float(_forward(problem).log_marginal_likelihood[0])

    bounds = (math.log10(_MIN_ACCELERATION), math.log10(_MAX_ACCELERATION))
    slices = [slice(joint, joint + 1) for joint in range(joints.shape[1])]
    fits = [minimize_scalar(cost, bounds=bounds, args=(each,), method="bounded") for each in slices]
    return np.array([10.0**fit.x for fit in fits])


class _Problem(NamedTuple):  # validated input of the Kalman filter
    joints: np.ndarray  # (L, J, 3) minus the centre, 0 where missing
    variance: np.ndarray  # (L, J) of the noise, infinite where missing
    centre: np.ndarray  # (J, 3) means of the observed entries
    step: np.ndarray  # (2, 2) F
    process: np.ndarray  # (2, 2) or (J, 2, 2) Q

    @classmethod
    def of(
        cls,
        joints: np.ndarray,
        confidence: np.ndarray,
        noise: float,
        fps: float,
        acceleration: float | np.ndarray,
    ) -> _Problem:
        check_positive("noise", noise)
        check_positive("fps", fps)
        confidence = np.asarray(confidence, dtype=np.float64)
        check_finite("confidence", confidence)
        if confidence.size and confidence.min() < 0:
            raise ValueError(f"confidence must be non-negative, got {confidence.min():g}")
        seen = confidence > 0
        joints = _seen_joints(joints, seen, "confidence")
        centre = joints.sum(axis=0) / seen.sum(axis=0)[:, None]
        spread = np.asarray(acceleration, dtype=np.float64)
        if spread.ndim:
            check_shape("acceleration", spread, (joints.shape[1],))
        for value in spread.flat:
            check_positive("acceleration", float(value))
        with np.errstate(divide="ignore"):
            variance = noise**2 / confidence
        centred, d = np.where(seen[..., None], joints - centre, 0.0), 1 / fps
        step = np.array([[1.0, d], [0.0, 1.0]])
        process = spread[..., None, None] ** 2 * np.array([[d**3 / 3, d**2 / 2], [d**2 / 2, d]])
        return cls(centred, variance, centre, step, process)


class _Passes(NamedTuple):
    """Filtered and ``predicted`` states of each frame; the x, y and z axes share covariances."""

    mean: np.ndarray  # (L, J, 2, 3)
    covariance: np.ndarray  # (L, J, 2, 2)
    predicted: np.ndarray  # (L, J, 2, 3)
    predicted_covariance: np.ndarray  # (L, J, 2, 2)
    log_marginal_likelihood: np.ndarray  # (J,)


def _forward(problem: _Problem) -> _Passes:
    """Run the Kalman filter on all joints and axes at once."""
    L, J, _ = problem.joints.shape
    means, covariances = np.empty((2, L, J, 2, 3)), np.empty((2, L, J, 2, 2))
    mean = np.zeros((J, 2, 3))
    covariance = np.tile(np.diag([_POSITION_SD**2, _VELOCITY_SD**2]), (J, 1, 1))
    log_marginal_likelihood = np.zeros(J)
    for frame in range(L):
        if frame > 0:
            mean = problem.step @ mean
            covariance = problem.step @ covariance @ problem.step.T + problem.process
        means[1, frame], covariances[1, frame] = mean, covariance
        variance = problem.variance[frame]
        seen = np.isfinite(variance)
        total = covariance[:, 0, 0] + variance
        innovation = problem.joints[frame] - mean[:, 0]
        # The gain is zero for an infinite variance.
        gain = covariance[:, :, :1] / total[:, None, None]
        mean = mean + gain * innovation[:, None]
        # The Joseph form preserves positive definite covariances.
        factor = np.eye(2) - gain * np.array([1.0, 0.0])
        added = np.where(seen, variance, 0.0)[:, None, None] * (gain @ np.swapaxes(gain, -1, -2))
        covariance = factor @ covariance @ np.swapaxes(factor, -1, -2) + added
        means[0, frame], covariances[0, frame] = mean, covariance
        square = (innovation[seen] ** 2).sum(axis=-1) / total[seen]
        log_marginal_likelihood[seen] -= 0.5 * (square + 3 * np.log(2 * math.pi * total[seen]))
    return _Passes(means[0], covariances[0], means[1], covariances[1], log_marginal_likelihood)


def _seen_joints(joints: np.ndarray, seen: np.ndarray, name: str) -> np.ndarray:
    """Validate the input and return the joints with 0 where missing."""
    joints = np.asarray(joints, dtype=np.float64)
    check_shape("joints", joints, ("L", "J", 3))
    check_shape(name, seen, joints.shape[:2])
    if len(joints) == 0:
        raise ValueError("joints must have at least one frame, got none")
    never_seen = np.flatnonzero(~seen.any(axis=0))
    if len(never_seen):
        raise ValueError(
            f"{name} must be positive in at least one frame of every joint, got none for joint "
            f"{never_seen[0]}"
        )
    check_finite("joints", joints[seen])
    return np.where(seen[..., None], joints, 0.0)


def filled_between(joints: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return joints (L, J, 3) with missing entries interpolated linearly over time.

    ``seen`` (L, J) marks observed entries; the first and the last are extrapolated as constants.
    Raises ``ValueError`` if a joint is never observed, or an observed entry is not finite.
    """
    seen = np.asarray(seen, dtype=bool)
    joints = _seen_joints(joints, seen, "seen")
    frames, filled = np.arange(len(joints)), np.empty_like(joints)
    for joint, known in enumerate(map(np.flatnonzero, seen.T)):
        for axis in range(3):
            filled[:, joint, axis] = np.interp(frames, known, joints[known, joint, axis])
    return filled
