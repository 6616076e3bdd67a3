"""How fast the motion VAE generates and learns, at the published size on the CPU: ``name: value``.

Weights are fresh: what is computed does not depend on them. A training step is one of the second
phase, in mixed precision as the settings say; the pose network's answer is given.
"""

from __future__ import annotations

import os

os.environ["OMP_NUM_THREADS"] = "2"

import resource
import sys
import time
from collections.abc import Callable

import numpy as np
import torch

from probmotion.models.articulated_body import ArticulatedBody
from probmotion.models.motion_vae_losses import reconstruction, roughness
from probmotion.models.motion_vae_network import MotionVAENetwork
from probmotion.models.motion_vae_settings import MotionVAESettings
from probmotion.models.variational_terms import gaussian_kl
from probmotion.skeleton import Skeleton

BONES, SEQUENCES, BATCH = 20, 1_400, 64


def main() -> None:
    """Print every measurement."""
    torch.set_num_threads(2)
    body, settings = made_body(), MotionVAESettings.paper()
    network = MotionVAENetwork(settings, body.skeleton.n_joints, len(body.bones))
    report("generation_seconds", fastest(lambda: generate(network.eval(), body), 1))
    report("training_step_seconds", fastest(training(network.train(), body), 8))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    report("memory_gib", peak / (2**30 if sys.platform == "darwin" else 2**20))


def made_body() -> ArticulatedBody:
    """Return a body of 20 bones that turn, one after the other."""
    n_joints = BONES + 2
    names = ["root", *(f"joint {number}" for number in range(1, n_joints))]
    rest = np.tile([0.0, 0.1, 0.0], (n_joints, 1))
    return ArticulatedBody(Skeleton(names, range(-1, n_joints - 1)), rest)


@torch.no_grad()
def generate(network: MotionVAENetwork, body: ArticulatedBody) -> torch.Tensor:
    """Return joints of drawn motions, (1 400, 10, J, 3)."""
    latents = torch.randn(
        SEQUENCES, network.settings.latent, generator=torch.Generator().manual_seed(0)
    )
    still, here = torch.eye(3), torch.zeros(3)
    frames = network.settings.frames
    found = [
        body.positions(network.decode(some), still.expand(frames, 3, 3), here.expand(frames, 3))
        for some in latents.split(BATCH)
    ]
    return torch.cat(found)


def training(network: MotionVAENetwork, body: ArticulatedBody) -> Callable[[], None]:
    """Return a step of the second phase on one made batch."""
    settings, generator = network.settings, torch.Generator().manual_seed(0)
    shape = (BATCH, settings.frames, body.skeleton.n_joints)
    keypoints = torch.randn(*shape, 2, generator=generator)
    seen = torch.ones(shape)
    rest = torch.as_tensor(body.rest_positions, dtype=torch.float32)
    taught = 0.1 * torch.randn(*shape[:2], BONES, 3, generator=generator)
    rotation, translation = torch.eye(3).expand(*shape[:2], 3, 3), torch.zeros(*shape[:2], 3)
    optimiser = torch.optim.AdamW(network.parameters(), lr=1e-4)

    def step() -> None:
        mean, log_variance = network.encode(keypoints, seen, rest)
        noise = torch.randn(mean.shape, generator=generator)
        turns = network.decode(mean + (0.5 * log_variance).exp() * noise)
        positions = body.positions(turns, rotation, translation)
        zero = torch.zeros_like(mean)
        loss = (
            settings.reconstruction * reconstruction(positions, keypoints, seen, None)
            + settings.smoothness * roughness(turns, rotation, translation)
            + settings.ranges * body.range_excess(turns).sum(dim=-1)
            + settings.kl * gaussian_kl(mean, 0.5 * log_variance, zero, zero)
            + settings.teacher * (turns - taught).square().sum(dim=(-3, -2, -1))
        ).mean()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()

    return step


def fastest(work: Callable[[], object], times: int) -> float:
    """Return the least seconds of several runs, after one that warms up."""
    work()
    seconds = []
    for _ in range(times):
        begun = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - begun)
    return min(seconds)


def report(name: str, value: float) -> None:
    """Print one measurement."""
    print(f"{name}: {value:.4g}", flush=True)


if __name__ == "__main__":
    main()
