"""Tests of `Ensemble`: agreement with emcee, autocorrelation times, limits."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion import MotionDraws, seeds
from probmotion.metrics.chains import chain_diagnostics
from probmotion.posteriors.sampling import UnsupportedPosterior
from probmotion.samplers import Ensemble
from probmotion.samplers.mcmc.autocorrelation import autocorrelation_time

QUICK = Ensemble(walkers=8, warmup=20, thin=5, candidates=1)


def emcee_run(posterior, iterations):
    """Run emcee as in the second chain of the fixture ``run`` and return its sampler."""
    import emcee

    source = np.random.RandomState(np.random.MT19937(seeds.sequence(3, "chain", 1)))
    sampler = emcee.EnsembleSampler(8, 3, posterior.log_density, vectorize=True)
    start = posterior.initial(seeds.generator(3, "initial", 1), 8)
    state = sampler.run_mcmc(emcee.State(start, random_state=source.get_state()), 20)
    sampler.reset()
    sampler.run_mcmc(state, iterations)
    return sampler


def test_draws_are_those_of_emcee(posterior, run):
    long = run(QUICK, 100)
    sampler = emcee_run(posterior, 65)
    chain = sampler.get_chain()
    np.testing.assert_array_equal(long.dataset["theta"][1], chain[4::5].reshape(-1, 3)[:100])
    # The run is shorter than 3 times its estimate: all 13 recorded iterations count as one.
    assert 65 / 3 < autocorrelation_time(chain).max() < 65 / 2
    assert long.dataset["autocorrelation_time"][1] == 13
    # The acceptance rate of emcee is over 65 iterations, that of `Ensemble` over 64 of them.
    accepted = sampler.acceptance_fraction.mean()
    assert abs(long.dataset["acceptance_rate"][1] - accepted) <= 1 / 64


def test_long_runs_estimate_their_autocorrelation_time(posterior, run):
    time = run(QUICK, 800).dataset["autocorrelation_time"][1]
    slowest = autocorrelation_time(emcee_run(posterior, 500).get_chain()).max()
    assert 5 < slowest < 500 / 3
    np.testing.assert_allclose(time, slowest / 5)


def test_evaluations_are_counted_and_walkers_start_at_initial(run, two_modes, evaluations):
    assert run(QUICK, 16).counts == {"density": sum(evaluations)}
    assert sum(evaluations) == 2 * 8 * (1 + 20 + 2 * 5)
    points = two_modes.initial(np.random.default_rng(0), 16).reshape(2, 8, 3)
    draws = run(Ensemble(walkers=8, warmup=0, thin=1), 8, initial=points)
    unmoved = (draws.dataset["theta"].values == points).all(axis=-1)
    assert 0 < unmoved.sum() < 16  # rejected moves leave walkers at their start


def test_numbers_of_walkers_and_dimensions_are_checked(run):
    with pytest.raises(ValueError, match="walkers must be at least 6, twice the dimension, got 5"):
        run(Ensemble(walkers=5), 2)
    with pytest.raises(ValueError, match=r"initial must have shape \(2, 8, 3\), got \(2, 3\)"):
        run(QUICK, 2, initial=np.zeros((2, 3)))
    with pytest.raises(
        UnsupportedPosterior, match=r"supports at most 2 dimensions \(largest_dim\), got 3"
    ) as refused:
        run(Ensemble(largest_dim=2), 2)
    assert refused.value.word == "dimension"
    draws = run(Ensemble(warmup=0, thin=1, largest_dim=3), 2)
    assert draws.state["coordinates"].shape == (2, 12, 3)


@pytest.mark.parametrize(("correlation", "iterations"), [(0.0, 60), (0.9, 60), (0.9, 4000)])
def test_autocorrelation_time_of_an_autoregressive_process(correlation, iterations):
    """x' = ρ x + √(1−ρ²) ε has time (1 + ρ)/(1 − ρ), also in a run of three times that length."""
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((iterations, 200, 2))
    trace = noise.copy()
    for t in range(1, iterations):
        trace[t] = correlation * trace[t - 1] + np.sqrt(1 - correlation**2) * noise[t]
    expected = (1 + correlation) / (1 - correlation)
    np.testing.assert_allclose(autocorrelation_time(trace), expected, rtol=0.2, atol=0.1)
    trace[..., 0] = 3.0
    constant, varying = autocorrelation_time(trace)
    assert np.isnan(constant)
    assert np.isfinite(varying)


@pytest.mark.parametrize("thin", [1, 3])
def test_short_runs_have_no_autocorrelation_time(run, tmp_path, thin):
    """10 draws of 8 walkers are two recorded iterations."""
    sampler = Ensemble(walkers=8, warmup=0, thin=thin, candidates=1)
    for draws in (10, 4):
        run(sampler, draws, chains=4).save(tmp_path / "short.nc")
        loaded = MotionDraws.load(tmp_path / "short.nc")
        diagnostics = chain_diagnostics(loaded)
        finite = np.isfinite(loaded.dataset["autocorrelation_time"].values)
        assert finite.shape == (4,)
        assert finite.any() == ("acceptance" in diagnostics) == (thin == 3 and draws == 10)
        assert "ess_tail" not in diagnostics
        assert ("ess_bulk" in diagnostics) == finite.all()
