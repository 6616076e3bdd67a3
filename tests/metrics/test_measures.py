"""All metrics of a run: which apply, and their values for exact and wrong draws."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from probmotion import Cameras, Keypoints2D, Motion, MotionDraws, MotionPosterior, Skeleton
from probmotion.metrics.measures import _exact_draws, accuracy_of, measure
from probmotion.metrics.stein import kernel_stein_discrepancy, score_of
from probmotion.models import GaussianMixtureMotion
from probmotion.posteriors.problem import Problem
from probmotion.problems.observations import observe

K, R, L, J, A = 2, 2, 4, 5, 6
N = 300


def mixture(frames, n_joints, styles, weights):
    rng = np.random.default_rng(0)
    shape = (len(styles), frames, n_joints, 3)
    return GaussianMixtureMotion(
        skeleton=Skeleton([*"abcde"][:n_joints], [-1, 0, 1, 0, 3][:n_joints]),
        fps=30.0,
        means=rng.normal(size=shape),
        factors=0.4 * rng.normal(size=(shape[0], R, *shape[1:])),
        weights=np.array(weights),
        noise=0.05,
        azimuths=A,
        styles=styles,
    )


@pytest.fixture(scope="module")
def prior():
    return mixture(L, J, ("calm", "wild"), [0.7, 0.3])


@pytest.fixture(scope="module")
def generation(prior):
    return Problem("generation", "no observations", MotionPosterior(prior))


def observed(prior, kind, motion=None):
    motion = prior.sample(np.random.default_rng(1), 1)[0] if motion is None else motion
    motion = Motion(motion, prior.skeleton, 30.0)
    likelihood = observe(motion, kind, 0.05, 0)
    return Problem(kind, "", MotionPosterior(prior, likelihood), motion.positions)


@pytest.fixture(scope="module")
def occluded(prior):
    return observed(prior, "occluded")


def measured(problem, positions, seed=0, **more):
    options = {"seed": 0, "seconds": 1.5, "counts": {"denoiser": 10}, "independent": True}
    draws = MotionDraws.of(
        problem.posterior, SimpleNamespace(name="named"), positions[None], **options, **more
    )
    return measure(problem, draws, seed)


def test_exact_draws_have_ideal_values(generation):
    runs = [measured(generation, generation.reference(100 + i, N), i) for i in range(6)]
    ideals = {
        "swd_ratio": 1, "variance_ratio": 1, "off_manifold_ratio": 1, "log_density_gap": 0,
        "mode_proportion_calm": 0.7, "mode_proportion_wild": 0.3, "c2st": 0.5, "mmd": 0,
    }  # fmt: skip
    for name, ideal in ideals.items():
        values = np.array([run[name] for run in runs])
        spread = values.std(ddof=1) / math.sqrt(len(values))
        # Student's t with 5 degrees of freedom exceeds 6.9 once in a thousand.
        assert abs(values.mean() - ideal) < 6.9 * spread, name
        assert spread < 0.35, name
    assert np.mean([run["mean_error_sd"] for run in runs]) < 2 / math.sqrt(N)


def test_errors_are_detected(generation, prior):
    exact = generation.reference(7, N)
    narrow = exact.mean(axis=0) + 0.5 * (exact - exact.mean(axis=0))
    rough = exact + 0.1 * np.random.default_rng(2).normal(size=exact.shape)
    calm = exact[prior.style_responsibilities(exact)[:, 0] > 0.5]
    calm = np.concatenate([calm, calm])[:N]
    narrow, rough, calm = (measured(generation, x, 3) for x in (narrow, rough, calm))
    assert narrow["variance_ratio"] == pytest.approx(0.25, rel=0.1)
    # Added noise of sd 2 δ multiplies the variance off the manifold by five.
    assert rough["off_manifold_ratio"] == pytest.approx(5, rel=0.1)
    assert rough["log_density_gap"] < -50
    assert rough["c2st"] > 0.7
    assert calm["mode_proportion_calm"] == pytest.approx(1, abs=1e-6)
    assert calm["mode_proportions_tv"] == pytest.approx(0.3, abs=0.06)
    assert calm["recall"] < 0.8 < calm["precision"]
    assert calm["swd_ratio"] > 2
    assert calm["mmd"] > 0.01


def test_the_off_manifold_ratio_is_relative_to_exact_draws(occluded, prior):
    rough = occluded.truth + 0.2 * np.random.default_rng(3).normal(size=occluded.truth.shape)
    problem = observed(prior, "monocular", rough)
    exact = problem.reference(5, N)
    assert prior.off_manifold(exact).mean() > 1.2
    assert measured(problem, exact)["off_manifold_ratio"] == pytest.approx(1, abs=0.05)


def test_stein_discrepancy_of_stored_theta(occluded, prior):
    exact = occluded.reference(4, 60)
    theta = np.random.default_rng(5).normal(size=(1, 60, prior.dim))
    expected = kernel_stein_discrepancy(theta[0], score_of(occluded.posterior, theta[0]))
    assert measured(occluded, exact, theta=theta)["ksd"] == pytest.approx(expected)
    # The discrepancy is undefined for a chain that rarely moves, unlike other metrics.
    theta[0, :54] = 0
    stuck = measured(occluded, exact, theta=theta)
    assert math.isnan(stuck["ksd"])
    assert math.isfinite(stuck["swd_ratio"])
    assert "ksd" not in measured(occluded, exact)


def test_image_errors_against_the_projected_truth(occluded):
    truth, posterior = occluded.truth, occluded.posterior
    far = truth.copy()
    far[:, ::2] += 10.0  # three of five joints are outside the image
    static = np.repeat(truth[:1], L, axis=0)
    right, static, far = (measured(occluded, np.stack([m] * 9)) for m in (truth, static, far))
    assert (right["pck"], right["velocity_error"]) == (100, 0)
    assert far["pck"] == pytest.approx(40)
    assert static["velocity_error"] == pytest.approx(1)
    assert far["velocity_error"] == pytest.approx(0, abs=1e-9)
    # Image errors are undefined for motions behind a camera.
    camera = Cameras.ring(1, distance=5.0, perspective=True)
    motion = Motion(truth, posterior.skeleton, posterior.fps)
    keypoints = Keypoints2D.observe(motion, camera, noise=0.05, seed=0)
    problem = Problem("close", "", MotionPosterior(posterior.prior, keypoints), truth)
    behind = measured(problem, np.stack([truth, truth + 20.0, truth - 20.0] * 3))
    assert math.isnan(behind["pck"])
    assert math.isnan(behind["velocity_error"])


@pytest.mark.parametrize(("n_joints", "frames"), [(1, 1), (5, 1), (1, 4)])
def test_the_smallest_motions(n_joints, frames):
    problem = observed(mixture(frames, n_joints, ("calm",), [1.0]), "monocular")
    result = measured(problem, problem.reference(0, 20))
    assert ("pck" in result, "velocity_error" in result) == (n_joints * frames > 1, frames > 1)
    assert math.isfinite(result["swd_ratio"] + result["g_mpjpe_mm"])


def test_samplers_share_the_exact_draws_of_a_seed(generation):
    positions = generation.reference(1, 50)
    result = measured(generation, positions, 4)
    exact = _exact_draws(generation, 4, 50)
    assert measured(generation, positions, 4) == result
    assert _exact_draws(generation, 4, 50) is exact
    assert measured(generation, positions, 5)["swd_ratio"] != result["swd_ratio"]


def test_alignment_before_comparison(generation, prior):
    rng = np.random.default_rng(0)
    aligned = replace(generation, aligned_to=prior.means[0])
    rotations, _ = np.linalg.qr(rng.normal(size=(N, 1, 3, 3)))
    rotations *= np.linalg.det(rotations)[..., None, None]
    shifts = 10 * rng.normal(size=(N, 1, 1, 3))
    right = generation.reference(100, N)
    wrong = prior.means[0] + 1.5 * (right - prior.means[0])
    result = measured(aligned, right @ rotations + shifts)
    assert result["swd_ratio"] == pytest.approx(1, abs=0.4)
    assert result["variance_ratio"] == pytest.approx(1, abs=0.2)
    assert result["c2st"] == pytest.approx(0.5, abs=0.1)
    result = measured(aligned, wrong @ rotations + shifts)
    assert result["swd_ratio"] > 2
    assert result["variance_ratio"] > 1.5
    assert measured(generation, right @ rotations + shifts)["swd_ratio"] > 5
    with pytest.raises(ValueError, match="aligned_to must have shape"):
        replace(generation, aligned_to=prior.means)


def test_only_applicable_metrics_are_returned(generation, occluded, prior):
    class Plain:
        skeleton, frames, fps, dim = prior.skeleton, L, 30.0, L * J * 3

        def motion(self, theta):
            return theta.reshape(*theta.shape[:-1], L, J, 3)

    exact = occluded.reference(0, 20)
    result = measured(occluded, exact)
    assert {"mpjpe_mm", "mpjpe_visible_mm", "mpjpe_occluded_mm", "pa_mpjpe_mm"} < set(result)
    assert result["mpjpe_occluded_mm"] > result["mpjpe_visible_mm"]
    assert (result["seconds"], result["denoiser_evaluations"]) == (1.5, 10)
    assert not any(name.endswith("_mm") for name in measured(generation, exact))
    plain = measured(Problem("plain", "", MotionPosterior(Plain()), occluded.truth), exact)
    assert "mpjpe_mm" in plain
    assert not {"swd_ratio", "off_manifold_ratio", "mode_proportion_calm"} & set(plain)


def check(errors, **expected):
    """Compare errors, named without ``_mm``, with their expected values in millimetres."""
    assert {name: errors[f"{name}_mm"] for name in expected} == pytest.approx(expected, abs=1e-9)


def test_errors_by_hand(occluded):
    truth, posterior = occluded.truth, occluded.posterior
    mask = ~posterior.likelihood.entries.visible[0]
    n_occluded = mask.sum()
    assert n_occluded == 2 * (L // 2)
    # One draw is right; in the other, joints except the root are 3 cm to the side, occluded ones
    # 6 cm; both are translated by 1 m.
    wrong = truth.copy()
    wrong[:, 1:, 0] += 0.03
    wrong[mask, 0] += 0.03
    errors = accuracy_of(np.stack([truth, wrong]) + np.array([0, 0, 1.0]), truth, posterior)
    distance = 30.0 * (L * (J - 1) + n_occluded) / (L * J)
    visible = 30.0 * (L * (J - 1) - n_occluded) / (~mask).sum()
    check(errors, mpjpe=distance / 2, mpjpe_mean=distance / 2, mpjpe_best=0)
    check(errors, mpjpe_occluded=30, mpjpe_visible=visible / 2)
    assert errors["g_mpjpe_mm"] > 1000
    assert errors["pa_mpjpe_mm"] < distance / 2
    # Two draws are 10 cm to either side, with occluded joints 40 cm lower.
    draws = truth + np.array([0.1, -0.1])[:, None, None, None] * [1.0, 0, 0]
    draws[:, mask, 1] -= 0.4
    errors = accuracy_of(draws, truth, posterior)
    below, portion = 1000 * np.hypot(0.1, 0.4), n_occluded / (L * J)
    check(errors, g_mpjpe=100 * (1 - portion) + below * portion)
    check(errors, g_mpjpe_visible=100, g_mpjpe_occluded=below)
    check(errors, g_mpjpe_mean=400 * portion)
    check(errors, g_mpjpe_mean_visible=0, g_mpjpe_mean_occluded=400)


def test_accelerations_and_joints_that_any_camera_observes(prior, occluded):
    truth, posterior = occluded.truth, MotionPosterior(prior)
    centre = truth.mean(axis=0)
    scaled = np.stack([centre + 2 * (truth - centre), centre + 0.5 * (truth - centre)])
    assert accuracy_of(scaled, truth, posterior)["acceleration_ratio"] == pytest.approx(1.25)
    errors = accuracy_of(truth[None], np.zeros_like(truth), posterior)
    assert "acceleration_error" in errors
    assert "acceleration_ratio" not in errors
    mask = np.zeros((2, L, J), dtype=bool)
    mask[0, 0, 1] = mask[1, 0, 2] = True
    motion = Motion(truth, prior.skeleton, 30.0)
    likelihood = Keypoints2D.observe(motion, Cameras.ring(2), 0.05, 0, hidden=mask)
    errors = accuracy_of(truth[None], truth, MotionPosterior(prior, likelihood))
    assert "mpjpe_occluded_mm" not in errors
