"""Problems with other numbers, and with other truths drawn from the prior."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from scipy import stats

from probmotion.comparison.results.fingerprint import fingerprint
from probmotion.comparison.results.naming import _NAME
from probmotion.problems import load_problem, problem_names


def seen(problem):
    return problem.posterior.likelihood.entries.visible


def test_numbers_change_what_they_name():
    problem = load_problem(
        "gait-occluded", frames=8, joints=12, noise=0.05, hidden=0.25, components=6, seed=3
    )
    prior = problem.posterior.prior
    assert (prior.frames, len(prior.styles), prior.azimuths) == (8, 3, 2)
    assert problem.posterior.likelihood.noise == 0.05
    assert seen(problem).any(axis=(0, 1)).sum() == 12
    limb = {(~seen(load_problem("gait-occluded", frames=8, hidden=h)))[0].any(-1).sum()
            for h in (0.0, 0.25, 0.5, 1.0)}  # fmt: skip
    assert limb == {0, 2, 4, 8}
    other = load_problem("gait-occluded", frames=8, seed=4)
    assert (other.truth != load_problem("gait-occluded", frames=8).truth).any()


def test_few_components_are_styles_that_are_not_turned():
    prior = load_problem("gait", frames=4, components=2).posterior.prior
    assert (len(prior.styles), prior.azimuths) == (2, 1)
    assert prior.weights.sum() == pytest.approx(1)
    # The rest of the mixture is the whole one's: two of its components.
    whole = load_problem("gait", frames=4).posterior.prior
    np.testing.assert_array_equal(prior.means, whole.means[:2])


def test_a_problem_has_one_name_and_is_made_once():
    problem = load_problem("gait-monocular", noise=0.05, frames=4)
    assert problem.name == "gait-monocular(frames=4, noise=0.05)"
    assert _NAME.fullmatch(problem.name)
    assert load_problem(problem.name) is problem
    assert load_problem("gait-monocular", frames=4, noise=0.05, seed=0) is problem
    assert load_problem("gait-monocular(noise=0.02)") is load_problem("gait-monocular")


def test_a_worker_gets_an_equal_problem():
    problem = load_problem("gait-monocular", frames=4)
    assert fingerprint(pickle.loads(pickle.dumps(problem))) == fingerprint(problem)


@pytest.mark.parametrize(
    ("name", "scale", "sentence"),
    [
        ("gait-sparse", {"hidden": 0.5}, "knows no 'hidden', expected one of frames, components"),
        ("walk2d", {"frames": 5}, "walk2d knows no 'frames', expected no numbers"),
        ("gait", {"frames": 1}, "frames must be an integer of at least 2, got 1"),
        ("gait", {"components": 100}, "components must be a multiple of the 3 styles, got 100"),
        ("gait-monocular", {"frames": 4, "joints": 18}, "joints must be at most the 17, got 18"),
        ("gait-monocular", {"frames": 4, "noise": -1.0}, "noise is -1.0, expected"),
        ("gait-monocular", {"frames": 4, "hidden": 1.5}, "hidden must be a share, got 1.5"),
        ("gait(frames=[5])", {}, r"frames must be a number such as, got \[5\]"),
        ("gait(frames 5)", {}, "is 'gait.frames 5.', expected numbers such as"),
        ("gate(frames=5)", {}, "problem must be one of gait, got 'gate'"),
    ],
)
def test_what_makes_no_problem_is_told_in_one_sentence(name, scale, sentence):
    with pytest.raises(ValueError, match=sentence):
        load_problem(name, **scale)


def test_the_noisy_joints_have_outliers():
    problem = load_problem("gait-noisy3d")
    assert "gait-noisy3d" in problem_names()
    evidence = problem.posterior.likelihood
    residual = (evidence.joints - problem.truth).ravel() / 0.03
    assert stats.kstest(residual, stats.t(3).cdf).pvalue > 0.001
    assert stats.kstest(residual, stats.norm(0, residual.std()).cdf).pvalue < 0.001


def test_another_truth_has_evidence_of_its_own():
    problem = load_problem("gait-occluded", frames=6)
    first, second = problem.simulate(1), problem.simulate(2)
    assert (first.truth != second.truth).any()
    np.testing.assert_array_equal(first.truth, problem.simulate(1).truth)
    np.testing.assert_array_equal(first.truth, second.simulate(1).truth)
    np.testing.assert_array_equal(seen(first), seen(problem))
    for again in (first, second):
        evidence = again.posterior.likelihood
        residual = (evidence.keypoints - evidence.cameras.project(again.truth))[seen(again)]
        assert abs((residual / evidence.noise).var() - 1) < 4 * np.sqrt(2 / residual.size)
    assert load_problem("gait", frames=6).simulate(0).posterior.likelihood is None


def test_ranks_of_simulated_truths_are_uniform():
    """Simulation-based calibration (Talts et al. 2018) of exact draws, on a height and a depth."""
    problem = load_problem("gait-sparse", frames=2, components=6, noise=0.2)
    ranks = []
    for k in range(200):
        again = problem.simulate(k)
        draws = again.reference(k, 9)
        ranks.append([(draws[:, 0, 3, axis] < again.truth[0, 3, axis]).sum() for axis in (1, 2)])
    for scalar in np.transpose(ranks):
        counts = np.bincount(scalar, minlength=10)
        assert stats.chisquare(counts).pvalue > 0.001


def test_evidence_of_another_truth_is_not_calibrated():
    """The test above can fail: draws given one truth's evidence do not cover another's."""
    problem = load_problem("gait-monocular", frames=2, components=6)
    ranks = [
        (problem.reference(k, 9)[:, 0, 3, 2] < problem.simulate(k).truth[0, 3, 2]).sum()
        for k in range(100)
    ]
    assert stats.chisquare(np.bincount(ranks, minlength=10)).pvalue < 1e-6


def test_the_learnt_prior_simulates_too():
    problem = load_problem("walk-vae-monocular")
    again = problem.simulate(1)
    assert again.truth.shape == problem.truth.shape
    assert (again.truth != problem.truth).any()
    evidence = again.posterior.likelihood
    residual = evidence.keypoints - evidence.cameras.project(again.truth)
    assert abs(residual.std() / evidence.noise - 1) < 0.1
