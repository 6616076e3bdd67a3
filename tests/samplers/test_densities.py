"""Tests of starting points, their number of evaluations, and checks of continued runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import softmax

from probmotion import MotionDraws, MotionPosterior, seeds
from probmotion.problems import load_problem
from probmotion.samplers import NUTS, Ensemble, MetropolisHastings
from probmotion.samplers.densities import starting_points


@pytest.fixture(scope="module")
def posterior():
    return load_problem("gait-sparse").posterior


def starts(posterior, shape, candidates):
    """Return starting points and the batch sizes of the likelihood evaluations."""
    sizes = []

    def log_likelihood(theta):
        sizes.append(len(theta))
        return posterior.log_likelihood(theta)

    return starting_points(posterior, log_likelihood, None, shape, 5, candidates), sizes


def candidates_of(posterior, chain, n):
    return posterior.initial(seeds.generator(5, "initial", chain), n)


def test_starts_are_resampled_in_proportion_to_their_likelihood(posterior):
    """Compare how often each rank of 3 candidates is chosen with its probability."""
    n = 1500
    points, sizes = starts(posterior, (n, posterior.dim), 3)
    assert sizes == [3] * n
    chosen, probability = np.zeros((2, n, 3))
    for chain, point in enumerate(points):
        drawn = candidates_of(posterior, chain, 3)
        logs = posterior.log_likelihood(drawn)
        rank = np.argsort(logs)
        probability[chain] = softmax(logs[rank])
        chosen[chain] = (drawn[rank] == point).all(axis=1)
    assert (chosen.sum(axis=1) == 1).all()
    # Each choice is a Bernoulli variable with known probability.
    deviation = np.sqrt((probability * (1 - probability)).sum(axis=0))
    assert (deviation > 3.5).all()
    assert (abs((chosen - probability).sum(axis=0)) < 4 * deviation).all()
    subset, _ = starts(posterior, (2, posterior.dim), 3)
    np.testing.assert_array_equal(subset, points[:2])


def test_walkers_start_at_distinct_candidates(posterior):
    points, sizes = starts(posterior, (2, 7, posterior.dim), 40)
    assert sizes == [40, 40]
    for chain, walkers in enumerate(points):
        drawn = candidates_of(posterior, chain, 40)
        assert len(np.unique(walkers, axis=0)) == 7
        assert all((drawn == walker).all(axis=1).any() for walker in walkers)
        assert posterior.log_likelihood(walkers).mean() > posterior.log_likelihood(drawn).mean()


def test_starts_without_a_choice_are_prior_draws(posterior):
    """With as many candidates as walkers, or without observations, no likelihood is evaluated."""
    for target, candidates in ((posterior, 7), (MotionPosterior(posterior.prior), 1000)):
        points, sizes = starts(target, (2, 7, posterior.dim), candidates)
        assert sizes == []
        np.testing.assert_array_equal(points[1], candidates_of(target, 1, 7))


def test_starts_cover_modes_in_proportion_to_their_mass(two_modes):
    """Starts at the highest density would all be in the narrow mode, of mass 0.1."""
    means = np.array([[-12.0, 0.0, 0.0], [12.0, 0.0, 0.0]])
    spread = np.stack([2.0 * np.eye(3), 0.05 * np.eye(3)])
    prior = replace(two_modes, weights=np.array([0.9, 0.1]), means=means, covariances=spread)
    points, _ = starts(MotionPosterior(prior), (400, 3), 1000)
    assert (points[:, 0] < 0).mean() == pytest.approx(0.9, abs=0.06)


@pytest.mark.parametrize(
    "sampler",
    [
        MetropolisHastings(warmup=5, thin=1, candidates=30),
        NUTS(warmup=20, candidates=30),
        Ensemble(warmup=5, thin=1, candidates=50),
    ],
    ids=lambda sampler: sampler.name,
)
def test_candidates_are_counted_and_runs_of_other_posteriors_refused(mixture_posterior, sampler):
    resampled, single = (
        kind.sample(mixture_posterior, draws=40, chains=2, progress=False)
        for kind in (sampler, replace(sampler, candidates=1))
    )
    assert resampled.counts["density"] - single.counts["density"] == 2 * sampler.candidates
    shifted = MotionDraws(resampled.dataset.assign(theta=resampled.dataset["theta"] + 1))
    with pytest.raises(ValueError, match="initial must be a run of the same posterior, got one"):
        sampler.sample(mixture_posterior, draws=5, chains=2, initial=shifted, progress=False)
