"""Sizes of the motion diffusion model, by name, and the noise levels it learns."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from probmotion import seeds
from probmotion.models.diffusion.motion_transformer import MotionTransformer
from probmotion.posteriors.noise_schedule import NoiseSchedule
from probmotion.validation import check_count

__all__ = ["DiffusionSettings"]


@dataclass(frozen=True)
class DiffusionSettings:
    """Size of the network and the noise levels it learns.

    Parameters
    ----------
    frames : int
        Most frames L of a motion.
    layers, width, heads, feedforward : int
        Of the transformer encoder.
    dropout : float
        In training, at least 0 and below 1.
    steps : int
        T, number of noise levels.
    schedule_power : int
        Of the cosine schedule: 2 as published, 4 in the MAS authors' code.

    Raises
    ------
    ValueError
        If a number is out of range, or ``width`` is no multiple of ``heads`` and of 2.
    """

    frames: int = 60
    layers: int = 6
    width: int = 512
    heads: int = 4
    feedforward: int = 1024
    dropout: float = 0.1
    steps: int = 100
    schedule_power: int = 2

    def __post_init__(self) -> None:
        for name in ("layers", "width", "heads", "feedforward", "schedule_power"):
            check_count(name, getattr(self, name))
        for name in ("frames", "steps"):
            check_count(name, getattr(self, name), least=2)
        if not 0 <= self.dropout < 1:
            raise ValueError(f"dropout must be at least 0 and below 1, got {self.dropout}")
        if self.width % self.heads or self.width % 2:
            raise ValueError(
                f"width must be an even multiple of heads, {self.heads}, got {self.width}"
            )

    @classmethod
    def tiny(cls, frames: int = 20) -> DiffusionSettings:
        """Return the size for tests: learns a toy in seconds."""
        return cls(frames, layers=2, width=48, heads=2, feedforward=96, dropout=0.0)

    @classmethod
    def small(cls, frames: int = 40) -> DiffusionSettings:
        """Return the size that two cores train in minutes, and that ships."""
        return cls(frames, layers=4, width=128, heads=4, feedforward=256, dropout=0.0)

    @classmethod
    def paper(cls, frames: int = 180) -> DiffusionSettings:
        """Return the published size (section 6.2)."""
        return cls(frames)

    @classmethod
    def reference_code(cls, frames: int = 180) -> DiffusionSettings:
        """Return the size of the authors' released code, where it differs from the paper."""
        return cls(frames, layers=8, schedule_power=4)

    @property
    def schedule(self) -> NoiseSchedule:
        """The noise levels."""
        return NoiseSchedule.cosine(self.steps, power=self.schedule_power)

    def network(self, n_joints: int, seed: int = 0) -> MotionTransformer:
        """Return a network of this size with fresh weights."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seeds.integer(seed, "weights"))
            return MotionTransformer(
                2 * n_joints,
                self.frames,
                layers=self.layers,
                width=self.width,
                heads=self.heads,
                feedforward=self.feedforward,
                dropout=self.dropout,
            )

    def level(self, alpha_bar: float) -> float:
        """Return the number of a noise level by its ᾱ; between two levels by the noise's logarithm.

        Beyond the last level, where another schedule may begin, it is the last: the signal's share
        there is below a thousandth in any case.

        Raises
        ------
        ValueError
            If ᾱ is not above 0 and at most 1.
        """
        if not 0 < alpha_bar <= 1:
            raise ValueError(f"alpha_bar must be above 0 and at most 1, got {alpha_bar:.3g}")
        levels = self.schedule.alpha_bar
        # Level 0 has no noise; a hundredth of the first level's stands for it.
        noise = np.sqrt((1 - levels) / levels)
        noise[0] = 0.01 * noise[1]
        here = max(math.sqrt((1 - alpha_bar) / alpha_bar), noise[0])
        return float(np.interp(math.log(here), np.log(noise), np.arange(len(levels))))
