"""Tests of DAPS, RED-diff and twisted diffusion against linear algebra."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from probmotion import Cameras, Joints3D, Keypoints2D, Motion, MotionPosterior, UnsupportedPosterior
from probmotion.samplers.conditional import DAPS, REDDiff, TwistedDiffusion
from probmotion.samplers.conditional.coupling import Coupling, Quadratic
from probmotion.samplers.conditional.twisted import _resampled
from probmotion.samplers.diffusion import LogSNR
from probmotion.samplers.diffusion.guidance import LinearObservations
from probmotion.seeds import NormalStreams

QUICK = [DAPS(steps=4, ode_steps=2), REDDiff(steps=5), TwistedDiffusion(steps=4, particles=2)]


@pytest.fixture(scope="module")
def keypoints(gaussian):
    truth = Motion(gaussian.sample(np.random.default_rng(8), 1)[0], gaussian.skeleton, gaussian.fps)
    hidden = np.zeros((2, 2, 2), dtype=bool)
    hidden[1, 0, 1] = True
    cameras = Cameras.around([0.3, 1.1], [0.2, 0.5])
    return Keypoints2D.observe(truth, cameras, noise=0.1, seed=0, hidden=hidden)


def test_couplings_are_gaussian(gaussian_motion, gaussian, keypoints, assert_covariance):
    """N(y; A z, W⁻¹) N(z; x, ρ²) is the posterior of an isotropic prior at x."""
    rho, x = 0.3, np.random.default_rng(1).normal(size=(2, 2, 3))
    isotropic = gaussian_motion(0.7 * x, (0.7 * rho) ** 2 * np.eye(12), scale=0.7)
    mean, covariance = isotropic.posterior(keypoints)
    observations = LinearObservations.of(DAPS(), MotionPosterior(gaussian, keypoints))
    coupling = Coupling(Quadratic.of(observations), rho)
    many = np.broadcast_to(x, (6000, *x.shape))
    np.testing.assert_allclose(0.7 * coupling.mean(many[:1])[0], mean, atol=1e-10)
    noise = np.random.default_rng(2).standard_normal(many.shape)
    assert_covariance(0.7 * coupling.draw(many, noise) - mean, covariance)


def test_twisted_diffusion_is_exact_for_a_gaussian(gaussian, keypoints, assert_covariance):
    mean, covariance = gaussian.posterior(keypoints)
    sampler = TwistedDiffusion(steps=100, particles=2, levels=LogSNR(1e-2, 50.0), batch=500)
    draws = sampler.sample(MotionPosterior(gaussian, keypoints), draws=500, progress=False)
    assert_covariance(draws.flat() - mean, covariance)
    assert (
        abs(draws.flat().mean(axis=0) - mean).ravel() < 5 * np.sqrt(np.diag(covariance) / 1e3)
    ).all()


def test_particles_correct_a_wrong_proposal(gaussian, keypoints):
    """Proposals without guidance have the wrong mean, which weights correct."""

    class Unguided(type(gaussian)):
        def motion_covariance(self, x_t, alpha_bar):
            covariance = super().motion_covariance(x_t, alpha_bar)
            return lambda vectors: 0.3 * covariance(vectors)

    prior = Unguided(gaussian.mean, gaussian.covariance, gaussian.scale)
    mean, covariance = gaussian.posterior(keypoints)
    posterior = MotionPosterior(prior, keypoints)
    errors = []
    for particles in (2, 32):
        sampler = TwistedDiffusion(steps=30, particles=particles, levels=LogSNR(0.01, 50.0))
        drawn = sampler.sample(posterior, draws=80, progress=False).flat()
        z = (drawn.mean(axis=0) - mean).ravel() / np.sqrt(np.diag(covariance))
        errors.append(np.sqrt((z**2).mean()))
    assert errors[1] < 0.5 * errors[0]


def test_ancestors_follow_the_weights():
    log_weights = np.log(np.tile([0.5, 0.1, 0.4], (4000, 1)))
    streams = NormalStreams([np.random.default_rng(i) for i in range(4000)])
    ancestors = _resampled(log_weights, streams)
    for chosen in (ancestors[:, 0], ancestors.ravel()):
        np.testing.assert_allclose(np.bincount(chosen) / chosen.size, [0.5, 0.1, 0.4], atol=0.03)


@pytest.mark.parametrize("precision", [4.0, 0.0])
def test_annealing_has_the_moments_of_its_linear_maps(gaussian_motion, precision):
    """For isotropic priors all steps are scalar and linear."""
    prior = gaussian_motion(np.zeros((1, 2, 3)), np.eye(6))
    seen = Joints3D(np.full((1, 2, 3), 0.8), 0.5, np.array([[1.0, 0.0]]))
    sampler = DAPS(steps=8, ode_steps=3, levels=LogSNR(0.05, 10.0))
    mean, variance = 0.0, 0.0
    for t in range(8, 0, -1):
        sigma = sampler.schedule.sigma(t)
        gain = 1.0
        below = np.geomspace(sigma, 0.05, 3)
        for now, after in zip(below, [*below[1:], 0.0], strict=True):
            shrink = 1 / (1 + now**2)
            gain *= shrink + after / now * (1 - shrink)
        total = 1 / sigma**2 + precision
        mean = (gain * mean / sigma**2 + 0.8 * precision) / total
        variance = gain**2 * (variance + sigma**2) / sigma**4 / total**2 + 1 / total
    drawn = sampler.sample(MotionPosterior(prior, seen), draws=4000, progress=False).flat()
    joint = drawn[:, :, 0 if precision else 1]
    error = np.sqrt(2 / joint.size)
    assert joint.mean() == pytest.approx(mean, abs=5 * np.sqrt(variance / joint.size))
    assert joint.var() == pytest.approx(variance, rel=5 * error)
    if not precision:
        # Where nothing is observed, noise is added twice: draws are not those of the prior.
        assert joint.var() > 1 + 20 * error


def test_optimised_motions_are_modes_without_spread(gaussian, keypoints):
    posterior = MotionPosterior(gaussian, keypoints)
    drawn = REDDiff(steps=600).sample(posterior, draws=20, progress=False).flat()
    covariance = gaussian.posterior(keypoints)[1]
    assert drawn.reshape(20, -1).var(axis=0).sum() < 0.3 * np.trace(covariance)
    residual = keypoints.keypoints - keypoints.cameras.project(drawn)
    prior_residual = keypoints.keypoints - keypoints.cameras.project(gaussian.mean)
    seen = keypoints.entries.visible
    assert (residual[:, seen] ** 2).mean() < 0.1 * (prior_residual[seen] ** 2).mean()


def test_regularisation_balances_residual_and_prior(gaussian_motion):
    """At a constant level, steps of a standard normal end at the root of the mean gradient."""
    prior = gaussian_motion(np.zeros((1, 2, 3)), np.eye(6))
    posterior = MotionPosterior(prior, Joints3D(np.full((1, 2, 3), 0.8), noise=0.5))
    sigmas, streams = np.ones(300), NormalStreams([np.random.default_rng(i) for i in range(400)])
    for weight in (0.25, 1.0):
        sampler = REDDiff(weight=weight)
        given = sampler._pools(posterior), sampler._observations(posterior), (1, 2, 3)
        mean = sampler._draw(*given, sigmas, streams, lambda: None).mean()
        # (μ − y) + λ (μ − E[D(μ + ε)]) = 0 with D(x) = x/2.
        assert mean == pytest.approx(0.8 / (1 + weight / 2), abs=0.01)


@pytest.mark.parametrize("sampler", QUICK, ids=lambda sampler: sampler.name)
@pytest.mark.parametrize("denoiser", ["3d", "2d"])
def test_draws_do_not_depend_on_the_batch(gaussian, keypoints, sampler, denoiser):
    posterior = MotionPosterior(gaussian, keypoints)
    sampler = replace(sampler, denoiser=denoiser)
    together = sampler.sample(posterior, draws=5, chains=2, progress=False)
    apart = replace(sampler, batch=2).sample(posterior, draws=3, chains=2, progress=False)
    np.testing.assert_allclose(apart.positions.values, together.positions.values[:, :3], atol=1e-10)
    assert len(np.unique(together.flat().round(9), axis=0)) == 10
    expected = replace(sampler, batch=1).sample(posterior, draws=1, progress=False).counts
    assert together.counts == {name: 10 * count for name, count in expected.items()}
    if denoiser == "2d":
        assert expected["denoiser"] % 3 == 0


@pytest.mark.parametrize("sampler", QUICK, ids=lambda sampler: sampler.name)
def test_unsuitable_posteriors(gaussian, keypoints, minimal, sampler):
    with pytest.raises(UnsupportedPosterior, match="needs observations; try "):
        sampler.sample(MotionPosterior(gaussian), draws=1, progress=False)
    heavy = replace(keypoints, degrees_of_freedom=4.0)
    with pytest.raises(UnsupportedPosterior, match="supports only linear Gaussian likelihoods"):
        sampler.sample(MotionPosterior(gaussian, heavy), draws=1, progress=False)
    with pytest.raises(UnsupportedPosterior, match=r"Denoises3D or Denoises2D.*, got Minimal"):
        sampler.sample(MotionPosterior(minimal()), draws=1)
    with pytest.raises(ValueError, match="denoiser must be one of any, 3d, 2d, got '4d'"):
        replace(sampler, denoiser="4d")
