"""Base class for training on 2D tracks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from probmotion import seeds
from probmotion.extras import nn, torch
from probmotion.models.training.track_batches import Augmentation, learning_and_held_out
from probmotion.motion.motion import KeypointTrack

__all__ = ["TrackTrainee"]

_VALIDATION_BATCH = 256  # windows per validation loss


class TrackTrainee:
    """Base class of trainees: data, standardisation and settings for windows of 2D tracks.

    ``tracks`` are prepared (metres, centred) and have one skeleton and frame rate; ``validation``
    contains tracks of held-out clips; ``size`` contains the network's settings with its ``frames``.
    ``threshold`` is the minimum confidence of joints in the loss: .3 for people, .5 for horses, .01
    for data with a ball. Raises ``ValueError`` under the conditions of :class:`TrackBatches`.
    """

    network: nn.Module
    _loss: Callable[..., torch.Tensor]

    def __init__(
        self,
        tracks: Sequence[KeypointTrack],
        validation: Sequence[KeypointTrack],
        size: Any,
        *,
        threshold: float = 0.3,
        augmentation: Augmentation | None = None,
        seed: int = 0,
    ) -> None:
        augmentation = augmentation or Augmentation()
        self.size = size
        self.batches, self.held_out = learning_and_held_out(
            tracks, validation, size.frames, threshold, augmentation
        )
        self.standards = self.batches.standards
        self._seed = seed
        skeleton = self.batches.skeleton
        self.settings: Mapping[str, Any] = {
            "size": asdict(size),
            "joint_names": list(skeleton.joint_names),
            "parents": list(skeleton.parents),
            "fps": self.batches.fps,
            "mean": self.standards.mean.tolist(),
            "deviation": self.standards.deviation.tolist(),
            "threshold": threshold,
            "augmentation": asdict(augmentation),
            "data": self.batches.description,
            "validation_data": self.held_out.description,
        }

    def training_loss(
        self, network: nn.Module, rng: np.random.Generator, batch: int, device: torch.device
    ) -> torch.Tensor:
        """Return the loss of a random batch."""
        return self._loss(network, self.batches, rng, batch, device)

    def validation_loss(self, network: nn.Module, device: torch.device) -> float:
        """Return the loss of a fixed batch of held-out tracks."""
        rng = seeds.generator(self._seed, "validation")
        return float(self._loss(network, self.held_out, rng, _VALIDATION_BATCH, device))
