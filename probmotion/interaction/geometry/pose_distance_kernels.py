"""Compiled: how unlike 3D poses are after the best rigid motion, and the least over many.

A pair of poses is given up (its distance is infinite) as soon as it is known to exceed a limit.
Poses are centred on their mean joint. A graph is a list of edges, edge e of pose n at place
``starts[n] ≤ e < starts[n + 1]``, with weights that sum to 1 for each pose.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from probmotion.interaction.geometry.rigid_kernels import align, residual

__all__ = [
    "cartesian_minima",
    "cartesian_table",
    "interaction_minima",
    "interaction_table",
]

_MARGIN = 1.0 + 1e-6
"""By how much a bound with rounding errors must exceed the limit before it counts."""


@numba.njit(cache=True)
def cartesian_table(first: np.ndarray, second: np.ndarray, table: np.ndarray) -> None:
    """Write the root mean square joint distance of every two poses to ``table`` (n, m)."""
    rotation, horn, apart = np.empty((3, 3)), np.empty((4, 4)), np.empty(first.shape[1:])
    for a in range(first.shape[0]):
        for b in range(second.shape[0]):
            table[a, b] = _cartesian(first[a], second[b], np.inf, rotation, horn, apart)


@numba.njit(cache=True)
def cartesian_minima(truths: np.ndarray, draws: np.ndarray, least: np.ndarray) -> None:
    """Lower ``least`` (G,) to each true pose's distance from its nearest draw."""
    rotation, horn, apart = np.empty((3, 3)), np.empty((4, 4)), np.empty(draws.shape[1:])
    for g in range(truths.shape[0]):
        for s in range(draws.shape[0]):
            found = _cartesian(truths[g], draws[s], least[g], rotation, horn, apart)
            least[g] = min(least[g], found)


@numba.njit(cache=True)
def interaction_table(
    first: np.ndarray,
    first_starts: np.ndarray,
    first_edges: np.ndarray,
    first_weights: np.ndarray,
    second: np.ndarray,
    second_starts: np.ndarray,
    second_edges: np.ndarray,
    second_weights: np.ndarray,
    table: np.ndarray,
) -> None:
    """Write the dissimilarity of interaction coordinates of every two poses to ``table``."""
    rotation, horn, apart = np.empty((3, 3)), np.empty((4, 4)), np.empty(first.shape[1:])
    for a in range(first.shape[0]):
        here = slice(first_starts[a], first_starts[a + 1])
        for b in range(second.shape[0]):
            there = slice(second_starts[b], second_starts[b + 1])
            align(first[a], second[b], rotation, horn)
            residual(first[a], second[b], rotation, apart)
            half = _along(apart, first_edges[here], first_weights[here], 0.0, np.inf)
            table[a, b] = _along(apart, second_edges[there], second_weights[there], half, np.inf)


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
    """Lower ``least`` (G,) to each true pose's dissimilarity from its nearest draw."""
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
    # The alignment's own sum is cheap but rounded; only what might win is summed again.
    if align(first, second, rotation, horn) > _MARGIN * limit * limit * joints + 1e-12:
        return np.inf
    return math.sqrt(residual(first, second, rotation, apart) / joints)


@numba.njit(cache=True)
def _along(
    apart: np.ndarray, edges: np.ndarray, weights: np.ndarray, total: float, limit: float
) -> float:
    """Add to ``total`` one graph's part of eq. 8: w_ij ‖u_ij(1) − u_ij(2)‖ = w_ij ‖a_i − a_j‖.

    a is the difference of the aligned poses. What exceeds the limit is left unfinished.
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
