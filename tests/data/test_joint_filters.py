"""Filters of joints against exact solutions: polynomials, and the whole trajectory's Gaussian."""

from __future__ import annotations

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
    """Random joints 5 m from the origin, confidences, one joint hidden for a span, NaN there."""
    joints = np.array([5.0, -1.0, 2.0]) + np.cumsum(0.05 * rng.normal(size=(L, J, 3)), axis=0)
    confidence = rng.uniform(0.3, 2.0, size=(L, J))
    confidence[8:18, 1] = 0
    confidence[[0, 1, -1], 2] = 0
    return np.where(confidence[..., None] > 0, joints, np.nan), confidence


def dense_prior(frames, fps, acceleration):
    """Covariance of one coordinate's positions (L, L), from integrals of white acceleration.

    cov(x_s, x_t) = 10² + s t 10² + q ∫₀^min (s − u)(t − u) du.
    """
    time = np.arange(frames) / fps
    s, t = np.meshgrid(time, time, indexing="ij")
    least = np.minimum(s, t)
    white = s * t * least - (s + t) * least**2 / 2 + least**3 / 3
    return 100 + 100 * s * t + acceleration**2 * white


def dense(joints, confidence, acceleration):
    """Mean, deviation and log evidence by conditioning the joint Gaussian of all frames."""
    prior = dense_prior(len(joints), FPS, acceleration)
    mean, deviation = np.empty((2, *joints.shape))
    evidence = np.zeros(joints.shape[1])
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
        found = multivariate_normal(np.zeros(seen.sum()), total).logpdf(apart.T)
        evidence[joint] = found.sum()
    return mean, deviation, evidence


@pytest.mark.parametrize("acceleration", [0.3, 5.0, np.array([0.5, 4.0, 20.0])])
def test_the_smoother_is_the_exact_posterior(track, acceleration):
    joints, confidence = track
    found = kalman_smooth(joints, confidence, noise=NOISE, fps=FPS, acceleration=acceleration)
    evidence = log_marginal_likelihood(
        joints, confidence, noise=NOISE, fps=FPS, acceleration=acceleration
    )
    for joint, each in enumerate(np.broadcast_to(acceleration, J)):
        one = slice(joint, joint + 1)
        mean, deviation, exact = dense(joints[:, one], confidence[:, one], each)
        np.testing.assert_allclose(found[0][:, one], mean, rtol=0, atol=1e-9)
        np.testing.assert_allclose(found[1][:, one], deviation, rtol=0, atol=1e-9)
        np.testing.assert_allclose(evidence[one], exact, rtol=1e-9)


def test_hidden_spans_are_wide_and_straight_where_nothing_is_known(track):
    joints, confidence = track
    mean, deviation = kalman_smooth(joints, confidence, noise=NOISE, fps=FPS, acceleration=1.0)
    shown = np.where(np.isnan(joints), 0.0, joints)
    _, less = kalman_smooth(shown, np.ones((L, J)), noise=NOISE, fps=FPS, acceleration=1.0)
    assert (deviation[8:18, 1] > 1.5 * less[8:18, 1]).all()
    assert np.argmax(deviation[:, 1, 0]) in range(11, 15)
    # Before anything was seen the velocity is constant, but for the first one's broad prior.
    np.testing.assert_allclose(np.diff(mean[:3, 2], 2, axis=0), 0, atol=5e-5)


@pytest.mark.parametrize("hidden", [False, True])
def test_a_straight_line_without_acceleration_is_regression(rng, hidden):
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


def test_joints_do_not_influence_each_other(track):
    joints, confidence = track
    together = kalman_smooth(joints, confidence, noise=NOISE, fps=FPS)
    apart = [
        kalman_smooth(joints[:, [joint]], confidence[:, [joint]], noise=NOISE, fps=FPS)
        for joint in range(J)
    ]
    for found, alone in zip(together, zip(*apart, strict=True), strict=True):
        np.testing.assert_allclose(found, np.concatenate(alone, axis=1), rtol=1e-10)


def test_moving_everything_moves_the_means_alone(track):
    joints, confidence = track
    near = kalman_smooth(joints, confidence, noise=NOISE, fps=FPS)
    far = kalman_smooth(joints + 1000, confidence, noise=NOISE, fps=FPS)
    np.testing.assert_allclose(far[0] - 1000, near[0], atol=1e-6)
    np.testing.assert_allclose(far[1], near[1], rtol=1e-4)


def motion_of(rng, accelerations, frames):
    """Draws of the model: integrated white acceleration, exactly, from its own covariance."""
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


def test_the_fit_finds_the_acceleration_and_its_deviations_are_honest(rng):
    accelerations = np.array([0.5, 2.0, 8.0, 30.0])
    truth = motion_of(rng, accelerations, 400)
    joints = truth + 0.01 * rng.normal(size=truth.shape)
    confidence = np.ones(truth.shape[:2])
    for start in range(20, 380, 40):
        confidence[start : start + 15] = 0
    found = fit_acceleration(joints, confidence, noise=0.01, fps=FPS)
    np.testing.assert_allclose(found, accelerations, rtol=0.25)
    mean, deviation = kalman_smooth(joints, confidence, noise=0.01, fps=FPS)
    scores = (mean - truth) / deviation
    for seen in (True, False):
        assert scores[(confidence > 0) == seen].std() == pytest.approx(1, abs=0.15)


def test_the_fit_is_the_maximum_of_the_evidence(track):
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


def test_savitzky_golay_keeps_polynomials_of_its_order():
    time = np.arange(L)[:, None, None] / FPS
    cubic = 1 + time - 3 * time**2 + 2 * time**3 + np.zeros((L, J, 3))
    seen = np.ones((L, J), dtype=bool)
    found = savitzky_golay(cubic, seen, fps=FPS, window_seconds=0.4, order=3)
    np.testing.assert_allclose(found, cubic, atol=1e-12)
    assert np.abs(savitzky_golay(cubic, seen, fps=FPS, order=1) - cubic).max() > 1e-3


def test_savitzky_golay_is_a_local_regression(track, rng):
    joints = rng.normal(size=(L, J, 3))
    seen = np.ones((L, J), dtype=bool)
    found = savitzky_golay(joints, seen, fps=FPS, window_seconds=7 / FPS, order=2)
    design = np.arange(-3, 4)[:, None] ** np.arange(3)
    for frame in range(3, L - 3):
        around = joints[frame - 3 : frame + 4].reshape(7, -1)
        middle = np.linalg.lstsq(design, around, rcond=None)[0][0]
        np.testing.assert_allclose(found[frame].ravel(), middle, atol=1e-12)


def test_savitzky_golay_draws_lines_through_hidden_spans():
    time = np.arange(L)[:, None, None] * np.ones((L, J, 3))
    seen = np.ones((L, J), dtype=bool)
    seen[6:12, 0] = seen[:4, 1] = seen[-5:, 2] = False
    broken = np.where(seen[..., None], time, np.nan)
    found = savitzky_golay(broken, seen, fps=FPS, window_seconds=1 / FPS, order=0)
    expected = time.copy()
    expected[:4, 1] = 4
    expected[-5:, 2] = L - 6
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_both_remove_noise_of_a_smooth_motion(rng):
    time = np.arange(60)[:, None, None] / FPS
    truth = 0.5 * np.sin(2 * np.pi * time + np.arange(J)[:, None] + np.arange(3))
    joints = truth + NOISE * rng.normal(size=truth.shape)
    seen = np.ones((60, J), dtype=bool)
    polynomial = savitzky_golay(joints, seen, fps=FPS)
    smooth, _ = kalman_smooth(joints, seen.astype(float), noise=NOISE, fps=FPS)
    for found in (polynomial, smooth):
        assert np.sqrt(((found - truth) ** 2).mean()) < 0.65 * NOISE


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"confidence": np.zeros((L, J))}, "confidence hides joint 0 in all 24 frames"),
        ({"confidence": -np.ones((L, J))}, "confidence is -1 at its least, expected 0 or more"),
        ({"confidence": np.ones((L, 2))}, r"confidence has shape \(24, 2\)"),
        ({"joints": np.zeros((L, J, 2))}, r"joints has shape \(24, 3, 2\)"),
        (
            {"joints": np.full((L, J, 3), np.nan)},
            "joints must be finite, got 216 values that are NaN",
        ),
        ({"noise": 0.0}, "noise must be a finite number above 0, got 0.0"),
        ({"fps": -30.0}, "fps must be a finite number above 0, got -30.0"),
        ({"acceleration": 0.0}, "acceleration must be a finite number above 0, got 0.0"),
        ({"acceleration": np.ones(2)}, r"acceleration must have shape \(3\), got \(2,\)"),
    ],
)
def test_what_the_smoother_cannot_use_is_refused(change, message):
    given = {
        "joints": np.zeros((L, J, 3)),
        "confidence": np.ones((L, J)),
        "noise": NOISE,
        "fps": FPS,
        "acceleration": 1.0,
    }
    with pytest.raises(ValueError, match=message):
        kalman_smooth(**(given | change))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seen": np.arange(L * J).reshape(L, J) % J != 1}, "seen hides joint 1 in all 24 frames"),
        ({"seen": np.ones((2, J))}, r"seen must have shape \(24, 3\), got \(2, 3\)"),
        ({"window_seconds": 1.0}, "29 frames at 30 fps, expected at most the motion's 24 frames"),
        ({"order": 15}, "order must be less than the 15 frames of a window of 0.5 s, got 15"),
        ({"order": -1}, "order must be an integer of at least 0, got -1"),
        ({"fps": 0.0}, "fps must be a finite number above 0, got 0.0"),
    ],
)
def test_what_the_polynomial_cannot_use_is_refused(change, message):
    given = {"joints": np.zeros((L, J, 3)), "seen": np.ones((L, J), dtype=bool), "fps": FPS}
    with pytest.raises(ValueError, match=message):
        savitzky_golay(**(given | change))


def test_filling_needs_every_joint_once(rng):
    joints, seen = rng.normal(size=(L, J, 3)), np.ones((L, J), dtype=bool)
    seen[1:, 2] = False
    shown = np.where(seen[..., None], joints, np.nan)
    filled = filled_between(shown, seen)
    np.testing.assert_array_equal(filled[:, :2], joints[:, :2])
    np.testing.assert_array_equal(filled[:, 2], np.tile(joints[0, 2], (L, 1)))
    seen[0, 2] = False
    with pytest.raises(ValueError, match=r"^seen hides joint 2 in all 24 frames, expected"):
        filled_between(shown, seen)
    with pytest.raises(ValueError, match=r"^seen must have shape \(24, 3\), got \(24,\)"):
        filled_between(shown, seen[:, 0])
