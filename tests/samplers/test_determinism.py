"""Identical bits for any number of workers, draws and chains and any batch, on one machine.

Exceptions: linear algebra on several threads, whose sums depend on the number of threads. All
samplers therefore run with one (``probmotion.threads.one_thread``), as do worker processes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import probmotion as pm
from probmotion.posteriors.sampling import load_sampler
from probmotion.threads import one_thread
from tests.samplers.test_protocol import QUICK

pytestmark = pytest.mark.slow

# Matrix products round differently for one row than for several.
ROUNDED = {"mh": 1e-14, "dvae": 1e-14}


@pytest.fixture(params=QUICK)
def sampler(request):
    return load_sampler(request.param)(**QUICK[request.param])


@pytest.fixture
def posterior(sampler):
    return pm.problem("gait" if sampler.name == "sds" else "gait-monocular", frames=8).posterior


def test_draws_do_not_depend_on_batch_and_chains(sampler, posterior):
    rng = np.random.default_rng(0)
    tolerance = ROUNDED.get(sampler.name, 0.0)

    def positions(one, draws, chains):
        with one_thread():
            run = one.sample(posterior, draws=draws, chains=chains, seed=9, progress=False)
        return run.positions.values

    expected = positions(sampler, 6, 4)
    for _ in range(6):
        draws, chains = int(rng.integers(1, 7)), int(rng.integers(1, 5))
        batch = {"batch": int(rng.integers(1, 9))} if hasattr(sampler, "batch") else {}
        got = positions(replace(sampler, **batch), draws, chains)
        np.testing.assert_allclose(got, expected[:chains, :draws], rtol=0, atol=tolerance)


def test_draws_do_not_depend_on_workers(sampler):
    problem = "gait(frames=8)" if sampler.name == "sds" else "gait-monocular(frames=8)"
    options = {"draws": 20, "chains": 2, "seeds": 2, "progress": False}
    runs = [pm.compare(problem, sampler, workers=workers, **options) for workers in (0, 1, 2, 4)]
    expected = [runs[0].draws(problem, sampler.name, seed).flat() for seed in (0, 1)]
    for run in runs[1:]:
        for seed in (0, 1):
            np.testing.assert_array_equal(
                run.draws(problem, sampler.name, seed).flat(), expected[seed]
            )
