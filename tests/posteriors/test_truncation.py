"""Truncated density: eq. 11, skipped likelihood evaluations and statistics of runs."""

from __future__ import annotations

import math

import numpy as np
import pytest

from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.truncation import TruncatedPosterior, limit_for_dimension
from probmotion.samplers import MetropolisHastings
from probmotion.samplers.mcmc.proposals import Isotropic


class Line:
    """log f = −θ₀²/2 relative to a base measure of log density −|θ₁|."""

    skeleton, frames, fps, dim = Skeleton(["point"], [-1]), 1, 30.0, 2

    def motion(self, theta):
        return np.concatenate([theta, theta[..., :1]], axis=-1)[..., None, None, :]

    def log_measure(self, theta):
        return np.where(np.abs(theta[..., 1]) < 9, -np.abs(theta[..., 1]), -np.inf)

    def log_density(self, theta):
        return self.log_measure(theta) - 0.5 * theta[..., 0] ** 2

    def initial(self, rng, n):
        return rng.standard_normal((n, 2))


class Slope:
    """log L = min(0, x − 4) ≤ 0, recording where it is evaluated."""

    log_bound = 0.0

    def __init__(self):
        self.calls = []

    def log_density(self, positions):
        self.calls.extend(np.ravel(positions[..., 0, 0, 0]).tolist())
        return np.minimum(0.0, positions[..., 0, 0, 0] - 4)

    def simulate(self, rng, positions):
        return self


THETA = np.array([[0.0, 0.5], [1.0, 2.0], [4.0, 0.0], [-1.0, 1.0], [2.0, -3.0], [0.5, 10.0]])


def test_the_density_follows_eq_11():
    posterior = TruncatedPosterior(Line(), Slope(), seed=np.array([1.0, 0.3]), limit=math.e)
    seed = -0.5 - 3.0
    level = -0.5 * THETA[:, 0] ** 2 + np.minimum(0, THETA[:, 0] - 4)
    expected = np.where(level < seed - 1, -np.inf, np.minimum(level, seed + 1))
    assert posterior.log_seed == pytest.approx(seed)
    log_density = posterior.log_density(THETA)
    assert np.allclose(log_density, expected + Line().log_measure(THETA))
    assert np.isneginf(log_density).tolist() == [False, False, True, True, False, True]
    assert log_density[4] == pytest.approx(seed + 0 - 3 - 0.5)  # level −4, below the cap


def test_an_infinite_limit_does_not_truncate():
    untruncated = TruncatedPosterior(Line(), Slope())
    expected = Line().log_density(THETA) + np.minimum(0, THETA[:, 0] - 4)
    assert np.allclose(untruncated.log_density(THETA), expected)
    assert all(not flags.any() for flags in untruncated.draw_statistics(THETA, expected).values())


def test_the_likelihood_is_only_evaluated_where_needed():
    likelihood = Slope()
    posterior = TruncatedPosterior(Line(), likelihood, limit=math.e)
    likelihood.calls.clear()
    # The floor is at −5: priors below it are skipped, as are points outside the support.
    posterior.log_density(np.array([[3.0, 0.0], [3.3, 0.0], [-3.1, 0.0], [1.0, 10.0]]))
    assert likelihood.calls == [3.0, -3.1]


def test_densities_and_flags_at_the_cap_and_the_floor():
    posterior = TruncatedPosterior(Line(), seed=np.array([3.0, 0.0]), limit=math.exp(2))
    theta = np.array([[0.0, 1.0], [2.0, 0.0], [np.sqrt(2 * 5.7), 0.0], [np.sqrt(2 * 5.4), 0.0]])
    log_density = posterior.log_density(theta)
    np.testing.assert_allclose(log_density, [-2.5 - 1, -2.5, -5.7, -5.4])
    flags = posterior.draw_statistics(theta, log_density)
    assert flags["at_cap"].tolist() == [1, 1, 0, 0]
    assert flags["near_floor"].tolist() == [0, 0, 1, 0]


def test_runs_store_the_flags():
    posterior = TruncatedPosterior(Line(), limit=2.0)
    sampler = MetropolisHastings(Isotropic(1.0, None), warmup=0, thin=1)
    start = np.zeros((1, 2))
    draws = sampler.sample(posterior, draws=300, initial=start, progress=False)
    level = draws.dataset["log_density"] + np.abs(draws.dataset["theta"][..., 1])
    assert np.array_equal(draws.dataset["near_floor"], (level < -np.log(2) + 1).astype(int))
    assert not draws.dataset["at_cap"].any()


def test_the_limit_for_a_dimension_keeps_the_typical_set():
    dim = 108
    rng = np.random.default_rng(0)
    below = 0.5 * (rng.standard_normal((20_000, dim)) ** 2).sum(axis=1)
    lost = (below > math.log(limit_for_dimension(dim))).mean()
    assert 1e-4 < lost < 1e-2
    assert (below > math.log(100)).mean() > 0.999


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"limit": 1.0}, "limit must be above 1, got 1"),
        ({"seed": np.array([0.0, 10.0])}, "seed must have positive density, got log density -inf"),
        ({"seed": np.zeros(3)}, "seed must have shape"),
    ],
)
def test_invalid_arguments(settings, message):
    with pytest.raises(ValueError, match=message):
        TruncatedPosterior(Line(), **settings)
