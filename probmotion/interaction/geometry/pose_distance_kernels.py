"""Compiled nearest-draw distances of 3D poses after rigid alignment.

Evaluation of a pair of poses stops once its distance exceeds the smallest one so far. Poses are
centred on their mean joint. Pose n has the edges ``starts[n] ≤ e < starts[n + 1]``, with weights
that sum to 1.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from probmotion.interaction.geometry.rigid_kernels import align, residual

__all__ = ["cartesian_minima", "interaction_minima"]

_MARGIN = 1.0 + 1e-6
"""Tolerance of the early stop, for rounding errors."""


@numba.njit(cache=True)
def cartesian_minima(truths: np.ndarray, draws: np.ndarray, least: np.ndarray) -> None:
    """Lower ``least`` (G,) to the RMS joint distance of each true pose to its nearest draw."""
    rotation, horn, apart = np.empty((3, 3)), np.empty((4, 4)), np.empty(draws.shape[1:])
    for g in range(truths.shape[0]):
        for s in range(draws.shape[0]):
            found = _cartesian(truths[g], draws[s], least[g], rotation, horn, apart)
            least[g] = min(least[g], found)


@numba.njit(cache=True)
def interaction_minima(
    truths: np.ndarray,
    truth_starts: np.ndarray,
    truth_edges: np.ndarray,
    truth_weights: np.ndarray,
    draws: np.ndarray,
    draw_starts: np.ndarray,
    draw_edges: np.ndarray,
    draw_weights: np.ndarray,
    least: np.ndarray,
) -> None:
    """Lower ``least`` (G,) to the dissimilarity (eq. 8) of each true pose to its nearest draw."""
    rotation, horn, apart = np.empty((3, 3)), np.empty((4, 4)), np.empty(draws.shape[1:])
    for g in range(truths.shape[0]):
        here = slice(truth_starts[g], truth_starts[g + 1])
        for s in range(draws.shape[0]):
            there = slice(draw_starts[s], draw_starts[s + 1])
            limit = least[g]
            align(truths[g], draws[s], rotation, horn)
            residual(truths[g], draws[s], rotation, apart)
            found = _along(apart, truth_edges[here], truth_weights[here], 0.0, limit)
            if found < limit:
                found = _along(apart, draw_edges[there], draw_weights[there], found, limit)
                least[g] = min(limit, found)


@numba.njit(cache=True)
def _cartesian(
    first: np.ndarray,
    second: np.ndarray,
    limit: float,
    rotation: np.ndarray,
    horn: np.ndarray,
    apart: np.ndarray,
) -> float:
    joints = first.shape[0]
    # The sum of squares from the alignment is cheap but less accurate.
    if align(first, second, rotation, horn) > _MARGIN * limit * limit * joints + 1e-12:
        return np.inf
    return math.sqrt(residual(first, second, rotation, apart) / joints)


@numba.njit(cache=True)
def _along(
    apart: np.ndarray, edges: np.ndarray, weights: np.ndarray, total: float, limit: float
) -> float:
    """Add one graph's sum of eq. 8, Σ w_ij ‖a_i − a_j‖, to ``total``; stop beyond ``limit``.

    a is the difference of the aligned poses.
    """
    for e in range(edges.shape[0]):
        i, j = edges[e, 0], edges[e, 1]
        x = apart[i, 0] - apart[j, 0]
        y = apart[i, 1] - apart[j, 1]
        z = apart[i, 2] - apart[j, 2]
        total += weights[e] * math.sqrt(x * x + y * y + z * z)
        if total > limit:
            break
    return total
