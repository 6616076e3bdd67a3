"""Cost of writing draws to a folder as they come.

``stream_overhead_<sampler>``: processor time of a streamed run relative to that of the same run in
memory, the smallest of five alternating runs each, without imports. ``stream_peak_gib``: peak
memory of a process that streams 10⁶ draws of a chain in 150 dimensions, reads 20 000 of them and
computes R-hat.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass

import numpy as np

import probmotion as pm
from probmotion.metrics.chains import chain_diagnostics

SAMPLERS = {
    "mh": (pm.samplers.MetropolisHastings(), 1_500),
    "nuts": (pm.samplers.NUTS(), 4_000),
    "ancestral3d": (pm.samplers.Ancestral3D(), 100),
}


@dataclass(frozen=True, eq=False)
class Standard:
    """Standard normal prior of a motion with 10 frames of 5 joints: 150 dimensions."""

    skeleton = pm.Skeleton(["pelvis", "a", "b", "c", "d"], [-1, 0, 1, 2, 3])
    frames, fps, dim = 10, 30.0, 150

    def motion(self, theta: np.ndarray) -> np.ndarray:
        """Return θ as positions: ``(…, 150) → (…, 10, 5, 3)``."""
        return theta.reshape(*theta.shape[:-1], 10, 5, 3)

    def log_density(self, theta: np.ndarray) -> np.ndarray:
        """Return the log density up to a constant."""
        return -0.5 * (theta**2).sum(axis=-1)

    def initial(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Return n draws."""
        return rng.standard_normal((n, 150))


def overhead(name: str) -> float:
    """Return the relative processor time of streaming on ``gait-monocular``."""
    sampler, draws = SAMPLERS[name]
    posterior = pm.problem("gait-monocular").posterior
    options = {"draws": draws, "chains": 4, "progress": False}
    sampler.sample(posterior, **options)  # compiles
    memory, streamed = [], []
    for _ in range(5):
        start = time.process_time()
        sampler.sample(posterior, **options)
        middle = time.process_time()
        with tempfile.TemporaryDirectory() as folder:
            pm.sample(posterior, sampler, draws=4 * draws, chains=4, stream=folder, progress=False)
        memory.append(middle - start)
        streamed.append(time.process_time() - middle)
    return min(streamed) / min(memory)


def stream_many() -> None:
    """Stream 10⁶ draws; print the peak memory of the process."""
    sampler = pm.samplers.MetropolisHastings(warmup=100, thin=1)
    posterior = pm.MotionPosterior(Standard())
    with tempfile.TemporaryDirectory() as folder:
        draws = pm.sample(posterior, sampler, draws=10**6, chains=50, stream=folder, progress=False)
        thinned = draws.dataset.isel(draw=slice(None, None, 50))
        print(f"stream_draws: {draws.positions.sizes['draw'] * 50}")
        print(f"stream_rhat: {chain_diagnostics(pm.MotionDraws(thinned))['rhat']:.3f}")
    print(f"stream_peak_gib: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f}")


if __name__ == "__main__":
    if "--many" in sys.argv:
        stream_many()
    else:
        for name in SAMPLERS:
            print(f"stream_overhead_{name}: {overhead(name):.3f}", flush=True)
        subprocess.run([sys.executable, __file__, "--many"], check=True)
