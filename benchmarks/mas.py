"""Cost of MAS with a network of the published size: V = 5, L = 180, J = 16, 100 steps.

Perspective views, one motion, untrained weights. ``outside_network_share``: fraction of the time
outside the network's forward passes, with DDPM steps; ``outside_network_share_NAME`` with the other
integrators, 20 steps. ``network_gflops_share``: its floating-point rate over that
of a large float32 matrix product in the same run, on the same threads. ``memory_gib``: peak
memory of a separate process. ``strided_20_fid_ratio``: FID with 20 steps over that with 100,
prior walk2d, 256 motions each; ``strided_20_fid_gap``: their difference over the standard
deviation of ten repeats. ``split_gibbs_evaluations_per_draw``: evaluations of the 2D denoiser by
``split-gibbs`` on gait-monocular. With CUDA also motions per second, 64 at a time.
"""

from __future__ import annotations

import os

THREADS = os.environ.setdefault("OMP_NUM_THREADS", "1")
for threads in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[threads] = THREADS

import resource
import statistics
import subprocess
import sys
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch.utils.flop_counter import FlopCounterMode

from probmotion import MotionPosterior
from probmotion.models.diffusion.motion_diffusion import MotionDiffusion
from probmotion.models.diffusion.settings import DiffusionSettings
from probmotion.models.training.standardisation import Standards
from probmotion.motion.skeleton import Skeleton
from probmotion.problems import load_problem
from probmotion.samplers import MultiViewAncestral, SplitGibbs
from probmotion.samplers.diffusion.integrators import (
    DDIM,
    DDPM,
    AnyIntegrator,
    Heun,
    SecondOrderSDE,
)
from probmotion.samplers.diffusion.noise_levels import Cosine

FRAMES, JOINTS, VIEWS = 180, 16, 5
PUBLISHED = DDPM()
OTHERS = DDIM(), SecondOrderSDE(), Heun()


def paper_prior(device: str = "cpu") -> tuple[MotionDiffusion, torch.nn.Module]:
    """Return a prior of the published size with untrained weights, and its network."""
    size = DiffusionSettings.paper(FRAMES)
    rng = np.random.default_rng(0)
    standards = Standards(0.2 * rng.normal(size=(JOINTS, 2)), np.full((JOINTS, 2), 0.2))
    skeleton = Skeleton([f"joint-{j}" for j in range(JOINTS)], [-1] + [0] * (JOINTS - 1))
    network = size.network(JOINTS)
    prior = MotionDiffusion(network, size, standards, skeleton, 20.0, device=device)
    return prior, network


@dataclass
class Timer:
    """Seconds inside the network's forward passes."""

    device: str
    seconds: list[float] = field(default_factory=list)
    start: float = 0.0

    def attach(self, network: torch.nn.Module) -> None:
        """Time every subsequent forward pass."""
        network.register_forward_pre_hook(self._begin)
        network.register_forward_hook(self._end)

    def _begin(self, *_: Any) -> None:
        self.start = self._now()

    def _end(self, *_: Any) -> None:
        self.seconds.append(self._now() - self.start)

    def _now(self) -> float:
        if self.device == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter()


def run(
    prior: MotionDiffusion, draws: int, steps: int = 100, integrator: AnyIntegrator = PUBLISHED
) -> float:
    """Return the duration of MAS in seconds."""
    sampler = MultiViewAncestral(
        steps=steps, n_views=VIEWS, perspective=True, integrator=integrator
    )
    start = time.perf_counter()
    sampler.sample(MotionPosterior(prior), draws=draws, progress=False)
    return time.perf_counter() - start


def matmul_gflops(n: int = 2048, repeats: int = 15) -> float:
    """Return the median rate of products of n × n float32 matrices, in gigaflops."""
    a, b = torch.randn(n, n), torch.randn(n, n)
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        torch.mm(a, b)
        seconds.append(time.perf_counter() - start)
    return 2 * n**3 / statistics.median(seconds) / 1e9


def network_gflop(network: torch.nn.Module) -> float:
    """Return the number of floating-point operations of one step with V views, in 10⁹."""
    motions, levels = torch.zeros(VIEWS, FRAMES, 2 * JOINTS), torch.zeros(VIEWS)
    counter = FlopCounterMode(display=False)
    # The counter does not support PyTorch's fused encoder layer.
    torch.backends.mha.set_fastpath_enabled(False)
    try:
        with counter, torch.no_grad():
            network(motions, levels)
    finally:
        torch.backends.mha.set_fastpath_enabled(True)
    return float(counter.get_total_flops()) / 1e9


def on_cpu(steps: int = 100) -> dict[str, float]:
    """Return the measurements for one motion on the CPU."""
    prior, network = paper_prior()
    timer = Timer("cpu")
    timer.attach(network)
    run(prior, draws=1, steps=2)
    gflop = network_gflop(network)
    timer.seconds.clear()
    before = matmul_gflops()
    seconds = run(prior, draws=1, steps=steps)
    rate = (before + matmul_gflops()) / 2
    # Medians are robust to temporary load from other processes.
    measurements = {
        "outside_network_share": 1 - sum(timer.seconds) / seconds,
        "network_gflops_share": gflop / statistics.median(timer.seconds) / rate,
        "step_milliseconds": 1000 * seconds / steps,
        "network_gflop_per_step": gflop,
        "matmul_gflops": rate,
    }
    for integrator in OTHERS:
        timer.seconds.clear()
        seconds = run(prior, draws=1, steps=20, integrator=integrator)
        name = f"outside_network_share_{integrator.kind.replace('-', '_')}"
        measurements[name] = 1 - sum(timer.seconds) / seconds
    return measurements


def split_gibbs_evaluations() -> int:
    """Return the number of evaluations of a 2D denoiser for one draw of split Gibbs."""
    posterior = load_problem("gait-monocular").posterior
    drawn = SplitGibbs(denoiser="2d").sample(posterior, draws=1, progress=False)
    return drawn.counts["denoiser"]


def on_cuda() -> dict[str, float]:
    """Return the measurements for one motion and for 64 motions on a GPU."""
    prior, network = paper_prior("cuda")
    run(prior, draws=1, steps=10)
    single = run(prior, draws=1)
    run(prior, draws=64, steps=10)
    batch = run(prior, draws=64)
    # Synchronising at every forward pass would increase the durations above.
    timer = Timer("cuda")
    timer.attach(network)
    seconds = run(prior, draws=64)
    return {
        "cuda_seconds_one_motion": single,
        "cuda_motions_per_second": 64 / batch,
        "cuda_network_share": sum(timer.seconds) / seconds,
        "cuda_memory_gib": torch.cuda.max_memory_allocated() / 2**30,
    }


def strided(draws: int = 256) -> dict[str, float]:
    """Return the FID of 20 of the 100 trained levels relative to that of all levels."""
    problem = load_problem("walk2d")
    assert problem.generation is not None
    # Compare with training clips; FID to held-out clips is too large to depend on the steps.
    reference = problem.generation.of_learnt()
    fid, seconds = {}, {}
    for steps in (20, 100):
        sampler = MultiViewAncestral(
            steps=steps, levels=Cosine(trained_steps=100), perspective=True
        )
        start = time.perf_counter()
        motions = sampler.sample(problem.posterior, draws=draws, progress=False).flat()
        seconds[steps] = time.perf_counter() - start
        scores = reference.score_motions(motions, seed=0, samples=draws // 2)
        fid[steps] = scores["fid"]
    (fid_20, sd_20), (fid_100, sd_100) = fid[20], fid[100]
    return {
        "fid_20_steps": fid_20,
        "fid_100_steps": fid_100,
        "strided_20_fid_ratio": fid_20 / fid_100,
        "strided_20_fid_gap": (fid_20 - fid_100) / max(sd_20, sd_100),
        "strided_20_seconds_ratio": seconds[20] / seconds[100],
    }


def peak_memory() -> float:
    """Return the peak memory of this process after a few steps of one motion, GiB."""
    run(paper_prior()[0], draws=1, steps=5)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def main() -> None:
    """Print the measurements."""
    measurements = on_cpu()
    # Use a new process, so that the peak memory is that of MAS alone.
    process = subprocess.run(
        [sys.executable, __file__, "--memory"], check=True, capture_output=True, text=True
    )
    measurements["memory_gib"] = float(process.stdout)
    measurements["split_gibbs_evaluations_per_draw"] = split_gibbs_evaluations()
    measurements |= strided()
    if torch.cuda.is_available():
        measurements |= on_cuda()
    for name, value in measurements.items():
        print(f"{name}: {value:.4g}")


if __name__ == "__main__":
    torch.set_num_threads(int(THREADS))
    if sys.argv[1:] == ["--memory"]:
        print(peak_memory())
    else:
        main()
