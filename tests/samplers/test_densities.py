"""Where chains start, and what that costs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from probmotion import MotionPosterior, seeds
from probmotion.problems import load_problem
from probmotion.samplers import NUTS, Ensemble, MetropolisHastings
from probmotion.samplers.densities import starting_points


@pytest.fixture
def gaussian_mixture_motion(two_bumps):
    """A wide bump of mass 0.9 and one a hundred times as dense of mass 0.1, far apart."""
    apart = np.array([[-12.0, 0.0, 0.0], [12.0, 0.0, 0.0]])
    spread = np.stack([2.0 * np.eye(3), 0.05 * np.eye(3)])
    return MotionPosterior(
        replace(two_bumps, weights=np.array([0.9, 0.1]), means=apart, covariances=spread)
    )


@pytest.fixture
def posterior():
    return load_problem("gait-sparse").posterior


def likelihood_of(posterior: MotionPosterior):
    asked = []

    def log_likelihood(theta):
        asked.append(len(theta))
        return posterior.log_likelihood(theta)

    return log_likelihood, asked


def test_chains_start_at_candidates_in_proportion_to_their_likelihood(posterior):
    """3000 chains of 3 candidates each: how often the likeliest, and the least likely, is taken."""
    log_likelihood, asked = likelihood_of(posterior)
    points = starting_points(posterior, log_likelihood, None, (3000, posterior.dim), 5, 3)
    assert asked == [3] * 3000
    taken, shares = np.zeros((2, 3000, 3))
    for chain, point in enumerate(points):
        drawn = posterior.initial(seeds.generator(5, "initial", chain), 3)
        logs = posterior.log_likelihood(drawn)
        rank = np.argsort(logs)
        weight = np.exp(logs[rank] - logs.max())
        shares[chain] = weight / weight.sum()
        taken[chain] = (drawn[rank] == point).all(axis=1)
    assert (taken.sum(axis=1) == 1).all()
    # Each chain's choice is a Bernoulli draw with its own known probability.
    deviation = np.sqrt((shares * (1 - shares)).sum(axis=0))
    assert (deviation > 5).all()
    assert (abs((taken - shares).sum(axis=0)) < 4 * deviation).all()
    fewer = starting_points(posterior, log_likelihood, None, (2, posterior.dim), 5, 3)
    np.testing.assert_array_equal(fewer, points[:2])


def test_walkers_start_at_different_candidates(posterior):
    log_likelihood, asked = likelihood_of(posterior)
    points = starting_points(posterior, log_likelihood, None, (2, 7, posterior.dim), 5, 40)
    assert asked == [40, 40]
    for chain, walkers in enumerate(points):
        drawn = posterior.initial(seeds.generator(5, "initial", chain), 40)
        assert len(np.unique(walkers, axis=0)) == 7
        assert all((drawn == walker).all(axis=1).any() for walker in walkers)
        # Better than their candidates on the whole.
        assert posterior.log_likelihood(walkers).mean() > posterior.log_likelihood(drawn).mean()


@pytest.mark.parametrize("evidence", [True, False])
def test_no_candidate_is_looked_at_in_vain(posterior, evidence):
    """Where there are no more than needed, or no evidence to choose by, starts are prior draws."""
    if not evidence:
        posterior = MotionPosterior(posterior.prior)
    log_likelihood, asked = likelihood_of(posterior)
    candidates = 7 if evidence else 1000
    points = starting_points(posterior, log_likelihood, None, (2, 7, posterior.dim), 5, candidates)
    assert asked == []
    drawn = posterior.initial(seeds.generator(5, "initial", 1), 7)
    np.testing.assert_array_equal(points[1], drawn)


@pytest.mark.parametrize(
    "sampler",
    [
        MetropolisHastings(warmup=5, thin=1, candidates=30),
        NUTS(warmup=5, candidates=30),
        Ensemble(warmup=5, thin=1, candidates=50),
    ],
)
def test_candidates_are_counted(posterior, sampler):
    without = replace(sampler, candidates=1)
    many, few = (
        s.sample(posterior, draws=40, chains=2, progress=False) for s in (sampler, without)
    )
    assert many.counts["density"] - few.counts["density"] == 2 * sampler.candidates


def test_chains_find_the_mode_that_holds_the_mass():
    """After dense evidence in one view a wrong mode is 200 nats down, and no chain leaves one."""
    posterior = load_problem("gait-monocular").posterior
    exact = posterior.prior.exact_posterior(posterior.likelihood)
    best = exact._latent_mean.reshape(-1, posterior.dim)[exact.component_probabilities.argmax()]
    nuts = NUTS(warmup=150).sample(posterior, draws=50, chains=3, seed=1, progress=False)
    assert np.abs(nuts.dataset["theta"].values.mean(axis=1) - best).max() < 0.5


@pytest.mark.parametrize(
    "sampler",
    [MetropolisHastings(warmup=300, thin=2), NUTS(warmup=100), Ensemble(warmup=200, thin=2)],
)
def test_a_narrow_mode_of_little_mass_does_not_take_all_chains(gaussian_mixture_motion, sampler):
    """Starts chosen by density alone would all fall into it, and R-hat would see nothing."""
    posterior = gaussian_mixture_motion
    draws = sampler.sample(posterior, draws=200, chains=8, seed=0, progress=False)
    wide = draws.dataset["theta"].values[..., 0] < 0
    assert wide.mean() > 0.6


@pytest.mark.parametrize(
    "sampler", [MetropolisHastings(warmup=5), NUTS(warmup=5), Ensemble(warmup=5, thin=1)]
)
def test_a_run_does_not_go_on_with_another_posterior(posterior, sampler):
    run = sampler.sample(posterior, draws=5, seed=0, progress=False)
    other = load_problem("gait").posterior
    with pytest.raises(ValueError, match="initial is a run of another posterior: its last log"):
        sampler.sample(other, draws=5, seed=0, initial=run, progress=False)
