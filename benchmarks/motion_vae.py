"""Speed of motion VAE generation and training at the published size on the CPU.

Weights are untrained. Training steps are those of the second phase, in mixed precision.
``teacher_seconds_per_1000_frames``: duration of the pseudo-labels, computed before the first step.

``product_gigaflops``: rate of bfloat16 products of two matrices of 2048 rows.
``training_step_gigaflop``: operations of a step. ``training_step_share_of_products``: time of as
many operations at that rate, as a fraction of the duration of a step.
"""

from __future__ import annotations

import os

os.environ["OMP_NUM_THREADS"] = "2"

import resource
import sys
import time
import warnings
from collections.abc import Callable

import numpy as np
import torch
from torch.utils.flop_counter import FlopCounterMode

from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.models.vae.network import MotionVAENetwork
from probmotion.models.vae.pose_network import PoseNetwork
from probmotion.models.vae.settings import MotionVAESettings
from probmotion.models.vae.teacher_forcing import TeacherForcedPoses
from probmotion.models.vae.training import MotionVAETrainee
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton

BONES, SEQUENCES, BATCH = 20, 1_400, 64


def main() -> None:
    """Print every measurement."""
    torch.set_num_threads(2)
    body, settings = chain_body(), MotionVAESettings.paper()
    network = MotionVAENetwork(settings, body.skeleton.n_joints, len(body.bones))
    report("generation_seconds", fastest(lambda: generate(network.eval(), body), 1))
    step, seconds = training(body, settings)
    report("teacher_seconds_per_1000_frames", seconds)
    duration = fastest(step, 8)
    report("training_step_seconds", duration)
    with FlopCounterMode(display=False) as counter:
        step()
    operations, speed = counter.get_total_flops() / 1e9, product_gigaflops()
    report("product_gigaflops", speed)
    report("training_step_gigaflop", operations)
    report("training_step_share_of_products", operations / speed / duration)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    report("memory_gib", peak / (2**30 if sys.platform == "darwin" else 2**20))


def product_gigaflops(rows: int = 2048) -> float:
    """Return the rate of bfloat16 matrix products, gigaflops."""
    matrix = torch.randn(rows, rows, generator=torch.Generator().manual_seed(0)).bfloat16()
    return 2 * rows**3 / fastest(lambda: matrix @ matrix, 20) / 1e9


def chain_body() -> ArticulatedBody:
    """Return a chain of 20 bones; the rigid pose determines the first, 19 rotate."""
    n_joints = BONES + 1
    names = ["root", *(f"joint {number}" for number in range(1, n_joints))]
    rest = np.tile([0.0, 0.1, 0.0], (n_joints, 1))
    return ArticulatedBody(Skeleton(names, range(-1, n_joints - 1)), rest)


@torch.no_grad()
def generate(network: MotionVAENetwork, body: ArticulatedBody) -> torch.Tensor:
    """Return joint positions of drawn motions, (1400, 10, J, 3)."""
    latents = torch.randn(
        SEQUENCES, network.settings.latent, generator=torch.Generator().manual_seed(0)
    )
    rotation, origin = torch.eye(3), torch.zeros(3)
    frames = network.settings.frames
    rotation, origin = rotation.expand(frames, 3, 3), origin.expand(frames, 3)
    motions = [body.positions(network.decode(z), rotation, origin) for z in latents.split(BATCH)]
    return torch.cat(motions)


def training(
    body: ArticulatedBody, settings: MotionVAESettings
) -> tuple[Callable[[], None], float]:
    """Return a second-phase training step and the seconds of pseudo-labels per 1000 frames."""
    skeleton, rng = body.skeleton, np.random.default_rng(0)
    seen = np.ones((4 * settings.frames, skeleton.n_joints))
    tracks = []
    for n in range(8):
        keypoints = rng.normal(size=(*seen.shape, 2))
        keypoints[:, skeleton.roots[0]] = 0.0
        tracks.append(KeypointTrack(keypoints, seen, skeleton, 10.0, f"made-{n}"))
    teacher = PoseNetwork(settings, skeleton.n_joints, len(body.bones), body.n_groups)
    with warnings.catch_warnings():
        # Ignore the warning that the bones have no mirrored counterparts.
        warnings.simplefilter("ignore")
        trainee = MotionVAETrainee(tracks, tracks, settings, body, teacher)
    network = trainee.network.train()
    optimiser = torch.optim.AdamW(network.vae.parameters(), lr=1e-4, fused=True)

    def step() -> None:
        loss = trainee.training_loss(network, rng, BATCH, torch.device("cpu"))
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.vae.parameters(), 1.0)
        optimiser.step()

    start = time.perf_counter()
    rest = torch.as_tensor(body.rest_positions, dtype=torch.float32)
    TeacherForcedPoses(teacher, trainee.batches, rest)
    frames = len(trainee.batches.all_frames()[0])
    return step, 1000 * (time.perf_counter() - start) / frames


def fastest(work: Callable[[], object], times: int) -> float:
    """Return the minimum duration of several runs, after one warm-up run."""
    work()
    seconds = []
    for _ in range(times):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def report(name: str, value: float) -> None:
    """Print one measurement."""
    print(f"{name}: {value:.4g}", flush=True)


if __name__ == "__main__":
    main()
