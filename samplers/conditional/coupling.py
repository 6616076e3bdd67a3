"""Gaussian coupling of an auxiliary motion z to a motion x and to quadratic log likelihoods."""

from __future__ import annotations

import numpy as np

from probmotion.samplers.diffusion.guidance import LinearObservations

__all__ = ["Coupling", "Quadratic", "times"]


class Quadratic:
    """Log likelihood bᵀ z − ½ zᵀ G z + constant, independent between frames and joints.

    Parameters
    ----------
    information : ndarray, (…, L, J, 3, 3)
        G, normalised units.
    pull : ndarray, (…, L, J, 3)
        b, normalised units.
    """

    def __init__(self, information: np.ndarray, pull: np.ndarray) -> None:
        self.information = information
        self.pull = pull
        self.sizes, self._axes = np.linalg.eigh(information)

    @classmethod
    def of(cls, observations: LinearObservations) -> Quadratic:
        """Return the log likelihood of linear Gaussian observations: G = Aᵀ W A, b = Aᵀ W y."""
        weight = observations.precision
        pull = observations.adjoint(weight[..., None] * observations.target[None])
        return cls(observations.information(weight), pull)

    def power(self, sizes: np.ndarray) -> np.ndarray:
        """Return the matrix with the eigenvectors of G and eigenvalues ``sizes``, (…, 3)."""
        matrix: np.ndarray = (self._axes * sizes[..., None, :]) @ self._axes.swapaxes(-1, -2)
        return matrix

    def gains(self, rho: float) -> np.ndarray:
        """Return the eigenvalues of (I − ρ² G)⁻¹, or 1 where ρ² is too large to be subtracted."""
        rest = 1 - rho**2 * self.sizes
        gains: np.ndarray = 1 / np.where(rest > _ROUNDING, rest, 1.0)
        return gains

    def bounded_gains(self, rho: float) -> tuple[np.ndarray, np.ndarray]:
        """Return τ² and the eigenvalues of (I − τ² G)⁻¹, at most 10, as continuous functions of G.

        τ² is ρ², or less in directions where that would leave a tenth of the variance.
        """
        subtracted = np.minimum(rho**2, 0.9 / np.maximum(self.sizes, np.finfo(float).tiny))
        return subtracted, 1 / (1 - subtracted * self.sizes)


_ROUNDING = 1e-9  # of eigenvalues of I − ρ² G


class Coupling:
    """Distribution p(z | x) ∝ exp(bᵀ z − ½ zᵀ G z) N(z; x, ρ² I), independent between entries.

    Parameters
    ----------
    likelihood : Quadratic
        G and b, normalised units.
    rho : float
        ρ, normalised units.
    gains : ndarray, (…, L, J, 3), optional
        Factors of G and b along the eigenvectors of G. With those of (I − ρ² G)⁻¹, x has the
        likelihood exp(bᵀ x − ½ xᵀ G x) after z is integrated out. 1 by default.
    """

    def __init__(self, likelihood: Quadratic, rho: float, gains: np.ndarray | None = None) -> None:
        gains = np.ones_like(likelihood.sizes) if gains is None else gains
        self.pull = times(likelihood.power(gains), likelihood.pull)
        self.information = likelihood.power(gains * likelihood.sizes)
        size = gains * likelihood.sizes + 1 / rho**2
        self.root = likelihood.power(size**-0.5)
        self._whiten = likelihood.power(size**0.5)
        self._log_determinant = np.log(size).sum(axis=-1)
        self._rho = rho

    def mean(self, x: np.ndarray) -> np.ndarray:
        """Return E[z | x]: ``(B, L, J, 3) → (B, L, J, 3)``."""
        return times(self.root, times(self.root, self.pull + x / self._rho**2))

    def draw(self, x: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Return a draw of z | x for each row, given standard normal ``noise``, (B, L, J, 3)."""
        return self.mean(x) + times(self.root, noise)

    def log_density(self, z: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Return log p(z | x) up to a constant: ``(B, L, J, 3) → (B, L, J)``."""
        white = times(self._whiten, z - self.mean(x))
        log_density: np.ndarray = 0.5 * self._log_determinant - 0.5 * (white**2).sum(axis=-1)
        return log_density

    def score(self, z: np.ndarray, clean: np.ndarray) -> np.ndarray:
        """Return ∇ log of the marginal of z, given E[x | z] for x ~ p, z ~ N(x, ρ²)."""
        likelihood = self.pull - times(self.information, z)
        gradient: np.ndarray = (clean - z) / self._rho**2 + likelihood
        return gradient


def times(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return M v per entry: ``(…, L, J, 3, 3), (B, L, J, 3) → (B, L, J, 3)``."""
    product: np.ndarray = (matrices @ vectors[..., None])[..., 0]
    return product
