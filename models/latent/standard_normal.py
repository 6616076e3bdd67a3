"""Base class of priors over standard-normal coordinates.

Subclasses decode θ into motions. The density, draws and denoiser of θ are exact.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import numpy as np

from probmotion.arrays import Array, array_namespace
from probmotion.validation import check_shape

__all__ = ["StandardNormalPrior"]


class StandardNormalPrior(ABC):
    """Prior with coordinates θ ~ N(0, I), as NumPy, torch or JAX arrays."""

    @property
    @abstractmethod
    def dim(self) -> int:
        """Length of θ."""

    @abstractmethod
    def motion(self, theta: Array) -> Array:
        """Return the motion at θ, ``(…, dim) → (…, L, J, 3)``, metres."""

    def log_density(self, theta: Array) -> Array:
        """Return log N(θ; 0, I): ``(…, dim) → (…)``."""
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
        """Return E[θ | θ_t] = √ᾱ θ_t, which is exact: ``(…, dim) → (…, dim)``."""
        return math.sqrt(alpha_bar) * theta_t
