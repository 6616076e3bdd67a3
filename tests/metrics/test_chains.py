"""Chain diagnostics on chains whose mixing is known."""

from __future__ import annotations

import math
import tracemalloc
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest

from probmotion import MotionDraws, Skeleton, seeds
from probmotion.metrics.chains import chain_diagnostics, rhat_of_independent, watched_coordinates
from probmotion.metrics.cost import costs

CHAINS, DRAWS = 4, 500


@dataclass(frozen=True)
class Named:
    name: ClassVar[str] = "named"


class Posterior:
    skeleton = Skeleton(["a"], [-1])
    frames, fps = 1, 30.0

    def __init__(self, dim):
        self.dim = dim


def run(theta, statistics=None, independent=False):
    theta = np.asarray(theta)
    return MotionDraws.of(
        Posterior(theta.shape[2]),
        Named(),
        np.zeros((*theta.shape[:2], 1, 1, 3)),
        seed=0,
        seconds=2.5,
        theta=theta,
        statistics=statistics,
        counts={"density": 7},
        independent=independent,
    )


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def test_independent_draws_have_no_diagnostics(rng):
    assert chain_diagnostics(run(rng.normal(size=(CHAINS, DRAWS, 2)), independent=True)) == {}


def test_white_noise_is_worth_all_its_draws(rng):
    found = chain_diagnostics(run(rng.normal(size=(CHAINS, DRAWS, 2))))
    assert found["rhat"] < 1.01
    assert found["ess_bulk"] == pytest.approx(CHAINS * DRAWS, rel=0.15)
    assert set(found) == {"rhat", "ess_bulk", "ess_tail"}


def test_chains_too_short_to_show_that_draws_depend_have_no_size(rng):
    stuck = rng.normal(size=(CHAINS, 10, 1)) + 3 * np.arange(CHAINS)[:, None, None]
    assert set(chain_diagnostics(run(stuck))) == {"rhat", "ess_bulk", "ess_tail"}
    assert set(chain_diagnostics(run(stuck[:, :9]))) == {"rhat"}
    assert chain_diagnostics(run(stuck[:, :4]))["rhat"] > 1.5
    assert math.isnan(chain_diagnostics(run(stuck[:, :3]))["rhat"])


def test_an_autoregression_is_worth_what_theory_says(rng):
    phi, draws = 0.8, 4000
    theta = np.empty((CHAINS, draws, 1))
    theta[:, 0] = rng.normal(size=(CHAINS, 1))
    for t in range(1, draws):
        step = rng.normal(size=(CHAINS, 1))
        theta[:, t] = phi * theta[:, t - 1] + math.sqrt(1 - phi**2) * step
    expected = CHAINS * draws * (1 - phi) / (1 + phi)
    assert chain_diagnostics(run(theta))["ess_bulk"] == pytest.approx(expected, rel=0.15)


def test_stuck_chains_are_seen_in_few_and_in_many_coordinates(rng):
    for dim in (3, 200):
        stuck = rng.normal(size=(CHAINS, DRAWS, dim))
        assert chain_diagnostics(run(stuck))["rhat"] < 1.02
        stuck[0] += 5
        found = chain_diagnostics(run(stuck))
        assert found["rhat"] > 1.5
        assert found["ess_bulk"] < 10


def test_many_coordinates_are_watched_through_the_leading_ones(rng):
    theta = rng.normal(size=(2, 50, 40)) * np.r_[10.0, np.ones(39)]
    watched = watched_coordinates(run(theta))
    assert watched.shape == (2, 50, 10)
    assert abs(np.corrcoef(watched[..., 0].ravel(), theta[..., 0].ravel())[0, 1]) > 0.99


def test_an_ensemble_is_judged_by_its_autocorrelation_time(rng):
    theta = rng.normal(size=(CHAINS, DRAWS, 2))
    times = np.array([2.0, 5.0, 1.0, 4.0])
    found = chain_diagnostics(run(theta, {"autocorrelation_time": times}))
    assert set(found) == {"ess_bulk", "rhat"}
    assert found["ess_bulk"] == CHAINS * DRAWS / 5
    assert found["rhat"] < 1.01
    alone = chain_diagnostics(run(theta[:1], {"autocorrelation_time": times[:1]}))
    assert alone == {"ess_bulk": DRAWS / 2}


def test_ensembles_in_different_modes_are_seen(rng):
    theta = rng.normal(size=(CHAINS, DRAWS, 2))
    theta[0] += 5
    found = chain_diagnostics(run(theta, {"autocorrelation_time": np.ones(CHAINS)}))
    assert found["rhat"] > 1.5


def test_an_ensemble_of_unknown_autocorrelation_time_has_no_ess(rng):
    """Never a chain's, and none though it is known of the other ensembles."""
    theta = rng.normal(size=(CHAINS, 10, 2))
    for known in (0, CHAINS - 1):
        times = np.r_[np.ones(known), np.full(CHAINS - known, np.nan)]
        assert set(chain_diagnostics(run(theta, {"autocorrelation_time": times}))) == {"rhat"}
        alone = chain_diagnostics(run(theta[-1:], {"autocorrelation_time": times[-1:]}))
        assert alone == {}


def test_acceptance_is_averaged_and_divergences_are_counted(rng):
    theta = rng.normal(size=(CHAINS, DRAWS, 1))
    divergent = np.zeros((CHAINS, DRAWS), dtype=bool)
    divergent[1, 3:6] = True
    acceptance = np.array([0.2, 0.4, 0.2, 0.4])
    found = chain_diagnostics(run(theta, {"divergent": divergent, "acceptance": acceptance}))
    assert found["divergent"] == 3
    assert found["acceptance"] == pytest.approx(0.3)


def test_costs_are_the_runs(rng):
    found = costs(run(rng.normal(size=(1, 10, 1))))
    assert found == {"seconds": 2.5, "density_evaluations": 7}


def test_the_limit_of_r_hat_holds_one_run_at_a_time(monkeypatch):
    from arviz_stats.base import array_stats

    monkeypatch.setattr(array_stats, "rhat", lambda values, **axes: np.ones(values.shape[2]))
    tracemalloc.start()
    try:
        assert rhat_of_independent(4, 500) == 1
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 3 * 4 * 500 * 33 * 8


def test_the_limit_of_r_hat_is_of_the_runs_and_the_level():
    """The same from all runs at once; and half of all runs exceed the median."""
    from arviz_stats.base import array_stats

    runs = [seeds.generator(7, "rhat", k).standard_normal((2, 12, 33)) for k in range(100)]
    together = array_stats.rhat(np.concatenate(runs, axis=2), chain_axis=0, draw_axis=1)
    greatest = np.sort(together.reshape(100, 33).max(axis=1))
    found = rhat_of_independent(2, 12, level=0.5, seed=7)
    assert found == pytest.approx((greatest[49] + greatest[50]) / 2, rel=1e-12)


def test_of_short_chains_even_independent_draws_have_an_r_hat_far_from_1(rng):
    assert rhat_of_independent(4, 500) < 1.05
    limit = rhat_of_independent(4, 10)
    found = [chain_diagnostics(run(rng.normal(size=(4, 10, 32))))["rhat"] for _ in range(40)]
    assert limit > 1.25
    assert np.median(found) > 1.15
    # One in 20, by its name; of 40 more than 8 are one in 3000.
    assert sum(value > 0.97 * limit for value in found) > 0
    assert sum(value > limit for value in found) <= 8
