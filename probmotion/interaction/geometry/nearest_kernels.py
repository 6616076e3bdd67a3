"""Compiled distances between projections and annotations, with early stopping.

Sums are never reordered, so results are bit-identical for any batch and number of threads.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from probmotion.extras import NO_ALLOCATION, numba
from probmotion.interaction.geometry.graph_kernels import max_edges, write_graph
from probmotion.interaction.geometry.plane_contexts import context_cost, polar_bins

__all__ = [
    "INTERACTION", "Prepared", "all_distances", "annotation_graph_distance", "centred",
    "distances_to", "nearest_candidate", "nearest_in_batch", "nearest_in_batch_on_threads",
    "prepare_projection", "projection_sum", "residual", "rotation",
]  # fmt: skip

INTERACTION, CARTESIAN, SHAPE_CONTEXT = range(3)  # indices into nearest.MEASURES
_MIN_TOTAL = 1e-300  # avoids division by 0 if there are no edges


class Prepared(NamedTuple):
    """Precomputed data of n annotations and the options of the comparison.

    The edges of annotation k are ``edges[:, edge_start[k] : edge_start[k + 1]]``.
    """

    joints: np.ndarray  # (n, 2, J), metres, centred on the visible mean, 0 if occluded
    seen: np.ndarray  # (n, J), 1.0 if visible, else 0.0
    n_visible: np.ndarray  # (n,)
    square: np.ndarray  # (n,), sums of squared coordinates
    edge_start: np.ndarray  # (n + 1,)
    edges: np.ndarray  # (2, E), uint16, joint indices
    weights: np.ndarray  # (E,), w_ij / W of eq. 8
    contexts: np.ndarray  # (n, J, 60), uint8, shape contexts
    shared: np.ndarray  # shape_context.shared_table of the contexts
    offsets: np.ndarray  # (J, 2), joggle offsets
    measure: int  # index into nearest.MEASURES
    graph: int  # index into graphs.GRAPHS
    epsilon: float  # ε of eq. 8, metres


class Projection(NamedTuple):
    """Prepared projection: centred joints (2, J), and the weighted graph or the polar bins."""

    joints: np.ndarray
    edges: np.ndarray
    weights: np.ndarray
    n_edges: int
    bins: np.ndarray


# Two functions instead of one compiled twice: Numba's cache is keyed by the function's name, so a
# shared name would load parallel code in a single-threaded process.
@numba.njit(cache=True)
def nearest_in_batch(
    projections: np.ndarray, candidates: np.ndarray, prepared: Prepared
) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance and index of each projection's nearest candidate, (B, V) each."""
    n, n_views = projections.shape[:2]
    distances, indices = np.empty((n, n_views)), np.empty((n, n_views), np.int64)
    for flat in range(n * n_views):
        item, view = divmod(flat, n_views)
        distances[item, view], indices[item, view] = nearest_candidate(
            projections[item, view], candidates[view], prepared, np.inf
        )
    return distances, indices


@numba.njit(cache=True, parallel=True)
def nearest_in_batch_on_threads(
    projections: np.ndarray, candidates: np.ndarray, prepared: Prepared
) -> tuple[np.ndarray, np.ndarray]:
    """Run :func:`nearest_in_batch` on all of Numba's threads."""
    n, n_views = projections.shape[:2]
    distances, indices = np.empty((n, n_views)), np.empty((n, n_views), np.int64)
    for flat in numba.prange(n * n_views):
        item, view = divmod(np.int64(flat), n_views)
        distances[item, view], indices[item, view] = nearest_candidate(
            projections[item, view], candidates[view], prepared, np.inf
        )
    return distances, indices


@numba.njit(cache=True)
def all_distances(projections: np.ndarray, prepared: Prepared) -> np.ndarray:
    """Return the distances of projections (B, J, 2) to all n annotations, (B, n)."""
    n_items, n_annotations = projections.shape[0], prepared.joints.shape[0]
    out, candidates = np.empty((n_items, n_annotations)), np.arange(n_annotations)
    for item in range(n_items):
        projection = prepare_projection(projections[item], prepared)
        distances_to(projection, candidates, prepared, out[item])
    return out


@numba.njit(cache=True)
def nearest_candidate(
    points: np.ndarray, candidates: np.ndarray, prepared: Prepared, within: float
) -> tuple[float, int]:
    """Return the distance and index of the nearest candidate, −1 if none is within ``within``."""
    projection = prepare_projection(points, prepared)
    joints = projection.joints
    n_candidates = candidates.shape[0]
    turns, left = np.empty((2, n_candidates)), np.empty(n_candidates)
    n_joints, square = joints.shape[1], 0.0
    for joint in range(n_joints):
        square += joints[0, joint] ** 2 + joints[1, joint] ** 2
    for position in range(n_candidates):
        k = candidates[position]
        turns[0, position], turns[1, position], product = rotation(joints, prepared.joints[k])
        n_visible = prepared.n_visible[k]
        visible_square = square * n_visible / n_joints
        left[position] = (visible_square + prepared.square[k] - 2.0 * product) / max(n_visible, 1)
    difference, terms = np.empty_like(joints), np.empty(projection.edges.shape[1])
    best, where = within, n_candidates
    # The best-aligned candidate is likely nearest; if it is first, the others stop early.
    for position in np.argsort(left):
        cosine, sine, k = turns[0, position], turns[1, position], candidates[position]
        distance = _distance(projection, k, cosine, sine, prepared, best, difference, terms)
        if distance < best or (distance == best and position < where):
            best, where = distance, position
    return best, int(candidates[where]) if where < n_candidates else -1


@numba.njit(cache=True)
def distances_to(
    projection: Projection, candidates: np.ndarray, prepared: Prepared, distances: np.ndarray
) -> None:
    """Write the distances of a prepared projection to its candidates."""
    difference, terms = np.empty_like(projection.joints), np.empty(projection.edges.shape[1])
    for position in range(len(candidates)):
        k = candidates[position]
        cosine, sine, _ = rotation(projection.joints, prepared.joints[k])
        distance = _distance(projection, k, cosine, sine, prepared, np.inf, difference, terms)
        distances[position] = distance


@numba.njit(**NO_ALLOCATION)
def annotation_graph_distance(
    joints: np.ndarray, k: int, prepared: Prepared, difference: np.ndarray, terms: np.ndarray
) -> float:
    """Return the dissimilarity (eq. 8) with annotation k's graph also used for the projection."""
    cosine, sine, _ = rotation(joints, prepared.joints[k])
    residual(joints, prepared.joints[k], cosine, sine, difference)
    return 2.0 * _annotation_sum(difference, k, prepared, terms)


@numba.njit(cache=True)
def centred(points: np.ndarray) -> np.ndarray:
    """Return centred joints, ``(J, 2) → (2, J)``."""
    n_joints = points.shape[0]
    joints = np.empty((2, n_joints))
    for axis in range(2):
        mean = 0.0
        for joint in range(n_joints):
            mean += points[joint, axis]
        mean /= n_joints
        for joint in range(n_joints):
            joints[axis, joint] = points[joint, axis] - mean
    return joints


@numba.njit(cache=True)
def prepare_projection(points: np.ndarray, prepared: Prepared) -> Projection:
    """Return a projection's centred joints and its weighted graph or polar bins."""
    n_joints, joints = points.shape[0], centred(points)
    n_edges = 0
    capacity = max_edges(n_joints, prepared.graph) if prepared.measure == INTERACTION else 0
    edges, weights = np.empty((2, capacity), dtype=np.uint16), np.empty(capacity)
    bins = np.empty((2, 0, 0))
    if prepared.measure == INTERACTION:
        rows = np.empty((capacity, 2), dtype=np.uint16)
        n_edges, _ = write_graph(points, prepared.graph, prepared.offsets, rows)
        for edge in range(n_edges):
            i, j = rows[edge, 0], rows[edge, 1]
            x, y = joints[0, i] - joints[0, j], joints[1, i] - joints[1, j]
            edges[0, edge], edges[1, edge] = i, j
            weights[edge] = 1.0 / max(prepared.epsilon, np.sqrt(x * x + y * y))
        total = max(_sum(weights, n_edges), _MIN_TOTAL)
        for edge in range(n_edges):
            weights[edge] /= total
    elif prepared.measure == SHAPE_CONTEXT:
        bins = polar_bins(joints)
    return Projection(joints, edges, weights, n_edges, bins)


@numba.njit(**NO_ALLOCATION)
def rotation(source: np.ndarray, target: np.ndarray) -> tuple[float, float, float]:
    """Return the cosine and sine of the least-squares rotation and Σ target · (rotated source).

    ``target`` must be centred and 0 where occluded; ``source`` need not be centred.
    """
    along, across = 0.0, 0.0
    for joint in range(source.shape[1]):
        along += source[0, joint] * target[0, joint] + source[1, joint] * target[1, joint]
        across += source[0, joint] * target[1, joint] - source[1, joint] * target[0, joint]
    length = np.sqrt(along * along + across * across)
    if length > 0:
        return along / length, across / length, length
    return 1.0, 0.0, 0.0


@numba.njit(**NO_ALLOCATION)
def _distance(
    projection: Projection,
    k: int,
    cosine: float,
    sine: float,
    prepared: Prepared,
    best: float,
    difference: np.ndarray,
    terms: np.ndarray,
) -> float:
    """Return the distance to annotation k, or infinity once it exceeds ``best``."""
    seen = prepared.seen[k]
    if prepared.measure == SHAPE_CONTEXT:
        angle, contexts = np.arctan2(sine, cosine), prepared.contexts[k]
        return context_cost(projection.bins, angle, seen, contexts, prepared.shared, best)
    residual(projection.joints, prepared.joints[k], cosine, sine, difference)
    if prepared.measure == CARTESIAN:
        return _root_mean_square(difference, seen, prepared.n_visible[k])
    occluded = prepared.n_visible[k] < projection.joints.shape[1]
    total = projection_sum(difference, projection, occluded, seen, terms)
    if total > best or prepared.edge_start[k] == prepared.edge_start[k + 1]:
        return np.inf
    return total + _annotation_sum(difference, k, prepared, terms)


@numba.njit(**NO_ALLOCATION)
def residual(
    joints: np.ndarray, target: np.ndarray, cosine: float, sine: float, difference: np.ndarray
) -> None:
    """Write the difference of the rotated projection and an annotation."""
    for joint in range(joints.shape[1]):
        x, y = joints[0, joint], joints[1, joint]
        difference[0, joint] = cosine * x - sine * y - target[0, joint]
        difference[1, joint] = sine * x + cosine * y - target[1, joint]


@numba.njit(**NO_ALLOCATION)
def _annotation_sum(difference: np.ndarray, k: int, prepared: Prepared, terms: np.ndarray) -> float:
    """Return the second sum of eq. 8, over the annotation's graph."""
    start, stop = prepared.edge_start[k], prepared.edge_start[k + 1]
    for edge in range(start, stop):
        i, j = prepared.edges[0, edge], prepared.edges[1, edge]
        x, y = difference[0, i] - difference[0, j], difference[1, i] - difference[1, j]
        terms[edge - start] = prepared.weights[edge] * np.sqrt(x * x + y * y)
    return _sum(terms, stop - start)


@numba.njit(**NO_ALLOCATION)
def projection_sum(
    difference: np.ndarray,
    projection: Projection,
    occluded: bool,
    seen: np.ndarray,
    terms: np.ndarray,
) -> float:
    """Return the first sum of eq. 8, over the projection's graph; infinite if empty."""
    edges, weights, n_edges = projection.edges, projection.weights, projection.n_edges
    for edge in range(n_edges):
        i, j = edges[0, edge], edges[1, edge]
        x, y = difference[0, i] - difference[0, j], difference[1, i] - difference[1, j]
        terms[edge] = weights[edge] * np.sqrt(x * x + y * y)
    if not occluded:
        return _sum(terms, n_edges) if n_edges > 0 else np.inf
    for edge in range(n_edges):
        terms[edge] *= seen[edges[0, edge]] * seen[edges[1, edge]]
    total = _sum(terms, n_edges)
    for edge in range(n_edges):
        terms[edge] = weights[edge] * seen[edges[0, edge]] * seen[edges[1, edge]]
    weight = _sum(terms, n_edges)
    return total / weight if weight > 0 else np.inf


@numba.njit(**NO_ALLOCATION)
def _sum(terms: np.ndarray, n_terms: int) -> float:
    """Return the sum of the terms; four accumulators allow instruction-level parallelism."""
    a, b, c, d = 0.0, 0.0, 0.0, 0.0
    unrolled = n_terms - n_terms % 4
    for k in range(0, unrolled, 4):
        a, b, c, d = a + terms[k], b + terms[k + 1], c + terms[k + 2], d + terms[k + 3]
    for k in range(unrolled, n_terms):
        a += terms[k]
    return (a + b) + (c + d)


@numba.njit(**NO_ALLOCATION)
def _root_mean_square(difference: np.ndarray, seen: np.ndarray, n_visible: int) -> float:
    """Return the RMS distance of the visible joints after removal of the mean difference."""
    if n_visible == 0:
        return np.inf
    sum_x, sum_y, square = 0.0, 0.0, 0.0
    for joint in range(difference.shape[1]):
        sum_x += seen[joint] * difference[0, joint]
        sum_y += seen[joint] * difference[1, joint]
    mean_x, mean_y = sum_x / n_visible, sum_y / n_visible
    for joint in range(difference.shape[1]):
        x, y = difference[0, joint] - mean_x, difference[1, joint] - mean_y
        square += seen[joint] * (x * x + y * y)
    return np.sqrt(square / n_visible)
