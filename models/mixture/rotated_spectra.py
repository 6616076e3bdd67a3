"""Rotated spectral mixture observed with isotropic noise: density, denoiser, covariance products.

Component (k, s, a) has the DCT coefficients X = R(ψ_a)(m_k + V_k z), with independent
z_fp ~ N(0, λ_{k,s,f,p}) for frequency f and direction p. The noise is isotropic, so that
everything decouples in the coordinates V_kᵀ R(ψ_a)ᵀ y. These are trigonometric combinations of
three base products (cos ψ, −sin ψ, 1; see :mod:`~probmotion.models.mixture.rotated_mixture`).
Squared distances of all azimuths therefore follow from one 3×3 Gram matrix, and sums over azimuths
from a 3×3 matrix of weights: the cost does not depend on the number of azimuths. Means are

    E[X | y, k, s, a] = y − v R(ψ_a) V_k (λ + v)⁻¹ V_kᵀ (R(ψ_a)ᵀ y − m_k).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from probmotion.arrays import Array, array_namespace, constant, logsumexp
from probmotion.extras import is_installed
from probmotion.models.mixture.rotated_mixture import rotation_coefficients

if is_installed("numba"):
    from probmotion.models.mixture._spectral_kernels import (
        cross_products,
        from_bases,
        self_products,
        to_bases,
    )
else:
    from probmotion.models.mixture._spectral_products import (
        cross_products,
        from_bases,
        self_products,
        to_bases,
    )

__all__ = ["RotatedSpectra", "blocks"]

_BLOCK = 16
"""Points per block, so that products fit into a core's cache. The last block is padded with zeros:
rounding of a point must not depend on the batch size."""
_NEGLIGIBLE = 1e-16  # responsibilities below are set to 0
_Bases = tuple[np.ndarray, np.ndarray]  # products on the ground and in height
_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))  # entries of a symmetric 3×3 matrix


class _Level(NamedTuple):
    """Quantities that depend only on the variance v of the noise.

    ``precision`` 1/(λ + v), (K, S, L, P); ``offsets``, (K, S): log of each component's density of
    y at its mean, up to a constant.
    """

    variance: float
    precision: np.ndarray
    offsets: np.ndarray


class RotatedSpectra:
    """Mixture of motions X observed as y = X + N(0, v I), in DCT coefficients.

    Parameters
    ----------
    directions : ndarray, (K, B, P, P)
        V_k in each band of frequencies: orthonormal columns, P = 3 J.
    band : ndarray of int, (L,)
        Band of each frequency, ascending.
    means : ndarray, (K, L, P)
        m_k.
    spectra : ndarray, (K, S, L, P)
        λ: variances of the coordinates.
    log_weights : ndarray, (K, S)
        Log probabilities of the components.
    azimuths : ndarray, (A,)
        Equally likely azimuths ψ_a.
    """

    def __init__(
        self,
        directions: np.ndarray,
        band: np.ndarray,
        means: np.ndarray,
        spectra: np.ndarray,
        log_weights: np.ndarray,
        azimuths: np.ndarray,
    ) -> None:
        K, S, L, P = spectra.shape
        self.shape = (K, S, len(azimuths))
        self.frames, self.n_joints = L, P // 3
        self._means = (means[:, :, None] @ directions[:, band])[:, :, 0]
        # Resampled priors have no frequency in some bands.
        used, band = np.unique(band, return_inverse=True)
        directions = directions[:, used]
        self._spectra = spectra
        self._log_weights = log_weights - math.log(len(azimuths))
        # Rows of the x and z coordinates, and of the y coordinates.
        parts = (directions[:, :, 0::3], directions[:, :, 2::3])
        self._ground = np.ascontiguousarray(np.concatenate(parts, axis=2))
        self._height = np.ascontiguousarray(directions[:, :, 1::3])
        along, up = self._ground.swapaxes(2, 3), self._height.swapaxes(2, 3)
        J = self.n_joints
        turned = np.concatenate([along[..., J:], -along[..., :J]], axis=3)
        both = np.concatenate([along, turned], axis=2)
        self._transposed = np.ascontiguousarray(both), np.ascontiguousarray(up)
        self._edges = np.flatnonzero(np.diff(band, prepend=-1, append=-1))
        self._bands = [
            (int(band[start]), int(start), int(stop)) for start, stop in pairwise(self._edges)
        ]
        # Indices of a block's frequencies in the order of the bases' rows, and of the pairs.
        index = np.arange(_BLOCK * L).reshape(_BLOCK, L)
        rows = [index[:, start:stop].ravel() for _, start, stop in self._bands]
        self._order = np.concatenate(rows)
        self._twice = np.concatenate([2 * row + i for row in rows for i in range(2)])
        to_world = rotation_coefficients(azimuths)  # (A, 3)
        to_canonical = to_world * [1.0, -1.0, 1.0]
        # Bilinear and quadratic forms in (cos ψ, −sin ψ, 1) as products with their coefficients.
        products = to_canonical[:, :, None] * to_canonical[:, None, :]
        self._forms = products.reshape(len(azimuths), 9).T.copy()  # (9, A)
        self._squares = np.stack(
            [products[:, i, j] * (1 if i == j else 2) for i, j in _PAIRS]
        )  # (6, A)
        both = to_world[:, :, None] * to_canonical[:, None, :]
        self._both = both.reshape(len(azimuths), 9)
        self._last: _Level | None = None

    def denoise(self, y: np.ndarray, variance: float) -> np.ndarray:
        """Return E[X | y]: ``(n, L, J, 3) → (n, L, J, 3)``."""
        level = self._level(variance)
        out = np.empty_like(y)
        bases = self._space()
        for rows, block in blocks(y):
            self._bases(block, self._means, bases)
            weights = self._responsibilities(bases, level)
            mean = block - variance * self._weighted(bases, level.precision, weights)
            out[rows] = mean[: rows.stop - rows.start]
        return out

    def covariance(self, y: np.ndarray, variance: float) -> Callable[[np.ndarray], np.ndarray]:
        """Return u ↦ Cov[X | y] u for each row of y: arrays (n, L, J, 3)."""
        level = self._level(variance)
        no_means, own = np.zeros_like(self._means), self._spectra * level.precision
        states = []
        for _, block in blocks(y):
            bases = self._bases(block, self._means, self._space())
            states.append((bases, self._responsibilities(bases, level)))

        def product(vectors: np.ndarray) -> np.ndarray:
            out, turned = np.empty_like(vectors), self._space()
            for (rows, directions), (bases, weights) in zip(blocks(vectors), states, strict=True):
                self._bases(directions, no_means, turned)
                # Products of (y − E[X | y, k, s, a]) / v with the vectors, from 3×3 matrices.
                products = self._products(bases, turned, level.precision)
                centred = products - (weights * products).sum(axis=(1, 2, 3), keepdims=True)
                between = self._weighted(bases, level.precision, weights * centred)
                # A component's own covariance is v λ / (λ + v) in each direction.
                within = self._weighted(turned, own, weights)
                total = variance**2 * between + variance * within
                out[rows] = total[: rows.stop - rows.start]
            return out

        return product

    def responsibilities(self, x: np.ndarray) -> np.ndarray:
        """Return p(k, s, a | X): ``(n, L, J, 3) → (n, K, S, A)``."""
        out = np.empty((len(x), *self.shape))
        level, bases = self._level(0.0), self._space()
        for rows, block in blocks(x):
            weights = self._responsibilities(self._bases(block, self._means, bases), level)
            out[rows] = weights[: rows.stop - rows.start]
        return out

    def log_evidence(self, y: np.ndarray, variance: float) -> np.ndarray:
        """Return log p(k, s, a, y) up to a constant: ``(n, L, J, 3) → (n, K, S, A)``."""
        out = np.empty((len(y), *self.shape))
        level, bases = self._level(variance), self._space()
        for rows, block in blocks(y):
            logits = self._logits(self._bases(block, self._means, bases), level)
            out[rows] = logits[: rows.stop - rows.start]
        return out

    def log_density(self, x: Array) -> Array:
        """Return log p(X): ``(n, L, J, 3) → (n,)``; NumPy, torch or JAX."""
        xp = array_namespace(x)
        K, S, _ = self.shape
        n = x.shape[0]
        precision = 1 / self._spectra.reshape(K, S, -1)
        ground = xp.concat([x[..., 0], x[..., 2]], axis=-1)
        turned = xp.concat([x[..., 2], -x[..., 0]], axis=-1)
        products = []
        for b, start, stop in self._bands:
            V, H = constant(self._ground[:, None, b], x), constant(self._height[:, None, b], x)
            rows = slice(start, stop)
            products.append((ground[:, rows] @ V, turned[:, rows] @ V, x[:, rows, :, 1] @ H))
        bases = [
            xp.reshape(xp.concat(parts, axis=2), (K, n, -1))
            for parts in zip(*products, strict=True)
        ]
        bases[2] = bases[2] - constant(self._means.reshape(K, 1, -1), x)
        weight = constant(np.swapaxes(precision, 1, 2), x)
        gram = xp.stack([(bases[i] * bases[j]) @ weight for i, j in _PAIRS], axis=-1)
        squares = gram @ constant(self._squares, x)  # (K, n, S, A)
        offset = self._log_weights + 0.5 * np.log(precision).sum(axis=-1)
        logits = constant(offset, x)[:, None, :, None] - 0.5 * squares
        values = logsumexp(xp.reshape(xp.permute_dims(logits, (1, 0, 2, 3)), (n, -1)))
        return values - 0.5 * self._means[0].size * math.log(2 * math.pi)

    def _level(self, variance: float) -> _Level:
        """Return the quantities of a noise level; the last one is kept."""
        level = self._last
        if level is None or level.variance != variance:
            precision = 1 / (self._spectra + variance)
            offsets = self._log_weights + 0.5 * np.log(precision).sum(axis=(2, 3))
            level = self._last = _Level(variance, precision, offsets)
        return level

    def _space(self) -> _Bases:
        """Return arrays for the bases of a block; memory is slow at first use."""
        K, rows, P = self.shape[0], _BLOCK * self.frames, 3 * self.n_joints
        return np.empty((K, 2 * rows, P)), np.empty((K, rows, P))

    def _bases(self, y: np.ndarray, means: np.ndarray, out: _Bases) -> _Bases:
        """Return V_kᵀ (E_i y − δ_i3 m_k) for the three base rotations E_i.

        Rows are ordered as in :mod:`~probmotion.models.mixture._spectral_kernels`.
        """
        rows = y.reshape(-1, self.n_joints, 3)
        x, height, z = (rows[..., i] for i in range(3))
        both = np.concatenate([x, z, z, -x], axis=1).reshape(2 * len(rows), -1)
        motions = both[self._twice], height[self._order]
        to_bases(motions, (self._ground, self._height), means, self._edges, out)
        return out

    def _products(self, left: _Bases, right: _Bases, weights: np.ndarray) -> np.ndarray:
        """Return Σ w l r at each azimuth, for weights w (K, S, L, P), (n, K, S, A)."""
        K, S, _ = self.shape
        out = np.empty((left[1].shape[1] // self.frames, K, S, 9))
        cross_products(left, right, weights, self._edges, out)
        return (out.reshape(-1, K * S, 9) @ self._forms).reshape(-1, *self.shape)

    def _logits(self, bases: _Bases, level: _Level) -> np.ndarray:
        """Return log p(k, s, a, y) up to a constant, (n, K, S, A)."""
        K, S, _ = self.shape
        gram = np.empty((bases[1].shape[1] // self.frames, K, S, len(_PAIRS)))
        self_products(bases, level.precision, self._edges, gram)
        logits = (gram.reshape(-1, K * S, len(_PAIRS)) @ self._squares).reshape(-1, *self.shape)
        logits *= -0.5
        logits += level.offsets[..., None]
        return logits

    def _responsibilities(self, bases: _Bases, level: _Level) -> np.ndarray:
        """Return p(k, s, a | y), (n, K, S, A)."""
        weights = self._logits(bases, level)
        weights -= weights.max(axis=(1, 2, 3), keepdims=True)
        np.exp(weights, out=weights)
        weights /= weights.sum(axis=(1, 2, 3), keepdims=True)
        weights[weights < _NEGLIGIBLE] = 0.0
        return weights

    def _weighted(self, bases: _Bases, factors: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return Σ_ksa w R(ψ_a) V_k f V_kᵀ R(ψ_a)ᵀ (y − R(ψ_a) m_k), (n, L, J, 3)."""
        n, L, J = len(weights), self.frames, self.n_joints
        # Σ_a w c_i(ψ_a) c_j(−ψ_a) with c = (cos, sin, 1).
        sums = weights.reshape(n, -1, weights.shape[3]) @ self._both
        sums = sums.reshape(*weights.shape[:3], 3, 3)
        ground, height = np.zeros((n * L, 2 * J)), np.zeros((n * L, J))
        from_bases(bases, factors, sums, self._transposed, self._edges, (ground, height))
        out = np.empty((n * L, J, 3))
        out[self._order] = np.stack([ground[:, :J], height, ground[:, J:]], axis=-1)
        return out.reshape(n, L, J, 3)


def blocks(rows: np.ndarray) -> Iterator[tuple[slice, np.ndarray]]:
    """Yield the slice and the rows of each block, padded with zeros."""
    for start in range(0, len(rows), _BLOCK):
        stop = min(len(rows), start + _BLOCK)
        block = rows[start:stop]
        if stop - start < _BLOCK:
            block = np.concatenate([block, np.zeros((_BLOCK - len(block), *rows.shape[1:]))])
        yield slice(start, stop), block
