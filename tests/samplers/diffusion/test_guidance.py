"""Guidance against exact posteriors, closed forms and finite differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from probmotion import Cameras, Joints3D, Keypoints2D, Motion, MotionPosterior, UnsupportedPosterior
from probmotion.samplers import Ancestral3D, MultiViewAncestral, MultiViewPredictorCorrector
from probmotion.samplers.diffusion.guidance import (
    DPS,
    Evidence,
    MomentMatched,
    Replacement,
    WeightedTriangulation,
    conjugate_gradients,
    guide_towards,
)
from probmotion.samplers.diffusion.views import MotionDenoiser, MultiViewDenoiser, Views


@pytest.fixture(scope="module")
def keypoints(lively):
    """Two tilted views of a draw, one joint hidden in one frame of one of them."""
    motion = Motion(lively.sample(np.random.default_rng(8), 1)[0], lively.skeleton, lively.fps)
    hidden = np.zeros((2, 2, 2), dtype=bool)
    hidden[1, 0, 1] = True
    cameras = Cameras.around([0.3, 1.1], [0.2, 0.5])
    return Keypoints2D.observe(motion, cameras, noise=0.1, seed=0, hidden=hidden)


@pytest.fixture(scope="module")
def joints(lively):
    motion = Motion(lively.sample(np.random.default_rng(9), 1)[0], lively.skeleton, lively.fps)
    hidden = np.array([[False, True], [True, False]])
    return Joints3D.observe(motion, noise=0.2, seed=0, hidden=hidden)


def given_both(prior, likelihood, x_t, alpha_bar):
    """E[X₀ | X_t, y] by dense algebra: the noisy state is evidence like any other."""
    mean, covariance = prior.posterior(likelihood)
    posterior = replace(prior, mean=mean, covariance=covariance)
    return posterior.denoise_motion(x_t, alpha_bar)


@pytest.mark.parametrize("alpha_bar", [1e-4, 0.3, 0.95])
@pytest.mark.parametrize("evidence", ["keypoints", "joints"])
def test_moment_matching_is_exact_for_a_gaussian(lively, alpha_bar, evidence, request):
    likelihood = request.getfixturevalue(evidence)
    posterior = MotionPosterior(lively, likelihood)
    denoiser = MotionDenoiser(lively)
    x_t = np.random.default_rng(0).normal(size=(5, 2, 2, 3))
    exact = given_both(lively, likelihood, x_t, alpha_bar)
    gaps = []
    for steps in (1, 4, 16):
        guide = guide_towards(Ancestral3D(), posterior, MomentMatched(steps), denoiser)
        guided = guide(x_t, alpha_bar, denoiser.denoise(x_t, alpha_bar), None)
        gaps.append(abs(guided - exact).max())
    assert gaps[2] < 1e-9
    assert gaps[0] > gaps[1] > gaps[2]
    unguided = denoiser.denoise(x_t, alpha_bar)
    assert abs(unguided - exact).max() > 0.01
    assert denoiser.counts == {"denoiser": 20, "covariance": 5 * (1 + 4 + 16)}


def test_guided_draws_are_those_of_the_posterior(lively, keypoints, covariance_is):
    """With exact guidance the steps are those of a sampler whose prior is the posterior."""
    mean, covariance = lively.posterior(keypoints)
    guided = Ancestral3D(steps=60, guidance=MomentMatched(16)).sample(
        MotionPosterior(lively, keypoints), draws=400, seed=5, progress=False
    )
    direct = Ancestral3D(steps=60).sample(
        MotionPosterior(replace(lively, mean=mean, covariance=covariance)),
        draws=400,
        seed=5,
        progress=False,
    )
    np.testing.assert_allclose(guided.flat(), direct.flat(), atol=1e-8)
    gap = direct.flat().mean(axis=0) - mean
    assert abs(gap).max() < 5 * np.sqrt(np.diag(covariance).max() / 400)


def test_covariance_of_the_surrogate_is_its_jacobian_made_symmetric(lively):
    views = Views(Cameras.ring(3, elevation=0.5), (2.0, 1.0, 1.0))
    denoiser = MultiViewDenoiser(lively, views)
    alpha_bar, step = 0.4, 1e-5
    x = np.random.default_rng(1).normal(size=(1, 2, 2, 3))
    unit = np.eye(12).reshape(12, 2, 2, 3)
    here = np.repeat(x, 12, axis=0)
    jacobian = (
        (
            (
                denoiser.denoise(x + step * unit, alpha_bar)
                - denoiser.denoise(x - step * unit, alpha_bar)
            )
            / (2 * step)
        )
        .reshape(12, 12)
        .T
    )
    matrix = denoiser.covariance_product(here, alpha_bar, unit).reshape(12, 12).T
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-12)
    assert np.linalg.eigvalsh(matrix).min() > 0
    values, vectors = np.linalg.eigh(np.kron(np.eye(4), views.gram))
    half = vectors @ np.diag(np.sqrt(values)) @ vectors.T
    similar = half @ jacobian @ np.linalg.inv(half) * (1 - alpha_bar) / np.sqrt(alpha_bar)
    np.testing.assert_allclose(matrix, similar, atol=1e-8)
    assert abs(jacobian - jacobian.T).max() > 1e-3


def test_surrogate_of_an_isotropic_prior_is_guided_exactly(gaussian_motion):
    S = np.array([[1.0, 0.4], [0.4, 0.3]])
    prior = gaussian_motion(np.zeros((1, 2, 3)), np.kron(S, np.eye(3)))
    camera = Cameras.around([0.3], [0.2])
    seen = Keypoints2D(camera.project(np.ones((1, 2, 3))), camera, noise=0.1)
    denoiser = MultiViewDenoiser(prior, Views(Cameras.ring(5, elevation=0.4)))
    guide = guide_towards(
        MultiViewAncestral(), MotionPosterior(prior, seen), MomentMatched(8), denoiser
    )
    x_t = np.random.default_rng(0).normal(size=(3, 1, 2, 3))
    guided = guide(x_t, 0.3, denoiser.denoise(x_t, 0.3), None)
    np.testing.assert_allclose(guided, given_both(prior, seen, x_t, 0.3), atol=1e-9)


@pytest.mark.parametrize("multi_view", [False, True])
def test_dps_descends_the_distance_to_the_evidence(lively, keypoints, multi_view):
    posterior = MotionPosterior(lively, keypoints)
    if multi_view:
        denoiser = MultiViewDenoiser(lively, Views(Cameras.ring(3, elevation=0.5), (3.0, 1.0, 1.0)))
    else:
        denoiser = MotionDenoiser(lively)
    evidence = Evidence.of(Ancestral3D(), posterior)
    seen = (evidence.precision > 0)[..., None]
    alpha_bar = 0.4
    x = np.random.default_rng(1).normal(size=(1, 2, 2, 3))

    def distance(state):
        gap = seen * (evidence.target - evidence.observe(denoiser.denoise(state, alpha_bar)))
        return np.sqrt((gap**2).sum(axis=(1, 2, 3, 4)))

    unit = 1e-5 * np.eye(12).reshape(12, 2, 2, 3)
    gradient = (distance(x + unit) - distance(x - unit)) / 2e-5
    schedule = Ancestral3D(steps=20).schedule
    step = schedule.posterior(12)
    guide = guide_towards(Ancestral3D(), posterior, DPS(0.7), denoiser)
    clean = denoiser.denoise(x, alpha_bar)
    moved = step.clean * (guide(x, alpha_bar, clean, step) - clean)
    np.testing.assert_allclose(moved.ravel(), -0.7 * gradient, atol=1e-8)


def test_replacement_puts_the_evidence_in_and_leaves_the_rest(lively, keypoints):
    camera = Cameras.around([0.3], [0.2])
    one = Keypoints2D(
        keypoints.keypoints[:1], camera, noise=0.1, confidence=np.array([[[1.0, 0.5], [0.0, 1.0]]])
    )
    denoiser = MotionDenoiser(lively)
    guide = guide_towards(Ancestral3D(), MotionPosterior(lively, one), Replacement(), denoiser)
    clean = np.random.default_rng(0).normal(size=(2, 2, 2, 3))
    out = guide(clean, 0.5, clean, None)
    evidence = Evidence.of(Ancestral3D(), MotionPosterior(lively, one))
    seen = np.broadcast_to((one.confidence > 0)[..., None], evidence.observe(out)[0].shape)
    for motion in out:
        np.testing.assert_allclose(
            evidence.observe(motion[None])[0][seen], evidence.target[seen], atol=1e-12
        )
    np.testing.assert_array_equal(out[:, 1, 0], clean[:, 1, 0])
    depth = camera.rotation[0, 2]
    np.testing.assert_allclose(out @ depth, clean @ depth, atol=1e-12)
    # It is an average weighted by precision where views contradict each other.
    two = replace(
        one,
        keypoints=np.tile(one.keypoints, (2, 1, 1, 1)),
        cameras=Cameras.around([0.3, 0.3], [0.2, 0.2]),
        confidence=np.stack([np.ones((2, 2)), 3 * np.ones((2, 2))]),
    )
    shifted = two.keypoints.copy()
    shifted[1] += 0.4
    two = replace(two, keypoints=shifted)
    guide = guide_towards(Ancestral3D(), MotionPosterior(lively, two), Replacement(), denoiser)
    out = guide(clean, 0.5, clean, None) * lively.scale
    np.testing.assert_allclose(camera.project(out[0])[0], two.keypoints[0] + 0.3, atol=1e-12)


def test_weighted_triangulation_is_triangulation_with_more_views(lively, keypoints):
    ring = Cameras.ring(3, elevation=0.4)
    views = Views(ring)
    denoiser = MultiViewDenoiser(lively, views)
    posterior = MotionPosterior(lively, keypoints)
    guide = guide_towards(MultiViewAncestral(), posterior, WeightedTriangulation(2.0), denoiser)
    x_t = np.random.default_rng(0).normal(size=(1, 2, 2, 3))
    out = guide(x_t, 0.5, denoiser.denoise(x_t, 0.5), None)[0]
    # Row by row: the ring's denoised views with weight 1, the keypoints with weight 2.
    seen = lively.denoise(views.project(x_t), 0.5, ring)[0]
    for frame, joint in np.ndindex(2, 2):
        rows = [*ring.image_axes]
        targets = [*seen[:, frame, joint]]
        for v in range(2):
            weight = np.sqrt(2.0 * keypoints.confidence[v, frame, joint])
            rows.append(weight * keypoints.cameras.image_axes[v])
            targets.append(weight * keypoints.keypoints[v, frame, joint] / lively.scale)
        solution = np.linalg.lstsq(np.concatenate(rows), np.concatenate(targets), rcond=None)[0]
        np.testing.assert_allclose(out[frame, joint], solution, atol=1e-12)


def test_conjugate_gradients_solve_every_row_and_stop_where_done():
    rng = np.random.default_rng(0)
    matrix = rng.normal(size=(4, 7, 5))
    right = rng.normal(size=(4, 7))
    right[2] = 0

    def spread(u):
        return np.einsum("brc,br->bc", matrix, u)

    def whiten(m):
        return np.einsum("brc,bc->br", matrix, m)

    found = conjugate_gradients(spread, whiten, right, steps=30)
    for row in range(4):
        system = np.eye(7) + matrix[row] @ matrix[row].T
        expected = matrix[row].T @ np.linalg.solve(system, right[row])
        np.testing.assert_allclose(found[row], expected, atol=1e-12)
    alone = conjugate_gradients(
        lambda u: np.einsum("brc,br->bc", matrix[1:2], u),
        lambda m: np.einsum("brc,bc->br", matrix[1:2], m),
        right[1:2],
        steps=30,
    )
    np.testing.assert_allclose(alone[0], found[1], atol=1e-14)


def solved(system: np.ndarray, right: np.ndarray, steps: int) -> np.ndarray:
    """K u where (I + K) u = right, by as many steps of conjugate gradients; both with a row."""
    return conjugate_gradients(
        lambda u: np.einsum("bij,bj->bi", system, u), lambda moved: moved, right, steps
    )


def test_conjugate_gradients_stop_where_the_system_is_negative():
    """One eigenvalue of four is −0.999: along it the system is a thousandth of the identity."""
    values = np.array([[3.0, 2.0, 1.0, 0.5], [3.0, 2.0, 1.0, -0.999]])
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(4, 4)))[0]
    systems = np.einsum("ij,bj,kj->bik", turn, values, turn)
    right = np.random.default_rng(1).normal(size=(2, 4))
    wanted = np.linalg.solve(np.eye(4) + systems, right[..., None])[..., 0]
    wanted = np.einsum("bij,bj->bi", systems, wanted)
    np.testing.assert_allclose(solved(systems, right, 4)[0], wanted[0], atol=1e-12)
    # Solved to its end it is hundreds of times the right-hand side.
    left = [np.linalg.norm(solved(systems, right, steps)[1]) for steps in range(1, 30)]
    assert 0 < left[0] <= max(left) < 0.01 * np.linalg.norm(wanted[1])
    assert left[-1] == left[10]


def test_conjugate_gradients_stop_where_the_system_is_not_symmetric():
    """All its curvatures are 1.5: nothing but that directions are not conjugate tells."""
    system = np.array([[[0.5, 30.0], [-30.0, 0.5]]])
    right = np.array([[1.0, 1.0]])
    first = solved(system, right, 1)
    for steps in (2, 6, 100):
        assert np.array_equal(solved(system, right, steps), first)


def test_what_has_stopped_does_not_start_again():
    """Systems of any kind: after two answers that are the same, all are."""
    rng = np.random.default_rng(0)
    systems, right = 3 * rng.normal(size=(300, 6, 6)), rng.normal(size=(300, 6))
    answers = np.stack([solved(systems, right, steps) for steps in range(1, 10)])
    still = (answers[1:] == answers[:-1]).all(axis=-1)
    assert still[-1].all()
    assert (still[1:] >= still[:-1]).all()


def test_conjugate_gradients_go_on_where_evidence_hardly_meets_the_covariance():
    """K = diag(3, 0), and the right-hand side is nearly all outside its range."""
    found = solved(np.diag([3.0, 0.0])[None], np.array([[0.01, 1.0]]), 2)
    np.testing.assert_allclose(found, [[0.0075, 0.0]], rtol=1e-9)


@pytest.mark.parametrize("size", [1e2, 1e6, 1e10])
def test_conjugate_gradients_go_on_where_a_covariance_is_singular(size):
    """Of rank 2, seen four times over: three steps solve it, whatever is lost to rounding."""
    rng = np.random.default_rng(0)
    root = np.tile(rng.normal(size=(50, 5, 2)), (1, 4, 1))
    system = size * root @ root.swapaxes(1, 2)
    right = (system @ rng.normal(size=(50, 20, 1)))[..., 0]
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    # K u is nearly the right-hand side, which is in K's range: off by u, at most 1/size of it.
    found = solved(system, right, 6)
    smallest = np.linalg.eigvalsh(system)[:, -2]
    assert (np.linalg.norm(found - right, axis=1) < 2 / smallest + 1e-4).all()


@pytest.mark.parametrize(
    "guidance",
    [MomentMatched(), DPS(), Replacement(), WeightedTriangulation()],
    ids=lambda g: g.kind,
)
@pytest.mark.parametrize(
    "sampler",
    [Ancestral3D, MultiViewAncestral, MultiViewPredictorCorrector],
    ids=lambda sampler: sampler.name,
)
def test_guided_draws_depend_on_their_names_alone(lively, keypoints, sampler, guidance):
    posterior = MotionPosterior(lively, keypoints)
    made = sampler(steps=6, guidance=guidance)
    whole = made.sample(posterior, draws=5, seed=1, progress=False)
    small = replace(made, batch=2).sample(posterior, draws=5, seed=1, progress=True)
    np.testing.assert_allclose(small.positions.values, whole.positions.values, atol=1e-10)
    assert small.counts == whole.counts
    free = made.sample(MotionPosterior(lively), draws=5, seed=1, progress=False)
    assert abs(free.positions.values - whole.positions.values).max() > 1e-3
    assert f'"kind": "{guidance.kind}"' in whole.dataset.attrs["settings"]
    # Per draw and level: one product with the covariance for DPS, one per step of conjugate
    # gradients; of every view.
    products = {"moment-matched": 6, "dps": 1}.get(guidance.kind, 0)
    views = 1 if sampler is Ancestral3D else 5
    estimates = whole.counts["denoiser"] // (5 * views)
    assert whole.counts.get("covariance", 0) == 5 * views * estimates * products


def test_guidance_needs_what_it_needs(lively, keypoints):
    class Plain:
        """Denoises, and no more."""

        def __init__(self, prior):
            self.skeleton, self.frames, self.fps = prior.skeleton, prior.frames, prior.fps
            self.dim, self.scale = prior.dim, prior.scale
            self.motion, self.denoise = prior.motion, prior.denoise
            self.denoise_motion = prior.denoise_motion

    posterior = MotionPosterior(Plain(lively), keypoints)
    for sampler, protocol in (
        (Ancestral3D, "DenoiserCovariance3D"),
        (MultiViewAncestral, "DenoiserCovariance2D"),
        (MultiViewPredictorCorrector, "DenoiserCovariance2D"),
    ):
        for guidance in (MomentMatched(), DPS()):
            with pytest.raises(UnsupportedPosterior, match=f"needs a prior with {protocol}") as no:
                sampler(steps=3, guidance=guidance).sample(posterior, draws=1, progress=False)
            assert no.value.word == protocol
        draws = sampler(steps=3, guidance=Replacement()).sample(posterior, draws=2, progress=False)
        assert "covariance" not in draws.counts


def test_evidence_that_is_not_linear_is_refused(lively):
    motion = Motion(lively.mean, lively.skeleton, lively.fps)
    near = Cameras.ring(1, distance=9.0, perspective=True)
    perspective = Keypoints2D.observe(motion, near, noise=0.1, seed=0)
    outliers = Joints3D.observe(motion, noise=0.1, seed=0, degrees_of_freedom=3)

    class Other:
        frames, n_joints = 2, 2

        def log_density(self, positions):
            return 0.0

        def simulate(self, rng, positions):
            return self

    for likelihood, reason in (
        (perspective, "the cameras are perspective"),
        (outliers, "Student-t with 3 degrees"),
        (Other(), "but Other does not offer linear"),
    ):
        for sampler in (Ancestral3D(), MultiViewAncestral(), MultiViewPredictorCorrector()):
            with pytest.raises(UnsupportedPosterior, match=reason) as refused:
                sampler.sample(MotionPosterior(lively, likelihood), draws=1, progress=False)
            assert refused.value.word == "observations"


def test_settings_out_of_range():
    for make, message in (
        (lambda: MomentMatched(0), "steps is 0"),
        (lambda: DPS(-1.0), "step_size is -1.0"),
        (lambda: WeightedTriangulation(0.0), "weight is 0.0"),
    ):
        with pytest.raises(ValueError, match=message):
            make()
