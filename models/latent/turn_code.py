"""`TurnCode`: Gaussian distribution of an articulated body's bone rotations over a few frames.

One code z ~ N(0, I) determines the whole motion, as in *Ponymation* (section 3.1); the decoder is
linear. Its draws move at about the speed of the motions that it was learnt from.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probmotion.arrays import Array, constant
from probmotion.validation import check_count, check_finite, check_positive, check_shape

__all__ = ["TurnCode"]


@dataclass(frozen=True, eq=False)
class TurnCode:
    """Bone rotations ξ = μ + z W with z ~ N(0, I).

    Parameters
    ----------
    mean : ndarray, (L, B, 3)
        Mean rotation vectors μ, radians.
    basis : ndarray, (K, L, B, 3)
        Principal components W times their standard deviations.
    fps : float
        Frames per second.

    Raises
    ------
    ValueError
        If shapes disagree or a value is not finite.
    """

    mean: np.ndarray
    basis: np.ndarray
    fps: float

    def __post_init__(self) -> None:
        check_shape("mean", self.mean, ("L", "B", 3))
        check_shape("basis", self.basis, ("K", *self.mean.shape))
        check_finite("mean", self.mean)
        check_finite("basis", self.basis)
        check_positive("fps", self.fps)

    @classmethod
    def fit(cls, turns: np.ndarray, fps: float, dim: int) -> TurnCode:
        """Return the ``dim`` principal components of rotations (N, L, B, 3), radians."""
        check_shape("turns", turns, ("N", "L", "B", 3))
        check_count("dim", dim)
        most = min(len(turns) - 1, turns[0].size)
        if dim > most:
            raise ValueError(f"dim must be at most {most} for {len(turns)} motions, got {dim}")
        mean = turns.mean(axis=0)
        deviations = (turns - mean).reshape(len(turns), -1)
        _, sizes, directions = np.linalg.svd(deviations, full_matrices=False)
        basis = directions[:dim] * sizes[:dim, None] / np.sqrt(len(turns) - 1)
        return cls(mean, basis.reshape(dim, *mean.shape), fps)

    @property
    def dim(self) -> int:
        """Length K of z."""
        return len(self.basis)

    @property
    def frames(self) -> int:
        """Number of frames L."""
        return len(self.mean)

    def turns(self, z: Array) -> Array:
        """Return the rotation vectors at z: ``(…, K) → (…, L, B, 3)``, radians."""
        check_shape("z", z, ("…", self.dim))
        flat = z @ constant(self.basis.reshape(self.dim, -1), z)
        return flat.reshape(*z.shape[:-1], *self.mean.shape) + constant(self.mean, z)
