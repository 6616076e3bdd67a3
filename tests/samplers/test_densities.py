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
def posterior():
    return load_problem("gait-sparse").posterior


def density_of(posterior: MotionPosterior):
    asked = []

    def log_density(theta):
        asked.append(len(theta))
        return posterior.log_density(theta)

    return log_density, asked


def test_a_chain_starts_at_the_likeliest_of_its_own_candidates(posterior):
    log_density, asked = density_of(posterior)
    points = starting_points(posterior, log_density, None, (3, posterior.dim), 5, 40)
    assert asked == [40, 40, 40]
    for chain, point in enumerate(points):
        drawn = posterior.initial(seeds.generator(5, "initial", chain), 40)
        np.testing.assert_array_equal(point, drawn[posterior.log_density(drawn).argmax()])
    fewer = starting_points(posterior, log_density, None, (2, posterior.dim), 5, 40)
    np.testing.assert_array_equal(fewer, points[:2])


def test_walkers_start_at_the_likeliest_of_their_ensembles(posterior):
    log_density, _ = density_of(posterior)
    points = starting_points(posterior, log_density, None, (2, 7, posterior.dim), 5, 40)
    for chain, walkers in enumerate(points):
        drawn = posterior.initial(seeds.generator(5, "initial", chain), 40)
        best = np.sort(posterior.log_density(drawn))[::-1][:7]
        np.testing.assert_allclose(posterior.log_density(walkers), best, rtol=1e-12)
        assert len(np.unique(walkers, axis=0)) == 7


def test_no_more_candidates_than_needed_are_not_even_looked_at(posterior):
    log_density, asked = density_of(posterior)
    points = starting_points(posterior, log_density, None, (2, 7, posterior.dim), 5, 7)
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
    log_density, _ = density_of(posterior)
    exact = posterior.prior.exact_posterior(posterior.likelihood)
    best = exact._latent_mean.reshape(-1, posterior.dim)[exact.component_probabilities.argmax()]
    nuts = NUTS(warmup=150).sample(posterior, draws=50, chains=3, seed=1, progress=False)
    apart = np.abs(nuts.dataset["theta"].values.mean(axis=1) - best).max()
    assert apart < 0.5
    prior_draws = starting_points(posterior, log_density, None, (200, posterior.dim), 1, 1)
    chosen = starting_points(posterior, log_density, None, (20, posterior.dim), 1, 1000)
    assert np.median(posterior.log_density(chosen)) > np.quantile(
        posterior.log_density(prior_draws), 0.99
    )
