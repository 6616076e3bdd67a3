"""Compiled loops over coordinates for :mod:`~probmotion.models.mixture.rotated_spectra`.

Rows of n motions are ordered by band, then motion, then frequency, so that the entries of one
motion in one band are contiguous. ``edges`` are the first frequencies of the bands, then L.
Coordinates on the ground have twice as many rows: in each band first those of all motions as
(x, z), then as (z, −x). Base products are a pair: ground (K, 2 n L, P) and height (K, n L, P).
"""

from __future__ import annotations

import numpy as np

from probmotion.extras import numba

__all__ = ["cross_products", "from_bases", "self_products", "to_bases"]

# Sums may be reordered, which the compiler needs to use vector instructions.
_FAST = {"reassoc", "contract"}


@numba.njit(cache=True)
def to_bases(
    motions: tuple[np.ndarray, np.ndarray],
    directions: tuple[np.ndarray, np.ndarray],
    means: np.ndarray,
    edges: np.ndarray,
    out: tuple[np.ndarray, np.ndarray],
) -> None:
    """Write the products of motions with each band's directions, less means (K, L, P) in height.

    Motions are ground (2 n L, 2 J) and height (n L, J), directions (K, B, 2 J, P) and
    (K, B, J, P).
    """
    ground, height = motions
    K, L, P = means.shape
    n = len(height) // L
    for k in range(K):
        for band in range(len(edges) - 1):
            first, width = edges[band], edges[band + 1] - edges[band]
            begin, end = n * first, n * (first + width)
            np.dot(
                ground[2 * begin : 2 * end], directions[0][k, band], out[0][k, 2 * begin : 2 * end]
            )
            np.dot(height[begin:end], directions[1][k, band], out[1][k, begin:end])
            shift = means[k, first : first + width].ravel()
            for row in range(n):
                start = begin + row * width
                third = out[1][k, start : start + width].ravel()
                for c in range(width * P):
                    third[c] -= shift[c]


@numba.njit(cache=True, fastmath=_FAST)
def self_products(
    bases: tuple[np.ndarray, np.ndarray], weights: np.ndarray, edges: np.ndarray, out: np.ndarray
) -> None:
    """Write Σ w b_i b_j for i ≤ j over frequencies and coordinates, out (n, K, S, 6).

    Weights are w (K, S, L, P); the pairs are 00, 11, 22, 01, 02, 12.
    """
    n, K, S, P = *out.shape[:3], weights.shape[3]
    out[:] = 0.0
    for k in range(K):
        for band in range(len(edges) - 1):
            first, width = edges[band], edges[band + 1] - edges[band]
            for row in range(n):
                b0, b1, b2 = _of_motion(bases, k, n, row, first, width)
                for s in range(S):
                    w = weights[k, s, first : first + width].ravel()
                    s00 = s11 = s22 = s01 = s02 = s12 = 0.0
                    for c in range(width * P):
                        a0, a1, a2 = w[c] * b0[c], w[c] * b1[c], w[c] * b2[c]
                        s00 += a0 * b0[c]
                        s11 += a1 * b1[c]
                        s22 += a2 * b2[c]
                        s01 += a0 * b1[c]
                        s02 += a0 * b2[c]
                        s12 += a1 * b2[c]
                    sums = (s00, s11, s22, s01, s02, s12)
                    for i in range(6):
                        out[row, k, s, i] += sums[i]


@numba.njit(cache=True, fastmath=_FAST)
def cross_products(
    left: tuple[np.ndarray, np.ndarray],
    right: tuple[np.ndarray, np.ndarray],
    weights: np.ndarray,
    edges: np.ndarray,
    out: np.ndarray,
) -> None:
    """Write Σ w l_i r_j over frequencies and coordinates, w (K, S, L, P): out (n, K, S, 9)."""
    n, K, S, P = *out.shape[:3], weights.shape[3]
    out[:] = 0.0
    for k in range(K):
        for band in range(len(edges) - 1):
            first, width = edges[band], edges[band + 1] - edges[band]
            for row in range(n):
                l0, l1, l2 = _of_motion(left, k, n, row, first, width)
                r0, r1, r2 = _of_motion(right, k, n, row, first, width)
                for s in range(S):
                    w = weights[k, s, first : first + width].ravel()
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
                        out[row, k, s, i] += sums[i]


@numba.njit(cache=True, fastmath=_FAST)
def from_bases(
    bases: tuple[np.ndarray, np.ndarray],
    weights: np.ndarray,
    sums: np.ndarray,
    transposed: tuple[np.ndarray, np.ndarray],
    edges: np.ndarray,
    out: tuple[np.ndarray, np.ndarray],
) -> None:
    """Add Σ_ksij m_ij R_i V w b_j to ground (n L, 2 J) and height (n L, J).

    Weights are w (K, S, L, P), sums m (n, K, S, 3, 3). The transposed directions are
    (K, B, 2 P, 2 J), of (x, z) and then of (z, −x), and (K, B, P, J).
    """
    n, K, S, P = *sums.shape[:3], weights.shape[3]
    widest = np.diff(edges).max()
    mixed, raised = np.empty((n * widest, 2 * P)), np.empty((n * widest, P))
    totals = np.empty((3, widest * P))
    t0, t1, t2 = totals[0], totals[1], totals[2]
    for k in range(K):
        if not sums[:, k].any():
            continue
        for band in range(len(edges) - 1):
            first, width = edges[band], edges[band + 1] - edges[band]
            begin, end = n * first, n * (first + width)
            for row in range(n):
                b0, b1, b2 = _of_motion(bases, k, n, row, first, width)
                totals[:, : width * P] = 0.0
                for s in range(S):
                    w, m = weights[k, s, first : first + width].ravel(), sums[row, k, s]
                    m00, m01, m02 = m[0, 0], m[0, 1], m[0, 2]
                    m10, m11, m12 = m[1, 0], m[1, 1], m[1, 2]
                    m20, m21, m22 = m[2, 0], m[2, 1], m[2, 2]
                    for c in range(width * P):
                        a0, a1, a2 = w[c] * b0[c], w[c] * b1[c], w[c] * b2[c]
                        t0[c] += m00 * a0 + m01 * a1 + m02 * a2
                        t1[c] += m10 * a0 + m11 * a1 + m12 * a2
                        t2[c] += m20 * a0 + m21 * a1 + m22 * a2
                for f in range(width):
                    at = row * width + f
                    for c in range(P):
                        mixed[at, c] = t0[f * P + c]
                        mixed[at, P + c] = t1[f * P + c]
                        raised[at, c] = t2[f * P + c]
            _add_product(mixed[: n * width], transposed[0][k, band], out[0][begin:end])
            _add_product(raised[: n * width], transposed[1][k, band], out[1][begin:end])


@numba.njit(cache=True)
def _of_motion(
    bases: tuple[np.ndarray, np.ndarray], k: int, n: int, row: int, first: int, width: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a motion's three base products in a band, flat."""
    start = n * first + row * width
    turned = start + n * (first + width)
    straight = start + n * first
    return (
        bases[0][k, straight : straight + width].ravel(),
        bases[0][k, turned : turned + width].ravel(),
        bases[1][k, start : start + width].ravel(),
    )


@numba.njit(cache=True)
def _add_product(left: np.ndarray, right: np.ndarray, out: np.ndarray) -> None:
    total, product = out.ravel(), np.dot(left, right).ravel()
    for c in range(len(total)):
        total[c] += product[c]
