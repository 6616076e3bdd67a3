"""Learning an evaluator from 2D tracks: a variational autoencoder (MAS, section 6.3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from torch import nn

from probmotion import seeds
from probmotion.models.evaluation.evaluator import KIND
from probmotion.models.evaluation.track_autoencoder import EvaluatorSettings, TrackAutoencoder
from probmotion.models.training.track_batches import (
    Augmentation,
    TrackBatches,
    learning_and_held_out,
)
from probmotion.motion.motion import KeypointTrack

__all__ = ["EvaluatorTrainee"]

_VALIDATION_BATCH = 256


class EvaluatorTrainee:
    """What :func:`~probmotion.models.training.trainer.train` needs to learn an evaluator.

    The loss is the mean squared error in standardised units, over frames that are there and joints
    whose confidence is not below the threshold, plus ``kl_weight`` times the mean divergence of a
    motion's latent from N(0, I).

    Parameters
    ----------
    tracks : sequence of KeypointTrack
        Prepared: metres, centred, of one skeleton and frame rate.
    validation : sequence of KeypointTrack
        Of clips that are not among those of ``tracks``.
    size : EvaluatorSettings
        The network's.
    threshold : float
        Least confidence of a joint that counts; the encoder sees the others at their mean.
    augmentation : Augmentation
        How tracks are varied.
    seed : int
        Of the first weights and the validation batch.

    Raises
    ------
    ValueError
        If there is no track, they differ in skeleton or frame rate, or none has a confident joint.
    """

    kind = KIND

    def __init__(
        self,
        tracks: Sequence[KeypointTrack],
        validation: Sequence[KeypointTrack],
        size: EvaluatorSettings,
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
        skeleton = self.batches.skeleton
        self.standards = self.batches.standards
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seeds.integer(seed, "weights"))
            self.network: nn.Module = TrackAutoencoder(size, skeleton.n_joints)
        self._seed = seed
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
        """Return the loss of a fresh batch."""
        return self._loss(network, self.batches, rng, batch, device)

    def validation_loss(self, network: nn.Module, device: torch.device) -> float:
        """Return the loss on held-out tracks with noise that never changes."""
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
        noise = rng.standard_normal((n, self.size.latent), dtype=np.float32)
        moves = self.standards.deviation > 0
        scale = np.where(moves, self.standards.deviation, 1.0)
        counted = drawn.seen[..., None] & moves
        standardised = np.where(counted, (drawn.keypoints - self.standards.mean) / scale, 0.0)

        def moved(values: np.ndarray) -> torch.Tensor:
            return torch.as_tensor(values, device=device)

        wanted = moved(standardised.astype(np.float32)).flatten(2)
        weight = moved(counted).flatten(2)
        found, divergence = network(wanted, moved(drawn.valid), moved(noise))
        error = (weight * (found.float() - wanted) ** 2).sum() / weight.sum().clamp(min=1)
        return error + self.size.kl_weight * divergence.mean()
