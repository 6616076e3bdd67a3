"""Likelihoods against SciPy's densities and their own simulations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from probmotion import Cameras, Joints3D, Keypoints2D, KeypointTrack, Motion, Skeleton
from probmotion.posteriors.protocols import NotConjugate

SHAPE = (4, 3)  # frames, joints
CHAIN = Skeleton(["hip", "knee", "ankle"], [-1, 0, 1])
FREEDOMS = [None, 3.0, 0.7]


def some_confidence(*shape):
    """Confidences between 0.2 and 2, a quarter of them 0."""
    rng = np.random.default_rng(11)
    return rng.uniform(0.2, 2.0, shape) * (rng.random(shape) > 0.25)


def some_positions(*batch, seed=0):
    return np.random.default_rng(seed).standard_normal((*batch, *SHAPE, 3))


def keypoints(freedom=None, perspective=False, **changes):
    cameras = Cameras.ring(2, elevation=0.2, perspective=perspective)
    confidence = some_confidence(2, *SHAPE)
    seen = np.random.default_rng(1).standard_normal((2, *SHAPE, 2))
    seen[confidence == 0] = np.nan
    given = {"noise": 0.3, "confidence": confidence, "degrees_of_freedom": freedom} | changes
    return Keypoints2D(seen, cameras, **given)


def joints(freedom=None, **changes):
    confidence = some_confidence(*SHAPE)
    seen = np.random.default_rng(2).standard_normal((*SHAPE, 3))
    seen[confidence == 0] = np.nan
    given = {"noise": 0.3, "confidence": confidence, "degrees_of_freedom": freedom} | changes
    return Joints3D(seen, **given)


def density(residual, scale, freedom):
    if freedom is None:
        return stats.norm.logpdf(residual, scale=scale)
    return stats.t.logpdf(residual, freedom, scale=scale)


def by_scipy(likelihood, positions):
    """Sum over visible entries, with scale noise / √confidence."""
    if isinstance(likelihood, Keypoints2D):
        residual = likelihood.keypoints - likelihood.cameras.project(positions)
    else:
        residual = likelihood.joints - positions
    seen = likelihood.confidence > 0
    scale = likelihood.noise / np.sqrt(likelihood.confidence[seen])
    return density(residual[seen], scale[:, None], likelihood.degrees_of_freedom).sum()


@pytest.mark.parametrize("freedom", FREEDOMS)
@pytest.mark.parametrize("make", [keypoints, joints])
def test_densities_agree_with_scipy(library, make, freedom):
    likelihood = make(freedom)
    positions = some_positions(2, 3)
    got = library.compiled(likelihood.log_density)(library.array(positions))
    assert got.shape == (2, 3)
    wanted = [[by_scipy(likelihood, positions[b, c]) for c in range(3)] for b in range(2)]
    size = np.abs(wanted).max()
    np.testing.assert_allclose(
        np.asarray(got) / size, wanted / size, rtol=0, atol=library.tolerance
    )


def test_perspective_densities_agree_with_scipy(library):
    likelihood = keypoints(perspective=True)
    positions = some_positions() / 2
    got = library.compiled(likelihood.log_density)(library.array(positions))
    assert float(got) == pytest.approx(by_scipy(likelihood, positions), rel=library.tolerance)


@pytest.mark.parametrize("freedom", FREEDOMS)
@pytest.mark.parametrize("make", [keypoints, joints])
def test_gradients_are_finite_differences(differentiable, make, freedom):
    likelihood = make(freedom)
    positions, direction = some_positions(), some_positions(seed=1)
    gradient = differentiable.gradient(likelihood.log_density, positions)
    assert np.isfinite(gradient).all()
    step = 1e-5
    slope = (
        by_scipy(likelihood, positions + step * direction)
        - by_scipy(likelihood, positions - step * direction)
    ) / (2 * step)
    assert (gradient * direction).sum() == pytest.approx(slope, rel=1e-6)


def test_the_gaussian_limit_of_student_t():
    positions = some_positions()
    gauss = joints().log_density(positions)
    gaps = [abs(joints(nu).log_density(positions) - gauss) for nu in (1e2, 1e4, 1e6)]
    assert gaps[0] > 10 * gaps[1] > 100 * gaps[2]


def test_confidence_4_halves_the_noise():
    positions = some_positions()
    seen = some_positions(seed=3)
    strong = Joints3D(seen, 0.2, np.full(SHAPE, 4.0)).log_density(positions)
    assert strong == pytest.approx(Joints3D(seen, 0.1).log_density(positions))


def test_occluded_entries_are_ignored():
    confidence = some_confidence(*SHAPE)
    seen = some_positions(seed=3)
    a = Joints3D(seen, 0.2, confidence)
    changed = np.where(confidence[..., None] > 0, seen, 1e9)
    positions = some_positions()
    assert a.log_density(positions) == Joints3D(changed, 0.2, confidence).log_density(positions)
    moved = positions + np.where(confidence > 0, 0.0, 5.0)[..., None]
    assert a.log_density(positions) == pytest.approx(a.log_density(moved), abs=1e-12)
    nothing = Joints3D(np.full((*SHAPE, 3), np.nan), 0.2, np.zeros(SHAPE))
    assert nothing.log_density(positions) == 0


@pytest.mark.parametrize("make", [keypoints, joints])
def test_simulated_noise_has_the_specified_moments(make):
    """Mean and standard deviation of each entry, within 5 standard errors."""
    likelihood = make()
    positions = some_positions(seed=5)
    rng = np.random.default_rng(7)
    n, width = 4_000, 3 if make is joints else 2
    clean = positions if make is joints else likelihood.cameras.project(positions)
    seen = likelihood.confidence > 0
    noise = np.stack([likelihood.entries.draw(rng, width) for _ in range(n)])
    scale = likelihood.noise / np.sqrt(likelihood.confidence[seen])[:, None]
    assert (np.abs(noise[:, seen].mean(axis=0)) < 5 * scale / np.sqrt(n)).all()
    spread = noise[:, seen].std(axis=0) / scale
    assert (np.abs(spread - 1) < 5 / np.sqrt(2 * n)).all()
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
    assert stats.kstest(draws.ravel() / 0.3, stats.norm.cdf).pvalue < 1e-4


def test_observations_of_a_motion():
    motion = Motion(some_positions(seed=1), CHAIN, 30)
    cameras = Cameras.ring(3)
    hidden = np.zeros(SHAPE, dtype=bool)
    hidden[1] = True
    seen = Keypoints2D.observe(motion, cameras, 0.05, seed=4, hidden=hidden)
    assert (seen.confidence == np.where(hidden, 0.0, 1.0)).all()
    residual = (seen.keypoints - cameras.project(motion.positions))[:, ~hidden]
    assert 0.5 < residual.std() / 0.05 < 1.5
    again = Keypoints2D.observe(motion, cameras, 0.05, seed=4, hidden=hidden)
    np.testing.assert_array_equal(seen.keypoints, again.keypoints)
    other = Keypoints2D.observe(motion, cameras, 0.05, seed=5, hidden=hidden)
    assert (seen.keypoints != other.keypoints)[:, ~hidden].all()
    one_view = np.zeros((3, *SHAPE), dtype=bool)
    one_view[2] = True
    part = Keypoints2D.observe(motion, cameras, 0.05, seed=4, hidden=one_view)
    assert part.confidence is not None
    np.testing.assert_array_equal(part.confidence[:, 0, 0], [1, 1, 0])
    solid = Joints3D.observe(motion, 0.05, seed=4, hidden=hidden)
    assert 0.5 < (solid.joints - motion.positions)[~hidden].std() / 0.05 < 1.5


def test_likelihood_of_a_track():
    confidence = some_confidence(*SHAPE)
    points = np.where(confidence[..., None] > 0, 1.0, np.nan) * np.ones((*SHAPE, 2))
    track = KeypointTrack(points, confidence, CHAIN, 30)
    likelihood = Keypoints2D.from_track(track, Cameras.ring(1), 0.1)
    np.testing.assert_array_equal(likelihood.confidence, confidence[None])
    assert np.isfinite(likelihood.log_density(some_positions()))


@pytest.mark.parametrize("make", [keypoints, joints])
def test_the_linear_form_is_the_density_up_to_a_constant(make):
    likelihood = make()
    linear = likelihood.linear()
    positions = some_positions(6)
    residual = linear.target - np.einsum("vmi,blji->bvljm", linear.axes, positions)
    quadratic = -0.5 * (residual**2 * linear.precision[..., None]).sum(axis=(1, 2, 3, 4))
    gap = likelihood.log_density(positions) - quadratic
    np.testing.assert_allclose(gap, gap[0], rtol=1e-12)
    hidden = linear.precision == 0
    assert hidden.any()
    assert (linear.target[hidden] == 0).all()


def test_the_linear_form_includes_all_camera_parameters():
    cameras = Cameras(
        np.eye(3)[None], np.array([[0.3, -0.2, 5.0]]), np.array([2.0]), np.array([[7.0, 8.0]])
    )
    positions = some_positions(2)
    likelihood = Keypoints2D(np.zeros((1, *SHAPE, 2)), cameras, 0.4)
    linear = likelihood.linear()
    residual = linear.target - np.einsum("vmi,blji->bvljm", linear.axes, positions)
    wanted = likelihood.keypoints - cameras.project(positions)
    np.testing.assert_allclose(residual, wanted, atol=1e-13)


def test_nonlinear_likelihoods_are_not_conjugate():
    with pytest.raises(NotConjugate, match="the cameras are perspective, not orthographic"):
        keypoints(perspective=True).linear()
    for likelihood in (keypoints(3.0), joints(3.0)):
        with pytest.raises(NotConjugate, match="the noise is Student-t with 3 degrees of freedom"):
            likelihood.linear()


BLANK = np.zeros((2, *SHAPE, 2))
BROKEN = np.zeros((*SHAPE, 3))
BROKEN[2, 1, 0] = np.inf
MOTION = Motion(some_positions(), CHAIN, 30)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Keypoints2D(BLANK[:1], Cameras.ring(2), 0.1), r"keypoints must have shape \(2, L"),
        (lambda: Joints3D(BLANK[0], 0.1), r"joints must have shape \(L, J, 3\), got \(4, 3, 2\)"),
        (lambda: keypoints(confidence=np.ones(SHAPE)), r"confidence must have shape \(2, 4, 3\)"),
        (lambda: joints(noise="0.1"), "noise must be a finite number above 0"),
        (lambda: keypoints(noise=np.inf), "noise must be a finite number above 0"),
        (lambda: joints(-2.0), "degrees_of_freedom must be a finite number above 0"),
        (lambda: joints(confidence=-np.ones(SHAPE)), "confidence must be at least 0, got -1"),
        (lambda: joints(confidence=np.full(SHAPE, np.nan)), "confidence must be finite, got 12 va"),
        (lambda: Joints3D(BROKEN, 0.1), "joints must be finite, got 1 values"),
        (lambda: Keypoints2D(BLANK / 0, Cameras.ring(2), 0.1), "keypoints must be finite, got 48"),
        (
            lambda: Joints3D.observe(MOTION, 0.1, 0, hidden=np.zeros((3, 3), dtype=bool)),
            r"hidden must have shape \(4, 3\), got \(3, 3\)",
        ),
        (lambda: joints().log_density(np.zeros((5, 3, 3))), r"positions must have shape \(…, 4"),
        (lambda: joints().simulate(None, np.zeros((1, 4, 3, 3))), r"positions must have shape \(4"),
    ],
)
@pytest.mark.filterwarnings("ignore:invalid value")
def test_invalid_arguments(call, message):
    with pytest.raises(ValueError, match=message):
        call()
