"""`Ensemble`: emcee's own draws, walkers as one stream, autocorrelation, going on, Ctrl-C."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion import MotionDraws, MotionPosterior, seeds
from probmotion.metrics.chains import chain_diagnostics
from probmotion.posteriors.sampling import Interrupted, UnsupportedPosterior
from probmotion.samplers import Ensemble
from probmotion.samplers.mcmc.autocorrelation import autocorrelation_time

QUICK = Ensemble(walkers=8, warmup=20, thin=5, candidates=1)


def run(posterior, draws, chains=2, seed=3, sampler=QUICK, **more):
    return sampler.sample(
        posterior, draws=draws, chains=chains, seed=seed, **{"progress": False, **more}
    )


@pytest.fixture(scope="module")
def posterior(two_bumps):
    return MotionPosterior(two_bumps)


@pytest.fixture(scope="module")
def long(posterior):
    return run(posterior, 100)


def test_a_run_that_is_long_enough_tells_its_own_autocorrelation_time(two_bumps, posterior):
    import emcee

    found = run(posterior, 800).dataset["autocorrelation_time"][1]
    source = np.random.RandomState(np.random.MT19937(seeds.sequence(3, "chain", 1)))
    sampler = emcee.EnsembleSampler(8, 3, two_bumps.log_density, vectorize=True)
    start = posterior.initial(seeds.generator(3, "initial", 1), 8)
    state = sampler.run_mcmc(emcee.State(start, random_state=source.get_state()), 20)
    sampler.reset()
    sampler.run_mcmc(state, 500)
    slowest = autocorrelation_time(sampler.get_chain()).max()
    assert 5 < slowest < 500 / 3
    np.testing.assert_allclose(found, slowest / 5)


def test_the_draws_are_emcees_own(two_bumps, posterior, long):
    import emcee

    source = np.random.RandomState(np.random.MT19937(seeds.sequence(3, "chain", 1)))
    sampler = emcee.EnsembleSampler(8, 3, two_bumps.log_density, vectorize=True)
    start = posterior.initial(seeds.generator(3, "initial", 1), 8)
    state = sampler.run_mcmc(emcee.State(start, random_state=source.get_state()), 20)
    sampler.reset()
    sampler.run_mcmc(state, 65)
    chain = sampler.get_chain()
    kept = chain[4::5].reshape(-1, 3)
    np.testing.assert_array_equal(long.dataset["theta"][1], kept[:100])
    # A run of 65 iterations is too short to tell a time of 25: all 13 that are kept count as one.
    assert 65 / 3 < autocorrelation_time(chain).max() < 65 / 2
    assert long.dataset["autocorrelation_time"][1] == 13
    # emcee counts 65 iterations' moves, we those between them.
    accepted = sampler.acceptance_fraction.mean()
    assert abs(long.dataset["acceptance"][1] - accepted) <= 1 / 64


def test_what_is_stored_belongs_together(two_bumps, long):
    theta = long.dataset["theta"].values
    np.testing.assert_allclose(long.dataset["log_density"], two_bumps.log_density(theta))
    np.testing.assert_array_equal(long.positions.values, two_bumps.motion(theta))


def test_the_density_is_counted_to_the_last_evaluation(posterior, monkeypatch):
    asked = []
    monkeypatch.setattr(
        MotionPosterior,
        "log_density",
        lambda self, theta: asked.append(len(theta)) or self.prior.log_density(theta),
    )
    draws = run(posterior, 16)
    assert draws.counts == {"density": sum(asked)}
    assert sum(asked) == 2 * 8 * (1 + 20 + 2 * 5)


def test_going_on_is_as_if_it_had_not_stopped(posterior, long, tmp_path):
    """Also where a run stops between two walkers, or asks for no new iteration."""
    parts, given = [], None
    for draws in (11, 3, 1, 85):
        parts.append(run(posterior, draws, initial=given))
        parts[-1].save(tmp_path / "part.nc")
        given = MotionDraws.load(tmp_path / "part.nc")
    for name in ("theta", "positions", "log_density"):
        joined = np.concatenate([part.dataset[name].values for part in parts], axis=1)
        np.testing.assert_array_equal(joined, long.dataset[name].values)
    assert sum(part.counts["density"] for part in parts) == long.counts["density"]


def test_an_ensemble_is_the_same_beside_others_and_under_a_bar(posterior, long):
    many = run(posterior, 20, chains=4, progress=True)
    np.testing.assert_array_equal(many.dataset["theta"][:2], long.dataset["theta"][:, :20])


def test_walkers_start_where_they_are_told(posterior, two_bumps):
    points = two_bumps.initial(np.random.default_rng(0), 16).reshape(2, 8, 3)
    sampler = Ensemble(walkers=8, warmup=0, thin=1)
    draws = run(posterior, 8, sampler=sampler, initial=points)
    same = (draws.dataset["theta"].values == points).all(axis=-1)
    assert 0 < same.sum() < 16  # those that did not move yet


def interrupt_after(monkeypatch, evaluations):
    asked = [0]

    def log_density(self, theta):
        asked[0] += 1
        if asked[0] == evaluations:
            raise KeyboardInterrupt
        return self.prior.log_density(theta)

    monkeypatch.setattr(MotionPosterior, "log_density", log_density)


def test_an_interrupt_keeps_what_was_finished_and_the_run_goes_on(posterior, long, monkeypatch):
    # All starts at once; then two calls per iteration and ensemble.
    interrupt_after(monkeypatch, 1 + 2 * 2 * (20 + 3 * 5 + 2) + 1)
    with pytest.raises(Interrupted, match="interrupted after 24 draws per chain") as stopped:
        run(posterior, 100)
    rest = run(posterior, 76, initial=stopped.value.draws)
    theta = [stopped.value.draws.dataset["theta"].values, rest.dataset["theta"].values]
    np.testing.assert_array_equal(np.concatenate(theta, axis=1), long.dataset["theta"].values)


def test_an_interrupt_of_the_warm_up_is_a_plain_one(posterior, monkeypatch):
    interrupt_after(monkeypatch, 20)
    with pytest.raises(KeyboardInterrupt) as stopped:
        run(posterior, 10)
    assert not isinstance(stopped.value, Interrupted)


def test_too_few_walkers_are_refused(posterior):
    with pytest.raises(ValueError, match="walkers must be at least 6, twice, got 5"):
        run(posterior, 2, sampler=Ensemble(walkers=5))
    with pytest.raises(ValueError, match=r"initial must have shape \(2, 8, 3\), got \(2, 3\)"):
        run(posterior, 2, initial=np.zeros((2, 3)))


def test_many_dimensions_are_refused_unless_asked_for(posterior):
    with pytest.raises(
        UnsupportedPosterior, match=r"ensemble is for at most 2 dimensions \(largest_dim\)"
    ) as refused:
        run(posterior, 2, sampler=Ensemble(largest_dim=2))
    assert refused.value.word == "dimension"
    assert run(posterior, 2, sampler=Ensemble(warmup=0, thin=1, largest_dim=3)).counts


@pytest.mark.parametrize("correlation", [0.0, 0.9])
@pytest.mark.parametrize("iterations", [60, 4000])
def test_the_autocorrelation_time_of_a_known_process(correlation, iterations):
    """x' = ρ x + √(1−ρ²) ε has time (1 + ρ)/(1 − ρ), seen also in a run three times as long."""
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((iterations, 200, 2))
    trace = noise.copy()
    for t in range(1, iterations):
        trace[t] = correlation * trace[t - 1] + np.sqrt(1 - correlation**2) * noise[t]
    wanted = (1 + correlation) / (1 - correlation)
    np.testing.assert_allclose(autocorrelation_time(trace), wanted, rtol=0.2, atol=0.1)


def test_a_walker_that_never_moves_has_no_autocorrelation_time():
    trace = np.zeros((20, 4, 2))
    trace[..., 1] = np.random.default_rng(0).normal(size=(20, 4))
    still, moving = autocorrelation_time(trace)
    assert np.isnan(still)
    assert np.isfinite(moving)


@pytest.mark.parametrize("thin", [1, 3])
def test_a_short_run_gets_no_ess_of_a_chain(posterior, tmp_path, thin):
    """Of 10 draws of 8 walkers: two kept iterations, too few for an autocorrelation time."""
    sampler = Ensemble(walkers=8, warmup=0, thin=thin, candidates=1)
    for draws in (10, 4):
        run(posterior, draws, chains=4, sampler=sampler).save(tmp_path / "short.nc")
        found = MotionDraws.load(tmp_path / "short.nc")
        told = chain_diagnostics(found)
        known = np.isfinite(found.dataset["autocorrelation_time"].values)
        assert known.shape == (4,)
        assert known.any() == ("acceptance" in told) == (thin == 3 and draws == 10)
        assert "ess_tail" not in told
        assert ("ess_bulk" in told) == known.all()


@pytest.mark.parametrize("name", ["walkers", "warmup", "thin", "largest_dim"])
def test_wrong_settings_are_refused(name):
    with pytest.raises(ValueError, match=f"{name} must be an integer of at least, got -1"):
        Ensemble(**{name: -1})
