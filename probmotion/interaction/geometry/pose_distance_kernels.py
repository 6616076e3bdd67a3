"""Compiled nearest-draw distances of 3D poses after rigid alignment.

Evaluation of a pair of poses stops once its distance exceeds the smallest one so far. Poses are
centred on their mean joint. Pose n has the edges ``starts[n] ≤ e < starts[n + 1]``, with weights
that sum to 1.
"""

from __future__ import annotations

import math

import numpy as np

from probmotion.extras import numba
from probmotion.interaction.geometry.rigid_kernels import align, residual

__all__ = ["cartesian_minima", "interaction_minima"]

_MARGIN = 1.0 + 1e-6
"""Tolerance of the early stop, for rounding errors."""


@numba.njit(cache=True)
def cartesian_minima(truths: np.ndarray, draws: np.ndarray, minima: np.ndarray) -> None:
    """Lower ``minima`` (G,) to the RMS joint distance of each true pose to its nearest draw."""
    rotation, horn, difference = np.empty((3, 3)), np.empty((4, 4)), np.empty(draws.shape[1:])
    for g in range(truths.shape[0]):
        for s in range(draws.shape[0]):
            # The sum of squares from the alignment is cheap but less accurate.
            bound = _MARGIN * minima[g] * minima[g] * draws.shape[1] + 1e-12
            if align(truths[g], draws[s], rotation, horn) <= bound:
                square = residual(truths[g], draws[s], rotation, difference)
                minima[g] = min(minima[g], math.sqrt(square / draws.shape[1]))


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
    minima: np.ndarray,
) -> None:
    """Lower ``minima`` (G,) to the dissimilarity (eq. 8) of each true pose to its nearest draw."""
    rotation, horn, difference = np.empty((3, 3)), np.empty((4, 4)), np.empty(draws.shape[1:])
    for g in range(truths.shape[0]):
        truth_slice = slice(truth_starts[g], truth_starts[g + 1])
        for s in range(draws.shape[0]):
            draw_slice = slice(draw_starts[s], draw_starts[s + 1])
            limit = minima[g]
            align(truths[g], draws[s], rotation, horn)
            residual(truths[g], draws[s], rotation, difference)
            total = _along(
                difference, truth_edges[truth_slice], truth_weights[truth_slice], 0.0, limit
            )
            if total < limit:
                total = _along(
                    difference, draw_edges[draw_slice], draw_weights[draw_slice], total, limit
                )
                minima[g] = min(limit, total)


@numba.njit(cache=True)
def _along(
    difference: np.ndarray, edges: np.ndarray, weights: np.ndarray, total: float, limit: float
) -> float:
    """Add one graph's sum of eq. 8, Σ w_ij ‖a_i − a_j‖, to ``total``; stop beyond ``limit``.

    The vectors a_i are the joint differences of the aligned poses.
    """
    for e in range(edges.shape[0]):
        i, j = edges[e, 0], edges[e, 1]
        x = difference[i, 0] - difference[j, 0]
        y = difference[i, 1] - difference[j, 1]
        z = difference[i, 2] - difference[j, 2]
        total += weights[e] * math.sqrt(x * x + y * y + z * z)
        if total > limit:
            break
    return total
