"""Likelihoods against SciPy's densities and their own simulations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from probmotion import Cameras, Joints3D, Keypoints2D, KeypointTrack, Motion, Skeleton
from probmotion.posteriors.protocols import NotConjugate

SHAPE = (4, 3)  # frames, joints
CHAIN = Skeleton(["hip", "knee", "ankle"], [-1, 0, 1])


def some_confidence(*shape):
    """Confidences between 0.2 and 2, a quarter of them 0."""
    rng = np.random.default_rng(11)
    return rng.uniform(0.2, 2.0, shape) * (rng.random(shape) > 0.25)


def some_positions(*batch, seed=0):
    return np.random.default_rng(seed).standard_normal((*batch, *SHAPE, 3))


def arguments(shape, freedom, changes):
    """Random observations, NaN where occluded, and keyword arguments of the likelihood."""
    confidence = some_confidence(*shape[:-1])
    seen = np.random.default_rng(1).standard_normal(shape)
    seen[confidence == 0] = np.nan
    given = {"noise": 0.3, "confidence": confidence, "degrees_of_freedom": freedom}
    return seen, given | changes


def keypoints(freedom=None, perspective=False, **changes):
    seen, given = arguments((2, *SHAPE, 2), freedom, changes)
    return Keypoints2D(seen, Cameras.ring(2, elevation=0.2, perspective=perspective), **given)


def joints(freedom=None, **changes):
    seen, given = arguments((*SHAPE, 3), freedom, changes)
    return Joints3D(seen, **given)


def by_scipy(likelihood, positions):
    """Sum over visible entries, with scale noise / √confidence."""
    if isinstance(likelihood, Keypoints2D):
        residual = likelihood.keypoints - likelihood.cameras.project(positions)
    else:
        residual = likelihood.joints - positions
    seen = likelihood.confidence > 0
    scale = likelihood.noise / np.sqrt(likelihood.confidence[seen])[:, None]
    freedom = likelihood.degrees_of_freedom
    noise = stats.norm(scale=scale) if freedom is None else stats.t(freedom, scale=scale)
    return noise.logpdf(residual[seen]).sum()


MOTION = Motion(some_positions(), CHAIN, 30)


@pytest.mark.parametrize(
    "likelihood",
    [keypoints(), keypoints(3.0), keypoints(perspective=True), joints(), joints(3.0), joints(0.7)],
)
def test_densities_agree_with_scipy(library, likelihood):
    positions = some_positions(2, 3) / 2
    got = library.compiled(likelihood.log_density)(library.array(positions))
    wanted = [[by_scipy(likelihood, one) for one in row] for row in positions]
    np.testing.assert_allclose(np.asarray(got), wanted, rtol=library.tolerance)


@pytest.mark.parametrize("freedom", [None, 3.0])
@pytest.mark.parametrize("make", [keypoints, joints])
def test_gradients_match_finite_differences(differentiable, make, freedom):
    likelihood = make(freedom)
    positions, direction = some_positions(), some_positions(seed=1)
    gradient = differentiable.gradient(likelihood.log_density, positions)
    assert np.isfinite(gradient).all()
    ends = [by_scipy(likelihood, positions + step * direction) for step in (-1e-5, 1e-5)]
    assert (gradient * direction).sum() == pytest.approx(np.diff(ends).item() / 2e-5, rel=1e-6)


def test_occluded_entries_are_ignored():
    confidence, seen, positions = some_confidence(*SHAPE), some_positions(seed=3), some_positions()
    hidden = (confidence == 0)[..., None]
    value = Joints3D(seen, 0.2, confidence).log_density(positions)
    assert value == Joints3D(np.where(hidden, 1e9, seen), 0.2, confidence).log_density(positions)
    moved = np.where(hidden, positions + 5.0, positions)
    assert Joints3D(seen, 0.2, confidence).log_density(moved) == pytest.approx(value, abs=1e-12)
    nothing = Joints3D(np.full((*SHAPE, 3), np.nan), 0.2, np.zeros(SHAPE))
    assert nothing.log_density(positions) == 0


@pytest.mark.parametrize("make", [keypoints, joints])
def test_simulated_noise_has_the_specified_moments(make):
    """Mean and standard deviation of each entry, within 5 standard errors."""
    likelihood, positions = make(), some_positions(seed=5)
    rng, n, width = np.random.default_rng(7), 4_000, 3 if make is joints else 2
    clean = positions if make is joints else likelihood.cameras.project(positions)
    seen = likelihood.confidence > 0
    noise = np.stack([likelihood.entries.draw(rng, width) for _ in range(n)])
    standard = noise[:, seen] * np.sqrt(likelihood.confidence[seen])[:, None] / likelihood.noise
    assert (np.abs(standard.mean(axis=0)) < 5 / np.sqrt(n)).all()
    assert (np.abs(standard.std(axis=0) - 1) < 5 / np.sqrt(2 * n)).all()
    assert (noise[:, ~seen] == 0).all()
    once = likelihood.simulate(np.random.default_rng(8), positions)
    first = likelihood.entries.draw(np.random.default_rng(8), width)
    observed = once.joints if make is joints else once.keypoints
    np.testing.assert_allclose(observed[seen], (clean + first)[seen], atol=1e-14)
    np.testing.assert_array_equal(once.confidence, likelihood.confidence)


def test_simulated_student_t_noise():
    likelihood = Joints3D(np.zeros((50, 40, 3)), 0.3, degrees_of_freedom=3.0)
    draws = likelihood.entries.draw(np.random.default_rng(3), 3)
    assert stats.kstest(draws.ravel() / 0.3, stats.t(3).cdf).pvalue > 1e-4


def test_observations_of_a_motion():
    cameras = Cameras.ring(3)
    hidden = np.zeros(SHAPE, dtype=bool)
    hidden[1] = True

    def observe(seed, hidden=hidden):
        return Keypoints2D.observe(MOTION, cameras, 0.05, seed=seed, hidden=hidden)

    seen = observe(4)
    assert (seen.confidence == np.where(hidden, 0.0, 1.0)).all()
    residual = (seen.keypoints - cameras.project(MOTION.positions))[:, ~hidden]
    assert 0.5 < residual.std() / 0.05 < 1.5
    np.testing.assert_array_equal(seen.keypoints, observe(4).keypoints)
    assert (seen.keypoints != observe(5).keypoints)[:, ~hidden].all()
    one_view = np.zeros((3, *SHAPE), dtype=bool)
    one_view[2] = True
    np.testing.assert_array_equal(observe(4, one_view).confidence[:, 0, 0], [1, 1, 0])
    solid = Joints3D.observe(MOTION, 0.05, seed=4, hidden=hidden)
    assert 0.5 < (solid.joints - MOTION.positions)[~hidden].std() / 0.05 < 1.5


def test_likelihood_of_a_track():
    confidence = some_confidence(*SHAPE)
    points = np.where(confidence[..., None] > 0, np.ones((*SHAPE, 2)), np.nan)
    track = KeypointTrack(points, confidence, CHAIN, 30)
    likelihood = Keypoints2D.from_track(track, Cameras.ring(1), 0.1)
    np.testing.assert_array_equal(likelihood.confidence, confidence[None])
    assert (likelihood.skeleton, likelihood.fps) == (CHAIN, 30)


CAMERA = Cameras(
    np.eye(3)[None], np.array([[0.3, -0.2, 5.0]]), np.array([2.0]), np.array([[7.0, 8.0]])
)


@pytest.mark.parametrize(
    "likelihood", [keypoints(), joints(), Keypoints2D(np.ones((1, *SHAPE, 2)), CAMERA, 0.4)]
)
def test_the_linear_form_is_the_density_up_to_a_constant(likelihood):
    linear = likelihood.linear()
    positions = some_positions(6)
    residual = linear.target - np.einsum("vmi,blji->bvljm", linear.axes, positions)
    quadratic = -0.5 * (residual**2 * linear.precision[..., None]).sum(axis=(1, 2, 3, 4))
    constant = likelihood.log_density(positions) - quadratic
    np.testing.assert_allclose(constant, constant[0], rtol=1e-12)
    assert (linear.target[linear.precision == 0] == 0).all()


def test_nonlinear_likelihoods_are_not_conjugate():
    with pytest.raises(NotConjugate, match="the cameras are perspective, not orthographic"):
        keypoints(perspective=True).linear()
    for likelihood in (keypoints(3.0), joints(3.0)):
        with pytest.raises(NotConjugate, match="the noise is Student-t with 3 degrees of freedom"):
            likelihood.linear()


BLANK = np.zeros((2, *SHAPE, 2))
BROKEN = np.zeros((*SHAPE, 3))
BROKEN[2, 1, 0] = np.inf


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Keypoints2D(BLANK[:1], Cameras.ring(2), 0.1), r"keypoints must have shape \(2, L"),
        (lambda: keypoints(confidence=np.ones(SHAPE)), r"confidence must have shape \(2, 4, 3\)"),
        (lambda: joints(noise="0.1"), "noise must be a finite number above 0"),
        (lambda: joints(-2.0), "degrees_of_freedom must be a finite number above 0"),
        (lambda: joints(confidence=-np.ones(SHAPE)), "confidence must be at least 0, got -1"),
        (lambda: joints(confidence=np.full(SHAPE, np.nan)), "confidence must be finite, got 12 va"),
        (lambda: Joints3D(BROKEN, 0.1), "joints must be finite, got 1 values"),
        (lambda: Joints3D.observe(MOTION, 0.1, 0, hidden=np.eye(3)), r"hidden must have shape \(4"),
        (lambda: joints().log_density(np.zeros((5, 3, 3))), r"positions must have shape \(…, 4"),
        (lambda: joints().simulate(None, np.zeros((1, 4, 3, 3))), r"positions must have shape \(4"),
    ],
)
def test_invalid_arguments(call, message):
    with pytest.raises(ValueError, match=message):
        call()
