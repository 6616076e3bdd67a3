"""Overhead of MAS over its denoiser, in time and memory: L = 30, J = 17, 108 components, V = 5.

``mas_denoiser_share``: fraction of the time inside the exact prior's ``denoise``;
``mas_1000_draws_gib``: growth of peak memory during 1000 draws in one batch. One thread.
"""

from __future__ import annotations

import os

for threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[threads] = "1"

import resource
import subprocess
import sys
import time
from typing import Any

from probmotion import Cameras, MotionPosterior
from probmotion.data.synthetic.gaits import make_gaits
from probmotion.models import GaussianMixtureMotion
from probmotion.samplers import MultiViewAncestral


def gait_prior() -> GaussianMixtureMotion:
    """Return the exact prior over procedural gaits."""
    clips = make_gaits(300, styles={"walk": 0.5, "run": 0.3, "march": 0.2})
    labels = [clip.name.rpartition("-")[0] for clip in clips]
    return GaussianMixtureMotion.fit(clips, frames=30, rank=10, styles=labels)


class TimedPrior:
    """Wrapper of a prior that measures the time within its 2D denoiser."""

    def __init__(self, prior: GaussianMixtureMotion) -> None:
        self.prior = prior
        self.seconds = 0.0

    def __getattr__(self, name: str) -> Any:
        return getattr(self.prior, name)

    def denoise(self, x_t: Any, alpha_bar: float, cameras: Cameras) -> Any:
        """Call the denoiser of the prior and add its duration."""
        start = time.perf_counter()
        clean = self.prior.denoise(x_t, alpha_bar, cameras)
        self.seconds += time.perf_counter() - start
        return clean


def denoiser_share(prior: GaussianMixtureMotion, draws: int = 256) -> float:
    """Return the fraction of the duration of MAS spent in the denoiser."""
    timed = TimedPrior(prior)
    posterior = MotionPosterior(timed)  # type: ignore[arg-type]
    sampler = MultiViewAncestral()
    sampler.sample(posterior, draws=2, progress=False)
    timed.seconds = 0.0
    start = time.perf_counter()
    sampler.sample(posterior, draws=draws, progress=False)
    return timed.seconds / (time.perf_counter() - start)


def memory_growth(draws: int = 1000) -> float:
    """Return the growth of peak memory during a run of ``draws`` draws, in GiB."""
    posterior = MotionPosterior(gait_prior())
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    MultiViewAncestral(batch=draws).sample(posterior, draws=draws, progress=False)
    return (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 2**20


def main() -> None:
    """Print the measurements."""
    print(f"mas_denoiser_share: {denoiser_share(gait_prior()):.3f}")
    # Use a new process, so that the peak memory is that of MAS alone.
    process = subprocess.run(
        [sys.executable, __file__, "--growth"], check=True, capture_output=True, text=True
    )
    print(f"mas_1000_draws_gib: {float(process.stdout):.3f}")


if __name__ == "__main__":
    if sys.argv[1:] == ["--growth"]:
        print(memory_growth())
    else:
        main()
