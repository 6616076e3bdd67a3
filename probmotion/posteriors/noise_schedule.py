"""Noise schedule and DDPM posterior, for training and sampling.

x_t = √ᾱ_t x₀ + √(1−ᾱ_t) ε with ε ~ N(0, I). Level 0 is clean; level T is almost pure noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from probmotion.validation import check_count

__all__ = ["NoiseSchedule", "PosteriorStep"]

_OFFSET = 0.008  # prevents β_t from vanishing at small t


class PosteriorStep(NamedTuple):
    """DDPM posterior q(x_s | x_t, x₀): mean ``clean`` x₀ + ``noisy`` x_t, sd ``deviation``."""

    clean: float
    noisy: float
    deviation: float


@dataclass(frozen=True, eq=False)
class NoiseSchedule:
    """Noise schedule with signal levels ᾱ_0 = 1 > ᾱ_1 > … > ᾱ_T > 0.

    Parameters
    ----------
    alpha_bar : ndarray, (T + 1,)
        ᾱ_t, the fraction of the signal's variance at each level.
    times : ndarray, (T + 1,), optional
        Index of each level in the network's training schedule; 0..T by default.
    """

    alpha_bar: np.ndarray
    times: np.ndarray | None = None

    def __post_init__(self) -> None:
        levels = np.asarray(self.alpha_bar, dtype=np.float64)
        if levels.ndim != 1 or len(levels) < 2:
            raise ValueError(f"alpha_bar must have shape (T + 1,), got shape {levels.shape}")
        falls = np.diff([*levels, 0.0]) < 0
        if levels[0] != 1.0 or not falls.all():
            first = int(np.argmin(falls)) if levels[0] == 1.0 else 0
            given = ", ".join(f"{level:g}" for level in levels[first : first + 2])
            raise ValueError(
                f"alpha_bar must decrease from 1 to a number above 0, got {given} from level "
                f"{first}; use NoiseSchedule.cosine with power 2"
            )
        times = np.arange(len(levels)) if self.times is None else np.asarray(self.times)
        object.__setattr__(self, "alpha_bar", levels)
        object.__setattr__(self, "times", times)

    @classmethod
    def cosine(cls, steps: int, *, power: int = 2) -> NoiseSchedule:
        """Return the cosine schedule of Nichol and Dhariwal (2021), equation 17, with β_t ≤ 0.999.

        Parameters
        ----------
        steps : int
            Number of steps T.
        power : int
            ᾱ ∝ cos^power; 2 as published, 4 in the MAS authors' code.
        """
        check_count("steps", steps)
        angle = (np.arange(steps + 1) / steps + _OFFSET) / (1 + _OFFSET) * np.pi / 2
        raw = np.cos(angle) ** power
        with np.errstate(invalid="ignore"):  # large powers underflow
            beta = np.minimum(1 - raw[1:] / raw[:-1], 0.999)
        return cls(np.concatenate([[1.0], np.cumprod(1 - beta)]))

    @property
    def steps(self) -> int:
        """Number of steps T."""
        return len(self.alpha_bar) - 1

    def sigma(self, t: int) -> float:
        """Return the noise level σ = √((1−ᾱ)/ᾱ) at level t, in units of the signal."""
        alpha_bar = float(self.alpha_bar[t])
        return math.sqrt((1 - alpha_bar) / alpha_bar)

    def strided(self, steps: int) -> NoiseSchedule:
        """Return a schedule of ``steps`` steps with a subset of these levels."""
        check_count("steps", steps)
        if steps > self.steps:
            raise ValueError(f"steps must be at most the schedule's {self.steps}, got {steps}")
        assert self.times is not None
        levels = np.round(np.linspace(0, self.steps, steps + 1)).astype(int)
        return NoiseSchedule(self.alpha_bar[levels], self.times[levels])

    def posterior(self, t: int) -> PosteriorStep:
        """Return q(x_{t−1} | x_t, x₀), t = 1..T (Ho et al. 2020, equations 6 and 7).

        ``deviation`` is √β̃_t, where β̃_t = β_t (1−ᾱ_{t−1})/(1−ᾱ_t); it is 0 at t = 1.
        """
        if not 1 <= t <= self.steps:
            raise ValueError(f"t must be between 1 and {self.steps}, got {t}")
        bar_t, bar_s = float(self.alpha_bar[t]), float(self.alpha_bar[t - 1])
        alpha = bar_t / bar_s
        beta = 1 - alpha
        return PosteriorStep(
            clean=math.sqrt(bar_s) * beta / (1 - bar_t),
            noisy=math.sqrt(alpha) * (1 - bar_s) / (1 - bar_t),
            deviation=math.sqrt(beta * (1 - bar_s) / (1 - bar_t)),
        )
