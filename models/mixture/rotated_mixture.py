"""Gaussian mixture of components rotated about the vertical, with exact density and denoiser.

Component (k, a), with style k < K and azimuth ψ_a, a < A, has mean R(ψ_a) m_k, r factors R(ψ_a) W_k
and noise variance δ². A rotated field f is a trigonometric combination of three base fields,

    R(ψ) f = cos ψ (f_x, 0, f_z) + sin ψ (f_z, 0, −f_x) + (0, f_y, 0),

and its orthographic projections have the same form. Products with all K·A components therefore
reduce to products with 3·K·(1 + r) base fields, combined per azimuth.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from probmotion.arrays import Array, array_namespace, constant, logsumexp

__all__ = ["RotatedMixture", "rotation_coefficients", "rotation_fields"]

_BLOCK = 64
"""Points per block, so that products fit into a core's cache. The last block is padded with zeros:
rounding of a point must not depend on the batch size, as a sampler's steps amplify differences."""


def rotation_fields(fields: np.ndarray) -> np.ndarray:
    """Return the three base fields of each field of F vectors: ``(…, F, 3) → (…, 3, F, 3)``."""
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


def rotation_coefficients(azimuths: np.ndarray) -> np.ndarray:
    """Return the weights (cos ψ, sin ψ, 1) of the base fields, ``(A,) → (A, 3)``."""
    return np.stack([np.cos(azimuths), np.sin(azimuths), np.ones_like(azimuths)], axis=-1)


class _Level(NamedTuple):
    """Quantities that depend only on the noise level.

    ``signal``: √ᾱ; ``total``: τ = ᾱ δ² + 1 − ᾱ, the variance around the factors; ``shrink``:
    (1−ᾱ)/τ; ``root`` (K, A, r): (1 + ᾱλ/τ)^(−½), λ as in ``_State``; ``to_latent``: matrices
    (K, A r, 3 r + 1) from base products and 1 to whitened latents.
    """

    signal: float
    total: float
    shrink: float
    root: np.ndarray
    to_latent: np.ndarray


class _State(NamedTuple):
    """Posterior of components and latents given one noisy observation of each of n points.

    Contains p(k, a | x), (K, A, n), and the whitened latents u = (1 + ᾱλ/τ)^(−½) Bᵀ W_kᵀ R(ψ_a)ᵀ
    (x − √ᾱ R(ψ_a) m_k), (K, A, r, n): E[z | x, k, a] = √ᾱ/τ B (1 + ᾱλ/τ)^(−½) u, with λ and B the
    eigenvalues and eigenbasis of the component's Gram matrix.
    """

    responsibilities: np.ndarray
    whitened: np.ndarray


class RotatedMixture:
    """Gaussian mixture of noisy points x = √ᾱ (R(ψ_a)(m_k + W_k z) + δ ε) + √(1−ᾱ) ε' in ℝ^D.

    ``fields`` (K, 1 + r, 3, D) contains the base fields of each mean and its factors, ``azimuths``
    (A,) the equally likely azimuths, ``weights`` (K,) the style probabilities; ``variance`` is δ².
    """

    def __init__(
        self, fields: np.ndarray, azimuths: np.ndarray, weights: np.ndarray, variance: float
    ) -> None:
        K, width, _, D = fields.shape
        self.rank = width - 1
        self.variance = variance
        self.dim = D
        self.rotations = rotation_coefficients(azimuths)
        A = len(azimuths)
        self.shape = (K, A)
        self.log_weights = np.log(weights) - math.log(A)
        gram = np.einsum("kicd,kjed->kijce", fields, fields, optimize=True)
        gram = np.einsum("kijce,ac,ae->kaij", gram, self.rotations, self.rotations, optimize=True)
        self.square_mean = gram[..., 0, 0]
        self.eigenvalues, basis = np.linalg.eigh(gram[..., 1:, 1:])
        self.eigenvalues = np.maximum(self.eigenvalues, 0.0)
        self.basis = basis
        self.mean_latent = np.einsum("kair,kai->kar", basis, gram[..., 1:, 0])
        # Base products → products with every rotated eigenvector: (K, A r, 3 r).
        spread = np.einsum("ac,kair->karic", self.rotations, basis, optimize=True)
        self.to_latent = np.ascontiguousarray(spread.reshape(K, A * self.rank, 3 * self.rank))
        # Each style's row of zeros reserves a row of products for a constant that shifts latents.
        rows = np.zeros((K, 3 * width + 1, D))
        rows[:, :-1] = fields.reshape(K, 3 * width, D)
        self._fields = rows.reshape(-1, D)

    def denoise(self, x: np.ndarray, alpha_bar: float) -> np.ndarray:
        """Return E[x₀ | x_t]: ``(n, D) → (n, D)``, with x_t = √ᾱ x₀ + √(1−ᾱ) ε."""
        level = self._level(alpha_bar)
        out = np.empty_like(x)
        noise_factor = level.signal * self.variance / level.total
        latent_factor = level.signal / level.total
        for rows, n in _blocks(len(x)):
            weight, latent = self._condition(_filled(x[rows]), level)
            weight *= level.shrink
            latent *= weight[:, :, None]
            means = np.matmul(*self._combined(weight, latent, latent_factor, level))
            np.add(means[:n], noise_factor * x[rows], out=out[rows])
        return out

    def covariance(self, x: np.ndarray, alpha_bar: float) -> Callable[[np.ndarray], np.ndarray]:
        """Return v ↦ Cov[x₀ | x_t] v for each row of x_t: ``(n, D) → (n, D)``."""
        level = self._level(alpha_bar)
        states = []
        for rows, n in _blocks(len(x)):
            weight, latent = self._condition(_filled(x[rows]), level)
            latent *= level.signal / level.total
            states.append((rows, n, weight, latent))

        def product(v: np.ndarray) -> np.ndarray:
            out = np.empty_like(v)
            for rows, n, weight, latent in states:
                on_mean, on_latent = self._products(_filled(v[rows]), level, shifted=False)
                clean = on_mean + np.einsum("karn,karn->kan", latent, on_latent)
                weighted = weight * (clean - (weight * clean).sum(axis=(0, 1)))
                on_latent *= weight[:, :, None]
                on_latent += latent * weighted[:, :, None]
                signal = np.matmul(*self._combined(weighted, on_latent, 1.0, level))[:n]
                out[rows] = level.shrink**2 * signal + self.variance * level.shrink * v[rows]
            return out

        return product

    def responsibilities(self, x: np.ndarray) -> np.ndarray:
        """Return p(k, a | x₀) for clean points: ``(n, D) → (n, K, A)``."""
        level = self._level(1.0)
        out = np.empty((len(x), *self.shape))
        for rows, n in _blocks(len(x)):
            weight, _ = self._condition(_filled(x[rows]), level)
            out[rows] = weight[..., :n].transpose(2, 0, 1)
        return out

    def log_density(self, x: Array) -> Array:
        """Return the normalised log density of x₀: ``(…, D) → (…)``; NumPy, torch or JAX."""
        xp = array_namespace(x)
        level = self._level(1.0)
        K, A = self.shape
        batch = x.shape[:-1]
        n = math.prod(batch)
        flat = xp.reshape(x, (n, self.dim))
        width = 3 * (1 + self.rank)
        fields = self._fields.reshape(K, width + 1, self.dim)[:, :-1].reshape(K * width, -1)
        products = xp.reshape(flat @ constant(fields.T, flat), (n, K, 1 + self.rank, 3))
        on_mean = products[:, :, 0, :] @ constant(self.rotations.T, flat)
        factors = xp.reshape(products[:, :, 1:, :], (n, K, 1, 3 * self.rank))
        to_latent = np.swapaxes(level.to_latent, 1, 2)
        whitened = factors @ constant(to_latent[:, :-1], flat)
        whitened = whitened[:, :, 0, :] + constant(to_latent[:, -1], flat)
        square = xp.sum(xp.reshape(whitened, (n, K, A, self.rank)) ** 2, axis=-1)
        logits = (level.signal / level.total) * on_mean
        logits = logits + (0.5 * level.signal**2 / level.total**2) * square
        logits = xp.reshape(logits + constant(self._offsets(level), flat), (n, K * A))
        norm = xp.sum(flat**2, axis=-1) / level.total
        norm = norm + self.dim * math.log(2 * math.pi * level.total)
        return xp.reshape(logsumexp(logits) - 0.5 * norm, batch)

    def residual_variance(self, x: np.ndarray) -> np.ndarray:
        """Return the mean square of x outside its most likely component's subspace: (n,).

        Its expected value is δ².
        """
        level = self._level(1.0)
        # ‖x − m‖² minus its component inside the subspace, Σ (Bᵀ Wᵀ (x − m))² / λ.
        positive = self.eigenvalues > 0
        inverse = np.zeros_like(self.eigenvalues)
        inverse[positive] = 1 / (level.root**2 * self.eigenvalues)[positive]
        out = np.empty(len(x))
        for rows, n in _blocks(len(x)):
            block = _filled(x[rows])
            on_mean, whitened = self._products(block, level, shifted=True)
            inside = np.einsum("karn,karn,kar->kan", whitened, whitened, inverse, optimize=True)
            square = self.square_mean[..., None] - inside - 2 * on_mean + (block**2).sum(axis=1)
            weight, _ = self._condition(block, level)
            most_likely = weight.reshape(-1, _BLOCK).argmax(axis=0)
            outside = square.reshape(-1, _BLOCK)[most_likely, np.arange(_BLOCK)]
            out[rows] = outside[:n] / (self.dim - self.rank)
        return out

    def _level(self, alpha_bar: float) -> _Level:
        total = alpha_bar * self.variance + 1 - alpha_bar
        signal = math.sqrt(alpha_bar)
        root = 1 / np.sqrt(1 + (alpha_bar / total) * self.eigenvalues)
        K, A = self.shape
        flat_root = root.reshape(K, A * self.rank)
        to_latent = np.empty((K, A * self.rank, 3 * self.rank + 1))
        np.multiply(self.to_latent, flat_root[..., None], out=to_latent[..., :-1])
        to_latent[..., -1] = -signal * self.mean_latent.reshape(K, A * self.rank) * flat_root
        return _Level(signal, total, (1 - alpha_bar) / total, root, to_latent)

    def _offsets(self, level: _Level) -> np.ndarray:
        """Return the terms of log p(k, a, x) that depend on (k, a) but not on x, (K, A)."""
        energy = level.signal**2 * self.square_mean / level.total
        return self.log_weights[:, None] + np.log(level.root).sum(axis=-1) - 0.5 * energy

    def _condition(self, x: np.ndarray, level: _Level) -> _State:
        logits, whitened = self._products(x, level, shifted=True)
        logits *= level.signal / level.total
        square = np.einsum("karn,karn->kan", whitened, whitened)
        square *= 0.5 * level.signal**2 / level.total**2
        logits += square
        logits += self._offsets(level)[..., None]
        logits -= logits.max(axis=(0, 1))
        np.exp(logits, out=logits)
        logits /= logits.sum(axis=(0, 1))
        return _State(logits, whitened)

    def _products(
        self, x: np.ndarray, level: _Level, *, shifted: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return products of x with rotated means (K, A, n) and whitened eigenvectors (K, A, r, n).

        With ``shifted``, the component's noisy mean is subtracted from x for the latter.
        """
        K, A = self.shape
        n = len(x)
        base = (self._fields @ x.T).reshape(K, 3 * (1 + self.rank) + 1, n)
        base[:, -1] = float(shifted)
        on_latent = level.to_latent @ base[:, 3:]
        return self.rotations @ base[:, :3], on_latent.reshape(K, A, self.rank, n)

    def _combined(
        self, means: np.ndarray, latent: np.ndarray, latent_factor: float, level: _Level
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return Σ_ka R (means m_k + latent_factor W_k B (1 + ᾱλ/τ)^(−½) latent) as two factors.

        ``(K, A, n), (K, A, r, n) → (n, F), (F, D)``.
        """
        K, A, n = means.shape
        base = np.empty((K, 3 * (1 + self.rank) + 1, n))
        np.matmul(self.rotations.T, means, out=base[:, :3])
        back = np.swapaxes(level.to_latent, 1, 2)
        np.matmul(back, latent.reshape(K, A * self.rank, n), out=base[:, 3:])
        base[:, 3:] *= latent_factor
        # The last row multiplies a field of zeros.
        return base.reshape(-1, n).T, self._fields


def _blocks(n: int) -> Iterator[tuple[slice, int]]:
    """Yield the slice of rows of each block and the number of rows."""
    for start in range(0, n, _BLOCK):
        stop = min(n, start + _BLOCK)
        yield slice(start, stop), stop - start


def _filled(rows: np.ndarray) -> np.ndarray:
    """Return ``rows`` padded with zeros to ``_BLOCK`` rows."""
    if len(rows) == _BLOCK:
        return rows
    block = np.zeros((_BLOCK, rows.shape[1]))
    block[: len(rows)] = rows
    return block
