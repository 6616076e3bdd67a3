"""Rotated spectral mixture observed with isotropic noise: density, denoiser, covariance products.

Component (k, s, a) has the DCT coefficients X = R(ψ_a)(m_k + V_k z), with independent
z_fp ~ N(0, λ_{k,s,f,p}) for frequency f and direction p. The noise is isotropic, so that
everything decouples in the coordinates V_kᵀ R(ψ_a)ᵀ y. These are trigonometric combinations of
three base products (cos ψ, −sin ψ, 1; see :mod:`~probmotion.models.mixture.rotated_mixture`).
Squared distances of all azimuths therefore follow from one 3×3 Gram matrix, and sums over azimuths
from a 3×3 matrix of weights: the cost does not depend on the number of azimuths.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from probmotion.arrays import Array, array_namespace, constant, logsumexp
from probmotion.models.mixture.rotated_mixture import rotation_coefficients

__all__ = ["RotatedSpectra", "blocks"]

_BLOCK = 16
"""Points per block, so that products fit into a core's cache. The last block is padded with zeros:
rounding of a point must not depend on the batch size."""
_NEGLIGIBLE = 1e-16  # responsibilities below are set to 0
_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))  # entries of a symmetric 3×3 matrix


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
        scores = (means[:, :, None] @ directions[:, band])[:, :, 0]
        self._means = scores.reshape(K, L * P)
        self._spectra = spectra.reshape(K, S, L * P)
        self._log_weights = log_weights - math.log(len(azimuths))
        # Rows of the x and z coordinates, and of the y coordinates.
        parts = (directions[:, :, 0::3], directions[:, :, 2::3])
        self._ground = np.concatenate(parts, axis=2)
        self._height = np.ascontiguousarray(directions[:, :, 1::3])
        edges = np.flatnonzero(np.diff(band, prepend=-1, append=-1))
        self._bands = [
            (int(band[start]), slice(start, stop)) for start, stop in pairwise(edges.tolist())
        ]
        self._to_world = rotation_coefficients(azimuths)  # (A, 3)
        self._to_canonical = self._to_world * [1.0, -1.0, 1.0]
        # Quadratic forms in (cos ψ, −sin ψ, 1) as products with their six distinct coefficients.
        self._squares = np.stack(
            [
                self._to_canonical[:, i] * self._to_canonical[:, j] * (1 if i == j else 2)
                for i, j in _PAIRS
            ]
        )  # (6, A)
        both = self._to_world[:, :, None] * self._to_canonical[:, None, :]
        self._both = both.reshape(len(azimuths), 9)

    def denoise(self, y: np.ndarray, variance: float) -> np.ndarray:
        """Return E[X | y]: ``(n, L, J, 3) → (n, L, J, 3)``, v > 0."""
        out = np.empty_like(y)
        precision = 1 / (self._spectra + variance)
        gain = self._spectra * precision
        log_det = np.log(precision).sum(axis=-1)
        for rows, block in blocks(y):
            bases = [self._bases(block, k, shifted=True) for k in range(self.shape[0])]
            weights = self._responsibilities(bases, precision, log_det)
            out[rows] = self._mean(bases, gain, self._sums(weights))[: rows.stop - rows.start]
        return out

    def covariance_product(self, y: np.ndarray, variance: float, vectors: np.ndarray) -> np.ndarray:
        """Return Cov[X | y] u for each row: arrays (n, L, J, 3), v > 0."""
        out = np.empty_like(vectors)
        K, S, _ = self.shape
        precision = 1 / (self._spectra + variance)
        gain = self._spectra * precision
        log_det = np.log(precision).sum(axis=-1)
        for (rows, block), (_, directions) in zip(blocks(y), blocks(vectors), strict=True):
            bases = [self._bases(block, k, shifted=True) for k in range(K)]
            weights = self._responsibilities(bases, precision, log_det)
            turned = [self._bases(directions, k, shifted=False) for k in range(K)]
            # Products of each component's mean with the vectors, from 3×3 cross-Gram matrices.
            products = np.empty_like(weights)
            for k in range(K):
                for s in range(S):
                    means = gain[k, s] * bases[k]
                    means[2] += self._means[k]
                    cross = np.einsum("inp,jnp->nij", means, turned[k], optimize=True)
                    products[:, k, s] = np.einsum(
                        "ai,nij,aj->na", self._to_canonical, cross, self._to_canonical
                    )
            centred = products - (weights * products).sum(axis=(1, 2, 3), keepdims=True)
            total = self._mean(bases, gain, self._sums(weights * centred))
            # The components' own covariances, v λ / (λ + v) in each direction.
            own = self._mean(turned, variance * gain, self._sums(weights), means=False)
            out[rows] = (total + own)[: rows.stop - rows.start]
        return out

    def responsibilities(self, x: np.ndarray) -> np.ndarray:
        """Return p(k, s, a | X): ``(n, L, J, 3) → (n, K, S, A)``."""
        out = np.empty((len(x), *self.shape))
        precision = 1 / self._spectra
        log_det = np.log(precision).sum(axis=-1)
        for rows, block in blocks(x):
            bases = [self._bases(block, k, shifted=True) for k in range(self.shape[0])]
            weights = self._responsibilities(bases, precision, log_det)
            out[rows] = weights[: rows.stop - rows.start]
        return out

    def log_density(self, x: Array) -> Array:
        """Return log p(X): ``(n, L, J, 3) → (n,)``; NumPy, torch or JAX."""
        xp = array_namespace(x)
        precision = 1 / self._spectra
        K, n = self.shape[0], x.shape[0]
        ground = xp.concat([x[..., 0], x[..., 2]], axis=-1)
        turned = xp.concat([x[..., 2], -x[..., 0]], axis=-1)
        products = []
        for b, rows in self._bands:
            V, H = constant(self._ground[:, None, b], x), constant(self._height[:, None, b], x)
            products.append((ground[:, rows] @ V, turned[:, rows] @ V, x[:, rows, :, 1] @ H))
        bases = [
            xp.reshape(xp.concat(parts, axis=2), (K, n, -1))
            for parts in zip(*products, strict=True)
        ]
        bases[2] = bases[2] - constant(self._means[:, None], x)
        weight = constant(np.swapaxes(precision, 1, 2), x)
        gram = xp.stack([(bases[i] * bases[j]) @ weight for i, j in _PAIRS], axis=-1)
        squares = gram @ constant(self._squares, x)  # (K, n, S, A)
        offset = self._log_weights + 0.5 * np.log(precision).sum(axis=-1)
        logits = constant(offset, x)[:, None, :, None] - 0.5 * squares
        values = logsumexp(xp.reshape(xp.permute_dims(logits, (1, 0, 2, 3)), (n, -1)))
        return values - 0.5 * self._means.shape[1] * math.log(2 * math.pi)

    def _bases(self, y: np.ndarray, k: int, *, shifted: bool) -> np.ndarray:
        """Return V_kᵀ E_i y for the three base rotations E_i, (3, n, L P).

        With ``shifted``, the mean is subtracted from the third.
        """
        n, L, J, _ = y.shape
        out = np.empty((3, n, L, 3 * J))
        x, z = y[..., 0], y[..., 2]
        ground, turned = np.concatenate([x, z], axis=2), np.concatenate([z, -x], axis=2)
        for b, rows in self._bands:
            np.matmul(ground[:, rows], self._ground[k, b], out=out[0, :, rows])
            np.matmul(turned[:, rows], self._ground[k, b], out=out[1, :, rows])
            np.matmul(y[:, rows, :, 1], self._height[k, b], out=out[2, :, rows])
        out = out.reshape(3, n, -1)
        if shifted:
            out[2] -= self._means[k]
        return out

    def log_evidence(self, y: np.ndarray, variance: float) -> np.ndarray:
        """Return log p(k, s, a, y) up to a constant: ``(n, L, J, 3) → (n, K, S, A)``."""
        precision = 1 / (self._spectra + variance)
        bases = [self._bases(y, k, shifted=True) for k in range(self.shape[0])]
        return self._logits(bases, precision, np.log(precision).sum(axis=-1))

    def _logits(
        self, bases: list[np.ndarray], precision: np.ndarray, log_det: np.ndarray
    ) -> np.ndarray:
        """Return log p(k, s, a, y), (n, K, S, A); ``log_det`` is that of the precision, (K, S)."""
        K, S, A = self.shape
        logits = np.empty((bases[0].shape[1], K, S, A))
        for k in range(K):
            gram = np.stack([(bases[k][i] * bases[k][j]) @ precision[k].T for i, j in _PAIRS], -1)
            logits[:, k] = gram @ self._squares  # (n, S, 6) @ (6, A)
        logits *= -0.5
        logits += (self._log_weights + 0.5 * log_det)[..., None]
        return logits

    def _responsibilities(
        self, bases: list[np.ndarray], precision: np.ndarray, log_det: np.ndarray
    ) -> np.ndarray:
        """Return p(k, s, a | y), (n, K, S, A)."""
        logits = self._logits(bases, precision, log_det)
        logits -= logits.max(axis=(1, 2, 3), keepdims=True)
        weights = np.exp(logits)
        weights /= weights.sum(axis=(1, 2, 3), keepdims=True)
        weights[weights < _NEGLIGIBLE] = 0.0
        return weights

    def _sums(self, weights: np.ndarray) -> np.ndarray:
        """Return Σ_a w c_i(ψ_a) c_j(−ψ_a), (n, K, S, 3, 3), c = (cos, sin, 1)."""
        sums = weights @ self._both
        return sums.reshape(*sums.shape[:-1], 3, 3)

    def _mean(
        self, bases: list[np.ndarray], gain: np.ndarray, sums: np.ndarray, *, means: bool = True
    ) -> np.ndarray:
        """Return Σ_ksa w R(ψ_a)(m_k + V_k gain V_kᵀ R(ψ_a)ᵀ (y − R(ψ_a) m_k)), (n, L, J, 3)."""
        K, S, _ = self.shape
        L, J = self.frames, self.n_joints
        n = bases[0].shape[1]
        out = np.zeros((n, L, J, 3))
        for k in range(K):
            if not sums[:, k].any():
                continue
            combined = np.zeros((n, 3, L * 3 * J))
            for s in range(S):
                spread = np.swapaxes(gain[k, s] * bases[k], 0, 1)
                combined += sums[:, k, s] @ spread
            if means:
                combined += sums[:, k].sum(axis=1)[:, :, 2, None] * self._means[k]
            combined = combined.reshape(n, 3, L, 3 * J)
            for b, rows in self._bands:
                V, part = self._ground[k, b].T, combined[:, :, rows]
                ground, turned = part[:, 0] @ V, part[:, 1] @ V
                out[:, rows, :, 0] += ground[..., :J] + turned[..., J:]
                out[:, rows, :, 2] += ground[..., J:] - turned[..., :J]
                out[:, rows, :, 1] += part[:, 2] @ self._height[k, b].T
        return out


def blocks(rows: np.ndarray) -> Iterator[tuple[slice, np.ndarray]]:
    """Yield the slice and the rows of each block, padded with zeros."""
    for start in range(0, len(rows), _BLOCK):
        stop = min(len(rows), start + _BLOCK)
        block = rows[start:stop]
        if stop - start < _BLOCK:
            block = np.concatenate([block, np.zeros((_BLOCK - len(block), *rows.shape[1:]))])
        yield slice(start, stop), block
