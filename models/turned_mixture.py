"""A Gaussian mixture whose components are turned copies of a few: exact algebra, fast.

Component (k, a) has mean R(ψ_a) m_k, factors R(ψ_a) W_k and isotropic noise δ². A turned field is
a trigonometric combination of three base fields,

    R(ψ) f = cos ψ (f_x, 0, f_z) + sin ψ (f_z, 0, −f_x) + (0, f_y, 0),

and so is its image in any orthographic camera. Products with all K·A components are therefore
products with 3·K·(1 + r) base fields, combined per azimuth.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from probmotion.arrays import Array, array_namespace, constant, logsumexp

__all__ = ["Conditioned", "TurnedMixture", "turning_coefficients", "turning_fields"]

_BLOCK = 128
"""Rows handled at once: their products with all components stay in a core's cache."""


def turning_fields(fields: np.ndarray) -> np.ndarray:
    """Return the three base fields of each field: ``(…, F, 3) → (…, 3, F, 3)``."""
    x, y, z = fields[..., 0], fields[..., 1], fields[..., 2]
    zero = np.zeros_like(x)
    return np.stack(
        [
            np.stack([x, zero, z], axis=-1),
            np.stack([z, zero, -x], axis=-1),
            np.stack([zero, y, zero], axis=-1),
        ],
        axis=-3,
    )


def turning_coefficients(yaws: np.ndarray) -> np.ndarray:
    """Return the weights (cos ψ, sin ψ, 1) of the base fields, ``(A,) → (A, 3)``."""
    return np.stack([np.cos(yaws), np.sin(yaws), np.ones_like(yaws)], axis=-1)


class Conditioned(NamedTuple):
    """The mixture after one noisy observation of each of n points.

    Attributes
    ----------
    responsibilities : ndarray, (K, n, A)
        p(k, a | x).
    latent : ndarray, (K, n, A, r)
        E[z | x, k, a] in the eigenbasis of the component's Gram matrix.
    """

    responsibilities: np.ndarray
    latent: np.ndarray


class TurnedMixture:
    """x = √ᾱ (R(ψ_a)(m_k + W_k z) + δ ε) + √(1−ᾱ) ε', in D dimensions.

    Parameters
    ----------
    fields : ndarray, (K, 1 + r, 3, D)
        Base fields of the mean (first) and the factors of each style.
    yaws : ndarray, (A,)
        Azimuths ψ, radians, equally likely.
    weights : ndarray, (K,)
        Probabilities of the styles.
    variance : float
        δ².
    """

    def __init__(
        self, fields: np.ndarray, yaws: np.ndarray, weights: np.ndarray, variance: float
    ) -> None:
        K, width, _, D = fields.shape
        self.rank = width - 1
        self.variance = variance
        self.dim = D
        self.turns = turning_coefficients(yaws)
        A = len(yaws)
        self.shape = (K, A)
        self.log_weights = np.log(weights) - math.log(A)
        self.fields = np.ascontiguousarray(fields.reshape(K * width * 3, D))
        gram = np.einsum("kicd,kjed->kijce", fields, fields, optimize=True)
        gram = np.einsum("kijce,ac,ae->kaij", gram, self.turns, self.turns, optimize=True)
        self.square_mean = gram[..., 0, 0]
        self.eigenvalues, basis = np.linalg.eigh(gram[..., 1:, 1:])
        self.eigenvalues = np.maximum(self.eigenvalues, 0.0)
        self.basis = basis
        self.mean_latent = np.einsum("kair,kai->kar", basis, gram[..., 1:, 0])
        # Base products → products with every turned eigenvector: (K, 3 r, A r).
        spread = np.einsum("ac,kair->kicar", self.turns, basis, optimize=True)
        self.to_latent = np.ascontiguousarray(spread.reshape(K, 3 * self.rank, A * self.rank))
        self.from_latent = np.ascontiguousarray(np.swapaxes(self.to_latent, 1, 2))

    def denoise(self, x: np.ndarray, alpha_bar: float) -> np.ndarray:
        """Return E[x₀ | x_t]: ``(n, D) → (n, D)``, with x_t = √ᾱ x₀ + √(1−ᾱ) ε."""
        signal, total, shrink = self._levels(alpha_bar)
        out = np.empty_like(x)
        for start in range(0, len(x), _BLOCK):
            rows = slice(start, start + _BLOCK)
            means = self._mean_clean(self.condition(x[rows], alpha_bar))
            means *= shrink
            means += (signal * self.variance / total) * x[rows]
            out[rows] = means
        return out

    def covariance_product(self, x: np.ndarray, alpha_bar: float, v: np.ndarray) -> np.ndarray:
        """Return Cov[x₀ | x_t] v row by row: ``(n, D), (n, D) → (n, D)``.

        The mean of the components' covariances plus the covariance of their means.
        """
        signal, total, shrink = self._levels(alpha_bar)
        spread = 1 / (1 + (signal**2 / total) * self.eigenvalues)
        out = np.empty_like(v)
        for start in range(0, len(x), _BLOCK):
            rows = slice(start, start + _BLOCK)
            state = self.condition(x[rows], alpha_bar)
            on_mean, on_latent = self._products(v[rows])
            clean = on_mean + np.einsum("knar,knar->kna", state.latent, on_latent)
            centred = clean - np.einsum("kna,kna->n", state.responsibilities, clean)[:, None]
            weighted = state.responsibilities * centred
            latent = on_latent * spread[:, None] * state.responsibilities[..., None]
            latent += state.latent * weighted[..., None]
            product = self._combine(weighted, latent)
            out[rows] = shrink**2 * product + self.variance * shrink * v[rows]
        return out

    def condition(self, x: np.ndarray, alpha_bar: float) -> Conditioned:
        """Return the components' responsibilities and latent means for ``x`` (n, D)."""
        signal, total, _ = self._levels(alpha_bar)
        on_mean, centred = self._products(x)
        centred -= signal * self.mean_latent[:, None]
        spread = 1 / (1 + (signal**2 / total) * self.eigenvalues)
        latent = centred * spread[:, None]
        logits = np.einsum("knar,knar->kna", centred, latent)
        logits *= 0.5 * signal**2 / total**2
        on_mean *= signal / total
        logits += on_mean
        logits += self._offsets(signal, total)[:, None]
        logits -= logits.max(axis=(0, 2))[:, None]
        np.exp(logits, out=logits)
        logits /= logits.sum(axis=(0, 2))[:, None]
        latent *= signal / total
        return Conditioned(logits, latent)

    def log_density(self, x: Array, alpha_bar: float = 1.0) -> Array:
        """Return the normalised log density of x_t: ``(…, D) → (…)``, any array library."""
        xp = array_namespace(x)
        signal, total, _ = self._levels(alpha_bar)
        K, A = self.shape
        batch = x.shape[:-1]
        n = math.prod(batch)
        flat = xp.reshape(x, (n, self.dim))
        fields = constant(self.fields.T, flat)
        products = xp.reshape(flat @ fields, (n, K, 1 + self.rank, 3))
        on_mean = products[:, :, 0, :] @ constant(self.turns.T, flat)
        factors = xp.reshape(products[:, :, 1:, :], (n, K, 1, 3 * self.rank))
        latent = xp.reshape(factors @ constant(self.to_latent, flat), (n, K, A, self.rank))
        centred = latent - constant(signal * self.mean_latent, flat)
        spread = 1 / (1 + (signal**2 / total) * self.eigenvalues)
        square = xp.sum(centred**2 * constant(spread, flat), axis=-1)
        logits = (signal / total) * on_mean + (0.5 * signal**2 / total**2) * square
        logits = xp.reshape(logits + constant(self._offsets(signal, total), flat), (n, K * A))
        norm = xp.sum(flat**2, axis=-1) / total + self.dim * math.log(2 * math.pi * total)
        return xp.reshape(logsumexp(logits) - 0.5 * norm, batch)

    def residual_variance(self, x: np.ndarray) -> np.ndarray:
        """Return the mean square of ``x`` outside its component's subspace: ``(n, D) → (n,)``.

        The component is the one of highest responsibility at ᾱ = 1; the expected value is δ².
        """
        K, A = self.shape
        out = np.empty(len(x))
        for start in range(0, len(x), _BLOCK):
            rows = slice(start, start + _BLOCK)
            state = self.condition(x[rows], 1.0)
            on_mean, centred = self._products(x[rows])
            centred -= self.mean_latent[:, None]
            safe = np.where(self.eigenvalues > 0, self.eigenvalues, np.inf)
            inside = np.einsum("knar,knar,kar->kna", centred, centred, 1 / safe, optimize=True)
            square = (x[rows] ** 2).sum(axis=-1)[:, None] - 2 * on_mean
            square += self.square_mean[:, None] - inside
            n = square.shape[1]
            likeliest = np.swapaxes(state.responsibilities, 0, 1).reshape(n, K * A).argmax(axis=1)
            flat = np.swapaxes(square, 0, 1).reshape(n, K * A)
            out[rows] = flat[np.arange(n), likeliest] / (self.dim - self.rank)
        return out

    def _levels(self, alpha_bar: float) -> tuple[float, float, float]:
        """√ᾱ, the noise's variance τ = ᾱ δ² + 1 − ᾱ around the factors, and (1−ᾱ)/τ."""
        total = alpha_bar * self.variance + 1 - alpha_bar
        return math.sqrt(alpha_bar), total, (1 - alpha_bar) / total

    def _offsets(self, signal: float, total: float) -> np.ndarray:
        """The part of log π p(x | k, a) that does not depend on x, (K, A)."""
        log_det = np.log1p((signal**2 / total) * self.eigenvalues).sum(axis=-1)
        energy = signal**2 * self.square_mean / total
        return self.log_weights[:, None] - 0.5 * (log_det + energy)

    def _products(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Products with every turned mean (K, n, A) and eigenvector (K, n, A, r)."""
        K, A = self.shape
        base = (x @ self.fields.T).reshape(len(x), K, 3 * (1 + self.rank)).transpose(1, 0, 2)
        on_mean = base[..., :3] @ self.turns.T
        on_latent = (base[..., 3:] @ self.to_latent).reshape(K, len(x), A, self.rank)
        return on_mean, on_latent

    def _mean_clean(self, state: Conditioned) -> np.ndarray:
        """Σ p(k, a | x) R(ψ_a)(m_k + W_k E[z | x, k, a]), (n, D)."""
        latent = state.latent * state.responsibilities[..., None]
        return self._combine(state.responsibilities, latent)

    def _combine(self, means: np.ndarray, latent: np.ndarray) -> np.ndarray:
        """Σ_ka (means_ka R m_k + R W_k latent_ka): ``(K, n, A), (K, n, A, r) → (n, D)``."""
        K, n, A = means.shape
        base = np.empty((n, K, 3 * (1 + self.rank)))
        base[..., :3] = (means @ self.turns).transpose(1, 0, 2)
        flat = latent.reshape(K, n, A * self.rank)
        base[..., 3:] = (flat @ self.from_latent).transpose(1, 0, 2)
        return base.reshape(n, len(self.fields)) @ self.fields
