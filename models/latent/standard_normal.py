"""`StandardNormalPrior`: what every prior whose coordinates are N(0, I) can do with them.

A learnt decoder makes motions of θ; of θ itself density, draws and denoiser are known exactly.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import numpy as np

from probmotion.arrays import Array, array_namespace
from probmotion.validation import check_shape

__all__ = ["StandardNormalPrior"]


class StandardNormalPrior(ABC):
    """θ ~ N(0, I); how long θ is and which motion stands at it, a subclass says.

    Densities and denoiser are of θ's kind of array: NumPy, torch or JAX.
    """

    @property
    @abstractmethod
    def dim(self) -> int:
        """Length of θ."""

    @abstractmethod
    def motion(self, theta: Array) -> Array:
        """Return the motion at θ, ``(…, dim) → (…, L, J, 3)``, metres."""

    def log_density(self, theta: Array) -> Array:
        """Return log N(θ; 0, I): ``(…, dim) → (…)``.

        Raises
        ------
        ValueError
            If θ has another length.
        """
        check_shape("theta", theta, ("…", self.dim))
        xp = array_namespace(theta)
        return -0.5 * (xp.sum(theta**2, axis=-1) + self.dim * math.log(2 * math.pi))

    def initial(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Return n draws of θ, (n, dim)."""
        return rng.standard_normal((n, self.dim))

    def sample(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Return n motions, (n, L, J, 3), metres."""
        return self.motion(self.initial(rng, n))

    def denoise_coordinates(self, theta_t: Array, alpha_bar: float) -> Array:
        """Return E[θ | θ_t] = √ᾱ θ_t, exactly, since θ ~ N(0, I): ``(…, dim) → (…, dim)``."""
        return math.sqrt(alpha_bar) * theta_t
