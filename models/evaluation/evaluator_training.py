"""Training of the evaluator: a variational autoencoder of 2D tracks (MAS, section 6.3)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from probmotion import seeds
from probmotion.extras import nn, torch
from probmotion.models.evaluation.evaluator import KIND
from probmotion.models.evaluation.track_autoencoder import EvaluatorSettings, TrackAutoencoder
from probmotion.models.training.track_batches import TrackBatches
from probmotion.models.training.track_trainee import TrackTrainee
from probmotion.motion.motion import KeypointTrack

__all__ = ["EvaluatorTrainee"]


class EvaluatorTrainee(TrackTrainee):
    """Trainee of an evaluator for :func:`~probmotion.models.training.trainer.train`.

    The loss is the mean squared error in standardised units over visible joints, plus ``kl_weight``
    times the mean KL divergence of the latents from N(0, I). Parameters are those of
    :class:`~probmotion.models.training.track_trainee.TrackTrainee`; occluded joints are set to
    their mean.
    """

    kind = KIND
    size: EvaluatorSettings

    def __init__(
        self,
        tracks: Sequence[KeypointTrack],
        validation: Sequence[KeypointTrack],
        size: EvaluatorSettings,
        *,
        seed: int = 0,
        **options: Any,
    ) -> None:
        super().__init__(tracks, validation, size, seed=seed, **options)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seeds.integer(seed, "weights"))
            self.network = TrackAutoencoder(size, self.batches.skeleton.n_joints)

    def _loss(
        self,
        network: nn.Module,
        batches: TrackBatches,
        rng: np.random.Generator,
        n: int,
        device: torch.device,
    ) -> torch.Tensor:
        drawn = batches.draw(rng, n)
        unit = rng.standard_normal((n, self.size.latent), dtype=np.float32)
        varies = self.standards.deviation > 0
        scale = np.where(varies, self.standards.deviation, 1.0)
        counted = drawn.seen[..., None] & varies
        standardised = np.where(counted, (drawn.keypoints - self.standards.mean) / scale, 0.0)
        target, weight, valid, noise = (
            torch.as_tensor(array, device=device)
            for array in (standardised.astype(np.float32), counted, drawn.valid, unit)
        )
        target, weight = target.flatten(2), weight.flatten(2)
        decoded, divergence = network(target, valid, noise)
        error = (weight * (decoded.float() - target) ** 2).sum() / weight.sum().clamp(min=1)
        return error + self.size.kl_weight * divergence.mean()
