"""Regularisation by denoising diffusion (RED-diff, Mardani et al. 2024)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from probmotion.samplers.adam import Adam
from probmotion.samplers.conditional.base import (
    AnnealedSampler,
    DenoiserChoice,
    VarianceExploding,
)
from probmotion.samplers.diffusion.guidance import LinearObservations
from probmotion.samplers.diffusion.noise_levels import AnyLevels, Karras
from probmotion.seeds import NormalStreams
from probmotion.validation import check_positive

__all__ = ["REDDiff"]


@dataclass(frozen=True)
class REDDiff(AnnealedSampler):
    """Variational inference with a point mass (Mardani et al. 2024, algorithm 1).

    Adam minimises ½ ‖y − A μ‖² + λ Σ_t w_t sg[ε̂ − ε]ᵀ μ over falling noise levels, with w_t = σ_t,
    the inverse root of the signal-to-noise ratio. Draws differ only in noise: the method finds
    modes and has no spread of its own.

    Parameters
    ----------
    steps : int
        Number of noise levels and of Adam steps.
    weight : float
        Weight λ of the prior; .25 as published.
    learning_rate : float
        Learning rate of Adam, normalised units; .1 as published.
    levels : AnyLevels
        Spacing of the noise levels.
    denoiser : {"any", "3d", "2d"}
        Kind of denoiser; "any" is the 3D denoiser if the prior has one.
    batch : int
        Maximum batch size; does not affect the draws.
    """

    name: ClassVar[str] = "red-diff"

    steps: int = 500
    weight: float = 0.25
    learning_rate: float = 0.1
    levels: AnyLevels = field(default_factory=Karras)
    denoiser: DenoiserChoice = "any"
    batch: int = 256

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive("weight", self.weight)
        check_positive("learning_rate", self.learning_rate)

    def _draw(
        self,
        pools: list[VarianceExploding],
        observations: LinearObservations,
        shape: tuple[int, ...],
        sigmas: np.ndarray,
        streams: NormalStreams,
        tick: Callable[[], Any],
    ) -> np.ndarray:
        mean = np.zeros((len(streams.generators), *shape))
        adam = Adam(mean, self.learning_rate)
        confidence = observations.confidence[..., None]
        for level, sigma in enumerate(sigmas):
            clean = pools[level % len(pools)]
            noise = streams.normal(*shape)
            # w_t (ε̂ − ε) = σ (μ − D)/σ.
            prior = mean - clean(mean + sigma * noise, sigma)
            residual = observations.observe(mean) - observations.target
            adam.descend(observations.adjoint(confidence * residual) + self.weight * prior)
            tick()
        return mean
