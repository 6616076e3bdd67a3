"""MAS against its analytic limits (exact problems 1-6), and its options.

On a Gaussian prior every step of MAS is linear, so the covariance after T steps is a product of
matrices: no Monte Carlo. The error of T steps falls as 1/T, which two values of T remove.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad

from probmotion import (
    Cameras,
    Keypoints2D,
    MotionPosterior,
    NoiseSchedule,
    UnsupportedPosterior,
    triangulate,
)
from probmotion.samplers import MultiViewAncestral
from probmotion.samplers.diffusion.ancestral import MotionState, ancestral
from probmotion.samplers.diffusion.views import MultiViewDenoiser, Views
from probmotion.seeds import NormalStreams

ELEVATION = math.radians(15)


def mas_covariance(prior, views, schedule, *, shared_noise=True, power=1):
    """Covariance of MAS's output on a zero-mean Gaussian prior, by its own denoiser.

    The denoiser is linear here: its matrix is what it makes of the unit vectors.
    """
    n = prior.dim
    unit = np.eye(n).reshape(n, *prior.mean.shape)
    if shared_noise:
        denoiser = MultiViewDenoiser(prior, views)
        identity = fresh = np.eye(n)

        def matrix(t):
            return denoiser.denoise(unit, schedule.alpha_bar[t]).reshape(n, n).T, identity
    else:
        # The state is all views; embed is the projection of the triangulated motion.
        project = views.project(unit).reshape(n, -1).T
        size = len(project)
        seen = np.eye(size).reshape(size, views.n_views, *prior.mean.shape[:-1], 2)
        fresh = np.eye(size)

        def matrix(t):
            clean = prior.denoise(seen, schedule.alpha_bar[t], views.cameras)
            return views.combine(clean).reshape(size, n).T, project

    covariance = fresh
    for t in range(schedule.steps, 0, -1):
        step = schedule.posterior(t)
        estimate, embed = matrix(t)
        if t == 1:
            return estimate @ covariance @ estimate.T
        move = step.clean * embed @ estimate + step.noisy * np.eye(len(covariance))
        covariance = move @ covariance @ move.T + step.deviation ** (2 * power) * fresh
    raise AssertionError


def limit(prior, views, **options):
    """The covariance as T → ∞, from T = 500 and 1000."""
    coarse, fine = (
        mas_covariance(prior, views, NoiseSchedule.cosine(T), **options) for T in (500, 1000)
    )
    return 2 * fine - coarse


def centred(gaussian_motion, covariance):
    return gaussian_motion(np.zeros((1, len(covariance) // 3, 3)), np.asarray(covariance))


def diagonal(horizontal, vertical):
    return np.diag([horizontal, vertical, horizontal])


def test_limit_1_isotropic_covariances_are_exact(gaussian_motion):
    S = np.array([[1.0, 0.4], [0.4, 0.3]])
    prior = centred(gaussian_motion, np.kron(S, np.eye(3)))
    for views in (Cameras.ring(2, elevation=0.5), Cameras.around([0.1, 1.3, 4], [0.1, 0.7, -0.4])):
        np.testing.assert_allclose(limit(prior, Views(views)), prior.covariance, atol=5e-4)


def test_limit_1_symmetric_about_the_vertical_is_exact_without_elevation(gaussian_motion):
    prior = centred(gaussian_motion, diagonal(1.0, 0.05))
    found = limit(prior, Views(Cameras.ring(5)))
    np.testing.assert_allclose(found, prior.covariance, atol=5e-4)


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
    found = limit(prior, Views(Cameras.ring(5, elevation=e)))
    np.testing.assert_allclose(found, diagonal(shrunk, s_2), atol=1e-3)


@pytest.mark.parametrize("large", [0, 2])
def test_limit_3_large_directions_shrink_and_null_ones_inflate(gaussian_motion, large):
    true = np.array([0.01, 0.3, 0.01])
    true[large] = 1.0
    prior = centred(gaussian_motion, np.diag(true))
    views = Views(Cameras.ring(5))
    # Of the horizontal plane a view sees its image x axis alone.
    along = views.axes[:, 0]
    seen = along**2 @ true
    expected = np.full(3, 0.3)
    for axis in (0, 2):
        share = along[:, axis] ** 2 / views.gram[axis, axis]
        # The integrand Π_v [s_v/(s_v+u)]^(2 c_v), whose exponents add up to 2.
        expected[axis] = quad(
            lambda u, c=share: np.prod((seen / (seen + u)) ** (2 * c)), 0, math.inf
        )[0]
    if large == 2:
        assert (expected[2], expected[0]) == pytest.approx((0.675, 0.055), abs=3e-3)
    np.testing.assert_allclose(limit(prior, views), np.diag(expected), atol=1e-3)


def test_limit_4_chirality_is_lost(gaussian_motion):
    # Two joints whose horizontal positions x + iz have the covariance S + iT.
    S, T = np.array([[1.0, 0.3], [0.3, 0.5]]), np.array([[0.0, 0.4], [-0.4, 0.0]])
    covariance = np.zeros((2, 3, 2, 3))
    covariance[:, 1, :, 1] = 0.2 * np.eye(2)
    covariance[:, 0, :, 0] = covariance[:, 2, :, 2] = S
    without = covariance.copy()
    covariance[:, 2, :, 0], covariance[:, 0, :, 2] = T, -T
    prior = centred(gaussian_motion, covariance.reshape(6, 6))
    assert np.linalg.eigvalsh(prior.covariance).min() > 0
    found = limit(prior, Views(Cameras.ring(5)))
    np.testing.assert_allclose(found, without.reshape(6, 6), atol=1e-3)


@pytest.mark.parametrize("n_views", [3, 5, 12])
def test_limit_5_independent_noise_averages_the_motion_away(gaussian_motion, n_views):
    S = np.array([[1.0, 0.4], [0.4, 0.3]])
    prior = centred(gaussian_motion, np.kron(S, np.eye(3)))
    for elevation in (0.0, ELEVATION):
        views = Views(Cameras.ring(n_views, elevation=elevation))
        schedules = (NoiseSchedule.cosine(T) for T in (200, 400))
        coarse, fine = (mas_covariance(prior, views, s, shared_noise=False) for s in schedules)
        expected = np.kron(S, np.linalg.inv(views.gram))
        np.testing.assert_allclose(2 * fine - coarse, expected, atol=3e-3)
        if elevation == 0:
            wanted = np.diag([2, 1, 2]) / n_views
            np.testing.assert_allclose(np.linalg.inv(views.gram), wanted, atol=1e-12)


def test_limit_6_finitely_many_steps_shrink_variance(gaussian_motion):
    views = Views(Cameras.ring(3, elevation=0.3))

    def ratio(s, T):
        prior = centred(gaussian_motion, s * np.eye(3))
        found = mas_covariance(prior, views, NoiseSchedule.cosine(T)) / s
        np.testing.assert_allclose(found, found[0, 0] * np.eye(3), atol=1e-12)
        return found[0, 0]

    assert ratio(1.0, 100) == pytest.approx(0.955, abs=6e-4)
    assert ratio(1.0, 1000) == pytest.approx(0.995, abs=6e-4)
    # The small-noise variance of the table: .79 at T = 100 goes with .967 at T = 1000.
    assert ratio(0.0137, 100) == pytest.approx(0.79, abs=6e-3)
    assert ratio(0.0137, 1000) == pytest.approx(0.967, abs=2e-3)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"shared_noise": False},
        {"variance_for_deviation": True},
        {"view_weights": (3.0, 1.0, 0.5)},
        {"schedule_power": 4},
        {"trained_steps": 100},
    ],
    ids=lambda options: "-".join(options) or "default",
)
def test_draws_follow_the_recursion(lively, covariance_is, options):
    sampler = MultiViewAncestral(steps=10, n_views=3, elevation=ELEVATION, **options)
    draws = sampler.sample(MotionPosterior(lively), draws=8000, seed=4, progress=False)
    centred_prior = replace(lively, mean=np.zeros_like(lively.mean))
    expected = mas_covariance(
        centred_prior,
        Views(sampler.cameras, sampler.view_weights),
        sampler.schedule,
        shared_noise=sampler.shared_noise,
        power=2 if sampler.variance_for_deviation else 1,
    )
    # A step moves the mean as it moves any clean motion: the mean is kept but for x_T's, which has
    # none of it; that is √ᾱ_T of it, far below the Monte Carlo error.
    covariance_is(draws.flat() - lively.mean, expected * lively.scale**2)


def test_schedule_matters_to_the_recursion(gaussian_motion):
    # The comparison above would notice a wrong schedule.
    prior = centred(gaussian_motion, np.eye(3))
    views = Views(Cameras.ring(3))
    one, two = (
        mas_covariance(prior, views, NoiseSchedule.cosine(10, power=power)) for power in (2, 4)
    )
    assert abs(one - two).max() > 0.03


def test_stopping_a_level_early_returns_its_estimate(lively):
    posterior = MotionPosterior(lively)
    sampler = MultiViewAncestral(steps=10, stop_level=2)
    trace = sampler.trace(posterior, draws=3)
    assert len(trace.estimates) == 9
    draws = sampler.sample(posterior, draws=3, progress=False)
    np.testing.assert_array_equal(draws.flat(), trace.estimates[-1] * lively.scale)
    assert draws.counts == {"denoiser": 9 * 5 * 3}
    whole = MultiViewAncestral(steps=10).trace(posterior, draws=3)
    np.testing.assert_array_equal(trace.estimates, whole.estimates[:-1])


def test_perspective_views_from_afar_are_orthographic_ones(lively):
    posterior = MotionPosterior(lively)
    near = MultiViewAncestral(steps=10).sample(posterior, draws=5, progress=False).flat()
    gaps = []
    for distance in (1e3, 1e4):
        sampler = MultiViewAncestral(steps=10, perspective=True, distance=distance)
        far = sampler.sample(posterior, draws=5, progress=False)
        gaps.append(abs(far.flat() - near).max())
    assert gaps[0] < 1e-2
    # The difference is O(1/d) (appendix C.2).
    assert gaps[1] == pytest.approx(gaps[0] / 10, rel=0.05)


def test_perspective_draws_are_consistent_with_their_views(lively):
    sampler = MultiViewAncestral(steps=10, perspective=True, distance=7.0)
    trace = sampler.trace(MotionPosterior(lively), draws=3)
    seen = sampler.cameras.project(trace.estimates[-1] * lively.scale) / lively.scale
    np.testing.assert_allclose(trace.replay(sampler.cameras), seen, atol=1e-12)


def test_orthographic_noise_is_noise_and_perspective_is_near():
    # Appendix C: P N(0, I₃) = N(0, I₂), and |p_orth − p_persp| ≤ 1/(d − 1) inside the unit ball.
    ring = Cameras.ring(5, elevation=0.3)
    products = ring.image_axes @ ring.image_axes.swapaxes(1, 2)
    np.testing.assert_allclose(products, np.tile(np.eye(2), (5, 1, 1)), atol=1e-15)
    rng = np.random.default_rng(0)
    points = rng.normal(size=(500, 1, 3))
    points /= np.linalg.norm(points, axis=-1, keepdims=True)
    for distance in (2.0, 7.0, 50.0):
        near = Cameras.ring(5, elevation=0.3, distance=distance, perspective=True)
        gap = np.linalg.norm(near.project(points) - ring.project(points), axis=-1)
        assert gap.max() <= 1 / (distance - 1)
        assert gap.max() > 0.3 / distance


@pytest.mark.parametrize("perspective", [False, True])
def test_replay_shows_the_run_from_any_view(lively, perspective):
    posterior = MotionPosterior(lively)
    sampler = MultiViewAncestral(steps=40, perspective=perspective)
    trace = sampler.trace(posterior, draws=2, seed=1)
    draws = sampler.sample(posterior, draws=2, seed=1, progress=False).flat()
    np.testing.assert_array_equal(trace.estimates[-1] * lively.scale, draws)
    # From its own views, denoising what is replayed gives the run's own estimates.
    for level in (40, 20, 5, 1):
        noisy = trace.replay(sampler.cameras, level)
        clean = lively.denoise(noisy, sampler.schedule.alpha_bar[level], sampler.cameras)
        again = triangulate(clean * lively.scale, sampler.cameras, iterations=20) / lively.scale
        # A run linearises perspective views twice, from its last estimate, which moves far here.
        tolerance = 1e-3 if perspective else 1e-12
        np.testing.assert_allclose(again, trace.estimates[40 - level], atol=tolerance)
    # From a new view it is that view of one 3D state.
    new = Cameras.around([0.7], [0.4], perspective=perspective)
    if not perspective:
        state = Views(sampler.cameras).combine(trace.replay(sampler.cameras, 4))
        np.testing.assert_allclose(trace.replay(new, 4), Views(new).project(state), atol=1e-12)
    finished = new.project(draws) / lively.scale
    np.testing.assert_allclose(trace.replay(new), finished, atol=1e-12)
    with pytest.raises(ValueError, match=r"level must be 0 or one from 1 to 40, got 41"):
        trace.replay(new, 41)


@pytest.mark.parametrize("perspective", [False, True])
@pytest.mark.parametrize("shared_noise", [True, False])
def test_draws_depend_on_their_names_alone(lively, shared_noise, perspective):
    posterior = MotionPosterior(lively)
    sampler = MultiViewAncestral(steps=6, shared_noise=shared_noise, perspective=perspective)
    whole = sampler.sample(posterior, draws=7, chains=3, seed=2, progress=False).positions.values
    bars = sampler.sample(posterior, draws=7, chains=3, seed=2, progress=True).positions.values
    np.testing.assert_array_equal(bars, whole)
    small = replace(sampler, batch=2).sample(posterior, draws=7, chains=3, seed=2, progress=False)
    np.testing.assert_allclose(small.positions.values, whole, atol=1e-12)
    fewer = sampler.sample(posterior, draws=4, chains=2, seed=2, progress=False)
    np.testing.assert_allclose(fewer.positions.values, whole[:2, :4], atol=1e-12)
    other = sampler.sample(posterior, draws=7, chains=3, seed=3, progress=False).positions.values
    assert abs(other - whole).min() > 0
    flat = whole.reshape(21, -1)
    assert len(np.unique(flat[:, 0])) == 21


def test_interrupted_run_keeps_finished_batches(lively):
    from probmotion.posteriors.sampling import Interrupted

    calls = []

    class Impatient(type(lively)):
        def denoise(self, x_t, alpha_bar, cameras):
            calls.append(len(x_t))
            if len(calls) > 14:
                raise KeyboardInterrupt
            return super().denoise(x_t, alpha_bar, cameras)

    sampler = MultiViewAncestral(steps=6, batch=3)
    wanted = sampler.sample(MotionPosterior(lively), draws=9, chains=2, progress=False)
    posterior = MotionPosterior(Impatient(lively.mean, lively.covariance, lively.scale))
    with pytest.raises(Interrupted) as caught:
        sampler.sample(posterior, draws=9, chains=2, progress=False)
    kept = caught.value.draws.positions.values
    assert kept.shape[:2] == (2, 3)
    np.testing.assert_array_equal(kept, wanted.positions.values[:, :3])


def test_counts_are_of_views_and_draws_are_independent(lively):
    sampler = MultiViewAncestral(steps=7, n_views=3)
    draws = sampler.sample(MotionPosterior(lively), draws=4, chains=2, progress=False)
    assert draws.counts == {"denoiser": 7 * 3 * 8}
    assert draws.independent


def test_reference_code_differs_as_documented():
    code = MultiViewAncestral.reference_code()
    assert (code.n_views, code.schedule_power, code.stop_level) == (7, 4, 2)
    assert code.perspective
    assert MultiViewAncestral() == MultiViewAncestral(
        steps=100, n_views=5, elevation=math.pi / 16, schedule_power=2, stop_level=1
    )


def test_what_does_not_fit_is_refused_in_a_sentence(lively, gaussian_motion):
    posterior = MotionPosterior(lively)
    with pytest.raises(ValueError, match=r"initial is ndarray, expected None: mas starts every"):
        MultiViewAncestral().sample(posterior, initial=np.zeros(3), progress=False)
    for wrong, message in (
        ({"n_views": 1}, r"n_views must be an integer of at least 2, got 1"),
        ({"steps": 0}, r"steps is 0"),
        ({"stop_level": 101}, r"stop_level must be at most, got 101"),
        ({"view_weights": (1.0, 2.0)}, r"view_weights must have shape \(5\), got \(2,\)"),
        ({"trained_steps": 50}, r"steps must be at most the schedule's 50, got 100"),
    ):
        with pytest.raises(ValueError, match=message):
            MultiViewAncestral(**wrong)

    class Flat(gaussian_motion):
        def denoise(self, x_t, alpha_bar, cameras):
            raise ValueError("cameras must be orthographic cameras, got perspective")

    flat = MotionPosterior(Flat(lively.mean, lively.covariance))
    with pytest.raises(UnsupportedPosterior, match=r"perspective views needs a denoiser of such"):
        MultiViewAncestral(perspective=True).sample(flat, draws=1, progress=False)

    cameras = Cameras.ring(1)
    seen = Keypoints2D(cameras.project(lively.mean), cameras, noise=0.1)
    for options in ({"perspective": True}, {"shared_noise": False}):
        with pytest.raises(UnsupportedPosterior, match="orthographic and share their noise"):
            MultiViewAncestral(**options).sample(MotionPosterior(lively, seen), progress=False)

    class Mute:
        skeleton, frames, fps, dim = lively.skeleton, 2, 20.0, 12

        def motion(self, theta):
            return theta

    with pytest.raises(UnsupportedPosterior, match="needs a prior with Denoises2D"):
        MultiViewAncestral().sample(MotionPosterior(Mute()), progress=False)


def test_a_prominent_perspective_view_counts_more(lively):
    posterior = MotionPosterior(lively)
    even = MultiViewAncestral(steps=6, perspective=True)
    ones, plain, prominent = (
        replace(even, view_weights=weights).sample(posterior, draws=4, progress=False).flat()
        for weights in ((1.0,) * 5, None, (9.0, 1.0, 1.0, 1.0, 1.0))
    )
    np.testing.assert_allclose(ones, plain, atol=1e-12)
    assert abs(prominent - plain).max() > 1e-3


def test_the_next_level_gets_the_next_levels_noise(lively):
    """Noise may depend on the level: the state at t − 1 has that of t − 1."""
    asked = []

    class Listening(MotionState):
        def noise(self, streams, t):
            asked.append(t)
            return super().noise(streams, t)

    views = Views(Cameras.ring(5, elevation=0.3))
    schedule = NoiseSchedule.cosine(5)
    shape = (lively.frames, lively.skeleton.n_joints, 3)
    state = Listening(MultiViewDenoiser(lively, views), schedule, shape)
    ancestral(state, NormalStreams([np.random.default_rng(0)]), lambda: None)
    assert asked == [5, 4, 3, 2, 1]


def test_two_views_stand_120_degrees_apart():
    """MAS, table 2: opposite views would see the same picture, mirrored, and no depth."""
    np.testing.assert_allclose(
        MultiViewAncestral(n_views=2).cameras.azimuth, [0, 2 * np.pi / 3], atol=1e-12
    )
    five = MultiViewAncestral(n_views=5, elevation=0.3, perspective=True, distance=4.0).cameras
    ring = Cameras.ring(5, elevation=0.3, perspective=True, distance=4.0)
    np.testing.assert_array_equal(five.rotation, ring.rotation)
    np.testing.assert_array_equal(five.focal, ring.focal)


def test_level_views_are_warned_of(lively):
    sampler = MultiViewAncestral(steps=2, elevation=0.0)
    with pytest.warns(UserWarning, match="elevation is 0: .* that mas cannot resolve"):
        sampler.sample(MotionPosterior(lively), draws=1, progress=False)
