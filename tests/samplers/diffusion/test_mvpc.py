"""The multi-view predictor-corrector: without its corrector it is MAS; what the corrector does."""

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


def test_without_gamma_and_corrector_it_is_mas_to_the_last_digit(lively):
    posterior = MotionPosterior(lively)
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
def test_counts_are_those_of_the_design(lively, settings, calls):
    sampler = MultiViewPredictorCorrector(**settings)
    draws = sampler.sample(MotionPosterior(lively), draws=2, progress=False)
    assert draws.counts == {"denoiser": 2 * calls}


def test_accurate_preset():
    assert MultiViewPredictorCorrector.accurate() == MultiViewPredictorCorrector(
        steps=100, corrector_steps=2, corrector_size=0.4
    )


def test_gamma_by_noise_level():
    sampler = MultiViewPredictorCorrector()
    levels = (0.01, 0.15, 0.499, 0.5, 1.0, 50.0)
    assert [sampler.gamma_at(level) for level in levels] == [0, 0, 0, 0.5, 0.5, 0.5]


def test_noise_has_the_covariance_of_the_views_disagreement(covariance_is):
    sampler = MultiViewPredictorCorrector(n_views=4, elevation=0.6, gamma=0.8)
    views = Views(Cameras.ring(4, elevation=0.6))
    spread = 4 * np.linalg.inv(views.gram)
    np.testing.assert_allclose(np.trace(np.linalg.inv(spread)), 2, atol=1e-12)
    factor = sampler._noise_factor(views)
    assert factor(0.1) is None
    for level, power in ((0.6, 0.8), (3.0, 0.8)):
        values, vectors = np.linalg.eigh(spread)
        expected = vectors @ np.diag(values**power) @ vectors.T
        np.testing.assert_allclose(factor(level) @ factor(level).T, expected, atol=1e-12)

        class State(MotionState):
            def __init__(self, schedule):
                self.schedule, self.shape, self.noise_factor = schedule, (1, 1, 3), factor

        t = int(np.argmin(abs(np.sqrt(1 / sampler.schedule.alpha_bar - 1) - level)))
        streams = NormalStreams([np.random.default_rng(i) for i in range(4000)])
        covariance_is(State(sampler.schedule).noise(streams, t), expected)


def mvpc_covariance(prior, sampler):
    """Covariance of the sampler's output on a zero-mean Gaussian prior: every step is linear."""
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
def test_draws_follow_the_recursion(lively, covariance_is, corrector_steps):
    sampler = MultiViewPredictorCorrector(steps=8, corrector_steps=corrector_steps)
    draws = sampler.sample(MotionPosterior(lively), draws=16_000, seed=4, progress=False)
    expected = mvpc_covariance(replace(lively, mean=np.zeros_like(lively.mean)), sampler)
    # The corrector keeps the mean as the predictor does, whatever the prior's.
    mean = draws.flat().mean(axis=0)
    covariance_is(draws.flat() - mean, expected * lively.scale**2)


def test_corrector_leaves_the_pool_of_the_views_as_it_is(gaussian_motion, covariance_is):
    """Langevin dynamics with γ = 1: stationary density Π_v p_v(P_v X)^(1/V), a Gaussian here.

    The chain is linear; its own covariance equation says what small steps converge to.
    """
    rng = np.random.default_rng(2)
    root = rng.normal(size=(6, 6))
    prior = gaussian_motion(np.zeros((1, 2, 3)), root @ root.T * 0.1 + 0.05 * np.eye(6))
    views = Views(Cameras.ring(5, elevation=0.4))
    denoiser = MultiViewDenoiser(prior, views)
    alpha_bar = 0.7
    # The pool's precision is the mean over views of the noisy marginals' precisions.
    rows = [np.kron(np.eye(2), P) for P in views.axes]
    noisy = [alpha_bar * R @ prior.covariance @ R.T + (1 - alpha_bar) * np.eye(4) for R in rows]
    precision = sum(R.T @ np.linalg.solve(S, R) for R, S in zip(rows, noisy, strict=True)) / 5
    pool = np.linalg.inv(precision)
    spread = np.kron(np.eye(2), 5 * np.linalg.inv(views.gram))
    unit = np.eye(6).reshape(6, 1, 2, 3)
    pull = math.sqrt(alpha_bar) * denoiser.denoise(unit, alpha_bar).reshape(6, 6).T - np.eye(6)
    # The drift is the preconditioned score of the pool …
    np.testing.assert_allclose(pull, -(1 - alpha_bar) * spread @ precision, atol=1e-12)
    # … so one step changes the pool's covariance at second order in its size only.
    gaps = []
    for size in (0.02, 0.01):
        move = np.eye(6) + size * pull
        after = move @ pool @ move.T + 2 * size * (1 - alpha_bar) * spread
        gaps.append(abs(after - pool).max())
    assert gaps[0] == pytest.approx(4 * gaps[1], rel=1e-9)

    # The sampler's own corrector makes that move with that noise.
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
    covariance_is(moved - mean, 2 * 0.3 * (1 - at) * spread)


def test_corrector_stops_where_there_is_little_noise(lively):
    sampler = MultiViewPredictorCorrector(steps=50)
    views = Views(Cameras.ring(5, elevation=0.2))
    state = MotionState(
        MultiViewDenoiser(lively, views), sampler.schedule, (2, 2, 3), None, lambda level: None
    )
    x = np.ones((1, 2, 2, 3))
    levels = np.sqrt(1 / sampler.schedule.alpha_bar - 1)
    for t in range(1, 50):
        streams = NormalStreams([np.random.default_rng(t)])
        changed = not np.array_equal(sampler._corrector()(state, streams, x, t), x)
        assert changed == (levels[t] >= 0.15)


def test_a_gaussian_is_no_longer_exact_which_is_the_price(gaussian_motion):
    prior = gaussian_motion(np.zeros((1, 1, 3)), np.eye(3))
    posterior = MotionPosterior(prior)
    sampler = MultiViewPredictorCorrector(steps=50)
    draws = sampler.sample(posterior, draws=4000, progress=False).flat()
    variance = draws.reshape(-1, 3).var(axis=0)
    # Λ is about 1.9, 1, 1.9 here: more horizontal noise, more horizontal variance.
    # A sample variance has standard deviation √(2/4000) = 0.022 of itself.
    assert variance[0] > 1 + 4 * 0.022
    assert variance[0] > variance[1] + 2 * 0.032


def test_draws_depend_on_their_names_alone(lively):
    posterior = MotionPosterior(lively)
    sampler = MultiViewPredictorCorrector(steps=8)
    whole = sampler.sample(posterior, draws=5, chains=3, seed=2, progress=False).positions.values
    bars = sampler.sample(posterior, draws=5, chains=3, seed=2, progress=True).positions.values
    np.testing.assert_array_equal(bars, whole)
    small = replace(sampler, batch=2).sample(posterior, draws=5, chains=3, seed=2, progress=False)
    np.testing.assert_allclose(small.positions.values, whole, atol=1e-12)
    fewer = sampler.sample(posterior, draws=4, chains=2, seed=2, progress=False)
    np.testing.assert_allclose(fewer.positions.values, whole[:2, :4], atol=1e-12)


def test_views_that_never_tilt_are_warned_of(lively):
    with pytest.warns(UserWarning, match="elevation is 0: views that never tilt leave a mirror"):
        MultiViewPredictorCorrector(steps=3, elevation=0.0).sample(
            MotionPosterior(lively), draws=1, progress=False
        )


def test_what_does_not_fit_is_refused_in_a_sentence(lively):
    for wrong, message in (
        ({"corrector_size": 1.5}, r"corrector_size must be at most 1, got 1.5"),
        ({"corrector_steps": -1}, r"corrector_steps is -1"),
        ({"gamma": -0.5}, r"gamma must be a finite number of at least 0, got -0.5"),
        ({"gamma_from": np.nan}, r"gamma_from must be a finite number of at least 0, got nan"),
    ):
        with pytest.raises(ValueError, match=message):
            MultiViewPredictorCorrector(**wrong)
    with pytest.raises(ValueError, match="initial is list, expected None: mvpc starts every draw"):
        MultiViewPredictorCorrector().sample(MotionPosterior(lively), initial=[], progress=False)
