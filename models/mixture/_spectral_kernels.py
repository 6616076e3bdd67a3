"""Compiled loops over coordinates for :mod:`~probmotion.models.mixture.rotated_spectra`.

Rows of n motions are ordered by band, then motion, then frequency, so that the entries of one
motion in one band are contiguous. ``edges`` are the first frequencies of the bands, then L. Base
products are (3, n L, P).
"""

from __future__ import annotations

import numba
import numpy as np

__all__ = ["combine", "cross_products", "from_bases", "to_bases"]

# Sums may be reordered, which the compiler needs to use vector instructions.
_FAST = {"reassoc", "contract"}


@numba.njit(cache=True)
def to_bases(
    ground: np.ndarray,
    height: np.ndarray,
    along: np.ndarray,
    up: np.ndarray,
    mean: np.ndarray,
    edges: np.ndarray,
    out: np.ndarray,
) -> None:
    """Write the products of motions with each band's directions, less a mean (L, P) in the third.

    ``ground`` (2, n L, 2 J) contains (x, z) and (z, −x), ``height`` (n L, J) y; ``along``
    (B, 2 J, P) and ``up`` (B, J, P) the corresponding rows of the directions.
    """
    n, P = len(height) // len(mean), mean.shape[1]
    for band in range(len(edges) - 1):
        first, width = edges[band], edges[band + 1] - edges[band]
        begin, end = n * first, n * (first + width)
        for i in range(2):
            np.dot(ground[i, begin:end], along[band], out[i, begin:end])
        np.dot(height[begin:end], up[band], out[2, begin:end])
        shift = mean[first : first + width].ravel()
        for row in range(n):
            start = begin + row * width
            third = out[2, start : start + width].ravel()
            for c in range(width * P):
                third[c] -= shift[c]


@numba.njit(cache=True)
def from_bases(
    bases: np.ndarray,
    along: np.ndarray,
    up: np.ndarray,
    edges: np.ndarray,
    ground: np.ndarray,
    height: np.ndarray,
) -> None:
    """Add the transpose of :func:`to_bases`, without mean, to ``ground`` and ``height``.

    ``along`` (B, P, 2 J) and ``up`` (B, P, J) are transposed.
    """
    n = len(height) // edges[-1]
    for band in range(len(edges) - 1):
        begin, end = n * edges[band], n * edges[band + 1]
        for i in range(2):
            _add_product(bases[i, begin:end], along[band], ground[i, begin:end])
        _add_product(bases[2, begin:end], up[band], height[begin:end])


@numba.njit(cache=True)
def _add_product(left: np.ndarray, right: np.ndarray, out: np.ndarray) -> None:
    total, product = out.ravel(), np.dot(left, right).ravel()
    for c in range(len(total)):
        total[c] += product[c]


@numba.njit(cache=True, fastmath=_FAST)
def cross_products(
    left: np.ndarray, right: np.ndarray, weights: np.ndarray, edges: np.ndarray, out: np.ndarray
) -> None:
    """Write Σ w l_i r_j over frequencies and coordinates, for weights (S, L, P): (n, S, 9)."""
    n, P = len(out), left.shape[2]
    out[:] = 0.0
    for band in range(len(edges) - 1):
        first, width = edges[band], edges[band + 1] - edges[band]
        for row in range(n):
            start = n * first + row * width
            l0, r0 = left[0, start : start + width].ravel(), right[0, start : start + width].ravel()
            l1, r1 = left[1, start : start + width].ravel(), right[1, start : start + width].ravel()
            l2, r2 = left[2, start : start + width].ravel(), right[2, start : start + width].ravel()
            for s in range(len(weights)):
                w = weights[s, first : first + width].ravel()
                s00 = s01 = s02 = s10 = s11 = s12 = s20 = s21 = s22 = 0.0
                for c in range(width * P):
                    a0, a1, a2 = w[c] * l0[c], w[c] * l1[c], w[c] * l2[c]
                    s00 += a0 * r0[c]
                    s01 += a0 * r1[c]
                    s02 += a0 * r2[c]
                    s10 += a1 * r0[c]
                    s11 += a1 * r1[c]
                    s12 += a1 * r2[c]
                    s20 += a2 * r0[c]
                    s21 += a2 * r1[c]
                    s22 += a2 * r2[c]
                sums = (s00, s01, s02, s10, s11, s12, s20, s21, s22)
                for i in range(9):
                    out[row, s, i] += sums[i]


@numba.njit(cache=True, fastmath=_FAST)
def combine(bases: np.ndarray, weights: np.ndarray, sums: np.ndarray, edges: np.ndarray) -> None:
    """Replace each base b_i by Σ_sj m_ij w b_j, for weights w (S, L, P) and sums m (n, S, 3, 3)."""
    n, P = len(sums), bases.shape[2]
    totals = np.empty((3, np.diff(edges).max() * P))
    t0, t1, t2 = totals[0], totals[1], totals[2]
    for band in range(len(edges) - 1):
        first, width = edges[band], edges[band + 1] - edges[band]
        for row in range(n):
            start = n * first + row * width
            b0 = bases[0, start : start + width].ravel()
            b1 = bases[1, start : start + width].ravel()
            b2 = bases[2, start : start + width].ravel()
            totals[:, : width * P] = 0.0
            for s in range(len(weights)):
                w, m = weights[s, first : first + width].ravel(), sums[row, s]
                m00, m01, m02 = m[0, 0], m[0, 1], m[0, 2]
                m10, m11, m12 = m[1, 0], m[1, 1], m[1, 2]
                m20, m21, m22 = m[2, 0], m[2, 1], m[2, 2]
                for c in range(width * P):
                    a0, a1, a2 = w[c] * b0[c], w[c] * b1[c], w[c] * b2[c]
                    t0[c] += m00 * a0 + m01 * a1 + m02 * a2
                    t1[c] += m10 * a0 + m11 * a1 + m12 * a2
                    t2[c] += m20 * a0 + m21 * a1 + m22 * a2
            for c in range(width * P):
                b0[c], b1[c], b2[c] = t0[c], t1[c], t2[c]
