"""Representation of noisy motions during sampling."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from probmotion.posteriors.noise_schedule import NoiseSchedule
from probmotion.samplers.diffusion.guidance import Guide
from probmotion.seeds import NormalStreams

__all__ = ["MotionState", "State"]


class State(Protocol):
    """Representation of a noisy motion during sampling, as a 3D motion or as several views."""

    schedule: NoiseSchedule
    counts: dict[str, int]

    def noise(self, streams: NormalStreams, t: int) -> np.ndarray:
        """Return unit noise for a state at level t."""

    def estimate(self, x_t: np.ndarray, t: int) -> np.ndarray:
        """Return the estimate of the clean motion from the state at level t, (B, L, J, 3)."""

    def embed(self, motions: np.ndarray) -> np.ndarray:
        """Convert clean motions (B, L, J, 3) to the representation of the state."""


class Denoiser(Protocol):
    """Denoiser that counts its evaluations."""

    counts: dict[str, int]

    def denoise(self, x_t: np.ndarray, alpha_bar: float) -> np.ndarray:
        """Return the estimate of the clean motion from ``x_t`` at ᾱ, of the same shape."""


@dataclass
class MotionState:
    """State with one noisy motion per draw, (B, L, J, 3) or (B, L, J, 2); ``shape`` excludes B.

    Estimates alternate between the ``denoisers``, which share their counts. ``guides``, one for
    each, condition the estimates on the observations. ``noise_factor`` maps σ to a matrix F,
    (3, 3), for noise F ε, or to ``None`` for the identity.
    """

    denoisers: Sequence[Denoiser]
    schedule: NoiseSchedule
    shape: tuple[int, ...]
    guides: Sequence[Guide | None] = (None,)
    noise_factor: Callable[[float], np.ndarray | None] = lambda level: None
    counts: dict[str, int] = field(init=False)
    _estimates: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        self.counts = self.denoisers[0].counts

    def noise(self, streams: NormalStreams, t: int) -> np.ndarray:
        """Return F(σ_t) ε, ε ~ N(0, I); level T starts a new batch."""
        if t == self.schedule.steps:
            self._estimates = 0
        noise = streams.normal(*self.shape)
        factor = self.noise_factor(self.schedule.sigma(t))
        return noise if factor is None else noise @ factor.T

    def estimate(self, x_t: np.ndarray, t: int) -> np.ndarray:
        """Return the guided estimate of the clean motion."""
        turn = self._estimates % len(self.denoisers)
        self._estimates += 1
        alpha_bar = float(self.schedule.alpha_bar[t])
        clean = self.denoisers[turn].denoise(x_t, alpha_bar)
        guide = self.guides[turn % len(self.guides)]
        if guide is None:
            return clean
        return guide(x_t, alpha_bar, clean, self.schedule.posterior(t))

    def embed(self, motions: np.ndarray) -> np.ndarray:
        """Return the motions unchanged."""
        return motions
