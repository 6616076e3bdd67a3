"""Gait problems: references, observations, parameters and simulated truths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from probmotion import MotionPosterior
from probmotion.comparison.results.folder_names import _NAME
from probmotion.posteriors.problem import Problem
from probmotion.problems import load_problem
from probmotion.problems.gait import GAIT_PROBLEMS

OBSERVED = ["gait-monocular", "gait-occluded", "gait-sparse", "quadruped-monocular"]


def visible(problem):
    return problem.posterior.likelihood.entries.visible


@pytest.mark.parametrize("name", GAIT_PROBLEMS)
def test_reference_draws_are_seeded(name):
    problem = load_problem(name)
    assert problem.name == name
    assert problem.has_reference
    draws = problem.reference(3, 4)
    assert draws.shape == (4, 30, 17, 3)
    np.testing.assert_array_equal(draws, problem.reference(3, 4))
    assert (draws != problem.reference(4, 4)).any()


@pytest.mark.parametrize("name", OBSERVED)
def test_truth_is_typical_and_noise_has_the_stated_scale(name):
    problem = load_problem(name)
    likelihood = problem.posterior.likelihood
    exact = problem.posterior.prior.exact_posterior(likelihood)
    at_draws = exact.log_density(problem.reference(0, 500))
    assert abs(exact.log_density(problem.truth) - at_draws.mean()) < 4 * at_draws.std()
    residual = (likelihood.keypoints - likelihood.cameras.project(problem.truth))[visible(problem)]
    assert abs((residual / likelihood.noise).var() - 1) < 4 * np.sqrt(2 / residual.size)


def test_a_leg_is_occluded_for_half_of_the_frames():
    problem = load_problem("gait-occluded")
    hidden = ~problem.posterior.likelihood.entries.visible[0]
    names = np.array(problem.posterior.skeleton.joint_names)
    assert set(names[hidden.any(axis=0)]) == {"right_hip", "right_knee", "right_ankle"}
    assert (hidden[:, hidden.any(axis=0)].sum(axis=0) == 15).all()


def test_sparse_observations_leave_many_modes_and_every_style():
    problem = load_problem("gait-sparse")
    assert problem.posterior.likelihood.entries.visible.sum() == 6
    exact = problem.posterior.prior.exact_posterior(problem.posterior.likelihood)
    weights = exact.component_probabilities
    entropy = -(weights * np.log(np.maximum(weights, 1e-300))).sum()
    assert np.exp(entropy) > 9
    assert weights.sum(axis=1).min() > 0.05
    dense = load_problem("gait-monocular")
    dense_posterior = dense.posterior.prior.exact_posterior(dense.posterior.likelihood)
    assert dense_posterior.component_probabilities.max() > 0.99


def test_non_conjugate_problems_have_no_reference():
    gait = load_problem("gait").posterior.prior

    class Plain:
        skeleton, frames, fps, dim = gait.skeleton, gait.frames, gait.fps, 1530

        def motion(self, theta):
            return theta

    problem = Problem("plain", "", MotionPosterior(Plain()))
    assert not problem.has_reference
    with pytest.raises(ValueError, match="problem plain must have reference draws"):
        problem.reference(0, 5)
    observed = load_problem("gait-monocular").posterior
    student_t = replace(observed.likelihood, degrees_of_freedom=4.0)
    assert not Problem("heavy", "", MotionPosterior(observed.prior, student_t)).has_reference
    with pytest.raises(ValueError, match=r"truth must have shape \(30, 17, 3\), got \(29, 17, 3\)"):
        Problem("bad", "", observed, np.zeros((29, 17, 3)))


def test_parameters_change_the_problem():
    problem = load_problem(
        "gait-occluded", frames=8, joints=12, noise=0.05, hidden=0.25, components=6, seed=3
    )
    prior = problem.posterior.prior
    assert (prior.frames, len(prior.styles), prior.azimuths) == (8, 3, 2)
    assert problem.posterior.likelihood.noise == 0.05
    assert visible(problem).any(axis=(0, 1)).sum() == 12
    occluded = {(~visible(load_problem("gait-occluded", frames=8, hidden=h)))[0].any(-1).sum()
            for h in (0.0, 0.25, 0.5, 1.0)}  # fmt: skip
    assert occluded == {0, 2, 4, 8}
    other = load_problem("gait-occluded", frames=8, seed=4)
    assert (other.truth != load_problem("gait-occluded", frames=8).truth).any()


def test_few_components_are_styles_without_azimuths():
    prior = load_problem("gait", frames=4, components=2).posterior.prior
    assert (len(prior.styles), prior.azimuths) == (2, 1)
    assert prior.weights.sum() == pytest.approx(1)
    full = load_problem("gait", frames=4).posterior.prior
    np.testing.assert_array_equal(prior.means, full.means[:2])
    weights = dict(zip(full.styles, full.weights, strict=True))
    assert weights == {"walk": 0.5, "run": 0.3, "march": 0.2}
    assert (full.frames, full.rank, full.azimuths) == (4, 10, 36)


def test_problem_is_cached_under_a_canonical_name():
    problem = load_problem("gait-monocular", noise=0.05, frames=4)
    assert problem.name == "gait-monocular(frames=4, noise=0.05)"
    assert _NAME.fullmatch(problem.name)
    assert load_problem(problem.name) is problem
    assert load_problem("gait-monocular", frames=4, noise=0.05, seed=0) is problem
    assert load_problem("gait-monocular(noise=0.02)") is load_problem("gait-monocular")


@pytest.mark.parametrize(
    ("name", "scale", "sentence"),
    [
        ("gait-sparse", {"hidden": 0.5}, "must be one of frames, components, .* got 'hidden'"),
        ("walk2d", {"frames": 5}, "parameters of walk2d must not be set, got 'frames'"),
        ("gait", {"frames": 1}, "frames must be an integer of at least 2, got 1"),
        ("gait", {"components": 100}, "components must be at most 3, .* or a multiple .* got 100"),
        ("gait-monocular", {"frames": 4, "joints": 18}, "joints must be at most 17, got 18"),
        ("gait-monocular", {"frames": 4, "noise": -1.0}, "noise must be a finite number above 0"),
        ("gait-monocular", {"frames": 4, "hidden": 1.5}, "hidden must be between 0 and 1, got 1.5"),
        ("gait(frames=[5])", {}, r"frames must be a number such as 30, got \[5\]"),
        ("gait(frames 5)", {}, r"parameters must be given as in .* got \(frames 5\)"),
        ("gate(frames=5)", {}, "problem must be one of gait, .* got 'gate'"),
    ],
)
def test_invalid_parameters_are_rejected(name, scale, sentence):
    with pytest.raises(ValueError, match=sentence):
        load_problem(name, **scale)


def test_noisy_joints_have_student_t_noise():
    problem = load_problem("gait-noisy3d")
    likelihood = problem.posterior.likelihood
    residual = (likelihood.joints - problem.truth).ravel() / 0.03
    assert stats.kstest(residual, stats.t(3).cdf).pvalue > 0.001
    assert stats.kstest(residual, stats.norm(0, residual.std()).cdf).pvalue < 0.001


@pytest.mark.parametrize("name", ["gait-occluded(frames=6)", "walk-vae-monocular"])
def test_simulated_problem_has_its_own_truth_and_observations(name):
    problem = load_problem(name)
    first, second = problem.simulate(1), problem.simulate(2)
    assert (first.truth != second.truth).any()
    np.testing.assert_array_equal(first.truth, second.simulate(1).truth)
    np.testing.assert_array_equal(visible(first), visible(problem))
    for simulated in (first, second):
        likelihood = simulated.posterior.likelihood
        residual = likelihood.keypoints - likelihood.cameras.project(simulated.truth)
        residual = residual[visible(simulated)] / likelihood.noise
        assert abs(residual.var() - 1) < 4 * np.sqrt(2 / residual.size)
    assert load_problem("gait", frames=6).simulate(0).posterior.likelihood is None


def test_ranks_of_simulated_truths_are_uniform():
    """Exact draws pass simulation-based calibration (Talts et al. 2018) of height and depth."""
    problem = load_problem("gait-sparse", frames=2, components=6, noise=0.2)
    ranks = []
    for k in range(200):
        simulated = problem.simulate(k)
        below = simulated.reference(k, 9)[:, 0, 3] < simulated.truth[0, 3]
        ranks.append(below[:, 1:].sum(axis=0))
    for scalar in np.transpose(ranks):
        counts = np.bincount(scalar, minlength=10)
        assert stats.chisquare(counts).pvalue > 0.001


def test_observations_of_another_truth_are_not_calibrated():
    """This is the negative control of the test above."""
    problem = load_problem("gait-monocular", frames=2, components=6)
    ranks = [
        (problem.reference(k, 9)[:, 0, 3, 2] < problem.simulate(k).truth[0, 3, 2]).sum()
        for k in range(100)
    ]
    assert stats.chisquare(np.bincount(ranks, minlength=10)).pvalue < 1e-6
