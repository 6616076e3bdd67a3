"""Speed of pose-pair sampling with 32 views and the 32 nearest of 6000 annotations per view.

``proposals_per_second``: density evaluations of Metropolis-Hastings on all threads (SciPy's Qhull
takes about 220 µs for each of the 32 triangulations of an evaluation). ``draws_per_second``: one
draw per step of every chain; the published system draws about 10 per second on four cores.
``acceptance``: mean acceptance rate. ``ess_per_second``: bulk effective sample size of the worst
coordinate. ``triangulation_share``: fraction of an evaluation spent on triangulations, one thread.
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
from probmotion.interaction.annotations.views import project_to_views
from probmotion.interaction.geometry.delaunay import max_planar_edges, write_delaunay
from probmotion.interaction.geometry.graphs import joggle_offsets
from probmotion.metrics.chains import chain_diagnostics
from probmotion.posteriors.problem import Problem
from probmotion.problems import pairs_problem
from probmotion.samplers import MetropolisHastings
from probmotion.samplers.mcmc.proposals import Isotropic

CHAINS, WARMUP, DRAWS = 32, 300, 400


@numba.njit(cache=True)
def triangulate_all(keypoints: np.ndarray, offsets: np.ndarray, edges: np.ndarray) -> int:
    """Triangulate the joints of every view, (n, J, 2); return the number of edges."""
    total = 0
    for view in keypoints:
        total += write_delaunay(view, offsets, edges)[0]
    return total


def problem(folder: str | None) -> Problem:
    """Return the pose-pair problem with 6000 annotations."""
    if folder is not None:
        return pairs_problem(salsa_pairs(folder), SALSA_HELD_OUT, n_annotations=6000)
    return pairs_problem(synthetic_dances(80), ["dance-78", "dance-79"], n_annotations=6000)


def triangulation_share(given: Problem, theta: np.ndarray) -> float:
    """Return the fraction of an evaluation spent on triangulations, on one thread."""
    numba.set_num_threads(1)
    posterior = given.posterior
    poses = posterior.motion(theta)[:, 0]
    keypoints = project_to_views(poses, posterior.likelihood.views, posterior.skeleton)
    keypoints = np.ascontiguousarray(keypoints.reshape(-1, *keypoints.shape[2:]))
    joints = keypoints.shape[1]
    edges = np.empty((max_planar_edges(joints), 2), dtype=np.int16)
    offsets = joggle_offsets(joints, 2)
    seconds = []
    for call in (
        lambda: triangulate_all(keypoints, offsets, edges),
        lambda: posterior.log_density(theta),
    ):
        call()
        start = time.perf_counter()
        for _ in range(5):
            call()
        seconds.append(time.perf_counter() - start)
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    return seconds[0] / seconds[1]


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
    print(f"proposals_per_second: {draws.counts['density'] / draws.seconds:.0f}")
    print(f"draws_per_second: {CHAINS * DRAWS / draws.seconds:.0f}")
    print(f"acceptance: {float(draws.dataset['acceptance_rate'].mean()):.3f}")
    print(f"ess_per_second: {chain_diagnostics(draws)['ess_bulk'] / draws.seconds:.2f}")
    share = triangulation_share(given, draws.dataset["theta"].values[:, -1])
    print(f"triangulation_share: {share:.3f}")
    folder = ["--data", options.data] if options.data else []
    # Use a new process, so that the peak memory is that of drawing and saving alone.
    subprocess.run([sys.executable, __file__, "--keep", "100000", *folder], check=True)


if __name__ == "__main__":
    main()
