"""The registered problems are what their names say."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion import MotionPosterior
from probmotion.posteriors.problem import Problem
from probmotion.problems import load_problem
from probmotion.problems.gait import GAIT_PROBLEMS

WITH_EVIDENCE = ["gait-monocular", "gait-occluded", "gait-sparse", "quadruped-monocular"]


@pytest.mark.parametrize("name", GAIT_PROBLEMS)
def test_reference_draws_are_the_posteriors_and_seeded(name):
    problem = load_problem(name)
    assert problem.name == name
    assert load_problem(name) is problem
    assert problem.has_reference
    draws = problem.reference(3, 4)
    assert draws.shape == (4, 30, 17, 3)
    np.testing.assert_array_equal(draws, problem.reference(3, 4))
    assert (draws != problem.reference(4, 4)).any()


def test_an_unknown_problem_is_told_the_known_ones():
    with pytest.raises(ValueError, match="problem must be one of gait, gait-mono, got 'gate'"):
        load_problem("gate")


def test_the_gait_prior_is_the_designs():
    prior = load_problem("gait").posterior.prior
    assert (prior.frames, prior.rank, prior.azimuths) == (30, 10, 36)
    weights = dict(zip(prior.styles, prior.weights, strict=True))
    assert weights == {"walk": 0.5, "run": 0.3, "march": 0.2}
    assert load_problem("gait").truth is None
    assert load_problem("gait-monocular").posterior.prior is prior


@pytest.mark.parametrize("name", WITH_EVIDENCE)
def test_the_truth_is_a_typical_draw_of_its_posterior(name):
    problem = load_problem(name)
    exact = problem.posterior.prior.exact_posterior(problem.posterior.likelihood)
    at_draws = exact.log_density(problem.reference(0, 500))
    assert abs(exact.log_density(problem.truth) - at_draws.mean()) < 4 * at_draws.std()


@pytest.mark.parametrize("name", WITH_EVIDENCE)
def test_the_keypoints_are_of_the_truth_with_the_stated_noise(name):
    problem = load_problem(name)
    evidence = problem.posterior.likelihood
    residual = evidence.keypoints - evidence.cameras.project(problem.truth)
    seen = residual[evidence.entries.visible] / evidence.noise
    assert abs(seen.var() - 1) < 4 * np.sqrt(2 / seen.size)


def test_the_occluded_limb_is_a_leg_for_half_of_the_frames():
    problem = load_problem("gait-occluded")
    hidden = ~problem.posterior.likelihood.entries.visible[0]
    names = np.array(problem.posterior.skeleton.joint_names)
    assert set(names[hidden.any(axis=0)]) == {"right_hip", "right_knee", "right_ankle"}
    assert (hidden[:, hidden.any(axis=0)].sum(axis=0) == 15).all()


def test_sparse_evidence_leaves_many_modes_and_every_style():
    problem = load_problem("gait-sparse")
    assert problem.posterior.likelihood.entries.visible.sum() == 6
    exact = problem.posterior.prior.exact_posterior(problem.posterior.likelihood)
    weights = exact.component_probabilities
    entropy = -(weights * np.log(np.maximum(weights, 1e-300))).sum()
    assert np.exp(entropy) > 9
    assert weights.sum(axis=1).min() > 0.05
    dense = load_problem("gait-monocular")
    one = dense.posterior.prior.exact_posterior(dense.posterior.likelihood)
    assert one.component_probabilities.max() > 0.99


def test_a_truth_of_another_shape_is_refused():
    posterior = load_problem("gait").posterior
    with pytest.raises(ValueError, match=r"truth must have shape \(30, 17, 3\), got \(29, 17, 3\)"):
        Problem("bad", "", posterior, np.zeros((29, 17, 3)))


def test_a_prior_without_closed_form_has_no_reference():
    gait = load_problem("gait").posterior.prior

    class Plain:
        skeleton, frames, fps, dim = gait.skeleton, gait.frames, gait.fps, 1530

        def motion(self, theta):
            return theta

    problem = Problem("plain", "", MotionPosterior(Plain()))
    assert not problem.has_reference
    with pytest.raises(ValueError, match="problem plain has no reference: Plain has no exact"):
        problem.reference(0, 5)


def test_student_t_noise_has_no_reference():
    from dataclasses import replace

    problem = load_problem("gait-monocular")
    evidence = replace(problem.posterior.likelihood, degrees_of_freedom=4.0)
    heavy = Problem("heavy", "", MotionPosterior(problem.posterior.prior, evidence))
    assert not heavy.has_reference
