"""Tests of guidance: exact posteriors, closed forms, finite differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from probmotion import (
    Cameras,
    Joints3D,
    Keypoints2D,
    Motion,
    MotionPosterior,
    NoiseSchedule,
    UnsupportedPosterior,
)
from probmotion.problems import load_problem
from probmotion.samplers import Ancestral3D, MultiViewAncestral, MultiViewPredictorCorrector
from probmotion.samplers.diffusion.guidance import (
    DPS,
    ExactGuidance,
    LinearisedObservations,
    LinearObservations,
    MomentMatched,
    Replacement,
    WeightedTriangulation,
    conjugate_gradients,
    guide_towards,
)
from probmotion.samplers.diffusion.views import MotionDenoiser, MultiViewDenoiser, Views


@pytest.fixture(scope="module")
def observations(gaussian):
    """Return two views of a motion, and its joints, each with occluded entries."""
    truth = Motion(gaussian.sample(np.random.default_rng(8), 1)[0], gaussian.skeleton, gaussian.fps)
    hidden = np.zeros((2, 2, 2), dtype=bool)
    hidden[1, 0, 1] = True
    cameras = Cameras.around([0.3, 1.1], [0.2, 0.5])
    return {
        "keypoints": Keypoints2D.observe(truth, cameras, noise=0.1, seed=0, hidden=hidden),
        "joints": Joints3D.observe(truth, noise=0.2, seed=0, hidden=np.eye(2, dtype=bool)),
    }


@pytest.fixture(scope="module")
def keypoints(observations):
    return observations["keypoints"]


def exact_denoiser(prior, likelihood, x_t, alpha_bar):
    """Return E[X₀ | X_t, y] by dense linear algebra."""
    return prior.given(likelihood).denoise_motion(x_t, alpha_bar)


@pytest.mark.parametrize("alpha_bar", [1e-4, 0.3, 0.95])
@pytest.mark.parametrize("observed", ["keypoints", "joints"])
def test_moment_matching_is_exact_for_a_gaussian(gaussian, observations, alpha_bar, observed):
    likelihood = observations[observed]
    posterior = MotionPosterior(gaussian, likelihood)
    denoiser = MotionDenoiser(gaussian)
    x_t = np.random.default_rng(0).normal(size=(5, 2, 2, 3))
    exact = exact_denoiser(gaussian, likelihood, x_t, alpha_bar)
    errors = []
    for steps in (1, 4, 16):
        guide = guide_towards(Ancestral3D(), posterior, MomentMatched(steps), denoiser)
        guided = guide(x_t, alpha_bar, denoiser.denoise(x_t, alpha_bar), None)
        errors.append(abs(guided - exact).max())
    assert errors[2] < 1e-9
    assert errors[0] > errors[1] > errors[2]
    unguided = denoiser.denoise(x_t, alpha_bar)
    assert abs(unguided - exact).max() > 0.01
    assert denoiser.counts == {"denoiser": 20, "covariance": 5 * (1 + 4 + 16)}


def test_guidance_does_not_depend_on_the_rows_at_a_time(gaussian, keypoints, monkeypatch):
    posterior, denoiser = MotionPosterior(gaussian, keypoints), MotionDenoiser(gaussian)
    rng = np.random.default_rng(0)
    x_t = rng.normal(size=(5, 2, 2, 3))
    axes, target = rng.normal(size=(5, 2, 2, 4, 3)), rng.normal(size=(5, 2, 2, 4, 1))
    linearised = LinearisedObservations(axes, target, np.ones((2, 2, 4)))
    results = []
    for rows in (64, 2):
        monkeypatch.setattr("probmotion.samplers.diffusion.guidance._ROWS", rows)
        guides = [
            guide_towards(Ancestral3D(), posterior, method, denoiser)
            for method in (MomentMatched(), DPS())
        ]
        step = NoiseSchedule.cosine(10).posterior(5)
        results.append(
            [
                *(guide(x_t, 0.4, x_t / 2, step) for guide in guides),
                *MomentMatched().condition(linearised, denoiser, x_t, 0.4, x_t / 2),
            ]
        )
    for whole, parts in zip(*results, strict=True):
        np.testing.assert_allclose(parts, whole, rtol=1e-12)


def test_moment_matched_draws_are_those_of_the_posterior(gaussian, keypoints):
    """For a Gaussian the steps are those of a sampler with the posterior as its prior."""
    guided, direct = (
        Ancestral3D(steps=40).sample(posterior, draws=40, seed=5, progress=False).flat()
        for posterior in (
            MotionPosterior(gaussian, keypoints),
            MotionPosterior(gaussian.given(keypoints)),
        )
    )
    np.testing.assert_allclose(guided, direct, atol=1e-8)


@pytest.mark.parametrize("kind", [Ancestral3D, MultiViewAncestral, MultiViewPredictorCorrector])
def test_exactly_guided_draws_are_those_of_the_conditioned_prior(kind):
    problem = load_problem("gait-sparse", frames=3, components=6, noise=0.1)
    guided, direct = (
        sampler.sample(posterior, draws=4, seed=5, progress=False)
        for sampler, posterior in (
            (kind(steps=6, guidance=ExactGuidance()), problem.posterior),
            (kind(steps=6), problem.posterior.conditioned()),
        )
    )
    np.testing.assert_array_equal(guided.flat(), direct.flat())
    assert guided.counts == direct.counts
    assert guided.counts.keys() == {"denoiser"}


def test_exactly_guided_draws_choose_styles_with_the_probabilities_of_the_posterior():
    """Moment matching replaces the styles that are left by one Gaussian."""
    problem = load_problem("gait-sparse")
    prior, posterior = problem.posterior.prior, problem.posterior
    exact = prior.exact_posterior(posterior.likelihood).sample(np.random.default_rng(0), 4000)
    expected = prior.style_responsibilities(exact).mean(axis=0)
    errors = []
    for guidance in (ExactGuidance(), MomentMatched()):
        draws = Ancestral3D(guidance=guidance).sample(posterior, draws=400, progress=False)
        shares = prior.style_responsibilities(draws.flat()).mean(axis=0)
        errors.append(0.5 * abs(shares - expected).sum())
    assert errors[0] < 0.05 < errors[1]


def test_default_gamma_depends_on_the_observations(gaussian, keypoints):
    for likelihood, gamma in ((None, None), (keypoints, 0.5)):
        posterior = MotionPosterior(gaussian, likelihood)
        default, half = (
            MultiViewPredictorCorrector(gamma=value).sample(posterior, draws=2, progress=False)
            for value in (None, 0.5)
        )
        assert np.array_equal(default.flat(), half.flat()) == (gamma == 0.5)


def test_multi_view_covariance_is_the_symmetrised_jacobian(gaussian):
    views = Views(Cameras.ring(3, elevation=0.5), (2.0, 1.0, 1.0))
    denoiser = MultiViewDenoiser(gaussian, views)
    alpha_bar, step = 0.4, 1e-5
    x = np.random.default_rng(1).normal(size=(1, 2, 2, 3))
    unit = np.eye(12).reshape(12, 2, 2, 3)
    repeated = np.repeat(x, 12, axis=0)
    up, down = (denoiser.denoise(x + sign * step * unit, alpha_bar) for sign in (1, -1))
    jacobian = ((up - down) / (2 * step)).reshape(12, 12).T
    matrix = denoiser.covariance(repeated, alpha_bar)(unit).reshape(12, 12).T
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-12)
    assert np.linalg.eigvalsh(matrix).min() > 0
    values, vectors = np.linalg.eigh(np.kron(np.eye(4), views.gram))
    half = vectors @ np.diag(np.sqrt(values)) @ vectors.T
    similar = half @ jacobian @ np.linalg.inv(half) * (1 - alpha_bar) / np.sqrt(alpha_bar)
    np.testing.assert_allclose(matrix, similar, atol=1e-8)
    assert abs(jacobian - jacobian.T).max() > 1e-3


@pytest.mark.parametrize("multi_view", [False, True])
def test_dps_descends_the_distance_to_the_observations(gaussian, keypoints, multi_view):
    posterior = MotionPosterior(gaussian, keypoints)
    views = Views(Cameras.ring(3, elevation=0.5), (3.0, 1.0, 1.0))
    denoiser = MultiViewDenoiser(gaussian, views) if multi_view else MotionDenoiser(gaussian)
    observations = LinearObservations.of(Ancestral3D(), posterior)
    observed = (observations.precision > 0)[..., None]
    alpha_bar = 0.4
    x = np.random.default_rng(1).normal(size=(1, 2, 2, 3))

    def distance(state):
        predicted = observations.observe(denoiser.denoise(state, alpha_bar))
        residual = observed * (observations.target - predicted)
        return np.sqrt((residual**2).sum(axis=(1, 2, 3, 4)))

    unit = 1e-5 * np.eye(12).reshape(12, 2, 2, 3)
    gradient = (distance(x + unit) - distance(x - unit)) / 2e-5
    schedule = Ancestral3D(steps=20).schedule
    step = schedule.posterior(12)
    guide = guide_towards(Ancestral3D(), posterior, DPS(0.7), denoiser)
    clean = denoiser.denoise(x, alpha_bar)
    change = step.clean * (guide(x, alpha_bar, clean, step) - clean)
    np.testing.assert_allclose(change.ravel(), -0.7 * gradient, atol=1e-8)


def test_replacement_changes_only_the_observed_coordinates(gaussian, keypoints):
    camera = Cameras.around([0.3], [0.2])
    one = Keypoints2D(
        keypoints.keypoints[:1], camera, noise=0.1, confidence=np.array([[[1.0, 0.5], [0.0, 1.0]]])
    )
    denoiser = MotionDenoiser(gaussian)
    guide = guide_towards(Ancestral3D(), MotionPosterior(gaussian, one), Replacement(), denoiser)
    clean = np.random.default_rng(0).normal(size=(2, 2, 2, 3))
    result = guide(clean, 0.5, clean, None)
    observations = LinearObservations.of(Ancestral3D(), MotionPosterior(gaussian, one))
    predicted = observations.observe(result)
    observed = np.broadcast_to((one.confidence > 0)[..., None], predicted[0].shape)
    for motion in predicted:
        np.testing.assert_allclose(motion[observed], observations.target[observed], atol=1e-12)
    np.testing.assert_array_equal(result[:, 1, 0], clean[:, 1, 0])
    depth = camera.rotation[0, 2]
    np.testing.assert_allclose(result @ depth, clean @ depth, atol=1e-12)
    # Inconsistent views are averaged by precision.
    two = Keypoints2D(
        np.concatenate([one.keypoints, one.keypoints + 0.4]),
        Cameras.around([0.3, 0.3], [0.2, 0.2]),
        noise=0.1,
        confidence=np.stack([np.ones((2, 2)), 3 * np.ones((2, 2))]),
    )
    guide = guide_towards(Ancestral3D(), MotionPosterior(gaussian, two), Replacement(), denoiser)
    result = guide(clean, 0.5, clean, None) * gaussian.scale
    np.testing.assert_allclose(camera.project(result[0])[0], two.keypoints[0] + 0.3, atol=1e-12)


def test_weighted_triangulation_adds_views(gaussian, keypoints):
    ring = Cameras.ring(3, elevation=0.4)
    views = Views(ring)
    denoiser = MultiViewDenoiser(gaussian, views)
    posterior = MotionPosterior(gaussian, keypoints)
    guide = guide_towards(MultiViewAncestral(), posterior, WeightedTriangulation(2.0), denoiser)
    x_t = np.random.default_rng(0).normal(size=(1, 2, 2, 3))
    result = guide(x_t, 0.5, denoiser.denoise(x_t, 0.5), None)[0]
    # The expected result is least squares with weight 1 for denoised views, 2 for keypoints.
    clean = gaussian.denoise(views.project(x_t), 0.5, ring)[0]
    for frame, joint in np.ndindex(2, 2):
        rows = [*ring.image_axes]
        targets = [*clean[:, frame, joint]]
        for v in range(2):
            weight = np.sqrt(2.0 * keypoints.confidence[v, frame, joint])
            rows.append(weight * keypoints.cameras.image_axes[v])
            targets.append(weight * keypoints.keypoints[v, frame, joint] / gaussian.scale)
        solution = np.linalg.lstsq(np.concatenate(rows), np.concatenate(targets), rcond=None)[0]
        np.testing.assert_allclose(result[frame, joint], solution, atol=1e-12)


def test_conjugate_gradients_solve_every_row():
    rng = np.random.default_rng(0)
    matrix = rng.normal(size=(4, 7, 5))
    right = rng.normal(size=(4, 7))
    right[2] = 0

    def spread(u):
        return np.einsum("brc,br->bc", matrix, u)

    def whiten(m):
        return np.einsum("brc,bc->br", matrix, m)

    solution = conjugate_gradients(spread, whiten, right, steps=30)
    for row in range(4):
        system = np.eye(7) + matrix[row] @ matrix[row].T
        expected = matrix[row].T @ np.linalg.solve(system, right[row])
        np.testing.assert_allclose(solution[row], expected, atol=1e-12)


def solved(system, right, steps):
    """Return K u with (I + K) u = right after ``steps`` steps, for every row."""
    return conjugate_gradients(
        lambda u: np.einsum("bij,bj->bi", system, u), lambda v: v, right, steps
    )


def test_conjugate_gradients_stop_if_the_system_is_not_positive_or_symmetric():
    """One eigenvalue of K is −0.999, so the solution is large along it."""
    values = np.array([[3.0, 2.0, 1.0, 0.5], [3.0, 2.0, 1.0, -0.999]])
    rotation = np.linalg.qr(np.random.default_rng(0).normal(size=(4, 4)))[0]
    systems = np.einsum("ij,bj,kj->bik", rotation, values, rotation)
    right = np.random.default_rng(1).normal(size=(2, 4))
    expected = np.linalg.solve(np.eye(4) + systems, right[..., None])[..., 0]
    expected = np.einsum("bij,bj->bi", systems, expected)
    np.testing.assert_allclose(solved(systems, right, 4)[0], expected[0], atol=1e-12)
    # The solution is hundreds of times the right-hand side.
    sizes = [np.linalg.norm(solved(systems, right, steps)[1]) for steps in range(1, 30)]
    assert 0 < sizes[0] <= max(sizes) < 0.01 * np.linalg.norm(expected[1])
    assert sizes[-1] == sizes[10]
    # All curvatures are 1.5 in this asymmetric system, so only the conjugacy of directions fails.
    system = np.array([[[0.5, 30.0], [-30.0, 0.5]]])
    right = np.array([[1.0, 1.0]])
    first = solved(system, right, 1)
    for steps in (2, 6, 100):
        assert np.array_equal(solved(system, right, steps), first)


@pytest.mark.parametrize("size", [1e2, 1e6, 1e10])
def test_conjugate_gradients_continue_if_the_covariance_is_singular(size):
    """K has rank 2, so three steps solve the system despite rounding."""
    rng = np.random.default_rng(0)
    root = np.tile(rng.normal(size=(50, 5, 2)), (1, 4, 1))
    system = size * root @ root.swapaxes(1, 2)
    right = (system @ rng.normal(size=(50, 20, 1)))[..., 0]
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    # The right-hand side is in the range of K, so K u differs from it by u, of order 1/size.
    smallest = np.linalg.eigvalsh(system)[:, -2]
    error = np.linalg.norm(solved(system, right, 6) - right, axis=1)
    assert (error < 2 / smallest + 1e-4).all()
    # The right-hand side is almost orthogonal to the range of K = diag(3, 0).
    solution = solved(np.diag([3.0, 0.0])[None], np.array([[0.01, 1.0]]), 2)
    np.testing.assert_allclose(solution, [[0.0075, 0.0]], rtol=1e-9)


GUIDANCES = [MomentMatched(), DPS(), Replacement(), WeightedTriangulation(), ExactGuidance()]


@pytest.mark.parametrize("guidance", GUIDANCES, ids=lambda guidance: guidance.kind)
def test_guided_draws_do_not_depend_on_the_batch(gaussian, keypoints, guidance):
    posterior = MotionPosterior(gaussian, keypoints)
    for kind in (Ancestral3D, MultiViewAncestral, MultiViewPredictorCorrector):
        sampler = kind(steps=6, guidance=guidance)
        full = sampler.sample(posterior, draws=5, seed=1, progress=False)
        batched = replace(sampler, batch=2).sample(posterior, draws=5, seed=1, progress=False)
        np.testing.assert_allclose(batched.flat(), full.flat(), atol=1e-10)
        assert batched.counts == full.counts
        unguided = sampler.sample(MotionPosterior(gaussian), draws=5, seed=1, progress=False)
        assert abs(unguided.flat() - full.flat()).max() > 1e-3
        # An estimate takes one covariance product with DPS, or one per conjugate-gradient step.
        products = {"moment-matched": 6, "dps": 1}.get(guidance.kind, 0)
        assert full.counts.get("covariance", 0) == products * full.counts["denoiser"]


def test_guidance_by_covariances_needs_a_prior_that_provides_them(gaussian, keypoints):
    class Plain:
        """Prior with denoisers but without covariances."""

        def __init__(self, prior):
            self.denoise, self.denoise_motion = prior.denoise, prior.denoise_motion
            for name in ("skeleton", "frames", "fps", "dim", "scale", "motion"):
                setattr(self, name, getattr(prior, name))

    posterior = MotionPosterior(Plain(gaussian), keypoints)
    for sampler, protocol in (
        (Ancestral3D, "DenoiserCovariance3D"),
        (MultiViewAncestral, "DenoiserCovariance2D"),
        (MultiViewPredictorCorrector, "DenoiserCovariance2D"),
    ):
        for guidance in (MomentMatched(), DPS()):
            with pytest.raises(UnsupportedPosterior, match=f"that implements {protocol}") as error:
                sampler(steps=3, guidance=guidance).sample(posterior, draws=1, progress=False)
            assert error.value.word == protocol
        with pytest.raises(UnsupportedPosterior, match=r"given\(likelihood\), got Plain; use Mom"):
            sampler(steps=3, guidance=ExactGuidance()).sample(posterior, draws=1, progress=False)
        draws = sampler(steps=3, guidance=Replacement()).sample(posterior, draws=2, progress=False)
        assert "covariance" not in draws.counts
