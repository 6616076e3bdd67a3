"""Gaussian coupling of a motion to linear Gaussian observations."""

from __future__ import annotations

import numpy as np

from probmotion.samplers.diffusion.guidance import LinearObservations

__all__ = ["Coupling", "times"]


class Coupling:
    """Distribution p(z | x) ∝ N(y; A z, W⁻¹) N(z; x, ρ² I), independent between entries.

    Parameters
    ----------
    observations : LinearObservations
        A, y and W, in normalised units.
    rho : float
        ρ, normalised units.
    split : bool
        Subtract ρ² from the variances of the observations where these are larger, so that
        y | x has the variance W⁻¹ after z is integrated out.
    """

    def __init__(
        self, observations: LinearObservations, rho: float, *, split: bool = False
    ) -> None:
        weight = observations.precision
        if split:
            weight = weight / np.where(weight * rho**2 < 1, 1 - weight * rho**2, 1.0)
        self.pull = observations.adjoint(weight[..., None] * observations.target[None])
        self.information = observations.information(weight)
        size, axes = np.linalg.eigh(self.information + np.eye(3) / rho**2)
        self.root = (axes / np.sqrt(size)[..., None, :]) @ axes.swapaxes(-1, -2)
        self._rho = rho

    def mean(self, x: np.ndarray) -> np.ndarray:
        """Return E[z | x]: ``(B, L, J, 3) → (B, L, J, 3)``."""
        return times(self.root, times(self.root, self.pull + x / self._rho**2))

    def draw(self, x: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Return a draw of z | x for each row, given standard normal ``noise``, (B, L, J, 3)."""
        return self.mean(x) + times(self.root, noise)

    def score(self, z: np.ndarray, clean: np.ndarray) -> np.ndarray:
        """Return ∇ log p_ρ(z) N(y; A z, W⁻¹), given E[x | z] for x ~ p, z ~ N(x, ρ²)."""
        likelihood = self.pull - times(self.information, z)
        gradient: np.ndarray = (clean - z) / self._rho**2 + likelihood
        return gradient


def times(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return M v per entry: ``(L, J, 3, 3), (B, L, J, 3) → (B, L, J, 3)``."""
    product: np.ndarray = (matrices @ vectors[..., None])[..., 0]
    return product
