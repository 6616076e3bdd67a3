"""The measures of one run together: which apply, and what perfect and broken draws get."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest

from probmotion import Cameras, Keypoints2D, Motion, MotionDraws, MotionPosterior, Skeleton
from probmotion.metrics.measures import _exact_draws, accuracy_of, measure
from probmotion.metrics.stein import kernel_stein_discrepancy, score_of
from probmotion.models import GaussianMixtureMotion
from probmotion.posteriors.problem import Problem
from probmotion.problems.observations import observe

K, R, L, J, A = 2, 2, 4, 5, 6
N = 400


@dataclass(frozen=True)
class Named:
    name: ClassVar[str] = "named"


@pytest.fixture(scope="module")
def prior():
    rng = np.random.default_rng(0)
    return GaussianMixtureMotion(
        skeleton=Skeleton(["root", "a", "b", "c", "d"], [-1, 0, 1, 0, 3]),
        fps=30.0,
        means=rng.normal(size=(K, L, J, 3)),
        factors=0.4 * rng.normal(size=(K, R, L, J, 3)),
        weights=np.array([0.7, 0.3]),
        noise=0.05,
        azimuths=A,
        styles=("calm", "wild"),
    )


@pytest.fixture(scope="module")
def generation(prior):
    return Problem("generation", "no evidence", MotionPosterior(prior))


@pytest.fixture(scope="module")
def occluded(prior):
    truth = Motion(prior.sample(np.random.default_rng(1), 1)[0], prior.skeleton, 30.0)
    evidence = observe(truth, "occluded", 0.05, 0)
    return Problem("occluded", "a limb hidden", MotionPosterior(prior, evidence), truth.positions)


def run(problem, positions, **more):
    return MotionDraws.of(
        problem.posterior,
        Named(),
        positions[None],
        seed=0,
        seconds=1.5,
        counts={"denoiser": 10},
        independent=True,
        **more,
    )


def test_exact_draws_are_found_right(generation):
    found = [
        measure(generation, run(generation, generation.reference(100 + i, N)), seed=i)
        for i in range(10)
    ]
    for name, right in {
        "swd_ratio": 1,
        "variance_ratio": 1,
        "off_manifold_ratio": 1,
        "log_density_gap": 0,
        "mode_proportion_calm": 0.7,
        "mode_proportion_wild": 0.3,
        "c2st": 0.5,
        "mmd": 0,
    }.items():
        values = np.array([each[name] for each in found])
        spread = values.std(ddof=1) / math.sqrt(len(values))
        # Student's t with 9 degrees of freedom exceeds 4.8 once in a thousand.
        assert abs(values.mean() - right) < 4.8 * spread, name
        assert spread < 0.35, name
    assert np.mean([each["mean_error_sd"] for each in found]) < 2 / math.sqrt(N)


def test_off_is_judged_by_exact_draws_where_evidence_moves_it(occluded, prior):
    rough = occluded.truth + 0.2 * np.random.default_rng(3).normal(size=occluded.truth.shape)
    evidence = observe(Motion(rough, prior.skeleton, 30.0), "monocular", 0.02, 0)
    problem = Problem("rough", "evidence off the manifold", MotionPosterior(prior, evidence))
    exact = problem.reference(5, N)
    assert prior.off_manifold(exact).mean() > 2
    assert measure(problem, run(problem, exact), 0)["off_manifold_ratio"] == pytest.approx(
        1, abs=0.03
    )


def test_errors_are_found(generation, prior):
    exact = generation.reference(7, N)
    narrow = exact.mean(axis=0) + 0.5 * (exact - exact.mean(axis=0))
    rough = exact + 0.1 * np.random.default_rng(2).normal(size=exact.shape)
    calm = exact[prior.style_responsibilities(exact)[:, 0] > 0.5]
    calm = np.concatenate([calm, calm])[:N]
    found = {
        name: measure(generation, run(generation, positions), seed=3)
        for name, positions in {"narrow": narrow, "rough": rough, "calm": calm}.items()
    }
    assert found["narrow"]["variance_ratio"] == pytest.approx(0.25, rel=0.1)
    # Noise of twice δ on top: variance five times as large, off the subspaces as everywhere.
    assert found["rough"]["off_manifold_ratio"] == pytest.approx(5, rel=0.1)
    assert found["rough"]["log_density_gap"] < -50
    assert found["calm"]["mode_proportion_calm"] == pytest.approx(1, abs=1e-6)
    assert found["calm"]["mode_proportions_tv"] == pytest.approx(0.3, abs=0.06)
    assert found["calm"]["recall"] < 0.8 < found["calm"]["precision"]
    assert found["calm"]["swd_ratio"] > 2
    for wrong in found.values():
        assert wrong["mmd"] > 0
    assert found["rough"]["c2st"] > 0.7


def test_draws_are_judged_by_the_density_where_they_keep_theta(occluded, prior):
    exact = occluded.reference(4, N)
    theta = np.random.default_rng(5).normal(size=(1, N, prior.dim))
    found = measure(occluded, run(occluded, exact, theta=theta), 0)["ksd"]
    score = score_of(occluded.posterior, theta[0])
    assert found == pytest.approx(kernel_stein_discrepancy(theta[0], score))
    assert math.isnan(measure(occluded, run(occluded, exact, theta=0 * theta), 0)["ksd"])
    # A chain that moved once in a while is judged by all else.
    theta[0, : 9 * N // 10] = 0
    found = measure(occluded, run(occluded, exact, theta=theta), 0)
    assert math.isnan(found["ksd"])
    assert math.isfinite(found["swd_ratio"])
    assert "ksd" not in measure(occluded, run(occluded, exact), 0)


def test_draws_are_compared_with_the_truth_in_the_pictures_that_were_seen(occluded):
    truth = occluded.truth
    root = np.repeat(truth[:1], len(truth), axis=0)
    far = truth.copy()
    far[:, ::2] += 10.0  # every other joint, further than any picture is wide
    n_far = len(range(0, truth.shape[1], 2)) / truth.shape[1]
    draws = {"right": truth, "still": root, "far": far}
    found = {
        name: measure(occluded, run(occluded, np.stack([motion] * 9)), 0)
        for name, motion in draws.items()
    }
    assert (found["right"]["pck"], found["right"]["velocity_error"]) == (100, 0)
    assert found["far"]["pck"] == pytest.approx(100 * (1 - n_far))
    # What stands still misses all of every displacement.
    assert found["still"]["velocity_error"] == pytest.approx(1)
    assert found["far"]["velocity_error"] == pytest.approx(0, abs=1e-9)


def test_behind_a_camera_there_is_no_picture(occluded):
    truth = occluded.truth
    camera = Cameras.ring(1, distance=5.0, perspective=True)
    motion = Motion(truth, occluded.posterior.skeleton, occluded.posterior.fps)
    seen = Keypoints2D.observe(motion, camera, noise=0.05, seed=0)
    problem = Problem("near", "near", MotionPosterior(occluded.posterior.prior, seen), truth)
    behind = np.stack([truth, truth + 20.0, truth - 20.0] * 3)
    found = measure(problem, run(problem, behind), 0)
    assert math.isnan(found["pck"])
    assert math.isnan(found["velocity_error"])
    assert found["g_mpjpe_mm"] > 1000


@pytest.mark.parametrize(("n_joints", "frames"), [(1, 1), (5, 1), (1, 4)])
def test_the_smallest_motions_are_measured_by_what_they_have(n_joints, frames):
    rng = np.random.default_rng(2)
    prior = GaussianMixtureMotion(
        skeleton=Skeleton([*"abcde"][:n_joints], range(-1, n_joints - 1)),
        fps=30.0,
        means=rng.normal(size=(1, frames, n_joints, 3)),
        factors=rng.normal(size=(1, 2, frames, n_joints, 3)),
        weights=np.ones(1),
        noise=0.1,
        azimuths=A,
        styles=("calm",),
    )
    truth = Motion(prior.sample(rng, 1)[0], prior.skeleton, 30.0)
    posterior = MotionPosterior(prior, observe(truth, "monocular", 0.05, 0))
    problem = Problem("small", "small", posterior, truth.positions)
    found = measure(problem, run(problem, problem.reference(0, 20)), 0)
    assert ("pck" in found) == (n_joints * frames > 1)
    assert ("velocity_error" in found) == (frames > 1)
    assert math.isfinite(found["swd_ratio"] + found["g_mpjpe_mm"])


def test_samplers_of_one_seed_share_their_exact_draws(generation):
    assert _exact_draws(generation, 4, 50) is _exact_draws(generation, 4, 50)
    draws = run(generation, generation.reference(1, 50))
    assert measure(generation, draws, 4) == measure(generation, draws, 4)
    assert measure(generation, draws, 4)["swd_ratio"] != measure(generation, draws, 5)["swd_ratio"]


def test_where_motions_stand_does_not_count_where_the_problem_says_so(generation, prior):
    """Right motions, each put anywhere, are right; of wrong ones the place hides nothing."""
    rng = np.random.default_rng(0)
    anywhere = replace(generation, aligned_to=prior.means[0])
    right = generation.reference(100, N)
    wrong = prior.means[0] + 1.5 * (right - prior.means[0])
    found = {}
    for name, motions in (("right", right), ("wrong", wrong)):
        turns, _ = np.linalg.qr(rng.normal(size=(N, 1, 3, 3)))
        turns *= np.linalg.det(turns)[..., None, None]
        placed = motions @ turns + 10 * rng.normal(size=(N, 1, 1, 3))
        for problem in (generation, anywhere):
            found[name, problem] = measure(problem, run(problem, placed), seed=0)
    assert found["right", generation]["swd_ratio"] > 5
    assert found["right", generation]["c2st"] > 0.7
    assert found["right", anywhere]["swd_ratio"] == pytest.approx(1, abs=0.4)
    assert found["right", anywhere]["variance_ratio"] == pytest.approx(1, abs=0.2)
    assert found["right", anywhere]["c2st"] == pytest.approx(0.5, abs=0.1)
    assert found["wrong", anywhere]["swd_ratio"] > 2
    assert found["wrong", anywhere]["variance_ratio"] > 1.5
    with pytest.raises(ValueError, match="aligned_to has shape"):
        replace(generation, aligned_to=prior.means)


def test_generation_has_no_truth_and_evidence_has_one(generation, occluded):
    without = measure(generation, run(generation, generation.reference(0, 20)), 0)
    within = measure(occluded, run(occluded, occluded.reference(0, 20)), 0)
    assert not any(name.endswith("_mm") for name in without)
    assert {"mpjpe_mm", "mpjpe_visible_mm", "mpjpe_occluded_mm", "pa_mpjpe_mm"} < set(within)
    assert within["mpjpe_occluded_mm"] > within["mpjpe_visible_mm"]
    assert within["seconds"] == 1.5
    assert within["denoiser_evaluations"] == 10


def test_a_prior_without_closed_form_has_no_distances(occluded):
    class Plain:
        """What any prior must have and no more."""

        def __init__(self, prior):
            self.skeleton, self.frames, self.fps = prior.skeleton, prior.frames, prior.fps
            self.dim = L * J * 3

        def motion(self, theta):
            return theta.reshape(*theta.shape[:-1], L, J, 3)

    prior = occluded.posterior.prior
    plain = Problem("plain", "", MotionPosterior(Plain(prior)), occluded.truth)
    found = measure(plain, run(plain, occluded.reference(0, 20)), 0)
    assert "mpjpe_mm" in found
    assert not {"swd_ratio", "off_manifold_ratio", "mode_proportion_calm", "log_density_gap"} & set(
        found
    )


def test_accuracy_by_hand(occluded):
    truth, posterior = occluded.truth, occluded.posterior
    hidden = ~posterior.likelihood.entries.visible[0]
    assert hidden.sum() == 2 * (L // 2)
    # One draw is right; the other has every joint but the root 3 cm too far to the side, and
    # where hidden 6 cm; all is moved by 1 m, which root alignment forgets.
    wrong = truth.copy()
    wrong[:, 1:, 0] += 0.03
    wrong[hidden, 0] += 0.03
    found = accuracy_of(np.stack([truth, wrong]) + np.array([0, 0, 1.0]), truth, posterior)
    away = 30.0 * (L * (J - 1) + hidden.sum()) / (L * J)
    assert found["mpjpe_mm"] == pytest.approx(away / 2)
    assert found["mpjpe_mean_mm"] == pytest.approx(away / 2)
    assert found["mpjpe_best_mm"] == pytest.approx(0, abs=1e-9)
    assert found["mpjpe_occluded_mm"] == pytest.approx(30)
    visible = 30.0 * (L * (J - 1) - hidden.sum()) / (~hidden).sum()
    assert found["mpjpe_visible_mm"] == pytest.approx(visible / 2)
    assert found["g_mpjpe_mm"] > 1000
    assert found["pa_mpjpe_mm"] < away / 2


def test_global_errors_and_acceleration_by_hand(occluded):
    truth, posterior = occluded.truth, occluded.posterior
    hidden = ~posterior.likelihood.entries.visible[0]
    # Two draws: one 10 cm off to the side, the other 10 cm off to the other; where hidden both
    # are 40 cm further down.
    draws = np.stack([truth, truth])
    draws[0, ..., 0] += 0.1
    draws[1, ..., 0] -= 0.1
    draws[:, hidden, 1] -= 0.4
    found = accuracy_of(draws, truth, posterior)
    n_hidden = hidden.sum()
    below = 1000 * np.hypot(0.1, 0.4)
    assert found["g_mpjpe_visible_mm"] == pytest.approx(100)
    assert found["g_mpjpe_occluded_mm"] == pytest.approx(below)
    total = (100 * (L * J - n_hidden) + below * n_hidden) / (L * J)
    assert found["g_mpjpe_mm"] == pytest.approx(total)
    assert found["g_mpjpe_mean_visible_mm"] == pytest.approx(0, abs=1e-9)
    assert found["g_mpjpe_mean_occluded_mm"] == pytest.approx(400)
    assert found["g_mpjpe_mean_mm"] == pytest.approx(400 * n_hidden / (L * J))
    # Twice the truth's accelerations and half of them: 1.25 on average.
    middle = truth.mean(axis=0)
    scaled = np.stack([middle + 2 * (truth - middle), middle + 0.5 * (truth - middle)])
    assert accuracy_of(scaled, truth, posterior)["acceleration_ratio"] == pytest.approx(1.25)


def test_what_does_not_apply_is_left_out(prior, occluded):
    truth = occluded.truth
    everything = MotionPosterior(prior)
    found = accuracy_of(truth[None], truth, everything)
    assert {"g_mpjpe_mm", "g_mpjpe_mean_mm", "acceleration_ratio"} < set(found)
    assert not any(name.endswith(("_hidden_mm", "_visible_mm")) for name in found)
    still = np.zeros_like(truth)
    assert "acceleration_ratio" not in accuracy_of(truth[None], still, everything)
    assert "acceleration_error" in accuracy_of(truth[None], still, everything)


def test_a_joint_counts_as_visible_if_any_camera_sees_it(prior, occluded):
    from probmotion import Cameras

    truth = Motion(occluded.truth, prior.skeleton, 30.0)
    hidden = np.zeros((2, L, J), dtype=bool)
    hidden[0, 0, 1] = hidden[1, 0, 2] = True
    evidence = Keypoints2D.observe(truth, Cameras.ring(2), 0.05, 0, hidden=hidden)
    found = accuracy_of(occluded.truth[None], occluded.truth, MotionPosterior(prior, evidence))
    assert "mpjpe_occluded_mm" not in found
