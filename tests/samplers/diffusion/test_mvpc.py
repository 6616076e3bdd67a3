"""Tests of `MultiViewPredictorCorrector`: reduction to MAS, exact covariance, the corrector."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import solve_continuous_lyapunov

from probmotion import Cameras, MotionPosterior
from probmotion.samplers import MultiViewAncestral, MultiViewPredictorCorrector
from probmotion.samplers.diffusion import DDPM, Cosine, SecondOrderSDE
from probmotion.samplers.diffusion.views import (
    MultiViewDenoiser,
    Views,
    pools,
    symmetric_power,
    view_sets,
    views_around,
)


def test_mvpc_without_gamma_and_corrector_equals_mas(gaussian):
    posterior = MotionPosterior(gaussian)
    predictor_only = MultiViewPredictorCorrector(
        steps=20, gamma=0.0, corrector_steps=0, elevation=math.pi / 16
    )
    mvpc, mas = (
        sampler.sample(posterior, draws=6, seed=3, progress=False)
        for sampler in (
            predictor_only,
            MultiViewAncestral(
                steps=20,
                levels=predictor_only.levels,
                integrator=predictor_only.integrator,
            ),
        )
    )
    np.testing.assert_array_equal(mvpc.positions, mas.positions)
    assert mvpc.counts == mas.counts


def test_first_order_preset(gaussian):
    """Its 50 levels and 45 corrector steps of five views cost as much as MAS."""
    sampler = replace(MultiViewPredictorCorrector.learnt(), elevation=0.2)
    draws = sampler.sample(MotionPosterior(gaussian), draws=2, progress=False)
    assert draws.counts == {"denoiser": 2 * 475}


def test_views_of_training_at_elevation_0_have_no_gamma(gaussian):
    """The elevation of a learnt denoiser's views counts as one that is set."""

    class Learnt(type(gaussian)):
        view_elevation = 0.0

    learnt = Learnt(gaussian.mean, gaussian.covariance, gaussian.scale)
    with pytest.warns(UserWarning, match="mvpc cannot distinguish a motion from its mirror image"):
        draws = [
            MultiViewPredictorCorrector(**settings)
            .sample(MotionPosterior(prior), draws=2, progress=False)
            .flat()
            for prior, settings in (
                (learnt, {}),
                (learnt, {"gamma": 0.0}),
                (gaussian, {"elevation": 0.0}),
                (learnt, {"elevation": 0.1}),
            )
        ]
    np.testing.assert_array_equal(draws[0], draws[1])
    np.testing.assert_array_equal(draws[0], draws[2])
    assert abs(draws[0] - draws[3]).max() > 0.01


@pytest.mark.parametrize(
    ("settings", "calls"), [({}, 3 * 158), ({"elevation": 0.2, "corrector_steps": 3}, 5 * 280)]
)
def test_evaluations_are_counted(gaussian, settings, calls):
    sampler = MultiViewPredictorCorrector(**settings)
    draws = sampler.sample(MotionPosterior(gaussian), draws=2, progress=False)
    assert draws.counts == {"denoiser": 2 * calls}


def test_gamma_by_noise_level():
    levels = (0.01, 0.5, 0.999, 1.0, 3.999, 4.0, 50.0)
    sampler = MultiViewPredictorCorrector()
    assert [sampler.gamma_at(level) for level in levels] == [0, 0, 0, 1, 1, 0, 0]
    guided = [sampler.gamma_at(level, observed=True) for level in levels]
    assert guided == [0, 0, 0, 0.5, 0.5, 0.5, 0.5]
    assert [sampler.gamma_at(level, horizontal=True) for level in levels] == [0] * 7
    learnt = MultiViewPredictorCorrector.learnt()
    assert [learnt.gamma_at(level) for level in levels] == [0, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5]


def mvpc_covariance(prior, sampler):
    """Return the exact covariance of the sampler on a zero-mean Gaussian prior."""
    n = prior.dim
    unit = np.eye(n).reshape(n, *prior.mean.shape)
    denoisers = pools(prior, view_sets(prior, sampler.n_views, sampler.elevation))
    views, turns = denoisers[0].views, iter(range(1000))
    schedule, size = sampler.schedule, sampler.corrector_size
    sigma = np.sqrt(1 / schedule.alpha_bar - 1)
    values, vectors = np.linalg.eigh(views.n_views * np.linalg.inv(views.gram))
    second_order = isinstance(sampler.integrator, SecondOrderSDE)

    def matrix(t):
        denoiser = denoisers[next(turns) % len(denoisers)]
        return denoiser.denoise(unit, schedule.alpha_bar[t]).reshape(n, n).T

    def noise(t):
        power = sampler.gamma_at(sigma[t])
        return np.kron(np.eye(n // 3), (vectors * values**power) @ vectors.T)

    def grown(covariance, move, added):
        """Return the covariance of (move (x, D), D) plus noise in x, for the pair (x, D)."""
        both = move @ covariance @ move.T
        both[:n, :n] += added
        return both

    # The pair of the state and the previous estimate is linear in the noises.
    covariance = np.zeros((2 * n, 2 * n))
    covariance[:n, :n] = noise(schedule.steps)
    identity, zero = np.eye(n), np.zeros((n, n))
    for t in range(schedule.steps, 1, -1):
        step, D = schedule.posterior(t), matrix(t)
        ratio = 0.0
        if second_order and t < schedule.steps:
            steps = np.log(sigma[t] / sigma[t - 1]), np.log(sigma[t + 1] / sigma[t])
            ratio = 0.5 * min(steps[0] / steps[1], 2.0)
        move = np.block(
            [
                [
                    step.noisy * identity + step.clean * (1 + ratio) * D,
                    -step.clean * ratio * identity,
                ],
                [D, zero],
            ]
        )
        covariance = grown(covariance, move, step.deviation**2 * noise(t - 1))
        if sigma[t - 1] >= sampler.corrected_from:
            alpha_bar = schedule.alpha_bar[t - 1]
            for _ in range(sampler.corrector_steps):
                drift = (1 - size) * identity + size * math.sqrt(alpha_bar) * matrix(t - 1)
                move = np.block([[drift, zero], [zero, identity]])
                covariance = grown(covariance, move, 2 * size * (1 - alpha_bar) * noise(t - 1))
    last = matrix(1)
    return last @ covariance[:n, :n] @ last.T


@pytest.mark.parametrize(
    "options",
    [
        {"corrector_steps": 0, "gamma": 0.8},
        {"corrector_steps": 2},
        {"levels": Cosine(), "integrator": DDPM()},
        {"elevation": 0.3},
    ],
)
def test_draws_have_the_exact_covariance(gaussian, assert_covariance, options):
    sampler = MultiViewPredictorCorrector(steps=8, **options)
    draws = sampler.sample(MotionPosterior(gaussian), draws=10_000, seed=4, progress=False)
    expected = mvpc_covariance(replace(gaussian, mean=np.zeros_like(gaussian.mean)), sampler)
    assert_covariance(draws.flat() - gaussian.mean, expected * gaussian.scale**2)


def test_an_isotropic_gaussian_is_not_sampled_exactly(gaussian_motion):
    prior = gaussian_motion(np.zeros((1, 1, 3)), np.eye(3))
    sampler = MultiViewPredictorCorrector(elevation=math.pi / 16, gamma=0.5)
    variance = np.diag(mvpc_covariance(prior, sampler))
    # Λ is about (1.9, 1, 1.9), and the variance is larger along the same axes.
    assert variance[0] > 1.1
    assert variance[0] > variance[1] + 0.1


def test_the_corrector_preserves_the_pool_of_the_views(gaussian_motion):
    """With γ = 1, Langevin dynamics have the stationary density Π_v p_v(P_v X)^(1/V)."""
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
    drift = math.sqrt(alpha_bar) * denoiser.denoise(unit, alpha_bar).reshape(6, 6).T - np.eye(6)
    # The drift is the preconditioned score of the pool.
    np.testing.assert_allclose(drift, -(1 - alpha_bar) * spread @ precision, atol=1e-12)
    # One step changes the covariance of the pool only to second order in its size.
    errors = []
    for size in (0.02, 0.01):
        move = np.eye(6) + size * drift
        after = move @ pool @ move.T + 2 * size * (1 - alpha_bar) * spread
        errors.append(abs(after - pool).max())
    assert errors[0] == pytest.approx(4 * errors[1], rel=1e-9)


@pytest.mark.parametrize(
    ("direction", "with_gamma_0", "with_gamma_1"), [((1, 1, 1), 2 / 3, 1.0), ((1, 0, 0), 1.0, 1.5)]
)
def test_gamma_1_counts_directions_seen_by_all_views_once(
    gaussian_motion, direction, with_gamma_0, with_gamma_1
):
    """The corrector's variance along a diagonal is right with γ = 1, along an axis with γ = 0."""
    u = np.array(direction) / np.linalg.norm(direction)
    prior = gaussian_motion(np.zeros((1, 1, 3)), np.outer(u, u) + 1e-9 * np.eye(3))
    views = view_sets(prior, 3, None)[0]
    alpha_bar = 1 - 1e-6
    denoised = MultiViewDenoiser(prior, views).denoise(np.eye(3).reshape(3, 1, 1, 3), alpha_bar)
    drift = math.sqrt(alpha_bar) * denoised.reshape(3, 3).T - np.eye(3)
    for gamma, expected in ((0, with_gamma_0), (1, with_gamma_1)):
        noise = symmetric_power(views.n_views * np.linalg.inv(views.gram), gamma)
        stationary = solve_continuous_lyapunov(drift, -2 * (1 - alpha_bar) * noise)
        assert u @ stationary @ u == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("elevation", [0.0, 0.2])
def test_elevation_0_does_not_distinguish_mirror_images(gaussian, elevation):
    """A pool of views of a denoiser that ignores the azimuth commutes with reflection in depth."""

    class AnyAzimuth(type(gaussian)):
        def denoise(self, x_t, alpha_bar, cameras):
            same = Cameras.around(np.zeros(cameras.n_views), cameras.elevation)
            return super().denoise(x_t, alpha_bar, same)

    prior = AnyAzimuth(gaussian.mean, gaussian.covariance)
    pool = MultiViewDenoiser(prior, Views(views_around(5, elevation)))
    x, mirror = np.random.default_rng(0).normal(size=(3, 2, 2, 3)), np.array([1.0, 1.0, -1.0])
    difference = pool.denoise(mirror * x, 0.5) - mirror * pool.denoise(x, 0.5)
    assert (np.abs(difference).max() < 1e-12) == (elevation == 0)
