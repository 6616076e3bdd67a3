"""Training of the motion denoiser on noisy joints only (Motion-DVAE, appendices B, C and E.2)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from probmotion.extras import nn, torch
from probmotion.models.bodies.body_states import to_world
from probmotion.models.dvae.inference import Denoiser, DenoisingNetworks
from probmotion.models.dvae.joint_noise import JointNoise
from probmotion.models.dvae.motion_denoiser import KIND
from probmotion.models.dvae.motion_dvae import MotionDVAE
from probmotion.models.dvae.motion_windows import Windows, WindowTrainee
from probmotion.models.dvae.noisy_windows import NoisyWindows
from probmotion.models.training.checkpoints import weights_digest
from probmotion.models.training.settings import TrainingSettings
from probmotion.motion.motion import Motion

__all__ = ["DenoiserTrainee", "usual_denoiser_training"]


class DenoiserTrainee(WindowTrainee):
    """Trainee of a motion denoiser for :func:`~probmotion.models.training.trainer.train`.

    The loss is the negative evidence lower bound of noisy joints per frame. Clips provide only
    the simulated noisy joints and the bone lengths β, which are not inferred. The prior is fixed.

    Parameters
    ----------
    clips : sequence of Motion
        Clips with the prior's skeleton and frame rate, metres.
    validation : sequence of Motion
        Held-out clips.
    prior : MotionDVAE
        Trained motion prior.
    noise : JointNoise
        Corruption model.
    latent_weight : float
        Weight of the KL term of the latents; 0 for the ablation without a motion prior.
    annealing : int
        Number of steps over which ``latent_weight`` rises from 0.
    seed : int
        Seed of the initial weights and the validation noise.
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
        states, frames = prior.states, prior.settings.frames
        super().__init__(clips, validation, states, frames, latent_weight, annealing, seed)
        self.prior = prior
        self.noise = JointNoise() if noise is None else noise
        self.network = DenoisingNetworks(prior, seed)
        self.settings: Mapping[str, Any] = {
            "prior": dict(prior.card["network"]),
            "prior_weights": weights_digest(prior.model),
            "noise": asdict(self.noise),
            "latent_weight": latent_weight,
            "annealing": annealing,
            "clips": sorted(clip.name for clip in clips),
            "validation_clips": sorted(clip.name for clip in validation),
        }

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
        # Random placement keeps the network from learning the canonical heading and position.
        heading = rng.uniform(-np.pi, np.pi, len(clean))
        ground = rng.normal(0.0, self.prior.spread, (len(clean), 2))
        noisy = self.noise.apply(rng, to_world(clean, heading, ground), skeleton)
        noisy_windows = NoisyWindows.of(*noisy, windows.bodies, skeleton).to(device)
        self.prior.model.to(device)
        denoiser = Denoiser(self.prior, network)
        first, shape = denoiser.noise_numbers(clean.shape[1])
        numbers = (
            torch.as_tensor(rng.standard_normal((len(clean), *size), dtype=np.float32))
            for size in ((first,), shape)
        )
        inferred = denoiser.infer(noisy_windows, *(part.to(device) for part in numbers))
        bound = denoiser.bound(noisy_windows, inferred, first=True)
        return -bound.total(weight).mean() / clean.shape[1]


def usual_denoiser_training(size: str) -> tuple[TrainingSettings, int]:
    """Return the training settings of a size and the number of its KL annealing steps.

    ``paper``: up to 500 epochs with a patience of 10 (E.2); an epoch is 1000 steps here.
    Raises ``ValueError`` for an unknown size.
    """
    tiny = TrainingSettings(steps=400, batch=32, learning_rate=3e-3, ema=0.98)
    small = replace(tiny, steps=6000, learning_rate=1e-3, ema=0.998, halve_at=(3000, 4500, 5300))
    paper = TrainingSettings(steps=500_000, learning_rate=1e-4, optimiser="adamax", ema=0.0)
    paper = replace(paper, checkpoint_every=1000, patience=10)
    known = {"tiny": (tiny, 100), "small": (small, 500), "paper": (paper, 50_000)}
    if size not in known:
        raise ValueError(f"size must be one of {', '.join(known)}, got {size!r}")
    return known[size]
