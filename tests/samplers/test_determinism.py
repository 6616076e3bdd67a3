"""Identical bits for any number of workers, draws and chains and any batch, on one machine.

docs/concepts/posterior.md names the exceptions:

- Sums of linear algebra on several threads depend on their number. Runs of a comparison, and worker
  processes, therefore have one thread (``probmotion.threads.one_thread``).
- Products of matrices round differently for other numbers of rows (``ROUNDED``).
- The exact denoisers compute blocks of 64 points. On some processors, products round differently
  from the 61st on, so 48 draws are compared here; ``tests/posteriors/test_streams.py`` has 80.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import probmotion as pm
from probmotion.posteriors.problem import Problem
from probmotion.posteriors.sampling import load_sampler
from probmotion.samplers.conditional import DAPS, REDDiff, TwistedDiffusion
from probmotion.samplers.diffusion import StochSync, SyncTweedies
from tests.samplers.test_protocol import QUICK

RIVALS = {
    "daps": DAPS(steps=4, ode_steps=2),
    "red-diff": REDDiff(steps=5),
    "tds": TwistedDiffusion(steps=4, particles=2),
    "stoch-sync": StochSync(steps=3, ode_steps=2),
    "sync-tweedies": SyncTweedies(steps=5),
}
DRAWS, CHAINS = 12, 4
# In metres: of one chain of mh, and of other numbers of draws in a batch of dvae.
ROUNDED = {"mh": 1e-14, "dvae": 1e-14}


def quick(name):
    """Return a sampler with the least effort."""
    return RIVALS[name] if name in RIVALS else load_sampler(name)(**QUICK[name])


@pytest.fixture(scope="module")
def target():
    """Return a problem of observations and one without, which alone suits sds."""
    film = pm.problem("gait-monocular", frames=8).posterior
    prior = pm.MotionPosterior(film.prior)
    return [Problem("film", "walks", film), Problem("prior", "walks", prior)]


@pytest.fixture(scope="module")
def draws_of(target):
    """Return a function that draws with all samplers, or with those that have a batch."""

    @cache
    def drawn(draws, chains, workers, batch=None):
        samplers = {name: quick(name) for name in [*QUICK, *RIVALS]}
        if batch is not None:
            samplers = {
                name: replace(sampler, batch=batch)
                for name, sampler in samplers.items()
                if hasattr(sampler, "batch")
            }
        found, options = {}, {"chains": chains, "workers": workers, "progress": False}
        for problem in target:
            used = {n: s for n, s in samplers.items() if (n == "sds") == (problem.name == "prior")}
            grid = pm.compare(problem, used, draws=draws, **options)
            found |= {name: grid.draws(problem.name, name).positions.values for name in used}
        return found

    return drawn


@pytest.fixture(scope="module")
def expected(draws_of):
    drawn = draws_of(CHAINS * DRAWS, CHAINS, 0)
    for values in drawn.values():
        assert len(np.unique(values.reshape(CHAINS * DRAWS, -1), axis=0)) > CHAINS
    return drawn


@pytest.mark.slow
@pytest.mark.parametrize("batch", [None, 3])
@pytest.mark.parametrize("chains", [1, 2, CHAINS])
@pytest.mark.parametrize("workers", [0, 1, 2, 4])
def test_draws_do_not_depend_on_workers_chains_and_batch(
    workers, chains, batch, draws_of, expected
):
    here = draws_of(DRAWS, chains, 0, batch)
    for name, got in draws_of(DRAWS, chains, workers, batch).items():
        np.testing.assert_array_equal(got, here[name], err_msg=name)
        tolerance = 0 if (name, chains > 1) == ("mh", True) else ROUNDED.get(name, 0)
        np.testing.assert_allclose(
            got, expected[name][:chains, : DRAWS // chains], rtol=0, atol=tolerance, err_msg=name
        )
