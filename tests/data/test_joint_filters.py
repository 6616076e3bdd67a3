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
    """Random joints and confidences, with missing entries (NaN)."""
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
    least = np.minimum(s, t)
    white = s * t * least - (s + t) * least**2 / 2 + least**3 / 3
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
        apart = joints[seen, joint] - centre
        mean[:, joint] = centre + gain @ apart
        variance = np.diag(prior - gain @ prior[seen])
        deviation[:, joint] = np.sqrt(variance)[:, None]
        density = multivariate_normal(np.zeros(seen.sum()), total)
        likelihood[joint] = density.logpdf(apart.T).sum()
    return mean, deviation, likelihood


@pytest.mark.parametrize("acceleration", [0.3, 5.0, np.array([0.5, 4.0, 20.0])])
def test_kalman_smooth_is_the_exact_posterior(track, acceleration):
    joints, confidence = track
    given = {"noise": NOISE, "fps": FPS, "acceleration": acceleration}
    result = kalman_smooth(joints, confidence, **given)
    likelihood = log_marginal_likelihood(joints, confidence, **given)
    for joint, each in enumerate(np.broadcast_to(acceleration, J)):
        one = slice(joint, joint + 1)
        mean, deviation, exact = dense(joints[:, one], confidence[:, one], each)
        np.testing.assert_allclose(result[0][:, one], mean, rtol=0, atol=1e-9)
        np.testing.assert_allclose(result[1][:, one], deviation, rtol=0, atol=1e-9)
        np.testing.assert_allclose(likelihood[one], exact, rtol=1e-9)


@pytest.mark.parametrize("hidden", [False, True])
def test_small_acceleration_gives_linear_regression(rng, hidden):
    time = np.arange(L)[:, None, None] / FPS
    joints = 1 + 2 * time + NOISE * rng.normal(size=(L, 1, 3))
    confidence = np.ones((L, 1))
    confidence[5:15] = 0 if hidden else 1
    mean, deviation = kalman_smooth(joints, confidence, noise=NOISE, fps=FPS, acceleration=1e-3)
    keep = confidence[:, 0] > 0
    design = np.stack([np.ones(L), time[:, 0, 0]], axis=-1)
    normal = np.linalg.inv(design[keep].T @ design[keep])
    line = design @ normal @ design[keep].T @ joints[keep, 0]
    np.testing.assert_allclose(mean[:, 0], line, atol=2e-5)
    spread = NOISE * np.sqrt(np.einsum("la,ab,lb->l", design, normal, design))
    np.testing.assert_allclose(deviation[:, 0, 0], spread, rtol=1e-3)


def motion_of(rng, accelerations, frames):
    """Sample the model exactly, (frames, J, 3)."""
    d = 1 / FPS
    process = np.array([[d**3 / 3, d**2 / 2], [d**2 / 2, d]])
    factor = np.linalg.cholesky(process)
    state = np.zeros((len(accelerations), 2, 3))
    motion = []
    for _ in range(frames):
        motion.append(state[:, 0])
        pushed = accelerations[:, None, None] * (factor @ rng.normal(size=state.shape))
        state = np.stack([state[:, 0] + d * state[:, 1], state[:, 1]], axis=1) + pushed
    return np.stack(motion)


def test_fit_recovers_the_acceleration_and_is_calibrated(rng):
    accelerations = np.array([0.5, 2.0, 8.0, 30.0])
    truth = motion_of(rng, accelerations, 400)
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
    top = log_marginal_likelihood(joints, confidence, acceleration=best, **given)
    for factor in (0.5, 0.9, 1.1, 2.0):
        assert (
            log_marginal_likelihood(joints, confidence, acceleration=best * factor, **given) < top
        ).all()
    by_default = kalman_smooth(joints, confidence, **given)
    with_it = kalman_smooth(joints, confidence, acceleration=best, **given)
    np.testing.assert_array_equal(by_default, with_it)


def test_savitzky_golay_reproduces_polynomials():
    time = np.arange(L)[:, None, None] / FPS
    cubic = 1 + time - 3 * time**2 + 2 * time**3 + np.zeros((L, J, 3))
    seen = np.ones((L, J), dtype=bool)
    result = savitzky_golay(cubic, seen, fps=FPS, window_seconds=0.4, order=3)
    np.testing.assert_allclose(result, cubic, atol=1e-12)
    assert np.abs(savitzky_golay(cubic, seen, fps=FPS, order=1) - cubic).max() > 1e-3


def test_savitzky_golay_is_a_local_regression(track, rng):
    joints = rng.normal(size=(L, J, 3))
    seen = np.ones((L, J), dtype=bool)
    result = savitzky_golay(joints, seen, fps=FPS, window_seconds=7 / FPS, order=2)
    design = np.arange(-3, 4)[:, None] ** np.arange(3)
    for frame in range(3, L - 3):
        around = joints[frame - 3 : frame + 4].reshape(7, -1)
        middle = np.linalg.lstsq(design, around, rcond=None)[0][0]
        np.testing.assert_allclose(result[frame].ravel(), middle, atol=1e-12)


def test_savitzky_golay_interpolates_missing_entries():
    time = np.arange(L)[:, None, None] * np.ones((L, J, 3))
    seen = np.ones((L, J), dtype=bool)
    seen[6:12, 0] = seen[:4, 1] = seen[-5:, 2] = False
    broken = np.where(seen[..., None], time, np.nan)
    result = savitzky_golay(broken, seen, fps=FPS, window_seconds=1 / FPS, order=0)
    expected = time.copy()
    expected[:4, 1] = 4
    expected[-5:, 2] = L - 6
    np.testing.assert_allclose(result, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"confidence": np.zeros((L, J))}, "confidence must observe every joint .* joint 0"),
        ({"confidence": -np.ones((L, J))}, "confidence must be non-negative, got -1"),
        ({"confidence": np.ones((L, 2))}, r"confidence must have shape \(24, 3\)"),
        ({"joints": np.zeros((L, J, 2))}, "joints must have shape"),
        ({"joints": np.full((L, J, 3), np.nan)}, "joints must be finite"),
        ({"noise": 0.0}, "noise must be a finite number above 0"),
        ({"fps": -30.0}, "fps must be a finite number above 0"),
        ({"acceleration": 0.0}, "acceleration must be a finite number above 0"),
        ({"acceleration": np.ones(2)}, "acceleration must have shape"),
    ],
)
def test_kalman_smooth_rejects_invalid_input(change, message):
    given = {"joints": np.zeros((L, J, 3)), "confidence": np.ones((L, J)), "noise": NOISE}
    with pytest.raises(ValueError, match=message):
        kalman_smooth(**(given | {"fps": FPS, "acceleration": 1.0} | change))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seen": np.arange(L * J).reshape(L, J) % J != 1}, "seen must observe .* joint 1"),
        ({"seen": np.ones((2, J))}, r"seen must have shape \(24, 3\), got \(2, 3\)"),
        ({"window_seconds": 1.0}, r"window_seconds must be at most .*, got 1 \(29 frames\)"),
        ({"order": 15}, "order must be less than the window's 15 frames, got 15"),
        ({"order": -1}, "order must be an integer of at least 0, got -1"),
        ({"fps": 0.0}, r"fps must be a finite number above 0, got 0\.0"),
    ],
)
def test_savitzky_golay_rejects_invalid_input(change, message):
    given = {"joints": np.zeros((L, J, 3)), "seen": np.ones((L, J), dtype=bool), "fps": FPS}
    with pytest.raises(ValueError, match=message):
        savitzky_golay(**(given | change))


def test_filled_between_holds_the_ends_and_needs_one_observation(rng):
    joints, seen = rng.normal(size=(L, J, 3)), np.ones((L, J), dtype=bool)
    seen[1:, 2] = False
    filled = filled_between(np.where(seen[..., None], joints, np.nan), seen)
    np.testing.assert_array_equal(filled[:, :2], joints[:, :2])
    np.testing.assert_array_equal(filled[:, 2], np.tile(joints[0, 2], (L, 1)))
    seen[0, 2] = False
    with pytest.raises(ValueError, match=r"seen must observe every joint .* joint 2"):
        filled_between(joints, seen)
