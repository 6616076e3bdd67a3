"""Tests common to all Markov chain samplers: θ and positions, continuation, Ctrl-C."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion import MotionDraws, MotionPosterior
from probmotion.posteriors.sampling import Interrupted
from probmotion.samplers import (
    NUTS,
    Ensemble,
    MetropolisHastings,
    ParallelTempering,
    SequentialMonteCarlo,
)
from probmotion.samplers.mcmc import nuts as nuts_module, smc as smc_module
from probmotion.samplers.mcmc.annealing import Population
from probmotion.samplers.mcmc.ladder import Ladder

SAMPLERS = {
    "mh": MetropolisHastings(warmup=60, thin=3, candidates=1),
    "ensemble": Ensemble(walkers=8, warmup=20, thin=5, candidates=1),
    "nuts": NUTS(warmup=60, candidates=1),
    "tempered": ParallelTempering(rungs=4, warmup=20, thin=2, particles=8, candidates=1),
    "smc": SequentialMonteCarlo(particles=8, thin=2, candidates=1),
}
DENSITY, CHUNK = (MotionPosterior, "log_density"), (nuts_module._Run, "_advance")
SWEEPS, MOVES = (Ladder, "advance"), (smc_module._Run, "record")


@pytest.fixture(scope="module", params=SAMPLERS)
def sampler(request):
    return SAMPLERS[request.param]


@pytest.fixture(scope="module")
def complete(sampler, run):
    return run(sampler, 100)


def assert_joined(parts, complete):
    for name in ("theta", "positions", "log_density"):
        joined = np.concatenate([part.dataset[name].values for part in parts], axis=1)
        np.testing.assert_array_equal(joined, complete.dataset[name].values)


def test_positions_and_densities_are_those_of_theta(complete, two_modes):
    theta = complete.dataset["theta"].values
    np.testing.assert_allclose(complete.dataset["log_density"], two_modes.log_density(theta))
    np.testing.assert_array_equal(complete.positions.values, two_modes.motion(theta))
    assert not complete.independent


def test_continuing_equals_one_run(sampler, run, complete, tmp_path):
    """Runs may end within an iteration of an ensemble, and continue without a new one."""
    parts, last = [], None
    for draws in (11, 3, 1, 85):
        parts.append(run(sampler, draws, initial=last))
        parts[-1].save(tmp_path / "part.nc")
        last = MotionDraws.load(tmp_path / "part.nc")
    assert_joined(parts, complete)
    for count in complete.counts:
        assert sum(part.counts[count] for part in parts) == complete.counts[count]


def test_chains_are_independent(sampler, run, complete):
    four = run(sampler, 20, chains=4, progress=True)
    # In mh the rounding of log densities depends on the batch and affects the adaptation.
    np.testing.assert_allclose(
        four.dataset["theta"][:2], complete.dataset["theta"][:, :20], rtol=1e-9, atol=1e-12
    )


def interrupt(monkeypatch, owner, name, n):
    """Raise KeyboardInterrupt at the n-th call of a method, once."""
    calls, method = [], getattr(owner, name)

    def interrupted(*arguments):
        calls.append(1)
        if len(calls) == n:
            raise KeyboardInterrupt
        return method(*arguments)

    monkeypatch.setattr(owner, name, interrupted)


@pytest.mark.parametrize(
    ("name", "method", "n", "finished"),
    [
        ("mh", DENSITY, 1 + 60 + 4 * 3 + 2, 4),
        # All starts are evaluated at once, then each ensemble twice per iteration.
        ("ensemble", DENSITY, 1 + 2 * 2 * (20 + 3 * 5 + 2) + 1, 24),
        # The call is for the second chunk of draws of chain 1, after 2 chunks of warm-up each.
        ("nuts", CHUNK, 4 + 2 + 2, 50),
        # The calls are for the second chain.
        ("tempered", SWEEPS, 2 * 4 + 2, 4),
        ("smc", MOVES, 2 * 3 + 2, 24),
    ],
)
def test_an_interrupted_run_can_be_continued(run, monkeypatch, name, method, n, finished):
    sampler = SAMPLERS[name]
    complete = run(sampler, 100)
    interrupt(monkeypatch, *method, n)
    with pytest.raises(Interrupted, match=f"after {finished} draws per chain") as stopped:
        run(sampler, 100)
    first = stopped.value.draws
    assert_joined([first, run(sampler, 100 - finished, initial=first)], complete)


@pytest.mark.parametrize(
    ("name", "method", "n"),
    [
        ("mh", DENSITY, 30),
        ("ensemble", DENSITY, 20),
        ("nuts", CHUNK, 2),
        ("tempered", (Ladder, "sweep"), 25),
        ("smc", (Population, "move"), 1),
    ],
)
def test_an_interrupt_during_warm_up_has_no_draws(run, monkeypatch, name, method, n):
    interrupt(monkeypatch, *method, n)
    with pytest.raises(KeyboardInterrupt) as stopped:
        run(SAMPLERS[name], 10)
    assert not isinstance(stopped.value, Interrupted)


@pytest.mark.parametrize("sampler", [SAMPLERS[name] for name in ("mh", "ensemble", "nuts")])
def test_starts_of_density_zero_are_refused(sampler, run):
    shape = (2, 8, 3) if sampler.name == "ensemble" else (2, 3)
    points = 1e200 * (1 + np.random.default_rng(0).random(shape))
    with (
        np.errstate(all="ignore"),
        pytest.raises(
            ValueError, match=r"initial must have a finite log density, got (-inf|nan) at"
        ),
    ):
        run(sampler, 2, initial=points)
