"""Tests of `MultiViewPredictorCorrector`: reduction to MAS, exact covariance, the corrector."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from probmotion import Cameras, MotionPosterior
from probmotion.samplers import MultiViewAncestral, MultiViewPredictorCorrector
from probmotion.samplers.diffusion.ancestral import MotionState
from probmotion.samplers.diffusion.views import MultiViewDenoiser, Views
from probmotion.seeds import NormalStreams

BARE = {"gamma": 0.0, "corrector_steps": 0}


def test_without_gamma_and_corrector_it_is_mas(gaussian):
    posterior = MotionPosterior(gaussian)
    bare = MultiViewPredictorCorrector(steps=20, **BARE)
    ours = bare.sample(posterior, draws=6, chains=2, seed=3, progress=False)
    mas = MultiViewAncestral(steps=20).sample(posterior, draws=6, chains=2, seed=3, progress=False)
    np.testing.assert_array_equal(ours.positions, mas.positions)
    assert ours.counts == mas.counts
    for change in ({"gamma": 0.5}, {"corrector_steps": 1}):
        other = replace(bare, **change).sample(posterior, draws=6, chains=2, seed=3, progress=False)
        assert abs(other.positions.values - mas.positions.values).max() > 1e-3


@pytest.mark.parametrize(
    ("settings", "calls"),
    [
        ({}, 475),
        ({"steps": 100}, 955),
        ({"steps": 100, "corrector_steps": 2, "corrector_size": 0.4}, 1410),
        ({"steps": 100, "corrector_steps": 3, "corrector_size": 0.3}, 1865),
    ],
)
def test_evaluations_are_counted(gaussian, settings, calls):
    sampler = MultiViewPredictorCorrector(**settings)
    draws = sampler.sample(MotionPosterior(gaussian), draws=2, progress=False)
    assert draws.counts == {"denoiser": 2 * calls}


def test_gamma_by_noise_level():
    sampler = MultiViewPredictorCorrector()
    levels = (0.01, 0.15, 0.499, 0.5, 1.0, 50.0)
    assert [sampler.gamma_at(level) for level in levels] == [0, 0, 0, 0.5, 0.5, 0.5]


def test_noise_has_the_covariance_lambda_to_the_gamma(assert_covariance):
    sampler = MultiViewPredictorCorrector(n_views=4, elevation=0.6, gamma=0.8)
    views = Views(Cameras.ring(4, elevation=0.6))
    spread = 4 * np.linalg.inv(views.gram)
    np.testing.assert_allclose(np.trace(np.linalg.inv(spread)), 2, atol=1e-12)
    factor = sampler._noise_factor(views)
    assert factor(0.1) is None
    values, vectors = np.linalg.eigh(spread)
    expected = vectors @ np.diag(values**0.8) @ vectors.T
    for level in (0.6, 3.0):
        np.testing.assert_allclose(factor(level) @ factor(level).T, expected, atol=1e-12)
        state = MotionState(MultiViewDenoiser(None, views), sampler.schedule, (1, 1, 3))
        state.noise_factor = factor
        t = int(np.argmin(abs(np.sqrt(1 / sampler.schedule.alpha_bar - 1) - level)))
        streams = NormalStreams([np.random.default_rng(i) for i in range(4000)])
        assert_covariance(state.noise(streams, t), expected)


def mvpc_covariance(prior, sampler):
    """Return the exact covariance of the sampler on a zero-mean Gaussian prior."""
    n = prior.dim
    unit = np.eye(n).reshape(n, *prior.mean.shape)
    views = Views(Cameras.ring(sampler.n_views, elevation=sampler.elevation))
    denoiser = MultiViewDenoiser(prior, views)
    schedule, size = sampler.schedule, sampler.corrector_size
    sigma = np.sqrt(1 / schedule.alpha_bar - 1)
    values, vectors = np.linalg.eigh(sampler.n_views * np.linalg.inv(views.gram))

    def matrix(t):
        return denoiser.denoise(unit, schedule.alpha_bar[t]).reshape(n, n).T

    def noise(t):
        power = 0.5 if sigma[t] >= 0.5 else 0.0
        return np.kron(np.eye(n // 3), (vectors * values**power) @ vectors.T)

    covariance = noise(schedule.steps)
    for t in range(schedule.steps, 1, -1):
        step = schedule.posterior(t)
        move = step.clean * matrix(t) + step.noisy * np.eye(n)
        covariance = move @ covariance @ move.T + step.deviation**2 * noise(t - 1)
        if sigma[t - 1] >= 0.15:
            alpha_bar = schedule.alpha_bar[t - 1]
            move = (1 - size) * np.eye(n) + size * math.sqrt(alpha_bar) * matrix(t - 1)
            for _ in range(sampler.corrector_steps):
                covariance = move @ covariance @ move.T + 2 * size * (1 - alpha_bar) * noise(t - 1)
    return matrix(1) @ covariance @ matrix(1).T


@pytest.mark.parametrize("corrector_steps", [0, 2])
def test_draws_have_the_exact_covariance(gaussian, assert_covariance, corrector_steps):
    sampler = MultiViewPredictorCorrector(steps=8, corrector_steps=corrector_steps)
    draws = sampler.sample(MotionPosterior(gaussian), draws=10_000, seed=4, progress=False)
    expected = mvpc_covariance(replace(gaussian, mean=np.zeros_like(gaussian.mean)), sampler)
    mean = draws.flat().mean(axis=0)
    assert_covariance(draws.flat() - mean, expected * gaussian.scale**2)


def test_the_corrector_preserves_the_pool_of_the_views(gaussian_motion, assert_covariance):
    """Langevin dynamics with γ = 1: stationary density Π_v p_v(P_v X)^(1/V), a Gaussian here."""
    rng = np.random.default_rng(2)
    root = rng.normal(size=(6, 6))
    prior = gaussian_motion(np.zeros((1, 2, 3)), root @ root.T * 0.1 + 0.05 * np.eye(6))
    views = Views(Cameras.ring(5, elevation=0.4))
    denoiser = MultiViewDenoiser(prior, views)
    alpha_bar = 0.7
    # The precision of the pool is the mean over views of those of the noisy marginals.
    rows = [np.kron(np.eye(2), P) for P in views.axes]
    noisy = [alpha_bar * R @ prior.covariance @ R.T + (1 - alpha_bar) * np.eye(4) for R in rows]
    precision = sum(R.T @ np.linalg.solve(S, R) for R, S in zip(rows, noisy, strict=True)) / 5
    pool = np.linalg.inv(precision)
    spread = np.kron(np.eye(2), 5 * np.linalg.inv(views.gram))
    unit = np.eye(6).reshape(6, 1, 2, 3)
    pull = math.sqrt(alpha_bar) * denoiser.denoise(unit, alpha_bar).reshape(6, 6).T - np.eye(6)
    # The drift is the preconditioned score of the pool.
    np.testing.assert_allclose(pull, -(1 - alpha_bar) * spread @ precision, atol=1e-12)
    # One step changes the covariance of the pool only to second order in its size.
    gaps = []
    for size in (0.02, 0.01):
        move = np.eye(6) + size * pull
        after = move @ pool @ move.T + 2 * size * (1 - alpha_bar) * spread
        gaps.append(abs(after - pool).max())
    assert gaps[0] == pytest.approx(4 * gaps[1], rel=1e-9)

    # The corrector of the sampler has this drift and noise.
    sampler = MultiViewPredictorCorrector(elevation=0.4, corrector_size=0.3, gamma=1.0)
    schedule = sampler.schedule
    t = int(np.argmin(abs(schedule.alpha_bar - alpha_bar)))
    state = MotionState(denoiser, schedule, (1, 2, 3), None, sampler._noise_factor(views))
    at = schedule.alpha_bar[t]
    pull = math.sqrt(at) * denoiser.denoise(unit, at).reshape(6, 6).T - np.eye(6)
    correct = sampler._corrector()
    start = rng.normal(size=(1, 1, 2, 3))
    streams = NormalStreams([np.random.default_rng(i) for i in range(6000)])
    moved = correct(state, streams, np.repeat(start, 6000, axis=0), t).reshape(6000, 6)
    mean = (np.eye(6) + 0.3 * pull) @ start.ravel()
    assert_covariance(moved - mean, 2 * 0.3 * (1 - at) * spread)


def test_the_corrector_is_skipped_at_low_noise(gaussian):
    sampler = MultiViewPredictorCorrector(steps=50)
    views = Views(Cameras.ring(5, elevation=0.2))
    state = MotionState(
        MultiViewDenoiser(gaussian, views), sampler.schedule, (2, 2, 3), None, lambda level: None
    )
    x = np.ones((1, 2, 2, 3))
    levels = np.sqrt(1 / sampler.schedule.alpha_bar - 1)
    for t in range(1, 50):
        streams = NormalStreams([np.random.default_rng(t)])
        changed = not np.array_equal(sampler._corrector()(state, streams, x, t), x)
        assert changed == (levels[t] >= 0.15)


def test_an_isotropic_gaussian_is_not_sampled_exactly(gaussian_motion):
    prior = gaussian_motion(np.zeros((1, 1, 3)), np.eye(3))
    posterior = MotionPosterior(prior)
    sampler = MultiViewPredictorCorrector(steps=50)
    draws = sampler.sample(posterior, draws=4000, progress=False).flat()
    variance = draws.reshape(-1, 3).var(axis=0)
    # Λ is about 1.9, 1, 1.9 here, and the variance is larger along the same axes.
    # A sample variance has standard deviation √(2/4000) = 0.022 of itself.
    assert variance[0] > 1 + 4 * 0.022
    assert variance[0] > variance[1] + 2 * 0.032
