"""How fast pose-pairs are drawn: full density, 32 views, the 32 nearest of 6000 annotations each.

``proposals_per_second``: density evaluations of Metropolis-Hastings on all threads (SciPy's Qhull
takes about 220 µs for each of the 32 triangulations that one evaluation makes).
``draws_per_second``: kept draws, one per step of every chain; the published system makes about 10
a second on four cores. ``acceptance``; ``ess_per_second``: bulk, of the coordinate that mixes
worst. ``triangulation_share``: of the time of an evaluation, on one thread. ``memory_gib``: the
most that a process held that kept ``draws_kept`` draws and saved them. Made data (procedural
dances), so that it runs anywhere; with ``--data FOLDER`` the real salsa clips there.
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
def triangulate_all(pictures: np.ndarray, offsets: np.ndarray, edges: np.ndarray) -> int:
    """Triangulate every picture, (n, J, 2); return the number of edges."""
    total = 0
    for picture in pictures:
        total += write_delaunay(picture, offsets, edges)[0]
    return total


def problem(folder: str | None) -> Problem:
    """Return the problem with 6000 annotations."""
    if folder is not None:
        return pairs_problem(salsa_pairs(folder), SALSA_HELD_OUT, n_annotations=6000)
    return pairs_problem(synthetic_dances(80), ["dance-78", "dance-79"], n_annotations=6000)


def triangulation_share(given: Problem, theta: np.ndarray) -> float:
    """Return the share of an evaluation that its triangulations take, on one thread."""
    numba.set_num_threads(1)
    posterior = given.posterior
    poses = posterior.motion(theta)[:, 0]
    pictures = project_to_views(poses, posterior.likelihood.views, posterior.skeleton)
    pictures = np.ascontiguousarray(pictures.reshape(-1, *pictures.shape[2:]))
    joints = pictures.shape[1]
    edges = np.empty((max_planar_edges(joints), 2), dtype=np.int16)
    offsets = joggle_offsets(joints, 2)
    seconds = []
    for call in (
        lambda: triangulate_all(pictures, offsets, edges),
        lambda: posterior.log_density(theta),
    ):
        call()
        start = time.perf_counter()
        for _ in range(5):
            call()
        seconds.append(time.perf_counter() - start)
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    return seconds[0] / seconds[1]


def keep_many(folder: str | None, draws: int) -> None:
    """Keep and save ``draws`` draws; print the memory it took."""
    sampler = MetropolisHastings(Isotropic(0.02), warmup=WARMUP, thin=1)
    posterior = problem(folder).posterior
    kept = sampler.sample(posterior, draws=draws // CHAINS, chains=CHAINS, progress=False)
    with tempfile.TemporaryDirectory() as place:
        kept.save(Path(place) / "draws.nc")
    print(f"draws_kept: {kept.positions.sizes['draw'] * CHAINS}")
    print(f"memory_gib: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f}")


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", help="folder of the salsa clips")
    parser.add_argument("--keep", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.keep:
        keep_many(options.data, options.keep)
        return
    given = problem(options.data)
    sampler = MetropolisHastings(Isotropic(0.02), warmup=WARMUP, thin=1)
    sampler.sample(given.posterior, draws=2, chains=CHAINS, progress=False)  # compiles
    draws = sampler.sample(given.posterior, draws=DRAWS, chains=CHAINS, progress=False)
    print(f"threads: {numba.get_num_threads()}")
    print(f"proposals_per_second: {draws.counts['density'] / draws.seconds:.0f}")
    print(f"draws_per_second: {CHAINS * DRAWS / draws.seconds:.0f}")
    print(f"acceptance: {float(draws.dataset['acceptance'].mean()):.3f}")
    print(f"ess_per_second: {chain_diagnostics(draws)['ess_bulk'] / draws.seconds:.2f}")
    share = triangulation_share(given, draws.dataset["theta"].values[:, -1])
    print(f"triangulation_share: {share:.3f}")
    folder = ["--data", options.data] if options.data else []
    # A process of its own, whose peak is that of keeping draws.
    subprocess.run([sys.executable, __file__, "--keep", "100000", *folder], check=True)


if __name__ == "__main__":
    main()
