"""Speed of pose-pair sampling with 32 views and the 32 nearest of 6000 annotations per view.

``full_proposals_per_second``: density evaluations of Metropolis-Hastings on all threads.
``draws_per_second``: one draw per step of every chain; the published system draws about 10 per
second on four cores. ``acceptance``: mean acceptance rate. ``ess_per_second``: bulk effective
sample size of the worst coordinate. ``full_density_ms`` and ``full_density_batch_ms``: one density
of a single point and of 64 points, on one thread. ``single_view_proposals_per_second``: Metropolis
proposals of ``tempered-pairs``, on one thread. They evaluate the distance to a single annotation;
the likelihood of the view accepts or rejects blocks of 40.
``memory_gib``: peak memory of a process that draws and saves ``draws_kept`` draws. The data are
synthetic dances, or the salsa clips in ``--data FOLDER``.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numba
import numpy as np

from probmotion.data.downloads import salsa_pairs
from probmotion.data.pair_sets import SALSA_HELD_OUT
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.metrics.chains import chain_diagnostics
from probmotion.posteriors.problem import Problem
from probmotion.problems import pairs_problem
from probmotion.samplers import MetropolisHastings
from probmotion.samplers.mcmc.proposals import Isotropic
from probmotion.samplers.mcmc.tempered_pairs import TemperedPairs
from probmotion.threads import one_thread

CHAINS, WARMUP, DRAWS = 32, 300, 400


def problem(folder: str | None) -> Problem:
    """Return the pose-pair problem with 6000 annotations."""
    if folder is not None:
        return pairs_problem(salsa_pairs(folder), SALSA_HELD_OUT, n_annotations=6000)
    return pairs_problem(synthetic_dances(80), ["dance-78", "dance-79"], n_annotations=6000)


def density_milliseconds(given: Problem, theta: np.ndarray) -> float:
    """Return the time of one log density in a batch of points (n, dim), on one thread."""
    seconds = []
    for _ in range(10):
        start = time.perf_counter()
        given.posterior.log_density(theta)
        seconds.append(time.perf_counter() - start)
    return 1e3 * min(seconds) / len(theta)


def single_view_proposals(given: Problem, exchanges: int = 40) -> float:
    """Return the proposals per second of the walk over single views, on one thread."""
    sampler = TemperedPairs(levels=8, warmup=16, thin=1)
    sampler.sample(given.posterior, draws=1, progress=False)  # compiles
    draws = sampler.sample(given.posterior, draws=exchanges, progress=False)
    return draws.counts["density"] / draws.seconds


def save_many_draws(folder: str | None, draws: int) -> None:
    """Draw and save ``draws`` draws; print the peak memory of the process."""
    sampler = MetropolisHastings(Isotropic(0.02), warmup=WARMUP, thin=1)
    posterior = problem(folder).posterior
    result = sampler.sample(posterior, draws=draws // CHAINS, chains=CHAINS, progress=False)
    with tempfile.TemporaryDirectory() as output:
        result.save(Path(output) / "draws.nc")
    print(f"draws_kept: {result.positions.sizes['draw'] * CHAINS}")
    print(f"memory_gib: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f}")


def main() -> None:
    """Print the measurements."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", help="Folder with the salsa clips; default: synthetic dances.")
    parser.add_argument("--keep", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.keep:
        save_many_draws(options.data, options.keep)
        return
    given = problem(options.data)
    sampler = MetropolisHastings(Isotropic(0.02), warmup=WARMUP, thin=1)
    sampler.sample(given.posterior, draws=2, chains=CHAINS, progress=False)  # compiles
    draws = sampler.sample(given.posterior, draws=DRAWS, chains=CHAINS, progress=False)
    print(f"threads: {numba.get_num_threads()}")
    print(f"full_proposals_per_second: {draws.counts['density'] / draws.seconds:.0f}")
    print(f"draws_per_second: {CHAINS * DRAWS / draws.seconds:.0f}")
    print(f"acceptance: {float(draws.dataset['acceptance_rate'].mean()):.3f}")
    print(f"ess_per_second: {chain_diagnostics(draws)['ess_bulk'] / draws.seconds:.2f}")
    theta = draws.dataset["theta"].values[:, -2:].reshape(2 * CHAINS, -1)
    with one_thread():
        print(f"full_density_ms: {density_milliseconds(given, theta[:1]):.2f}")
        print(f"full_density_batch_ms: {density_milliseconds(given, theta):.2f}")
    print(f"single_view_proposals_per_second: {single_view_proposals(given):.0f}")
    folder = ["--data", options.data] if options.data else []
    # Use a new process, so that the peak memory is that of drawing and saving alone.
    subprocess.run([sys.executable, __file__, "--keep", "100000", *folder], check=True)


if __name__ == "__main__":
    main()
