"""Overhead of this package over NumPyro and emcee called directly.

``nuts_ratio``, ``ensemble_ratio``: processor seconds of our sampler over those of the library on
the same density, start and random numbers; the script exits with an error if the draws differ.
Both compile NUTS anew. Medians over interleaved repeats in one process.
``…_density_fraction_…``: seconds in densities and their gradients over those of the sampler, on
problems with cheap densities and, the last, with a network. ``import_seconds``: ``import
probmotion`` in a new process, minimum of several. Float64, one thread.
"""

from __future__ import annotations

import os

for threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[threads] = "1"

import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import emcee
import jax
import numpy as np
from numpyro.infer import (
    MCMC,
    NUTS as Kernel,  # noqa: N811
)

from probmotion import MotionPosterior, seeds
from probmotion.problems import load_problem
from probmotion.samplers import NUTS, Ensemble, ParallelTempering, SequentialMonteCarlo
from probmotion.samplers.mcmc.nuts_kernel import compiled
from probmotion.samplers.mcmc.tempering import Points, TemperedDensity

SEED = 0


def nuts_directly(posterior: MotionPosterior, warmup: int, draws: int) -> np.ndarray:
    """Return θ of one chain drawn with NumPyro directly; also compute the motions."""
    start = posterior.initial(seeds.generator(SEED, "initial", 0), 1)[0]
    with jax.enable_x64(True):
        chain = MCMC(
            Kernel(potential_fn=lambda theta: -posterior.log_density(theta)),
            num_warmup=warmup,
            num_samples=draws,
            progress_bar=False,
        )
        chain.run(
            seeds.jax_key(SEED, "chain", 0),
            init_params=jax.numpy.asarray(start),
            extra_fields=("potential_energy", "accept_prob", "diverging", "num_steps"),
        )
        theta = np.asarray(chain.get_samples())
    posterior.complete(theta, seeds.generator(SEED, "motions"))
    return theta


def nuts(posterior: MotionPosterior, warmup: int, draws: int) -> np.ndarray:
    """Return θ of one chain drawn with our sampler."""
    compiled.cache_clear()
    result = NUTS(warmup=warmup, candidates=1).sample(
        posterior, draws=draws, seed=SEED, progress=False
    )
    return result.dataset["theta"].values[0]


def ensemble_directly(posterior: MotionPosterior, warmup: int, draws: int, thin: int) -> np.ndarray:
    """Return θ of one ensemble drawn with emcee directly; also compute the motions."""
    walkers = 4 * posterior.dim
    start = posterior.initial(seeds.generator(SEED, "initial", 0), walkers)
    source = np.random.RandomState(np.random.MT19937(seeds.sequence(SEED, "chain", 0)))
    sampler = emcee.EnsembleSampler(walkers, posterior.dim, posterior.log_density, vectorize=True)
    state = emcee.State(start, random_state=source.get_state())
    state = sampler.run_mcmc(state, warmup)
    sampler.reset()
    sampler.run_mcmc(state, draws // walkers, thin_by=thin)
    theta = sampler.get_chain(flat=True)
    posterior.complete(theta, seeds.generator(SEED, "motions"))
    return theta


def ensemble(posterior: MotionPosterior, warmup: int, draws: int, thin: int) -> np.ndarray:
    """Return θ of one ensemble drawn with our sampler."""
    sampler = Ensemble(warmup=warmup, thin=thin, candidates=1)
    result = sampler.sample(posterior, draws=draws, seed=SEED, progress=False)
    return result.dataset["theta"].values[0]


def ratio(ours: Callable[[], np.ndarray], theirs: Callable[[], np.ndarray], repeats: int) -> float:
    """Return the median ratio of the processor time of ``ours`` to that of ``theirs``."""
    ratios = []
    for repeat in range(repeats):
        seconds, draws = {}, {}
        # Alternate the order, so that a drift of the clock rate does not bias the ratio.
        for function in (ours, theirs) if repeat % 2 else (theirs, ours):
            # Measure processor time of this process only, independent of other load.
            start = time.process_time()
            draws[function] = function()
            seconds[function] = time.process_time() - start
        if not np.array_equal(draws[ours], draws[theirs]):
            raise SystemExit("draws of both functions must be equal, got different ones")
        ratios.append(seconds[ours] / seconds[theirs])
    return float(np.median(ratios))


def density_fraction(
    sampler: ParallelTempering | SequentialMonteCarlo, posterior: MotionPosterior
) -> float:
    """Return the median fraction of a sampler's run time that is spent in densities."""
    spent, fractions = 0.0, []
    functions = {name: getattr(TemperedDensity, name) for name in ("points", "values")}

    def timed(name: str) -> Callable[..., Points]:
        def function(self: TemperedDensity, *options: Any, **others: Any) -> Points:
            nonlocal spent
            # Replace what an inner call added: without gradients, `points` calls `values`.
            before, start = spent, time.perf_counter()
            result = functions[name](self, *options, **others)
            spent = before + time.perf_counter() - start
            return result

        return function

    for name in functions:
        setattr(TemperedDensity, name, timed(name))
    try:
        for seed in range(3):
            spent = 0.0
            result = sampler.sample(posterior, draws=50, seed=seed, progress=False)
            fractions.append(spent / result.seconds)
    finally:
        for name, function in functions.items():
            setattr(TemperedDensity, name, function)
    return float(np.median(fractions))


def import_seconds(repeats: int = 7) -> float:
    """Return the duration of ``import probmotion`` in a new process."""

    code = "import time; t = time.perf_counter(); import probmotion; print(time.perf_counter() - t)"
    runs = [subprocess.check_output([sys.executable, "-c", code]) for _ in range(repeats)]
    return min(float(run) for run in runs)


def main() -> None:
    """Print the measurements, then those of ``mas_overhead.py``."""
    print(f"import_seconds: {import_seconds():.3f}")
    posterior = load_problem("gait-monocular").posterior
    nuts_median = ratio(
        lambda: nuts(posterior, warmup=500, draws=2000),
        lambda: nuts_directly(posterior, warmup=500, draws=2000),
        repeats=5,
    )
    print(f"nuts_ratio: {nuts_median:.3f}")
    ensemble_median = ratio(
        lambda: ensemble(posterior, warmup=1000, draws=1600, thin=50),
        lambda: ensemble_directly(posterior, warmup=1000, draws=1600, thin=50),
        repeats=11,
    )
    print(f"ensemble_ratio: {ensemble_median:.3f}")
    for name in ("gait-monocular", "gait-noisy3d", "walk-vae-monocular"):
        posterior = load_problem(name).posterior
        for sampler in (ParallelTempering(warmup=50, thin=1), SequentialMonteCarlo(particles=64)):
            fraction = density_fraction(sampler, posterior)
            print(f"{sampler.name}_density_fraction_{name.replace('-', '_')}: {fraction:.3f}")
    mas = Path(__file__).with_name("mas_overhead.py")
    if mas.exists():
        subprocess.run([sys.executable, str(mas)], check=True)


if __name__ == "__main__":
    main()
