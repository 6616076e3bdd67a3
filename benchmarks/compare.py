"""Parallel efficiency of comparisons: random walks on ``gait``, 32 runs of 5 seconds each.

``efficiency_two_workers``: seconds in this process over twice those with two workers, from the
call of ``compare`` to its table, including the start of processes. ``worker_import_seconds``,
``worker_problem_seconds``: start-up of a worker. ``seconds_beyond_half``: excess over half the
serial time, of which about 4 s are process starts and at most one run's time is idle at the end.
``slowdown_in_samplers``: seconds within samplers with two workers over those in one process, an
effect of the hardware. Run on two idle cores.
"""

from __future__ import annotations

import os

for threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[threads] = "1"

import argparse
import subprocess
import sys
import time

from probmotion.comparison import compare
from probmotion.samplers import MetropolisHastings

_START = """
import time
start = time.perf_counter()
import probmotion.comparison.run.processes, probmotion.comparison.run.grid_runs, probmotion.metrics
from probmotion.problems import load_problem
import probmotion.samplers.mcmc.metropolis
imported = time.perf_counter()
load_problem("gait")
print(imported - start, time.perf_counter() - imported)
"""


def seconds(workers: int, runs: int, thin: int) -> tuple[float, float]:
    """Return the duration of a comparison and the time spent within samplers."""
    sampler = MetropolisHastings(warmup=1000, thin=thin)
    start = time.perf_counter()
    comparison = compare(
        "gait", sampler, draws=40, chains=4, seeds=runs, workers=workers, progress=False
    )
    duration = time.perf_counter() - start
    if len(comparison.results) != runs or comparison.failures:
        raise SystemExit(f"all {runs} runs must finish, got {len(comparison.failures)} failures")
    return duration, sum(run.metrics["seconds"] for run in comparison.results)


def main() -> None:
    """Print the measurements."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=32, help="Number of runs; default: 32.")
    parser.add_argument("--run-seconds", type=float, default=5.0, help="Duration of a run, s.")
    options = parser.parse_args()
    # Warm-up: import all modules and build the problem before timing.
    thin = 2000
    seconds(0, runs=1, thin=thin)
    _, run_seconds = seconds(0, runs=1, thin=thin)
    thin = max(1, round(thin * options.run_seconds / run_seconds))
    start = subprocess.check_output([sys.executable, "-c", _START], text=True).split()
    print(f"worker_import_seconds: {float(start[0]):.2f}")
    print(f"worker_problem_seconds: {float(start[1]):.2f}")
    serial, serial_in_samplers = seconds(0, options.runs, thin)
    parallel, parallel_in_samplers = seconds(2, options.runs, thin)
    print(f"seconds_in_one_process: {serial:.2f}")
    print(f"seconds_two_workers: {parallel:.2f}")
    print(f"seconds_beyond_half: {parallel - serial / 2:.2f}")
    print(f"slowdown_in_samplers: {parallel_in_samplers / serial_in_samplers:.3f}")
    print(f"efficiency_two_workers: {serial / (2 * parallel):.3f}")


if __name__ == "__main__":
    main()
