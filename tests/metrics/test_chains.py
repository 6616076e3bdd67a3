"""Convergence diagnostics on chains of known mixing."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from probmotion import MotionDraws, Skeleton
from probmotion.metrics import chains
from probmotion.metrics.chains import chain_diagnostics, monitored_coordinates, rhat_of_independent
from probmotion.metrics.measures import costs

CHAINS, DRAWS = 4, 500


def run(theta, statistics=None, independent=False):
    posterior = SimpleNamespace(
        skeleton=Skeleton(["a"], [-1]), frames=1, fps=30.0, dim=theta.shape[2], likelihood=None
    )
    return MotionDraws.of(
        posterior,
        SimpleNamespace(name="named"),
        np.zeros((*theta.shape[:2], 1, 1, 3)),
        seed=0,
        seconds=2.5,
        theta=theta,
        statistics=statistics,
        counts={"density": 7},
        independent=independent,
    )


def test_independent_draws_have_no_diagnostics(rng):
    draws = run(rng.normal(size=(CHAINS, DRAWS, 2)), independent=True)
    assert chain_diagnostics(draws) == {}
    assert costs(draws) == {"seconds": 2.5, "density_evaluations": 7}


def test_short_chains_have_no_ess(rng):
    stuck = rng.normal(size=(CHAINS, 10, 1)) + 3 * np.arange(CHAINS)[:, None, None]
    assert set(chain_diagnostics(run(stuck))) == {"rhat", "ess_bulk", "ess_tail"}
    assert set(chain_diagnostics(run(stuck[:, :9]))) == {"rhat"}
    assert chain_diagnostics(run(stuck[:, :4]))["rhat"] > 1.5
    assert math.isnan(chain_diagnostics(run(stuck[:, :3]))["rhat"])


def test_ess_of_an_autoregression(rng):
    phi, draws = 0.8, 4000
    theta = np.empty((CHAINS, draws, 1))
    theta[:, 0] = rng.normal(size=(CHAINS, 1))
    for t in range(1, draws):
        step = rng.normal(size=(CHAINS, 1))
        theta[:, t] = phi * theta[:, t - 1] + math.sqrt(1 - phi**2) * step
    expected = CHAINS * draws * (1 - phi) / (1 + phi)
    assert chain_diagnostics(run(theta))["ess_bulk"] == pytest.approx(expected, rel=0.15)


def test_stuck_chains_are_detected_in_any_dimension(rng):
    for dim in (3, 200):
        stuck = rng.normal(size=(CHAINS, DRAWS, dim))
        assert chain_diagnostics(run(stuck))["rhat"] < 1.02
        stuck[0] += 5
        result = chain_diagnostics(run(stuck))
        assert result["rhat"] > 1.5
        assert result["ess_bulk"] < 10


def test_only_principal_coordinates_are_monitored_in_high_dimension(rng):
    theta = rng.normal(size=(2, 50, 40)) * np.r_[10.0, np.ones(39)]
    monitored = monitored_coordinates(run(theta))
    assert monitored.shape == (2, 50, 10)
    np.testing.assert_array_equal(monitored_coordinates(run(theta[..., :3])), theta[..., :3])
    assert abs(np.corrcoef(monitored[..., 0].ravel(), theta[..., 0].ravel())[0, 1]) > 0.99


@pytest.mark.parametrize(("varying", "expected"), [(0, 1), (1, 1), (2, 2)])
def test_constant_coordinates_are_dropped_except_the_first(rng, varying, expected):
    values = np.zeros((2, 50, 40))
    values[..., :varying] = 1e6 * rng.normal(size=(2, 50, varying))
    rotated = values @ np.linalg.qr(rng.normal(size=(40, 40)))[0]
    assert chains.principal_coordinates(rotated).shape == (2, 50, expected)


def test_ensembles_use_their_autocorrelation_time(rng):
    theta = rng.normal(size=(CHAINS, DRAWS, 2))

    def diagnose(theta, times):
        return chain_diagnostics(run(theta, {"autocorrelation_time": np.asarray(times)}))

    result = diagnose(theta, [2.0, 5.0, 1.0, 4.0])
    assert set(result) == {"ess_bulk", "rhat"}
    assert result["ess_bulk"] == CHAINS * DRAWS / 5
    assert result["rhat"] < 1.01
    assert diagnose(theta[:1], [2.0]) == {"ess_bulk": DRAWS / 2}
    # The ESS is omitted if a single time is unknown.
    assert set(diagnose(theta, [1.0, 1.0, 1.0, np.nan])) == {"rhat"}
    assert diagnose(theta[:1], [np.nan]) == {}
    theta[0] += 5
    assert diagnose(theta, np.ones(CHAINS))["rhat"] > 1.5


def test_acceptance_and_divergences(rng):
    theta = rng.normal(size=(CHAINS, DRAWS, 1))
    divergent = np.zeros((CHAINS, DRAWS), dtype=bool)
    divergent[1, 3:6] = True
    acceptance = np.array([0.2, 0.4, 0.2, 0.4])
    result = chain_diagnostics(run(theta, {"diverging": divergent, "acceptance_rate": acceptance}))
    assert result["divergent"] == 3
    assert result["acceptance"] == pytest.approx(0.3)


@pytest.mark.parametrize("shape", [(4, 10), (4, 50)])
def test_the_limit_of_r_hat_is_its_quantile_over_converged_runs(shape):
    from arviz_stats.base import array_stats

    values = np.random.default_rng(3).standard_normal((*shape, 300))
    of_coordinates = array_stats.rhat(values, chain_axis=0, draw_axis=1)
    # The largest of 33 is below the limit in 5 % of runs if each is in .05^(1/33).
    expected = np.quantile(of_coordinates, 0.05 ** (1 / 33))
    limit = rhat_of_independent(*shape, level=0.05)
    assert limit - 1 == pytest.approx(expected - 1, rel=0.12)
