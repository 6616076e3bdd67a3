"""Learning a 2D motion diffusion model from 2D tracks (MAS, sections 4.1 and 6.2)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from torch import nn

from probmotion import seeds
from probmotion.models.diffusion.motion_diffusion import KIND
from probmotion.models.diffusion.settings import DiffusionSettings
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.track_batches import (
    Augmentation,
    TrackBatches,
    learning_and_held_out,
)
from probmotion.motion.motion import KeypointTrack

__all__ = ["DiffusionTrainee", "usual_training"]

_VALIDATION_BATCH = 256


class DiffusionTrainee:
    """What :func:`~probmotion.models.training.trainer.train` needs to learn a motion diffusion
    model.

    The loss is the mean squared error of the estimate of x₀ (not of ε), in standardised units,
    over frames that are there and joints whose confidence is not below the threshold.

    Parameters
    ----------
    tracks : sequence of KeypointTrack
        Prepared: metres, centred, of one skeleton and frame rate.
    validation : sequence of KeypointTrack
        Of clips that are not among those of ``tracks``.
    size : DiffusionSettings
        The network's.
    threshold : float
        Least confidence of a joint that is learnt from: .3 for people, .5 for horses, .01 with a
        ball (design of the data sets, section 6.1).
    augmentation : Augmentation
        How tracks are varied.
    seed : int
        Of the first weights and the validation batch.

    Raises
    ------
    ValueError
        If there is no track, they differ in skeleton or frame rate, none has a confident joint, or
        ``tracks`` never shows one of the joints: nothing would say where it is.
    """

    kind = KIND

    def __init__(
        self,
        tracks: Sequence[KeypointTrack],
        validation: Sequence[KeypointTrack],
        size: DiffusionSettings,
        *,
        threshold: float = 0.3,
        augmentation: Augmentation | None = None,
        seed: int = 0,
    ) -> None:
        varied = Augmentation() if augmentation is None else augmentation
        self.size = size
        self.batches, self.held_out = learning_and_held_out(
            tracks, validation, size.frames, threshold, varied
        )
        self.batches.check_all_seen()
        skeleton = self.batches.skeleton
        self.standards = self.batches.standards
        self.network = size.network(skeleton.n_joints, seed)
        self._seed = seed
        self._alpha_bar = torch.tensor(size.schedule.alpha_bar, dtype=torch.float32)
        self.settings: Mapping[str, Any] = {
            "size": asdict(size),
            "joint_names": list(skeleton.joint_names),
            "parents": list(skeleton.parents),
            "fps": self.batches.fps,
            "mean": self.standards.mean.tolist(),
            "deviation": self.standards.deviation.tolist(),
            "threshold": threshold,
            "augmentation": asdict(varied),
            "data": self.batches.description,
            "validation_data": self.held_out.description,
        }

    def training_loss(
        self, network: nn.Module, rng: np.random.Generator, batch: int, device: torch.device
    ) -> torch.Tensor:
        """Return the loss of a fresh batch at random levels t ~ U{1..T}."""
        return self._loss(network, self.batches, rng, batch, device)

    def validation_loss(self, network: nn.Module, device: torch.device) -> float:
        """Return the loss on held-out tracks at levels and noise that never change."""
        rng = seeds.generator(self._seed, "validation")
        return float(self._loss(network, self.held_out, rng, _VALIDATION_BATCH, device))

    def _loss(
        self,
        network: nn.Module,
        batches: TrackBatches,
        rng: np.random.Generator,
        n: int,
        device: torch.device,
    ) -> torch.Tensor:
        drawn = batches.draw(rng, n)
        levels = rng.integers(1, self.size.steps + 1, n)
        noise = rng.standard_normal(drawn.keypoints.shape, dtype=np.float32)

        def moved(values: np.ndarray) -> torch.Tensor:
            return torch.as_tensor(values, device=device)

        scale = self.standards.scale
        mean = moved((self.standards.mean / scale).astype(np.float32))
        deviation = moved((self.standards.deviation / scale).astype(np.float32))
        # What is not seen stands at its mean: nothing is learnt there, but attention looks at it.
        shown = np.where(drawn.seen[..., None], drawn.keypoints, self.standards.mean)
        clean = moved((shown / scale).astype(np.float32))
        alpha_bar = self._alpha_bar.to(device)[moved(levels)][:, None, None, None]
        noisy = alpha_bar.sqrt() * clean + (1 - alpha_bar).sqrt() * moved(noise)
        # Standardised by the variance that the level has, so that every level is of unit size.
        spread = torch.sqrt(alpha_bar * deviation**2 + (1 - alpha_bar))
        entered = (noisy - alpha_bar.sqrt() * mean) / spread
        found = network(entered.flatten(2), moved(levels), moved(drawn.valid)).unflatten(2, (-1, 2))
        moves = deviation > 0
        wanted = (clean - mean) / torch.where(moves, deviation, 1.0)
        weight = moved(drawn.seen)[..., None] * moves
        return (weight * (found.float() - wanted) ** 2).sum() / weight.sum().clamp(min=1)


def usual_training(size: str) -> TrainingSettings:
    """Return how a size is trained: ``tiny``, ``small``, ``paper`` or ``reference-code``.

    The paper prints "Adam, 0.1 lr", with which training diverges; ``paper`` is AdamW at 1e-4 with
    a moving average and clipping. ``reference-code`` is what the authors' released code does.

    Raises
    ------
    ValueError
        If the size is unknown.
    """
    known = {
        "tiny": TrainingSettings(steps=1000, learning_rate=2e-3, ema=0.99),
        "small": TrainingSettings(steps=12_000, learning_rate=1e-3),
        "paper": TrainingSettings(steps=600_000, learning_rate=1e-4, warmup=1000),
        "reference-code": TrainingSettings(
            steps=600_000, batch=32, learning_rate=1e-5, warmup=0, ema=0.0, clip=math.inf
        ),
    }
    if size not in known:
        raise ValueError(f"size must be one of {', '.join(known)}, got {size!r}")
    return known[size]
