"""Training of a 2D motion diffusion model on 2D tracks (MAS, sections 4.1 and 6.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import nn

from probmotion.models.diffusion.motion_diffusion import KIND
from probmotion.models.diffusion.settings import DiffusionSettings
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.track_batches import TrackBatches
from probmotion.models.training.track_trainee import TrackTrainee
from probmotion.motion.motion import KeypointTrack

__all__ = ["DiffusionTrainee", "usual_training"]


class DiffusionTrainee(TrackTrainee):
    """Trainee of a motion diffusion model.

    The loss is the mean squared error of the estimate of x₀ (not of ε), in standardised units, over
    visible joints, at random levels t ~ U{1..T}. Parameters are those of
    :class:`~probmotion.models.training.track_trainee.TrackTrainee`.
    Every joint must be visible somewhere in ``tracks``.
    """

    kind = KIND
    size: DiffusionSettings

    def __init__(
        self,
        tracks: Sequence[KeypointTrack],
        validation: Sequence[KeypointTrack],
        size: DiffusionSettings,
        *,
        seed: int = 0,
        **options: Any,
    ) -> None:
        super().__init__(tracks, validation, size, seed=seed, **options)
        self.batches.check_all_seen()
        self.network = size.network(self.batches.skeleton.n_joints, seed)
        self._alpha_bar = torch.tensor(size.schedule.alpha_bar, dtype=torch.float32)

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
        # Occluded joints are set to their mean: they have no loss, but attention reads them.
        shown = np.where(drawn.seen[..., None], drawn.keypoints, self.standards.mean)
        clean = moved((shown / scale).astype(np.float32))
        alpha_bar = self._alpha_bar.to(device)[moved(levels)][:, None, None, None]
        noisy = alpha_bar.sqrt() * clean + (1 - alpha_bar).sqrt() * moved(noise)
        # Standardise by the variance at each level, so that inputs have unit variance.
        spread = torch.sqrt(alpha_bar * deviation**2 + (1 - alpha_bar))
        entered = (noisy - alpha_bar.sqrt() * mean) / spread
        estimate = network(entered.flatten(2), moved(levels), moved(drawn.valid))
        estimate = estimate.unflatten(2, (-1, 2))
        moves = deviation > 0
        wanted = (clean - mean) / torch.where(moves, deviation, 1.0)
        weight = moved(drawn.seen)[..., None] * moves
        return (weight * (estimate.float() - wanted) ** 2).sum() / weight.sum().clamp(min=1)


def usual_training(size: str) -> TrainingSettings:
    """Return the training settings of ``tiny``, ``small``, ``paper`` or ``reference-code``.

    The paper states "Adam, 0.1 lr", with which training diverges; ``paper`` is AdamW at 1e-4 with a
    moving average and clipping. ``reference-code`` follows the authors' released code.
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
