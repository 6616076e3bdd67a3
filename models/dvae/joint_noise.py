"""Corruption model for recorded joints: noise, outliers and occlusion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_positive

__all__ = ["JointNoise", "NoisyJoints"]


class NoisyJoints(NamedTuple):
    """Noisy joints (B, L, J, 3), noise scale and visibility (B, L, J), 1/λ (B,) of Student-t."""

    joints: np.ndarray
    noise: np.ndarray
    seen: np.ndarray
    tails: np.ndarray


@dataclass(frozen=True)
class JointNoise:
    """Distribution of the corruption in the training data of a denoiser.

    Parameters
    ----------
    least, most : float
        Range of the noise standard deviation (Student-t: scale), metres; log-uniform per window.
    outliers : float
        Fraction of windows with Student-t noise of 2 to 8 degrees of freedom; the rest is Gaussian.
    hidden : float
        Fraction of windows in which limbs and single joints are temporarily occluded.

    Raises
    ------
    ValueError
        If a number is out of range.
    """

    least: float = 0.01
    most: float = 0.08
    outliers: float = 0.4
    hidden: float = 0.6

    def __post_init__(self) -> None:
        check_positive("least", self.least)
        check_positive("most", self.most)
        if not self.least <= self.most:
            raise ValueError(f"most must be at least least={self.least}, got {self.most}")
        for name in ("outliers", "hidden"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must be between 0 and 1, got {getattr(self, name)}")

    @classmethod
    def nearly_clean(cls) -> JointNoise:
        """Return Gaussian noise of 5 mm without occlusion."""
        return cls(least=5e-3, most=5e-3, outliers=0.0, hidden=0.0)

    def apply(
        self, rng: np.random.Generator, joints: np.ndarray, skeleton: Skeleton
    ) -> NoisyJoints:
        """Return corrupted copies of clean windows, (B, L, J, 3), metres."""
        n, frames, count, _ = joints.shape
        scale = np.exp(rng.uniform(np.log(self.least), np.log(self.most), n))
        heavy = np.less(rng.random(n), self.outliers)
        freedom = np.exp(rng.uniform(np.log(2.0), np.log(8.0), n))
        error = rng.standard_normal(joints.shape)
        # A Student-t variable is a normal variable divided by √(χ²/ν).
        nu = freedom[:, None, None, None]
        square = rng.chisquare(nu, joints.shape) / nu
        error = np.where(heavy[:, None, None, None], error / np.sqrt(square), error)
        seen = np.stack([self._seen(rng, frames, skeleton) for _ in range(n)])
        noise = np.broadcast_to(scale[:, None, None], (n, frames, count))
        tails = np.where(heavy, 1 / freedom, 0.0)
        return NoisyJoints(joints + scale[:, None, None, None] * error, noise, seen, tails)

    def _seen(self, rng: np.random.Generator, frames: int, skeleton: Skeleton) -> np.ndarray:
        """Return the visibility of one window, (L, J)."""
        seen = np.ones((frames, skeleton.n_joints), dtype=bool)
        if rng.random() >= self.hidden:
            return seen
        for _ in range(rng.integers(1, 4)):
            top = int(rng.integers(skeleton.n_joints))
            limb = [j for j in range(skeleton.n_joints) if j == top or top in skeleton.ancestors(j)]
            # Limit occlusions of most joints to a quarter of the window, for identifiability.
            most = frames // 4 if len(limb) > skeleton.n_joints // 2 else frames
            length = int(rng.integers(1, most + 1))
            start = int(rng.integers(0, frames - length + 1))
            seen[start : start + length, limb] = False
        seen &= rng.random(seen.shape) >= rng.choice([0.0, 0.0, 0.1, 0.3])
        if not seen.any():
            seen[0] = True
        return seen
