"""Tests of the split Gibbs sampler: exact at finite coupling, its parts, wrong settings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from probmotion import Cameras, Joints3D, Keypoints2D, Motion, MotionPosterior
from probmotion.samplers.conditional import SplitGibbs, twisted, z_steps
from probmotion.samplers.conditional.coupling import Coupling, Quadratic
from probmotion.samplers.diffusion.guidance import LinearObservations
from probmotion.seeds import NormalStreams

DRAWS = 1500
SWEPT = 3000


@pytest.fixture(scope="module")
def keypoints(gaussian):
    """Return keypoints of one camera, of which one is hidden."""
    truth = Motion(gaussian.sample(np.random.default_rng(8), 1)[0], gaussian.skeleton, gaussian.fps)
    hidden = np.zeros((1, 2, 2), dtype=bool)
    hidden[0, 0, 1] = True
    return Keypoints2D.observe(
        truth, Cameras.around([0.3], [0.2]), noise=0.2, seed=0, hidden=hidden
    )


def assert_exact(sampler, prior, likelihood, assert_covariance):
    mean, covariance = prior.posterior(likelihood)
    drawn = sampler.sample(MotionPosterior(prior, likelihood), draws=DRAWS, progress=False).flat()
    assert_covariance(drawn - mean, covariance)
    error = abs(drawn.mean(axis=0) - mean).ravel()
    assert (error < 5 * np.sqrt(np.diag(covariance) / DRAWS)).all()


@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
def test_draws_are_exact_at_finite_coupling(gaussian, keypoints, assert_covariance, share):
    sampler = SplitGibbs(steps=60, sweeps=6, share=share)
    assert_exact(sampler, gaussian, keypoints, assert_covariance)


def test_draws_are_exact_with_several_cameras(gaussian, keypoints, assert_covariance):
    """Cameras of other focal lengths, which see a joint from similar directions."""
    cameras = Cameras.around([0.3, 0.5, 2.0], [0.2, 0.1, 0.0])
    cameras = replace(cameras, focal=np.array([1.0, 2.0, 0.5]))
    seen = Keypoints2D(cameras.project(gaussian.mean), cameras, noise=0.3)
    assert_exact(SplitGibbs(steps=60, sweeps=6), gaussian, seen, assert_covariance)


def test_draws_from_views_are_exact_where_these_agree(
    gaussian, gaussian_motion, keypoints, assert_covariance
):
    """The three coordinates are independent and alike, so that every view has the 3D estimate."""
    between = gaussian.covariance.reshape(4, 3, 4, 3).trace(axis1=1, axis2=3)
    prior = gaussian_motion(gaussian.mean, np.kron(between, np.eye(3)), scale=0.7)
    sampler = SplitGibbs(steps=60, sweeps=6, denoiser="2d")
    assert_exact(sampler, prior, keypoints, assert_covariance)


def exact_draws(mean, covariance, rng):
    x = rng.normal(size=(SWEPT, mean.size)) @ np.linalg.cholesky(covariance).T
    return mean + x.reshape(SWEPT, *mean.shape)


class SharedGenerator(NormalStreams):
    """Streams of a batch from its first generator, which takes less time."""

    def _filled(self, method, size):
        return getattr(self.generators[0], method)(size)


@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
@pytest.mark.parametrize("subtracted", [True, False])
def test_sweeps_leave_the_posterior_invariant(
    gaussian, keypoints, assert_covariance, monkeypatch, share, subtracted
):
    """Exact draws remain exact in 30 sweeps, and not without the subtraction of ρ²."""
    if not subtracted:
        monkeypatch.setattr(
            z_steps, "Coupling", lambda likelihood, rho, gains: Coupling(likelihood, rho)
        )
    mean, covariance = gaussian.posterior(keypoints)
    rng, posterior = np.random.default_rng(3), MotionPosterior(gaussian, keypoints)
    x = exact_draws(mean, covariance, rng)
    sampler = SplitGibbs(sweeps=30, inner_steps=12, share=share)
    pools = sampler._pools(posterior)
    step, _ = sampler._step(posterior, pools[0])
    streams = SharedGenerator([rng] * SWEPT)
    x = gaussian.scale * sampler._sweep(pools, step, x / gaussian.scale, streams, lambda: None)
    # The expected log likelihood is that of the mean, less half of the number of directions that
    # the observations determine.
    determined = 12 - np.trace(np.linalg.solve(gaussian.covariance, covariance))
    log_density = keypoints.log_density(x)
    error = log_density.mean() - keypoints.log_density(mean) + 0.5 * determined
    deviations = abs(error) / (log_density.std() / np.sqrt(SWEPT))
    if subtracted:
        assert deviations < 4
        assert_covariance(x - mean, covariance)
        assert (abs(x.mean(axis=0) - mean).ravel() < 5 * np.sqrt(np.diag(covariance) / SWEPT)).all()
    else:
        assert deviations > 4


def test_langevin_dynamics_end_in_the_posterior(gaussian, keypoints, assert_covariance):
    """Of precise keypoints: ρ falls from above their noise to below it, where z is exact."""
    precise = replace(keypoints, noise=0.05 * keypoints.noise)
    mean, covariance = gaussian.posterior(precise)
    rng, posterior = np.random.default_rng(4), MotionPosterior(gaussian, precise)
    x = exact_draws(mean, covariance, rng)
    sampler = SplitGibbs()
    pools = sampler._pools(posterior)
    step, _ = sampler._step(posterior, pools[0])
    streams = SharedGenerator([rng] * SWEPT)
    x = gaussian.scale * sampler._anneal(pools, step, x / gaussian.scale, streams, lambda: None)
    assert_covariance(x - mean, covariance)


def test_reverse_diffusion_draws_from_the_conditional(gaussian, assert_covariance):
    """X | z has the posterior of joints observed with noise ρ."""
    rho, z = 0.4, np.random.default_rng(3).normal(size=(2, 2, 3))
    scaled = replace(gaussian, scale=1.0)
    precision = np.linalg.inv(scaled.covariance) + np.eye(12) / rho**2
    covariance = np.linalg.inv(precision)
    mean = covariance @ (
        np.linalg.solve(scaled.covariance, scaled.mean.ravel()) + z.ravel() / rho**2
    )
    sampler = SplitGibbs(inner_steps=12)
    posterior = MotionPosterior(scaled)
    clean = sampler._pools(posterior)[0]
    streams = NormalStreams([np.random.default_rng(i) for i in range(3000)])
    drawn = sampler._reverse(clean, np.broadcast_to(z, (3000, 2, 2, 3)), rho, streams)
    assert_covariance(drawn - mean.reshape(2, 2, 3), covariance)


def test_scores_are_those_of_the_marginal(gaussian, keypoints):
    """p_ρ(z) N(y; A z, σ_y² − ρ²) is Gaussian: compare with finite differences of its density."""
    rho = 0.15
    prior = replace(gaussian, scale=1.0)
    observations = LinearObservations.of(SplitGibbs(), MotionPosterior(prior, keypoints))
    clean = SplitGibbs()._pools(MotionPosterior(prior))[0]
    likelihood = Quadratic.of(observations)
    coupling = Coupling(likelihood, rho, likelihood.gains(rho))
    wide = np.linalg.inv(prior.covariance + rho**2 * np.eye(12))
    axes, target, precision = keypoints.linear()
    weight = np.where(precision > 0, 1 / (keypoints.noise**2 - rho**2), 0.0)

    def log_density(z):
        deviation = (z - prior.mean).ravel()
        residual = target - z @ axes.swapaxes(1, 2)[:, None]
        square = (weight[..., None] * residual**2).sum()
        return -0.5 * (deviation @ wide @ deviation + square)

    z = prior.mean + np.random.default_rng(0).normal(size=prior.mean.shape)
    score = coupling.score(z[None], clean(z[None], rho))[0]
    for index in np.ndindex(*z.shape):
        step = np.zeros(z.shape)
        step[index] = 1e-5
        slope = (log_density(z + step) - log_density(z - step)) / 2e-5
        assert score[index] == pytest.approx(slope, rel=1e-5, abs=1e-5)


@pytest.mark.parametrize("weighted", [True, False])
def test_modes_have_the_probabilities_of_the_posterior(mixture, monkeypatch, weighted):
    """Three modes have these from many weighted starts, and not from starts without weights."""
    if not weighted:
        monkeypatch.setattr(
            twisted,
            "_resampled",
            lambda weights, streams: np.broadcast_to(np.arange(weights.shape[1]), weights.shape),
        )
    truth = Motion(mixture.sample(np.random.default_rng(4), 1)[0], mixture.skeleton, mixture.fps)
    hidden = np.array([[[False, False], [True, True]]])
    seen = Keypoints2D.observe(truth, Cameras.ring(1, elevation=0.3), 0.3, seed=0, hidden=hidden)
    exact = mixture.exact_posterior(seen).component_probabilities
    assert (np.sort(exact, axis=None)[-3:] > 0.15).all()
    particles = 64 if weighted else 2
    sampler = SplitGibbs(steps=0, sweeps=1, particles=particles)
    drawn = sampler.sample(MotionPosterior(mixture, seen), draws=300, progress=False).flat()
    found = mixture._metres.responsibilities(drawn.reshape(300, -1)).mean(axis=0)
    distance = 0.5 * np.abs(found - exact).sum()
    assert (distance < 0.15) == weighted


@pytest.mark.parametrize("denoiser", ["3d", "2d"])
def test_draws_do_not_depend_on_the_batch(gaussian, keypoints, denoiser):
    posterior = MotionPosterior(gaussian, keypoints)
    sampler = SplitGibbs(steps=10, sweeps=2, start_steps=4, denoiser=denoiser)
    together = sampler.sample(posterior, draws=5, chains=2, progress=False)
    apart = replace(sampler, batch=2).sample(posterior, draws=3, chains=2, progress=False)
    np.testing.assert_allclose(apart.positions.values, together.positions.values[:, :3], atol=1e-9)
    assert len(np.unique(together.flat().round(9), axis=0)) == 10
    views = 3 if denoiser == "2d" else 1
    assert together.counts["denoiser"] % (10 * views) == 0
    assert together.counts["covariance"] > 0


def test_nothing_observed(gaussian, keypoints):
    blank = replace(keypoints, confidence=np.zeros((1, 2, 2)))
    with pytest.raises(ValueError, match="likelihood must contain an observed entry, got none"):
        SplitGibbs().sample(MotionPosterior(gaussian, blank), draws=1, progress=False)


def test_noise_below_the_resolution_of_denoisers(gaussian):
    exact = MotionPosterior(gaussian, Joints3D(gaussian.mean, noise=1e-9))
    with pytest.raises(ValueError, match=r"noise of a joint .* at least 7e-07 m.*, got 1e-09 m"):
        SplitGibbs().sample(exact, draws=1, progress=False)


def test_wrong_settings():
    with pytest.raises(ValueError, match=r"share must be below 1, as ρ must end below the noise"):
        SplitGibbs(share=1.2)
    with pytest.raises(ValueError, match="inner_steps must be an integer of at least 3, got 2"):
        SplitGibbs(inner_steps=2)
    with pytest.raises(ValueError, match="particles must be an integer of at least 2, got 1"):
        SplitGibbs(particles=1)


def test_particles_are_chosen_by_their_weights():
    systems = 4000
    weights = np.log([0.1, 0.7, 0.2])
    guided = np.tile(np.arange(3.0), systems).reshape(-1, 1, 1, 1)
    log_weights = np.tile(weights + 5.0, (systems, 1))
    particles = twisted.Particles(guided, guided, log_weights, log_weights)
    chosen = particles.chosen(NormalStreams.of_draws(0, [(0, i) for i in range(systems)]))
    shares = np.bincount(chosen.reshape(-1).astype(int), minlength=3) / systems
    np.testing.assert_allclose(shares, np.exp(weights), atol=4 * np.sqrt(0.25 / systems))
