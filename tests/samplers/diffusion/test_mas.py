"""Tests of `MultiViewAncestral`: analytic limits, options, replay in new views.

On a Gaussian prior every step of MAS is linear, so its covariance after T steps is exact. The limit
T → ∞ is extrapolated from two values of T, since the error decreases as 1/T.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad

from probmotion import Cameras, MotionPosterior, NoiseSchedule, triangulate
from probmotion.posteriors.sampling import Interrupted
from probmotion.samplers import MultiViewAncestral
from probmotion.samplers.diffusion.integrators import DDPM, Heun, SecondOrderSDE
from probmotion.samplers.diffusion.noise_levels import Cosine
from probmotion.samplers.diffusion.views import MultiViewDenoiser, Views

ELEVATION = math.radians(15)
S = np.array([[1.0, 0.4], [0.4, 0.3]])


def mas_covariance(prior, views, schedule, *, shared_noise=True, power=1):
    """Return the exact covariance of MAS on a zero-mean Gaussian prior.

    The matrix of the linear denoiser is computed from unit vectors.
    """
    n = prior.dim
    unit = np.eye(n).reshape(n, *prior.mean.shape)
    denoiser = MultiViewDenoiser(prior, views)
    # With independent noise the state consists of all views.
    embed = np.eye(n) if shared_noise else views.project(unit).reshape(n, -1).T
    size = len(embed)
    unit_views = np.eye(size).reshape(size, -1, *prior.mean.shape[:-1], 3 if shared_noise else 2)

    def estimate(t):
        if shared_noise:
            clean = denoiser.denoise(unit, schedule.alpha_bar[t])
        else:
            clean = views.combine(prior.denoise(unit_views, schedule.alpha_bar[t], views.cameras))
        return clean.reshape(size, n).T

    covariance = np.eye(size)
    for t in range(schedule.steps, 1, -1):
        step = schedule.posterior(t)
        move = step.clean * embed @ estimate(t) + step.noisy * np.eye(size)
        covariance = move @ covariance @ move.T + step.deviation ** (2 * power) * np.eye(size)
    return estimate(1) @ covariance @ estimate(1).T


def limit(prior, views, T=250, **options):
    """Return the covariance for infinitely many steps, extrapolated from T and 2 T."""
    coarse, fine = (
        mas_covariance(prior, views, NoiseSchedule.cosine(n), **options) for n in (T, 2 * T)
    )
    return 2 * fine - coarse


def centred(gaussian_motion, covariance):
    return gaussian_motion(np.zeros((1, len(covariance) // 3, 3)), np.asarray(covariance))


def diagonal(horizontal, vertical):
    return np.diag([horizontal, vertical, horizontal])


@pytest.mark.parametrize(
    ("covariance", "cameras"),
    [
        (np.kron(S, np.eye(3)), Cameras.ring(2, elevation=0.5)),
        (np.kron(S, np.eye(3)), Cameras.around([0.1, 1.3, 4], [0.1, 0.7, -0.4])),
        (diagonal(1.0, 0.05), Cameras.ring(5)),
    ],
)
def test_limit_1_isotropic_and_level_views_are_exact(gaussian_motion, covariance, cameras):
    prior = centred(gaussian_motion, covariance)
    np.testing.assert_allclose(limit(prior, Views(cameras)), prior.covariance, atol=5e-4)


@pytest.mark.parametrize(
    ("degrees", "horizontal", "vertical"), [(15, 0.835, 0.114), (30, 0.748, 0.288)]
)
def test_limit_2_elevation_mixes_vertical_and_horizontal(
    gaussian_motion, degrees, horizontal, vertical
):
    s_h, s_z = 1.0, 0.05
    e = math.radians(degrees)
    s_2 = math.cos(e) ** 2 * s_z + math.sin(e) ** 2 * s_h
    rho = 1 / (1 + math.sin(e) ** 2)
    shrunk = (
        s_h ** (2 * rho)
        * s_2 ** (2 - 2 * rho)
        * quad(lambda u: (s_h + u) ** (-2 * rho) * (s_2 + u) ** (2 * rho - 2), 0, math.inf)[0]
    )
    assert (shrunk, s_2) == pytest.approx((horizontal, vertical), abs=6e-4)
    prior = centred(gaussian_motion, diagonal(s_h, s_z))
    views = Views(Cameras.ring(5, elevation=e))
    np.testing.assert_allclose(limit(prior, views), diagonal(shrunk, s_2), atol=1e-3)


@pytest.mark.parametrize("large", [0, 2])
def test_limit_3_large_directions_shrink_and_null_ones_inflate(gaussian_motion, large):
    true = np.array([0.01, 0.3, 0.01])
    true[large] = 1.0
    prior = centred(gaussian_motion, np.diag(true))
    views = Views(Cameras.ring(5))
    # The image x axis of a view is horizontal.
    along = views.axes[:, 0]
    variance = along**2 @ true
    expected = np.full(3, 0.3)
    for axis in (0, 2):
        coefficient = along[:, axis] ** 2 / views.gram[axis, axis]
        # The integrand is Π_v [s_v/(s_v+u)]^(2 c_v); its exponents sum to 2.
        expected[axis] = quad(
            lambda u, c=coefficient: np.prod((variance / (variance + u)) ** (2 * c)), 0, math.inf
        )[0]
    if large == 2:
        assert (expected[2], expected[0]) == pytest.approx((0.675, 0.055), abs=3e-3)
    np.testing.assert_allclose(limit(prior, views), np.diag(expected), atol=1e-3)


def test_limit_4_chirality_is_lost(gaussian_motion):
    # The horizontal positions x + iz of the two joints have the covariance S + iT.
    T = np.array([[0.0, 0.4], [-0.4, 0.0]])
    covariance = np.zeros((2, 3, 2, 3))
    covariance[:, 1, :, 1] = 0.2 * np.eye(2)
    covariance[:, 0, :, 0] = covariance[:, 2, :, 2] = S + np.diag([0.0, 0.2])
    without = covariance.copy()
    covariance[:, 2, :, 0], covariance[:, 0, :, 2] = T, -T
    prior = centred(gaussian_motion, covariance.reshape(6, 6))
    assert np.linalg.eigvalsh(prior.covariance).min() > 0
    views = Views(Cameras.ring(5))
    np.testing.assert_allclose(limit(prior, views), without.reshape(6, 6), atol=1e-3)


@pytest.mark.parametrize(("n_views", "elevation"), [(3, 0.0), (5, ELEVATION)])
def test_limit_5_independent_noise_shrinks_the_motion(gaussian_motion, n_views, elevation):
    prior = centred(gaussian_motion, np.kron(S, np.eye(3)))
    views = Views(Cameras.ring(n_views, elevation=elevation))
    covariance = limit(prior, views, T=200, shared_noise=False)
    expected = np.kron(S, np.linalg.inv(views.gram))
    np.testing.assert_allclose(covariance, expected, atol=3e-3)
    if elevation == 0:
        inverse = np.diag([2, 1, 2]) / n_views
        np.testing.assert_allclose(np.linalg.inv(views.gram), inverse, atol=1e-12)


@pytest.mark.parametrize(
    ("variance", "T", "ratio", "error"),
    [(1.0, 100, 0.955, 6e-4), (1.0, 1000, 0.995, 6e-4), (0.0137, 100, 0.79, 6e-3)],
)
def test_limit_6_finitely_many_steps_shrink_variance(gaussian_motion, variance, T, ratio, error):
    prior = centred(gaussian_motion, variance * np.eye(3))
    views = Views(Cameras.ring(3, elevation=0.3))
    covariance = mas_covariance(prior, views, NoiseSchedule.cosine(T))
    np.testing.assert_allclose(covariance / variance, ratio * np.eye(3), atol=error)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"shared_noise": False},
        {"integrator": DDPM(variance_for_deviation=True)},
        {"view_weights": (3.0, 1.0, 0.5)},
        {"levels": Cosine(power=4)},
        {"levels": Cosine(trained_steps=100)},
    ],
    ids=lambda options: "-".join(map(str, options.values())) or "default",
)
def test_draws_have_the_exact_covariance(gaussian, assert_covariance, options):
    sampler = MultiViewAncestral(steps=10, n_views=3, elevation=ELEVATION, **options)
    draws = sampler.sample(MotionPosterior(gaussian), draws=8000, seed=4, progress=False)
    centred_prior = replace(gaussian, mean=np.zeros_like(gaussian.mean))
    expected = mas_covariance(
        centred_prior,
        Views(sampler.cameras, sampler.view_weights),
        sampler.schedule,
        shared_noise=sampler.shared_noise,
        power=2 if sampler.integrator.variance_for_deviation else 1,
    )
    # The relative error of the mean is √ᾱ_T, far below the Monte Carlo error.
    assert_covariance(draws.flat() - gaussian.mean, expected * gaussian.scale**2)


def test_stop_level_returns_the_estimate_at_that_level(gaussian):
    posterior = MotionPosterior(gaussian)
    sampler = MultiViewAncestral(steps=10, stop_level=2)
    trace = sampler.trace(posterior, draws=3)
    assert len(trace.steps) == 8
    draws = sampler.sample(posterior, draws=3, progress=False)
    np.testing.assert_array_equal(draws.flat(), trace.result * gaussian.scale)
    assert draws.counts == {"denoiser": 9 * 5 * 3}
    assert draws.independent
    complete = MultiViewAncestral(steps=10).trace(posterior, draws=3)
    np.testing.assert_array_equal(trace.result, complete.steps[-1].estimate)


@pytest.mark.parametrize("weights", [None, (5.0, 1.0, 1.0, 0.5, 1.0)])
def test_distant_perspective_views_are_orthographic(gaussian, weights):
    posterior = MotionPosterior(gaussian)
    sampler = MultiViewAncestral(steps=10, view_weights=weights)
    orthographic = sampler.sample(posterior, draws=5, progress=False).flat()
    errors = []
    for distance in (1e3, 1e4):
        sampler = replace(sampler, perspective=True, distance=distance)
        perspective = sampler.sample(posterior, draws=5, progress=False)
        errors.append(abs(perspective.flat() - orthographic).max())
    assert errors[0] < 1e-2
    # The difference is O(1/d) (appendix C.2).
    assert errors[1] == pytest.approx(errors[0] / 10, rel=0.05)


@pytest.mark.parametrize("integrator", [DDPM(), SecondOrderSDE(), Heun()])
@pytest.mark.parametrize("perspective", [False, True])
def test_replay_in_any_view(gaussian, perspective, integrator):
    posterior = MotionPosterior(gaussian)
    sampler = MultiViewAncestral(steps=40, perspective=perspective, integrator=integrator)
    trace = sampler.trace(posterior, draws=2, seed=1)
    draws = sampler.sample(posterior, draws=2, seed=1, progress=False).flat()
    np.testing.assert_array_equal(trace.result * gaussian.scale, draws)
    estimates = [*(step.estimate for step in trace.steps), trace.result]
    # Denoising the replay in the views of the run reproduces its estimates.
    for level in (40, 20, 5, 1):
        noisy = trace.replay(sampler.cameras, level)
        clean = gaussian.denoise(noisy, sampler.schedule.alpha_bar[level], sampler.cameras)
        again = triangulate(clean * gaussian.scale, sampler.cameras, iterations=20) / gaussian.scale
        # A run triangulates perspective views in two iterations only.
        tolerance = 1e-3 if perspective else 1e-12
        np.testing.assert_allclose(again, estimates[40 - level], atol=tolerance)
    # In a new view the replay is the projection of one 3D state.
    new = Cameras.around([0.7], [0.4], perspective=perspective)
    if not perspective:
        state = Views(sampler.cameras).combine(trace.replay(sampler.cameras, 4))
        np.testing.assert_allclose(trace.replay(new, 4), Views(new).project(state), atol=1e-12)
    for cameras in (new, sampler.cameras):
        finished = cameras.project(draws) / gaussian.scale
        np.testing.assert_allclose(trace.replay(cameras), finished, atol=1e-12)
    with pytest.raises(ValueError, match=r"level must be 0 or between 1 and 40, got 41"):
        trace.replay(new, 41)
    with pytest.raises(ValueError, match="shared_noise must be True"):
        MultiViewAncestral(shared_noise=False).trace(posterior, draws=1)


def test_an_interrupted_run_has_the_finished_batches(gaussian):
    calls = []

    class Interrupting(type(gaussian)):
        def denoise(self, x_t, alpha_bar, cameras):
            calls.append(len(x_t))
            if len(calls) > 14:
                raise KeyboardInterrupt
            return super().denoise(x_t, alpha_bar, cameras)

    sampler = MultiViewAncestral(steps=6, batch=3)
    complete = sampler.sample(MotionPosterior(gaussian), draws=9, chains=2, progress=False)
    posterior = MotionPosterior(Interrupting(gaussian.mean, gaussian.covariance, gaussian.scale))
    with pytest.raises(Interrupted) as caught:
        sampler.sample(posterior, draws=9, chains=2, progress=False)
    finished = caught.value.draws.positions.values
    assert finished.shape[:2] == (2, 3)
    np.testing.assert_array_equal(finished, complete.positions.values[:, :3])


def test_two_views_are_120_degrees_apart():
    """MAS, table 2: opposite views do not determine the depth."""
    np.testing.assert_allclose(
        MultiViewAncestral(n_views=2).cameras.azimuth, [0, 2 * np.pi / 3], atol=1e-12
    )
    options = {"elevation": 0.3, "perspective": True, "distance": 4.0}
    cameras, ring = MultiViewAncestral(**options).cameras, Cameras.ring(5, **options)
    np.testing.assert_array_equal(cameras.rotation, ring.rotation)
    np.testing.assert_array_equal(cameras.focal, ring.focal)
