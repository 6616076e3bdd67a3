"""Joint filters against exact solutions: polynomials and the joint Gaussian of a trajectory."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from probmotion.data.joint_filters import (
    filled_between,
    fit_acceleration,
    kalman_smooth,
    log_marginal_likelihood,
    savitzky_golay,
)

L, J, FPS, NOISE = 24, 3, 30.0, 0.03


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture
def track(rng):
    """Return random joints and confidences, with missing entries (NaN)."""
    joints = np.array([5.0, -1.0, 2.0]) + np.cumsum(0.05 * rng.normal(size=(L, J, 3)), axis=0)
    confidence = rng.uniform(0.3, 2.0, size=(L, J))
    confidence[8:18, 1] = 0
    confidence[[0, 1, -1], 2] = 0
    return np.where(confidence[..., None] > 0, joints, np.nan), confidence


def dense_prior(frames, fps, acceleration):
    """Return the prior covariance of a coordinate, (L, L), by integrating white acceleration.

    cov(x_s, x_t) = 10² + s t 10² + q ∫₀^min (s − u)(t − u) du.
    """
    time = np.arange(frames) / fps
    s, t = np.meshgrid(time, time, indexing="ij")
    end = np.minimum(s, t)
    white = s * t * end - (s + t) * end**2 / 2 + end**3 / 3
    return 100 + 100 * s * t + acceleration**2 * white


def dense(joints, confidence, acceleration):
    """Return mean, sd and log marginal likelihood from the joint Gaussian of all frames."""
    prior = dense_prior(len(joints), FPS, acceleration)
    mean, deviation = np.empty((2, *joints.shape))
    likelihood = np.zeros(joints.shape[1])
    for joint in range(joints.shape[1]):
        seen = confidence[:, joint] > 0
        centre = joints[seen, joint].mean(axis=0)
        noise = np.diag(NOISE**2 / confidence[seen, joint])
        total = prior[np.ix_(seen, seen)] + noise
        gain = np.linalg.solve(total, prior[seen]).T
        centred = joints[seen, joint] - centre
        mean[:, joint] = centre + gain @ centred
        variance = np.diag(prior - gain @ prior[seen])
        deviation[:, joint] = np.sqrt(variance)[:, None]
        density = multivariate_normal(np.zeros(seen.sum()), total)
        likelihood[joint] = density.logpdf(centred.T).sum()
    return mean, deviation, likelihood


@pytest.mark.parametrize("acceleration", [0.3, 5.0, np.array([0.5, 4.0, 20.0])])
def test_kalman_smooth_is_the_exact_posterior(track, acceleration):
    joints, confidence = track
    given = {"noise": NOISE, "fps": FPS, "acceleration": acceleration}
    result = kalman_smooth(joints, confidence, **given)
    likelihood = log_marginal_likelihood(joints, confidence, **given)
    for joint, value in enumerate(np.broadcast_to(acceleration, J)):
        index = slice(joint, joint + 1)
        mean, deviation, exact = dense(joints[:, index], confidence[:, index], value)
        np.testing.assert_allclose(result[0][:, index], mean, rtol=0, atol=1e-9)
        np.testing.assert_allclose(result[1][:, index], deviation, rtol=0, atol=1e-9)
        np.testing.assert_allclose(likelihood[index], exact, rtol=1e-9)


def test_fit_recovers_the_acceleration_and_is_calibrated(rng):
    accelerations = np.array([0.5, 2.0, 8.0, 30.0])
    # Draw trajectories from the prior with zero initial position and velocity.
    time = np.arange(400) / FPS
    covariance = dense_prior(400, FPS, 1.0) - 100 * (1 + np.multiply.outer(time, time))
    normal = rng.multivariate_normal(np.zeros(400), covariance, size=(4, 3), method="eigh")
    truth = accelerations[:, None] * np.moveaxis(normal, -1, 0)
    joints = truth + 0.01 * rng.normal(size=truth.shape)
    confidence = np.ones(truth.shape[:2])
    for start in range(20, 380, 40):
        confidence[start : start + 15] = 0
    result = fit_acceleration(joints, confidence, noise=0.01, fps=FPS)
    np.testing.assert_allclose(result, accelerations, rtol=0.25)
    mean, deviation = kalman_smooth(joints, confidence, noise=0.01, fps=FPS)
    scores = (mean - truth) / deviation
    for seen in (True, False):
        assert scores[(confidence > 0) == seen].std() == pytest.approx(1, abs=0.15)


def test_fit_maximises_the_marginal_likelihood(track):
    joints, confidence = track
    best = fit_acceleration(joints, confidence, noise=NOISE, fps=FPS)
    given = {"noise": NOISE, "fps": FPS}
    lower, maximum, higher = (
        log_marginal_likelihood(joints, confidence, acceleration=best * factor, **given)
        for factor in (0.9, 1.0, 1.1)
    )
    assert (np.maximum(lower, higher) < maximum).all()
    default = kalman_smooth(joints, confidence, **given)
    explicit = kalman_smooth(joints, confidence, acceleration=best, **given)
    np.testing.assert_array_equal(default, explicit)


def test_savitzky_golay_is_a_local_regression(rng):
    joints = rng.normal(size=(L, J, 3))
    seen = np.ones((L, J), dtype=bool)
    result = savitzky_golay(joints, seen, fps=FPS, window_seconds=7 / FPS, order=2)
    design = np.arange(-3, 4)[:, None] ** np.arange(3)
    for frame in range(L):
        middle = min(max(frame, 3), L - 4)
        window = joints[middle - 3 : middle + 4].reshape(7, -1)
        fitted = design @ np.linalg.lstsq(design, window, rcond=None)[0]
        np.testing.assert_allclose(result[frame].ravel(), fitted[frame - middle + 3], atol=1e-12)


def test_savitzky_golay_interpolates_missing_entries():
    time = np.arange(L)[:, None, None] * np.ones((L, J, 3))
    seen = np.ones((L, J), dtype=bool)
    seen[6:12, 0] = seen[:4, 1] = seen[-5:, 2] = False
    broken = np.where(seen[..., None], time, np.nan)
    expected = time.copy()
    expected[:4, 1] = 4
    expected[-5:, 2] = L - 6
    np.testing.assert_allclose(filled_between(broken, seen), expected, atol=1e-12)
    result = savitzky_golay(broken, seen, fps=FPS, window_seconds=1 / FPS, order=0)
    np.testing.assert_allclose(result, expected, atol=1e-12)


JOINTS, ONES, SEEN = np.zeros((L, J, 3)), np.ones((L, J)), np.ones((L, J), dtype=bool)


@pytest.mark.parametrize(
    ("call", "change", "message"),
    [
        (kalman_smooth, {"confidence": 0 * ONES}, "confidence must be positive .* for joint 0"),
        (kalman_smooth, {"confidence": -ONES}, "confidence must be non-negative, got -1"),
        (kalman_smooth, {"confidence": ONES[:, :2]}, r"confidence must have shape \(24, 3\)"),
        (kalman_smooth, {"joints": JOINTS[..., :2]}, "joints must have shape"),
        (kalman_smooth, {"joints": JOINTS + np.nan}, "joints must be finite"),
        (kalman_smooth, {"noise": 0.0}, "noise must be a finite number above 0"),
        (kalman_smooth, {"fps": -30.0}, "fps must be a finite number above 0"),
        (kalman_smooth, {"acceleration": 0.0}, "acceleration must be a finite number above 0"),
        (kalman_smooth, {"acceleration": np.ones(2)}, "acceleration must have shape"),
        (savitzky_golay, {"seen": SEEN & [True, False, True]}, "seen must be positive .* joint 1"),
        (savitzky_golay, {"seen": SEEN[:2]}, r"seen must have shape \(24, 3\), got \(2, 3\)"),
        (savitzky_golay, {"window_seconds": 1.0}, r"at most .*, got 1 \(29 frames\)"),
        (savitzky_golay, {"order": 15}, "order must be less than the window's 15 frames, got 15"),
        (savitzky_golay, {"order": -1}, "order must be an integer of at least 0, got -1"),
        (savitzky_golay, {"fps": 0.0}, r"fps must be a finite number above 0, got 0\.0"),
    ],
)
def test_invalid_input(call, change, message):
    given = {"joints": JOINTS, "fps": FPS} | (
        {"seen": SEEN}
        if call is savitzky_golay
        else {"confidence": ONES, "noise": NOISE, "acceleration": 1.0}
    )
    with pytest.raises(ValueError, match=message):
        call(**(given | change))
