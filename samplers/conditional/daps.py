"""Decoupled annealing posterior sampling (DAPS, Zhang et al. 2025)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np

from probmotion.samplers.conditional.base import (
    AnnealedSampler,
    DenoiserChoice,
    VarianceExploding,
)
from probmotion.samplers.conditional.coupling import Coupling, Quadratic
from probmotion.samplers.diffusion.guidance import LinearObservations
from probmotion.samplers.diffusion.noise_levels import AnyLevels, Karras
from probmotion.seeds import NormalStreams
from probmotion.validation import check_count

__all__ = ["DAPS"]


@dataclass(frozen=True)
class DAPS(AnnealedSampler):
    """Decoupled annealing posterior sampling (Zhang et al. 2025, algorithm 1).

    At each noise level σ the probability-flow ODE is solved from the state to a clean motion x̂; a
    motion is drawn from N(y; A z, W⁻¹) N(z; x̂, σ²), and noise of the next level is added. For
    linear observations this draw is exact, where the paper uses Langevin dynamics.

    Parameters
    ----------
    steps : int
        Number of noise levels T.
    ode_steps : int
        Number of Euler steps of the ODE at each level.
    levels : AnyLevels
        Spacing of the noise levels.
    denoiser : {"any", "3d", "2d"}
        Kind of denoiser; "any" is the 3D denoiser if the prior has one.
    batch : int
        Maximum batch size; does not affect the draws.
    """

    name: ClassVar[str] = "daps"

    steps: int = 100
    ode_steps: int = 5
    levels: AnyLevels = field(default_factory=Karras)
    denoiser: DenoiserChoice = "any"
    batch: int = 256

    def __post_init__(self) -> None:
        super().__post_init__()
        check_count("ode_steps", self.ode_steps)

    def _draw(
        self,
        pools: list[VarianceExploding],
        observations: LinearObservations,
        shape: tuple[int, ...],
        sigmas: np.ndarray,
        streams: NormalStreams,
        tick: Callable[[], Any],
    ) -> np.ndarray:
        likelihood = Quadratic.of(observations)
        z = np.zeros((len(streams.generators), *shape))
        for level, sigma in enumerate(sigmas):
            clean = pools[level % len(pools)]
            x = z + sigma * streams.normal(*shape)
            below = np.geomspace(sigma, sigmas[-1], self.ode_steps)
            for now, after in pairwise(below):
                estimate = clean(x, now)
                x = estimate + after / now * (x - estimate)
            z = Coupling(likelihood, sigma).draw(clean(x, below[-1]), streams.normal(*shape))
            tick()
        return z
