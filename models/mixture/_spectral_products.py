"""NumPy functions of :mod:`~probmotion.models.mixture._spectral_kernels`, used without Numba.

Results differ from those of the compiled loops by rounding.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

__all__ = ["cross_products", "from_bases", "self_products", "to_bases"]

_Bases = tuple[np.ndarray, np.ndarray]


def to_bases(
    motions: _Bases, directions: _Bases, means: np.ndarray, edges: np.ndarray, out: _Bases
) -> None:
    """Write the products of motions with each band's directions, less means (K, L, P) in height."""
    ground, height = motions
    K, L, P = means.shape
    n = len(height) // L
    for k, band, first, stop in _bands(K, edges):
        both, once = slice(2 * n * first, 2 * n * stop), slice(n * first, n * stop)
        np.dot(ground[both], directions[0][k, band], out[0][k, both])
        np.dot(height[once], directions[1][k, band], out[1][k, once])
        raised = out[1][k, once].reshape(n, stop - first, P)
        raised -= means[k, first:stop]


def self_products(bases: _Bases, weights: np.ndarray, edges: np.ndarray, out: np.ndarray) -> None:
    """Write Σ w b_i b_j over frequencies and coordinates: out (n, K, S, 6), 00 11 22 01 02 12."""
    products = np.empty((*out.shape[:3], 9))
    cross_products(bases, bases, weights, edges, products)
    out[:] = products[..., [0, 4, 8, 1, 2, 5]]


def cross_products(
    left: _Bases, right: _Bases, weights: np.ndarray, edges: np.ndarray, out: np.ndarray
) -> None:
    """Write Σ w l_i r_j over frequencies and coordinates, w (K, S, L, P): out (n, K, S, 9)."""
    n, K, S, _ = out.shape
    out[:] = 0.0
    for k, _, first, stop in _bands(K, edges):
        l, r = _of_motions(left, k, n, first, stop), _of_motions(right, k, n, first, stop)
        w = weights[k, :, first:stop].reshape(S, 1, -1)
        weighted = (w * l[:, None]).reshape(n, 3 * S, -1)
        out[:, k] += (weighted @ r.swapaxes(1, 2)).reshape(n, S, 9)


def from_bases(
    bases: _Bases,
    weights: np.ndarray,
    sums: np.ndarray,
    transposed: _Bases,
    edges: np.ndarray,
    out: _Bases,
) -> None:
    """Add Σ_ksij m_ij R_i V w b_j to ground (n L, 2 J) and height (n L, J)."""
    n, K, S = sums.shape[:3]
    P = weights.shape[3]
    for k, band, first, stop in _bands(K, edges):
        if not sums[:, k].any():
            continue
        b = _of_motions(bases, k, n, first, stop)
        w = weights[k, :, first:stop].reshape(S, -1)
        total = sum(sums[:, k, s] @ (w[s] * b) for s in range(S))
        x, z, y = (total[:, i].reshape(-1, P) for i in range(3))
        rows = slice(n * first, n * stop)
        out[0][rows] += np.concatenate([x, z], axis=1) @ transposed[0][k, band]
        out[1][rows] += y @ transposed[1][k, band]


def _bands(K: int, edges: np.ndarray) -> Iterator[tuple[int, int, int, int]]:
    """Yield the style, the band, its first frequency and the frequency after its last."""
    for k in range(K):
        for band, (first, stop) in enumerate(pairwise(edges.tolist())):
            yield k, band, first, stop


def _of_motions(bases: _Bases, k: int, n: int, first: int, stop: int) -> np.ndarray:
    """Return the three base products of all motions in a band, (n, 3, frequencies · P)."""
    both, once = slice(2 * n * first, 2 * n * stop), slice(n * first, n * stop)
    straight, turned = bases[0][k, both].reshape(2, n, -1)
    return np.stack([straight, turned, bases[1][k, once].reshape(n, -1)], axis=1)
