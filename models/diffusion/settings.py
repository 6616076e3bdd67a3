"""Settings of the motion diffusion model: network size and noise levels."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from probmotion import seeds
from probmotion.extras import torch
from probmotion.models.diffusion.motion_transformer import MotionTransformer
from probmotion.posteriors.noise_schedule import NoiseSchedule
from probmotion.validation import check_count

__all__ = ["DiffusionSettings", "TransformerSettings"]

_SIZES = ("layers", "width", "heads", "feedforward")  # Fields passed on to the encoder.


@dataclass(frozen=True)
class TransformerSettings:
    """Size of a transformer over frames; raises ``ValueError`` if a number is out of range.

    Parameters
    ----------
    frames : int
        Maximum number of frames L.
    layers, width, heads, feedforward : int
        Size of the encoder; ``width`` is even and a multiple of ``heads``.
    """

    frames: int = 60
    layers: int = 6
    width: int = 512
    heads: int = 4
    feedforward: int = 1024

    def __post_init__(self) -> None:
        check_count("frames", self.frames, least=2)
        for name in _SIZES:
            check_count(name, getattr(self, name))
        if self.width % self.heads or self.width % 2:
            raise ValueError(
                f"width must be even and a multiple of heads={self.heads}, got {self.width}"
            )


@dataclass(frozen=True)
class DiffusionSettings(TransformerSettings):
    """Size and noise levels of the network; raises ``ValueError`` if a number is out of range.

    Parameters
    ----------
    frames, layers, width, heads, feedforward : int
        Size of the transformer.
    dropout : float
        Dropout probability, at least 0 and below 1.
    steps : int
        Number of noise levels T.
    schedule_power : int
        Power of the cosine schedule: 2 as published, 4 in the MAS authors' code.
    """

    dropout: float = 0.1
    steps: int = 100
    schedule_power: int = 2

    def __post_init__(self) -> None:
        super().__post_init__()
        check_count("schedule_power", self.schedule_power)
        check_count("steps", self.steps, least=2)
        if not 0 <= self.dropout < 1:
            raise ValueError(f"dropout must be at least 0 and below 1, got {self.dropout}")

    @classmethod
    def tiny(cls, frames: int = 20) -> DiffusionSettings:
        """Return a size for tests, which trains in seconds."""
        return cls(frames, layers=2, width=48, heads=2, feedforward=96, dropout=0.0)

    @classmethod
    def small(cls, frames: int = 40) -> DiffusionSettings:
        """Return the shipped size, which trains in minutes on two cores."""
        return cls(frames, layers=4, width=128, heads=4, feedforward=256, dropout=0.0)

    @classmethod
    def paper(cls, frames: int = 180) -> DiffusionSettings:
        """Return the size published in MAS (section 6.2)."""
        return cls(frames)

    @classmethod
    def reference_code(cls, frames: int = 180) -> DiffusionSettings:
        """Return the size in the MAS authors' released code."""
        return cls(frames, layers=8, schedule_power=4)

    @cached_property
    def schedule(self) -> NoiseSchedule:
        """Noise levels of the cosine schedule."""
        return NoiseSchedule.cosine(self.steps, power=self.schedule_power)

    def network(self, n_joints: int, seed: int = 0) -> MotionTransformer:
        """Return an untrained network of this size."""
        sizes = {name: getattr(self, name) for name in (*_SIZES, "dropout")}
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seeds.integer(seed, "weights"))
            return MotionTransformer(2 * n_joints, self.frames, **sizes)

    def level(self, alpha_bar: float) -> float:
        """Return the fractional index of the noise level ᾱ, interpolated in log noise.

        Below the first level of training, the index is between 0 and 1.

        Raises
        ------
        ValueError
            If ᾱ is not in (0, 1] or below the last level of training.
        """
        if not 0 < alpha_bar <= 1:
            raise ValueError(f"alpha_bar must be above 0 and at most 1, got {alpha_bar:.3g}")
        noise, log_noise = math.sqrt((1 - alpha_bar) / alpha_bar), self._log_noise
        if alpha_bar < self.schedule.alpha_bar[-1] * (1 - 1e-9):
            raise ValueError(
                f"noise levels must be at most {self.schedule.sigma(self.steps):.3g}, the "
                f"network's last, got {noise:.3g}; use levels=Cosine(trained_steps={self.steps}) "
                "or Karras()"
            )
        # Below the first entry, np.interp returns level 0.
        here = math.log(noise) if noise > 0 else -math.inf
        return float(np.interp(here, log_noise, np.arange(len(log_noise))))

    @cached_property
    def _log_noise(self) -> np.ndarray:
        """Log noise levels log σ. Level 0 has no noise; σ₀ is set to σ₁/100."""
        sigma = np.array([self.schedule.sigma(t) for t in range(self.steps + 1)])
        sigma[0] = 0.01 * sigma[1]
        return np.log(sigma)
