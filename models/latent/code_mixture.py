"""`CodeMixture`: a Gaussian mixture of latent codes, and the base class of priors over them.

A variational autoencoder is trained with z ~ N(0, I), but its codes of real motion occupy only part
of that distribution; draws from the rest decode to averages of motions. A mixture fitted to the
codes is the aggregated posterior of Tomczak and Welling (2018), "VAE with a VampPrior".
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import ndtr

from probmotion.arrays import Array, array_namespace, constant
from probmotion.validation import check_count, check_finite, check_shape

__all__ = ["CodeMixture", "CodePrior"]

_ROUNDS = 40  # of expectation maximisation
_LEAST_VARIANCE = 1e-3
_PSEUDO_COUNT = 20.0
"""Weight of the shared covariance in that of a component, in codes."""


@dataclass(frozen=True, eq=False)
class CodeMixture:
    """Mixture Σ_k π_k N(m_k, F_k F_kᵀ) over codes z.

    Parameters
    ----------
    weights : ndarray, (K,)
        π: probabilities of the components.
    means : ndarray, (K, Z)
        m.
    factors : ndarray, (K, Z, Z)
        F: square roots of the covariances, lower triangular.

    Raises
    ------
    ValueError
        If shapes disagree, a value is not finite, or weights are not positive with sum 1.
    """

    weights: np.ndarray
    means: np.ndarray
    factors: np.ndarray

    def __post_init__(self) -> None:
        for name in ("weights", "means", "factors"):
            values = np.asarray(getattr(self, name), dtype=np.float64)
            check_finite(name, values)
            object.__setattr__(self, name, values)
        check_shape("means", self.means, ("K", "Z"))
        k, z = self.means.shape
        check_shape("weights", self.weights, (k,))
        check_shape("factors", self.factors, (k, z, z))
        if not ((self.weights > 0).all() and abs(self.weights.sum() - 1) < 1e-3):
            raise ValueError(f"weights must be positive with sum 1, got {self.weights}")
        object.__setattr__(self, "weights", self.weights / self.weights.sum())

    @classmethod
    def standard(cls, dim: int) -> CodeMixture:
        """Return N(0, I)."""
        return cls(np.ones(1), np.zeros((1, dim)), np.eye(dim)[None])

    @classmethod
    def fit(
        cls, codes: np.ndarray, variances: np.ndarray, components: int, rng: np.random.Generator
    ) -> CodeMixture:
        """Return a mixture fitted to codes N(μ_i, diag σ_i²) by expectation maximisation.

        Parameters
        ----------
        codes, variances : ndarray, (N, Z)
            μ and σ².
        components : int
            K, at most N / 2.
        rng : Generator
            Randomness of the initial components.
        """
        check_shape("codes", codes, ("N", "Z"))
        check_shape("variances", variances, codes.shape)
        check_count("components", components)
        if 2 * components > len(codes):
            raise ValueError(
                f"components must be at most half of the {len(codes)} codes, got {components}"
            )
        closest = _initial(codes, components, rng)
        shares = np.eye(components)[closest]
        for _ in range(_ROUNDS):
            log_shares = cls._maximised(codes, variances, shares)._mean_log_shares(codes, variances)
            shares = np.exp(log_shares - log_shares.max(axis=1, keepdims=True))
            shares /= shares.sum(axis=1, keepdims=True)
        return cls._maximised(codes, variances, shares)

    @classmethod
    def _maximised(
        cls, codes: np.ndarray, variances: np.ndarray, shares: np.ndarray
    ) -> CodeMixture:
        """Return the mixture of codes with their shares of each component, (N, K)."""
        counts = shares.sum(axis=0) + 1e-9
        means = shares.T @ codes / counts[:, None]
        scatter, within = [], (shares.T @ variances)
        for k in range(len(counts)):
            apart = codes - means[k]
            scatter.append((shares[:, k, None] * apart).T @ apart + np.diag(within[k]))
        shared = np.sum(scatter, axis=0) / len(codes)
        least = _LEAST_VARIANCE * np.eye(codes.shape[1])
        factors = [
            np.linalg.cholesky((one + _PSEUDO_COUNT * shared) / (count + _PSEUDO_COUNT) + least)
            for one, count in zip(scatter, counts, strict=True)
        ]
        return cls(counts / counts.sum(), means, np.array(factors))

    @property
    def dim(self) -> int:
        """Length Z of a code."""
        return self.means.shape[1]

    def _log_shares(self, z: Array, alpha_bar: float = 1.0) -> Array:
        """Return log π_k N(z; √ᾱ m_k, ᾱ Σ_k + (1 − ᾱ) I), ``(…, Z) → (…, K)``."""
        check_shape("z", z, ("…", self.dim))
        xp = array_namespace(z)
        variances, directions = self._spectra
        noisy = alpha_bar * variances + 1 - alpha_bar
        scaled = directions / np.sqrt(noisy)[:, None]
        along = self._deviations(z, scaled, math.sqrt(alpha_bar))
        constants = np.log(self.weights) - 0.5 * np.log(2 * np.pi * noisy).sum(axis=-1)
        return constant(constants, z) - 0.5 * xp.sum(along**2, axis=-1)

    def _deviations(self, z: Array, matrices: np.ndarray, scale: float) -> Array:
        """Return (z − scale m_k) A_k for matrices A (K, Z, Z), ``(…, Z) → (…, K, Z)``."""
        k, dim = self.means.shape
        # One product is much faster than one for each component.
        product = z @ constant(matrices.swapaxes(0, 1).reshape(dim, k * dim), z)
        centres = scale * (self.means[:, None] @ matrices)[:, 0]
        return product.reshape(*z.shape[:-1], k, dim) - constant(centres, z)

    @cached_property
    def _spectra(self) -> tuple[np.ndarray, np.ndarray]:
        """Variances (K, Z) and directions (K, Z, Z, in columns) of the components."""
        covariances = self.factors @ self.factors.swapaxes(-1, -2)
        variances, directions = np.linalg.eigh(covariances)
        return variances, directions

    def log_density(self, z: Array) -> Array:
        """Return log p(z): ``(…, Z) → (…)``."""
        return _log_sum_exp(self._log_shares(z))

    def _mean_log_shares(self, mean: Array, variance: Array) -> Array:
        """Return E[log π_k N(z; m_k, Σ_k)] for z ~ N(mean, diag variance), ``(…, K)``."""
        variances, directions = self._spectra
        precisions = (directions**2 / variances[:, None]).sum(axis=-1)  # diagonals of Σ⁻¹, (K, Z)
        return self._log_shares(mean) - 0.5 * variance @ constant(precisions.T, mean)

    def mean_log_density(self, mean: Array, variance: Array) -> Array:
        """Return a lower bound of E[log p(z)] for z ~ N(mean, diag variance), ``(…, Z) → (…)``.

        By Jensen's inequality; exact for one component.
        """
        return _log_sum_exp(self._mean_log_shares(mean, variance))

    def draw(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Return n codes, (n, Z)."""
        if len(self.weights) == 1:
            return self.means + rng.standard_normal((n, self.dim)) @ self.factors[0].T
        # One row of random numbers per code, so that codes do not depend on their number.
        numbers = rng.standard_normal((n, self.dim + 1))
        above = ndtr(numbers[:, -1:]) > np.cumsum(self.weights)[:-1]
        component = above.sum(axis=1)
        noise = numbers[:, :-1]
        return self.means[component] + np.einsum("nij,nj->ni", self.factors[component], noise)

    def denoise(self, z_t: Array, alpha_bar: float) -> Array:
        """Return E[z | z_t] for z_t = √ᾱ z + √(1 − ᾱ) ε: ``(…, Z) → (…, Z)``."""
        xp = array_namespace(z_t)
        log_shares = self._log_shares(z_t, alpha_bar)
        shares = xp.exp(log_shares - xp.max(log_shares, axis=-1, keepdims=True))
        shares = shares / xp.sum(shares, axis=-1, keepdims=True)
        variances, directions = self._spectra
        gain = math.sqrt(alpha_bar) * variances / (alpha_bar * variances + 1 - alpha_bar)
        matrices = (directions * gain[:, None]) @ directions.swapaxes(-1, -2)
        moved = self._deviations(z_t, matrices, math.sqrt(alpha_bar))
        return xp.sum(shares[..., None] * (constant(self.means, z_t) + moved), axis=-2)

    def along(self, directions: np.ndarray) -> CodeMixture:
        """Return the distribution of the coordinates Uᵀ z along orthonormal U (Z, k)."""
        check_shape("directions", directions, (self.dim, "k"))
        projected = directions.T @ self.factors
        covariances = projected @ projected.swapaxes(-1, -2)
        return CodeMixture(self.weights, self.means @ directions, np.linalg.cholesky(covariances))


def _log_sum_exp(values: Array) -> Array:
    xp = array_namespace(values)
    highest = xp.max(values, axis=-1, keepdims=True)
    return highest[..., 0] + xp.log(xp.sum(xp.exp(values - highest), axis=-1))


def _initial(codes: np.ndarray, components: int, rng: np.random.Generator) -> np.ndarray:
    """Return the closest of K random codes for each code, (N,), after some rounds of k-means."""
    centres = codes[rng.choice(len(codes), components, replace=False)]
    for _ in range(20):
        squares = (centres**2).sum(axis=1) - 2 * codes @ centres.T
        closest = squares.argmin(axis=1)
        for k in range(components):
            if (closest == k).any():
                centres[k] = codes[closest == k].mean(axis=0)
    return closest


class CodePrior(ABC):
    """Prior with coordinates θ from a mixture, as NumPy or torch arrays.

    Subclasses decode θ into motions. The density, draws and denoiser of θ are exact.
    """

    codes: CodeMixture

    @property
    def dim(self) -> int:
        """Length of θ."""
        return self.codes.dim

    @abstractmethod
    def motion(self, theta: Array) -> Array:
        """Return the motion at θ, ``(…, dim) → (…, L, J, 3)``, metres."""

    def log_density(self, theta: Array) -> Array:
        """Return log p(θ): ``(…, dim) → (…)``."""
        return self.codes.log_density(theta)

    def initial(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Return n draws of θ, (n, dim)."""
        return self.codes.draw(rng, n)

    def sample(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Return n motions, (n, L, J, 3), metres."""
        return self.motion(self.initial(rng, n))

    def denoise_coordinates(self, theta_t: Array, alpha_bar: float) -> Array:
        """Return E[θ | θ_t] for θ_t = √ᾱ θ + √(1 − ᾱ) ε: ``(…, dim) → (…, dim)``."""
        return self.codes.denoise(theta_t, alpha_bar)
