"""Training of a 2D motion diffusion model on 2D tracks (MAS, sections 4.1 and 6.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from probmotion.extras import nn, torch
from probmotion.models.diffusion.motion_diffusion import KIND
from probmotion.models.diffusion.settings import DiffusionSettings
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.track_batches import TrackBatches
from probmotion.models.training.track_trainee import TrackTrainee
from probmotion.motion.motion import KeypointTrack

__all__ = ["DiffusionTrainee", "usual_training"]


class DiffusionTrainee(TrackTrainee):
    """Trainee of a motion diffusion model for :func:`~probmotion.models.training.trainer.train`.

    The loss is the mean squared error of the estimate of x₀ (not of ε), in standardised units, over
    visible joints, at noise levels t ~ U{1..T}. Parameters are those of
    :class:`~probmotion.models.training.track_trainee.TrackTrainee`. Every joint must be visible in
    at least one frame of ``tracks``.
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

        def to_device(values: np.ndarray) -> torch.Tensor:
            return torch.as_tensor(values, device=device)

        scale = self.standards.scale
        mean = to_device((self.standards.mean / scale).astype(np.float32))
        deviation = to_device((self.standards.deviation / scale).astype(np.float32))
        # Set occluded joints to their mean: the loss excludes them, but attention does not.
        filled = np.where(drawn.seen[..., None], drawn.keypoints, self.standards.mean)
        clean = to_device((filled / scale).astype(np.float32))
        alpha_bar = self._alpha_bar.to(device)[to_device(levels)][:, None, None, None]
        noisy = alpha_bar.sqrt() * clean + (1 - alpha_bar).sqrt() * to_device(noise)
        # Standardise by the variance at each level, so that inputs have unit variance.
        spread = torch.sqrt(alpha_bar * deviation**2 + (1 - alpha_bar))
        inputs = (noisy - alpha_bar.sqrt() * mean) / spread
        estimate = network(inputs.flatten(2), to_device(levels), to_device(drawn.valid))
        estimate = estimate.unflatten(2, (-1, 2))
        varies = deviation > 0
        target = (clean - mean) / torch.where(varies, deviation, 1.0)
        weight = to_device(drawn.seen)[..., None] * varies
        return (weight * (estimate.float() - target) ** 2).sum() / weight.sum().clamp(min=1)


def usual_training(size: str) -> TrainingSettings:
    """Return the training settings of size ``tiny``, ``small``, ``paper`` or ``reference-code``.

    Training diverges with the published learning rate of 0.1. ``paper`` uses AdamW at 1e-4 with a
    moving average and gradient clipping; ``reference-code`` follows the MAS authors' code.
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
