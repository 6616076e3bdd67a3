"""Compiled log likelihoods of views, without the views that cannot contribute (eqs. 8-9).

The distance to an annotation is the sum of two parts, on the graph of the projection and on that of
the annotation. The second requires no triangulation and is a lower bound of both. A candidate is
therefore left out if its bound exceeds the distance at which its likelihood vanishes beside that of
the best view. The best-aligned candidate of all views is evaluated first, to make this limit small.
"""

from __future__ import annotations

import numpy as np

from probmotion.extras import numba
from probmotion.interaction.geometry.graph_kernels import max_edges
from probmotion.interaction.geometry.nearest_kernels import (
    Prepared,
    centred,
    prepare_projection,
    projection_sum,
    residual,
    rotation,
)

__all__ = ["log_terms_in_batch", "log_terms_on_threads"]

_NEGLIGIBLE = 42.0
"""Nats below the best of 32 views at which a view is left out: the others together do not change
the mean in double precision."""


@numba.njit(cache=True)
def log_terms_in_batch(
    projections: np.ndarray, candidates: np.ndarray, prepared: Prepared, noise: float
) -> np.ndarray:
    """Return −d²/2σ_l² of the nearest candidate in each view, −∞ if negligible: (B, V)."""
    logs = np.empty(projections.shape[:2])
    for item in range(len(projections)):
        _write_log_terms(projections[item], candidates, prepared, noise, logs[item])
    return logs


@numba.njit(cache=True, parallel=True)
def log_terms_on_threads(
    projections: np.ndarray, candidates: np.ndarray, prepared: Prepared, noise: float
) -> np.ndarray:
    """Run :func:`log_terms_in_batch` on all of Numba's threads."""
    logs = np.empty(projections.shape[:2])
    for item in numba.prange(len(projections)):
        _write_log_terms(projections[item], candidates, prepared, noise, logs[item])
    return logs


@numba.njit(cache=True)
def _write_log_terms(
    projections: np.ndarray,
    candidates: np.ndarray,
    prepared: Prepared,
    noise: float,
    logs: np.ndarray,
) -> None:
    """Write the log terms of one pose, projections (V, J, 2), to ``logs`` (V,)."""
    n_views, n_candidates = candidates.shape
    n_joints = projections.shape[1]
    joints = np.empty((n_views, 2, n_joints))
    cosines, sines = np.empty((n_views, n_candidates)), np.empty((n_views, n_candidates))
    alignment = np.empty(n_views)
    for view in range(n_views):
        joints[view] = centred(projections[view])
        alignment[view] = np.inf
        for position in range(n_candidates):
            k = candidates[view, position]
            cosine, sine, product = rotation(joints[view], prepared.joints[k])
            cosines[view, position], sines[view, position] = cosine, sine
            left = (prepared.square[k] - 2.0 * product) / max(prepared.n_visible[k], 1)
            alignment[view] = min(alignment[view], left)
    logs[:] = -np.inf
    limit, negligible = np.inf, _NEGLIGIBLE + np.log(max(1.0, n_views / 32))
    difference, bounds = np.empty((2, n_joints)), np.empty(n_candidates)
    terms = np.empty(max_edges(n_joints, prepared.graph))
    for view in np.argsort(alignment):
        possible = False
        for position in range(n_candidates):
            k = candidates[view, position]
            cosine, sine = cosines[view, position], sines[view, position]
            residual(joints[view], prepared.joints[k], cosine, sine, difference)
            start, stop = prepared.edge_start[k], prepared.edge_start[k + 1]
            bounds[position] = _bounded_sum(
                difference, prepared.edges, prepared.weights, start, stop, 0.0, limit
            )
            possible |= bounds[position] <= limit
        if not possible:
            continue
        projection = prepare_projection(projections[view], prepared)
        best = limit
        for position in np.argsort(bounds):
            if bounds[position] > best:
                break
            k = candidates[view, position]
            cosine, sine = cosines[view, position], sines[view, position]
            residual(joints[view], prepared.joints[k], cosine, sine, difference)
            if prepared.n_visible[k] < n_joints:
                total = projection_sum(difference, projection, True, prepared.seen[k], terms)
                distance = total + bounds[position]
            else:
                edges, weights, stop = projection.edges, projection.weights, projection.n_edges
                distance = _bounded_sum(difference, edges, weights, 0, stop, bounds[position], best)
            if distance <= best:
                best = distance
                logs[view] = -0.5 * (distance / noise) ** 2
        limit = min(limit, np.sqrt(best**2 + 2.0 * negligible * noise**2))


@numba.njit(cache=True)
def _bounded_sum(
    difference: np.ndarray,
    edges: np.ndarray,
    weights: np.ndarray,
    start: int,
    stop: int,
    other: float,
    limit: float,
) -> float:
    """Return the sum over a graph plus ``other``.

    It is infinite for an empty graph, or once it exceeds ``limit``.
    """
    if start == stop:
        return np.inf
    # Sums have the order of summation of nearest_kernels, so that results are bit-identical.
    a, b, c, d = 0.0, 0.0, 0.0, 0.0
    unrolled = stop - (stop - start) % 4
    for edge in range(start, unrolled, 4):
        a += weights[edge] * _length(difference, edges[0, edge], edges[1, edge])
        b += weights[edge + 1] * _length(difference, edges[0, edge + 1], edges[1, edge + 1])
        c += weights[edge + 2] * _length(difference, edges[0, edge + 2], edges[1, edge + 2])
        d += weights[edge + 3] * _length(difference, edges[0, edge + 3], edges[1, edge + 3])
        if (a + b) + (c + d) + other > limit:
            return np.inf
    for edge in range(unrolled, stop):
        a += weights[edge] * _length(difference, edges[0, edge], edges[1, edge])
    return (a + b) + (c + d) + other


@numba.njit(cache=True)
def _length(difference: np.ndarray, i: int, j: int) -> float:
    """Return the length of the difference between joints i and j."""
    x, y = difference[0, i] - difference[0, j], difference[1, i] - difference[1, j]
    return np.sqrt(x * x + y * y)
