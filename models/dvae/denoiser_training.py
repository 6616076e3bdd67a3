"""Learning to denoise without clean motion (B, C, E.2): the loss is of noisy joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from torch import nn

from probmotion import seeds
from probmotion.models.bodies.body_states import Placement
from probmotion.models.dvae.inference import Denoiser, DenoisingNetworks
from probmotion.models.dvae.joint_noise import JointNoise
from probmotion.models.dvae.motion_denoiser import KIND
from probmotion.models.dvae.motion_dvae import MotionDVAE
from probmotion.models.dvae.motion_windows import MotionWindows, Windows
from probmotion.models.dvae.noisy_windows import NoisyWindows
from probmotion.models.training.checkpoints import weights_digest
from probmotion.models.training.settings import TrainingSettings
from probmotion.motion.motion import Motion

__all__ = ["DenoiserTrainee", "usual_denoiser_training"]

_VALIDATION_BATCH = 256


class DenoiserTrainee:
    """What :func:`~probmotion.models.training.trainer.train` needs to learn to denoise.

    The loss is minus the evidence lower bound of noisy joints, per frame. Clips make the noisy
    joints and tell whose bones they are (the design's β, which is not inferred); their motion is
    not looked at again. The prior stays as it is.

    Parameters
    ----------
    clips : sequence of Motion
        Motion of the prior's skeleton and frame rate, metres.
    validation : sequence of Motion
        Clips that are not among them.
    prior : MotionDVAE
        What motion is like.
    noise : JointNoise
        What recordings are like.
    latent_weight : float
        Weight of the motion prior; 0 leaves it out (the ablation "no prior").
    annealing : int
        Steps over which the weight of the motion prior rises.
    seed : int
        Of the first weights and the validation's noise.
    """

    kind = KIND

    def __init__(
        self,
        clips: Sequence[Motion],
        validation: Sequence[Motion],
        prior: MotionDVAE,
        *,
        noise: JointNoise | None = None,
        latent_weight: float = 1.0,
        annealing: int = 0,
        seed: int = 0,
    ) -> None:
        frames = prior.settings.frames
        self.prior = prior
        self.noise = JointNoise() if noise is None else noise
        self.latent_weight = latent_weight
        self.annealing = annealing
        self.windows = MotionWindows(clips, prior.states, frames)
        self.held_out = MotionWindows(validation, prior.states, frames)
        self.network = DenoisingNetworks(prior, seed)
        self._seed = seed
        self._weight = latent_weight
        self.settings: Mapping[str, Any] = {
            "prior": dict(prior.card["network"]),
            "prior_weights": weights_digest(prior.model),
            "noise": asdict(self.noise),
            "latent_weight": latent_weight,
            "annealing": annealing,
            "clips": sorted(clip.name for clip in clips),
            "validation_clips": sorted(clip.name for clip in validation),
        }

    def anneal(self, step: int) -> None:
        """Set the weight of the motion prior at a step."""
        risen = min(1.0, step / self.annealing) if self.annealing else 1.0
        self._weight = self.latent_weight * risen

    def training_loss(
        self, network: nn.Module, rng: np.random.Generator, batch: int, device: torch.device
    ) -> torch.Tensor:
        """Return the loss of fresh noisy windows."""
        return self._loss(network, self.windows.draw(rng, batch), rng, self._weight, device)

    def validation_loss(self, network: nn.Module, device: torch.device) -> float:
        """Return the loss on held-out windows with noise that never changes."""
        rng = seeds.generator(self._seed, "validation")
        windows = self.held_out.spread(_VALIDATION_BATCH)
        return float(self._loss(network, windows, rng, self.latent_weight, device))

    def _loss(
        self,
        network: nn.Module,
        windows: Windows,
        rng: np.random.Generator,
        weight: float,
        device: torch.device,
    ) -> torch.Tensor:
        assert isinstance(network, DenoisingNetworks)
        skeleton = self.prior.skeleton
        clean = self.prior.states.positions(windows.states, windows.bodies)
        # Anywhere, looking anywhere: else a network would know where it looks that cannot be seen.
        heading = rng.uniform(-np.pi, np.pi, len(clean))
        ground = rng.normal(0.0, self.prior.spread, (len(clean), 2))
        noisy = self.noise.apply(rng, Placement(heading, ground).to_world(clean), skeleton)
        evidence = NoisyWindows.of(*noisy, windows.bodies, skeleton).to(device)
        self.prior.model.to(device)
        denoiser = Denoiser(self.prior, network)
        numbers, shape = denoiser.noise_numbers(clean.shape[1])
        drawn = rng.standard_normal((len(clean), numbers), dtype=np.float32)
        further = rng.standard_normal((len(clean), *shape), dtype=np.float32)
        inferred = denoiser.infer(
            evidence,
            torch.as_tensor(drawn, device=device),
            torch.as_tensor(further, device=device),
        )
        bound = denoiser.bound(evidence, inferred, first=True)
        return -bound.total(weight).mean() / clean.shape[1]


def usual_denoiser_training(size: str) -> tuple[TrainingSettings, int]:
    """Return how a denoiser of a size is trained, and over how many steps KL is annealed.

    ``paper``: 500 epochs at most, until the validation loss has not fallen for 10 (E.2); an epoch,
    which there is of AMASS, is 1000 steps here.

    Raises
    ------
    ValueError
        If the size is unknown.
    """
    known = {
        "tiny": (TrainingSettings(steps=400, batch=32, learning_rate=3e-3, ema=0.98), 100),
        "small": (
            TrainingSettings(
                steps=6000, batch=32, learning_rate=1e-3, ema=0.998, halve_at=(3000, 4500, 5300)
            ),
            500,
        ),
        "paper": (
            TrainingSettings(
                steps=500_000,
                learning_rate=1e-4,
                optimiser="adamax",
                ema=0.0,
                checkpoint_every=1000,
                patience=10,
            ),
            50_000,
        ),
    }
    if size not in known:
        raise ValueError(f"size must be one of {', '.join(known)}, got {size!r}")
    return known[size]
