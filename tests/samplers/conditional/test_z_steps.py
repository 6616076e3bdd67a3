"""Tests of split Gibbs with perspective cameras and Student-t noise against quadrature."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from probmotion import (
    Cameras,
    Joints3D,
    Keypoints2D,
    Motion,
    MotionPosterior,
    UnsupportedPosterior,
)
from probmotion.posteriors.likelihoods import LinearObservation
from probmotion.posteriors.sampling import suited
from probmotion.problems import load_problem
from probmotion.samplers.conditional import SplitGibbs
from probmotion.samplers.conditional.base import VarianceExploding
from probmotion.samplers.conditional.keypoints import Observations
from probmotion.samplers.conditional.z_steps import Auxiliary, MetropolisStep
from probmotion.samplers.diffusion.views import MotionDenoiser
from probmotion.seeds import NormalStreams

DRAWS = 1500
TINY = {"azimuth": [0.3, 1.4], "elevation": [0.2, -0.1]}


@pytest.fixture(scope="module")
def point(gaussian_motion):
    """Return a prior of one joint with correlated coordinates."""
    root = np.random.default_rng(3).normal(size=(3, 3)) * 0.12
    mean = np.array([[[0.1, -0.2, 0.15]]])
    return gaussian_motion(mean, root @ root.T + 0.02 * np.eye(3), scale=0.6)


OBSERVED = {
    "near camera": Keypoints2D(
        np.array([[[[0.25, 0.3]]]]),
        Cameras.around([0.3], [0.2], distance=1.8, perspective=True),
        0.1,
    ),
    "two near cameras": Keypoints2D(
        np.array([[[[0.25, 0.3]]], [[[-0.1, 0.2]]]]),
        Cameras.around(**TINY, distance=2.2, perspective=True),
        0.2,
        np.array([[[1.0]], [[0.5]]]),
    ),
    "student-t joint": Joints3D(np.array([[[0.6, 0.3, 0.1]]]), 0.15, degrees_of_freedom=3.0),
    "student-t keypoint": Keypoints2D(
        np.array([[[[0.5, 0.2]]], [[[0.1, 0.4]]]]),
        Cameras.around(**TINY),
        0.2,
        degrees_of_freedom=2.0,
    ),
    "both": Keypoints2D(
        np.array([[[[0.4, 0.3]]], [[[-0.1, 0.2]]]]),
        Cameras.around(**TINY, distance=2.2, perspective=True),
        0.15,
        degrees_of_freedom=3.0,
    ),
}


def quadrature(prior, likelihood):
    """Return grid points (n, 3) and the posterior weights."""
    root = np.linalg.cholesky(prior.covariance)
    unit = np.stack(np.meshgrid(*[np.linspace(-5, 5, 61)] * 3), axis=-1).reshape(-1, 3)
    unit = unit[(unit**2).sum(axis=1) < 25]
    points = prior.mean.ravel() + unit @ root.T
    log_weight = likelihood.log_density(points[:, None, None]) - 0.5 * (unit**2).sum(axis=1)
    weight = np.exp(log_weight - log_weight.max())
    return points, weight / weight.sum()


@pytest.mark.parametrize("name", OBSERVED)
def test_draws_have_the_moments_of_quadrature(point, assert_covariance, name):
    likelihood = OBSERVED[name]
    points, weight = quadrature(point, likelihood)
    mean = weight @ points
    covariance = (points - mean).T @ (weight[:, None] * (points - mean))
    sampler = SplitGibbs(steps=60, sweeps=20, batch=DRAWS)
    drawn = sampler.sample(MotionPosterior(point, likelihood), draws=DRAWS, progress=False)
    flat = drawn.flat().reshape(DRAWS, 3)
    white = np.linalg.inv(np.linalg.cholesky(covariance))
    error = white @ (flat.mean(axis=0) - mean)
    assert np.abs(error).max() < 5 / np.sqrt(DRAWS)
    # Errors of second moments are those of fourth moments of the posterior, by quadrature.
    products = np.einsum("ni,nj->nij", (points - mean) @ white.T, (points - mean) @ white.T)
    spread = np.sqrt(np.einsum("n,nij->ij", weight, (products - np.eye(3)) ** 2))
    got = np.cov(white @ (flat - mean).T)
    assert (np.abs(got - np.eye(3)) < 5 * spread / np.sqrt(DRAWS)).all()


@pytest.fixture
def cases(gaussian):
    """Return a function that converts a likelihood to its step, motions x and (z, w)."""

    def build(likelihood, n=50):
        rng = np.random.default_rng(1)
        centre = gaussian.mean.mean(axis=(0, 1)) / gaussian.scale
        step = MetropolisStep(Observations(likelihood, gaussian.scale, centre), centre)
        x = gaussian.sample(rng, n) / gaussian.scale
        z = x + 0.1 * rng.normal(size=x.shape)
        shape = (n, *step._observations.precision.shape)
        return step, x, Auxiliary(z, rng.uniform(0.2, 2.0, shape))

    return build


@pytest.fixture(scope="module")
def truth(gaussian):
    positions = gaussian.sample(np.random.default_rng(8), 1)[0]
    return Motion(positions, gaussian.skeleton, gaussian.fps)


@pytest.fixture(scope="module")
def keypoints(truth):
    """Return a function that observes keypoints in two perspective cameras, one hidden."""
    hidden = np.zeros((2, 2, 2), dtype=bool)
    hidden[1, 0, 1] = True

    def observe(distance=7.0, perspective=True, **options):
        cameras = Cameras.around(**TINY, distance=distance, perspective=perspective)
        cameras = replace(cameras, centre=np.array([[0.3, 0.1], [0.0, -0.2]]))
        return Keypoints2D.observe(truth, cameras, 0.2, seed=0, hidden=hidden, **options)

    return observe


@pytest.mark.parametrize("perspective", [True, False])
def test_linearisation(keypoints, gaussian, cases, perspective):
    """Residuals are those of the likelihood, and slopes its gradient."""
    likelihood = keypoints(3.0, perspective)
    step, x, _ = cases(likelihood, n=2)
    observations, scale = step._observations, gaussian.scale
    local = observations.linearise(x)
    seen = likelihood.keypoints - likelihood.cameras.project(scale * x)
    got = local.residual.reshape(2, 2, 2, 2, 2)  # draw, frame, joint, view, axis
    visible = likelihood.entries.visible
    np.testing.assert_allclose(np.moveaxis(got, 3, 1)[:, visible], seen[:, visible], atol=1e-12)
    slope = local.slope(observations.precision)
    for index in np.ndindex(*x.shape[1:]):
        change = np.zeros(x.shape[1:])
        change[index] = 1e-6
        above, below = (likelihood.log_density(scale * (x + s * change)) for s in (1, -1))
        np.testing.assert_allclose(slope[:, *index], (above - below) / 2e-6, rtol=1e-5, atol=1e-5)


def test_guidance_by_distant_cameras_is_that_of_orthographic_ones(keypoints, gaussian, cases):
    """Guided estimates and weights, with two cameras and a hidden joint."""
    clean = VarianceExploding(MotionDenoiser(gaussian))
    x = cases(keypoints(), n=3)[1]
    results = []
    for likelihood in (keypoints(1e5), keypoints(perspective=False)):
        posterior = MotionPosterior(gaussian, likelihood)
        estimate = clean(x, 0.3)
        _, observations = SplitGibbs()._step(posterior, clean)
        results.append(clean.condition(observations.about(estimate), x, 0.3, estimate))
    for (ours, theirs), change in zip(zip(*results, strict=True), (x, 1.0), strict=True):
        assert abs(ours - change).max() > 0.1
        np.testing.assert_allclose(ours, theirs, rtol=1e-3, atol=1e-3)


def test_joints_behind_a_camera_do_not_move_with_depth(keypoints, cases):
    step, x, _ = cases(keypoints(3.0), n=2)
    x = x - 100 * step._observations._cameras.rotation[0, 2]
    assert not step._observations.in_front(x).any()
    local = step._observations.linearise(x)
    for axis, change in enumerate(1e-6 * np.eye(3)):
        moved = step._observations.linearise(x + change).residual
        slope = (local.residual - moved) / 1e-6
        np.testing.assert_allclose(local.axes[..., axis], slope, rtol=1e-4, atol=1e-4)


def test_proposals_of_linear_observations_are_exact(keypoints, truth, cases):
    for likelihood in (
        keypoints(perspective=False, degrees_of_freedom=3.0),
        Joints3D.observe(truth, 0.2, seed=0, degrees_of_freedom=3.0),
    ):
        step, x, auxiliary = cases(likelihood)
        log_importance = step.log_importance(auxiliary, x, rho=0.3 * step.noise)
        assert np.ptp(log_importance) < 1e-9


def test_proposals_of_perspective_cameras_are_mostly_accepted(keypoints, cases):
    step, x, _ = cases(keypoints(7.0), n=400)
    streams = NormalStreams([np.random.default_rng(i) for i in range(400)])
    rho = 0.95 * step.noise
    before = step.draw(x, rho, streams, None)
    after = step.draw(x, rho, streams, before)
    accepted = (after.z != before.z).all(axis=-1).mean()
    assert 0.9 < accepted < 1


def test_precision_factors_given_residuals(truth, cases):
    """Given the residual r, w ~ Gamma((ν + 1)/2, rate (ν + r²/σ²)/2)."""
    likelihood = Joints3D.observe(truth, 0.2, seed=0, degrees_of_freedom=3.0)
    observations = cases(likelihood)[0]._observations
    residual = np.full((2000, 2, 2, 3), 0.3)
    streams = NormalStreams([np.random.default_rng(i) for i in range(2000)])
    weights = observations.weights(residual, streams)
    expected = stats.gamma(2.0, scale=2 / (3.0 + 1.5**2))
    assert stats.kstest(weights.ravel(), expected.cdf).pvalue > 1e-3
    assert stats.gamma(2.0, scale=2 / 3.0).sf(observations.largest_weight) <= 1.0001e-4


def test_distant_cameras_are_orthographic(gaussian, keypoints, assert_covariance):
    mean, covariance = gaussian.posterior(keypoints(perspective=False))
    posterior = MotionPosterior(gaussian, keypoints(1e5))
    sampler = SplitGibbs(steps=60, sweeps=6, batch=DRAWS)
    drawn = sampler.sample(posterior, draws=DRAWS, progress=False).flat()
    assert_covariance(drawn - mean, covariance)
    error = abs(drawn.mean(axis=0) - mean).ravel()
    assert (error < 5 * np.sqrt(np.diag(covariance) / DRAWS)).all()


class Affine:
    """Keypoints of one perspective camera, linearised about a motion, one view for each joint."""

    def __init__(self, likelihood, about):
        L, J, V = *about.shape[:2], about[..., 0].size
        step = 1e-6 * np.eye(3)[:, None, None]
        project = likelihood.cameras.project
        slopes = (project(about + step) - project(about - step))[:, 0] / 2e-6
        self.axes = np.moveaxis(slopes, 0, -1).reshape(V, 2, 3)
        each = np.eye(V).reshape(V, L, J)
        shift = (self.axes @ about.reshape(V, 3, 1))[..., 0].reshape(L, J, 2)
        seen = likelihood.keypoints[0] - project(about)[0] + shift
        self.target = each[..., None] * seen
        self.precision = each * likelihood.entries.precision[0]

    def linear(self):
        return LinearObservation(self.axes, self.target, self.precision)

    def log_density(self, motions):
        flat = motions.reshape(len(motions), -1, 3)
        residual = self.target.sum(axis=(1, 2)) - np.einsum("vmx,nvx->nvm", self.axes, flat)
        return -0.5 * (self.precision.sum(axis=(1, 2))[:, None] * residual**2).sum(axis=(1, 2))


def errors_in_a_perspective_camera(samplers, frames, distance):
    """Return the error of the mean, in standard deviations, and the variance ratio of samplers.

    The reference is the exact posterior of linearised keypoints, with importance weights. Draws
    as if the camera were orthographic are the last row.
    """
    problem = load_problem(f"gait-monocular(frames={frames})")
    prior, rng = problem.posterior.prior, np.random.default_rng(0)
    camera = Cameras.around([0.0], [0.26], distance=distance, perspective=True)
    motion = Motion(problem.truth, prior.skeleton, prior.fps)
    likelihood = Keypoints2D.observe(motion, camera, 0.02, seed=0)
    affine = Affine(likelihood, problem.truth)
    motions = prior.exact_posterior(affine).sample(rng, 4000)
    log_weight = likelihood.log_density(motions) - affine.log_density(motions)
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    assert (weight**2).sum() < 1 / 2000
    flat = motions.reshape(4000, -1)
    mean = weight @ flat
    variance = weight @ (flat - mean) ** 2
    posterior = MotionPosterior(prior, likelihood)
    approximate = replace(likelihood, cameras=camera.as_orthographic())
    drawn = [sampler.sample(posterior, draws=200, progress=False).flat() for sampler in samplers]
    drawn.append(prior.exact_posterior(approximate).sample(rng, 200))
    rows = []
    for draws in drawn:
        away = np.linalg.norm(draws.reshape(200, -1).mean(axis=0) - mean)
        rows.append((away / np.sqrt(variance.sum()), draws.var(axis=0).sum() / variance.sum()))
    return np.array(rows)


def test_gaits_in_a_perspective_camera():
    sampler = SplitGibbs(steps=100, start_steps=20)
    ours, orthographic = errors_in_a_perspective_camera([sampler], 3, 3.0)
    assert ours[0] < 0.2
    assert ours[1] == pytest.approx(1, abs=0.2)
    assert orthographic[0] > 0.5


@pytest.mark.slow
@pytest.mark.parametrize("distance", [3.0, 7.0])
def test_seconds_of_gaits_in_a_perspective_camera(distance):
    samplers = [SplitGibbs(denoiser="3d"), SplitGibbs(denoiser="2d")]
    *ours, orthographic = rows = errors_in_a_perspective_camera(samplers, 30, distance)
    print(f"{distance:g} m: mean error and variance of 3d, 2d, orthographic\n{rows.round(3)}")
    for error, variance in ours:
        assert error < 0.15  # 200 exact draws have .07
        assert variance == pytest.approx(1, abs=0.1)
    assert orthographic[0] > 0.4


@pytest.mark.parametrize("denoiser", ["3d", "2d"])
def test_draws_do_not_depend_on_the_batch(gaussian, keypoints, denoiser):
    posterior = MotionPosterior(gaussian, keypoints(3.0, degrees_of_freedom=3.0))
    sampler = SplitGibbs(steps=10, sweeps=3, start_steps=4, denoiser=denoiser)
    together = sampler.sample(posterior, draws=5, chains=2, progress=False)
    apart = replace(sampler, batch=2).sample(posterior, draws=3, chains=2, progress=False)
    np.testing.assert_allclose(apart.positions.values, together.positions.values[:, :3], atol=1e-9)


def test_unsupported_observations(gaussian, keypoints):
    class Flat:
        def log_density(self, positions):
            return 0 * positions.sum(axis=(-3, -2, -1))

        def simulate(self, rng, positions):
            return self

    posterior = MotionPosterior(gaussian, Flat())
    assert "split-gibbs" not in suited(posterior)
    assert "split-gibbs" in suited(MotionPosterior(gaussian, keypoints()))
    message = "^split-gibbs supports keypoints, joints and linear Gaussian likelihoods, got Flat"
    with pytest.raises(UnsupportedPosterior, match=message):
        SplitGibbs().sample(posterior, draws=1, progress=False)
    likelihood = keypoints()
    blank = replace(likelihood, confidence=np.zeros((2, 2, 2)))
    with pytest.raises(ValueError, match="likelihood must contain an observed entry, got none"):
        SplitGibbs().sample(MotionPosterior(gaussian, blank), draws=1, progress=False)
    away = replace(likelihood, cameras=replace(likelihood.cameras, translation=-np.ones((2, 3))))
    with pytest.raises(ValueError, match="must be in front of every camera, got depth"):
        SplitGibbs().sample(MotionPosterior(gaussian, away), draws=1, progress=False)
