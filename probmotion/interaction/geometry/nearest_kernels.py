"""Compiled distances between projections and annotations, with early stopping.

Sums are never reordered, so results are bit-identical for any batch and number of threads.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from probmotion.interaction.geometry.graph_kernels import max_edges, write_graph
from probmotion.interaction.geometry.plane_contexts import context_cost, polar_bins

__all__ = [
    "CARTESIAN",
    "INTERACTION",
    "SHAPE_CONTEXT",
    "Prepared",
    "Projection",
    "all_distances",
    "annotation_graph_distance",
    "centred",
    "distances_to",
    "nearest_candidate",
    "nearest_in_batch",
    "nearest_in_batch_on_threads",
    "prepare_projection",
]

INTERACTION, CARTESIAN, SHAPE_CONTEXT = range(3)
_SMALLEST = 1e-300  # avoids division by 0 if there are no edges


class Prepared(NamedTuple):
    """Precomputed data of n annotations and the options of the comparison.

    ``joints`` (n, 2, J), metres, centred on the visible mean, 0 if occluded; ``seen`` (n, J), 1 if
    visible, else 0; ``n_visible`` (n,); ``square`` (n,), sums of squared coordinates;
    ``edge_start`` (n + 1,), index of each annotation's first edge; ``edges`` (2, E) uint16;
    ``weights`` (E,), w_ij / W of eq. 8; ``contexts`` (n, J, 60) uint8; ``shared``, their
    :func:`~probmotion.interaction.geometry.shape_context.shared_table`; ``offsets`` (J, 2), joggle
    offsets; ``measure`` and ``graph``, indices; ``epsilon``, ε of eq. 8, metres.
    """

    joints: np.ndarray
    seen: np.ndarray
    n_visible: np.ndarray
    square: np.ndarray
    edge_start: np.ndarray
    edges: np.ndarray
    weights: np.ndarray
    contexts: np.ndarray
    shared: np.ndarray
    offsets: np.ndarray
    measure: int
    graph: int
    epsilon: float


class Projection(NamedTuple):
    """A prepared projection: centred joints (2, J), its weighted graph, or its polar bins."""

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
    """Return the distance and index of the nearest candidate for (B, V, J, 2) and (V, N)."""
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
    """Return the distances of (B, J, 2) to all n annotations, (B, n)."""
    n_items, n_annotations = projections.shape[0], prepared.joints.shape[0]
    out, every = np.empty((n_items, n_annotations)), np.arange(n_annotations)
    for item in range(n_items):
        projection = prepare_projection(projections[item], prepared)
        distances_to(projection, every, prepared, out[item])
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
        turns[0, position], turns[1, position], product = _rotation(joints, prepared.joints[k])
        n_visible, of_visible = prepared.n_visible[k], square
        if n_visible < n_joints:
            of_visible = _square_of_visible(joints, prepared.seen[k], n_visible)
        left[position] = (of_visible + prepared.square[k] - 2.0 * product) / max(n_visible, 1)
    apart, terms = np.empty_like(joints), np.empty(projection.edges.shape[1])
    best, where = within, n_candidates
    # The candidate with the best alignment is likely nearest; starting there stops others early.
    for position in np.argsort(left):
        cosine, sine, k = turns[0, position], turns[1, position], candidates[position]
        found = _distance(projection, k, cosine, sine, prepared, best, apart, terms)
        if found < best or (found == best and position < where):
            best, where = found, position
    return best, int(candidates[where]) if where < n_candidates else -1


@numba.njit(cache=True)
def distances_to(
    projection: Projection, candidates: np.ndarray, prepared: Prepared, found: np.ndarray
) -> None:
    """Write the distances of a prepared projection to its candidates."""
    apart, terms = np.empty_like(projection.joints), np.empty(projection.edges.shape[1])
    for position in range(len(candidates)):
        k = candidates[position]
        cosine, sine, _ = _rotation(projection.joints, prepared.joints[k])
        found[position] = _distance(projection, k, cosine, sine, prepared, np.inf, apart, terms)


@numba.njit(cache=True)
def annotation_graph_distance(
    joints: np.ndarray, k: int, prepared: Prepared, apart: np.ndarray, terms: np.ndarray
) -> float:
    """Return eq. 8 with annotation k's graph used for the projection as well."""
    cosine, sine, _ = _rotation(joints, prepared.joints[k])
    _residual(joints, prepared.joints[k], cosine, sine, apart)
    return 2.0 * _annotation_sum(apart, k, prepared, terms)


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
    most = max_edges(n_joints, prepared.graph) if prepared.measure == INTERACTION else 0
    edges, weights = np.empty((2, most), dtype=np.uint16), np.empty(most)
    bins = np.empty((2, 0, 0))
    if prepared.measure == INTERACTION:
        rows = np.empty((most, 2), dtype=np.uint16)
        n_edges, _ = write_graph(points, prepared.graph, prepared.offsets, rows)
        for edge in range(n_edges):
            i, j = rows[edge, 0], rows[edge, 1]
            x, y = joints[0, i] - joints[0, j], joints[1, i] - joints[1, j]
            edges[0, edge], edges[1, edge] = i, j
            weights[edge] = 1.0 / max(prepared.epsilon, np.sqrt(x * x + y * y))
        weights[:n_edges] /= max(_sum(weights, n_edges), _SMALLEST)
    elif prepared.measure == SHAPE_CONTEXT:
        bins = polar_bins(joints)
    return Projection(joints, edges, weights, n_edges, bins)


@numba.njit(cache=True)
def _rotation(source: np.ndarray, target: np.ndarray) -> tuple[float, float, float]:
    """Return cosine and sine of the least-squares rotation, and Σ target · (rotated source).

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


@numba.njit(cache=True)
def _square_of_visible(joints: np.ndarray, seen: np.ndarray, n_visible: int) -> float:
    """Return the sum of squared distances of the visible joints to their mean."""
    square, sum_x, sum_y = 0.0, 0.0, 0.0
    for joint in range(joints.shape[1]):
        x, y = seen[joint] * joints[0, joint], seen[joint] * joints[1, joint]
        sum_x, sum_y, square = sum_x + x, sum_y + y, square + x * x + y * y
    return square - (sum_x * sum_x + sum_y * sum_y) / max(n_visible, 1)


@numba.njit(cache=True)
def _distance(
    projection: Projection,
    k: int,
    cosine: float,
    sine: float,
    prepared: Prepared,
    best: float,
    apart: np.ndarray,
    terms: np.ndarray,
) -> float:
    """Return the distance to annotation k, or infinity once it exceeds ``best``."""
    seen = prepared.seen[k]
    if prepared.measure == SHAPE_CONTEXT:
        angle, contexts = np.arctan2(sine, cosine), prepared.contexts[k]
        return context_cost(projection.bins, angle, seen, contexts, prepared.shared, best)
    _residual(projection.joints, prepared.joints[k], cosine, sine, apart)
    if prepared.measure == CARTESIAN:
        return _root_mean_square(apart, seen, prepared.n_visible[k])
    occluded = prepared.n_visible[k] < projection.joints.shape[1]
    total = _projection_sum(apart, projection, occluded, seen, terms)
    if total > best or prepared.edge_start[k] == prepared.edge_start[k + 1]:
        return np.inf
    return total + _annotation_sum(apart, k, prepared, terms)


@numba.njit(cache=True)
def _residual(
    joints: np.ndarray, target: np.ndarray, cosine: float, sine: float, apart: np.ndarray
) -> None:
    """Write the difference of the rotated projection and an annotation."""
    for joint in range(joints.shape[1]):
        x, y = joints[0, joint], joints[1, joint]
        apart[0, joint] = cosine * x - sine * y - target[0, joint]
        apart[1, joint] = sine * x + cosine * y - target[1, joint]


@numba.njit(cache=True)
def _annotation_sum(apart: np.ndarray, k: int, prepared: Prepared, terms: np.ndarray) -> float:
    """Return the second sum of eq. 8, over the annotation's graph."""
    start, stop = prepared.edge_start[k], prepared.edge_start[k + 1]
    for edge in range(start, stop):
        i, j = prepared.edges[0, edge], prepared.edges[1, edge]
        x, y = apart[0, i] - apart[0, j], apart[1, i] - apart[1, j]
        terms[edge - start] = prepared.weights[edge] * np.sqrt(x * x + y * y)
    return _sum(terms, stop - start)


@numba.njit(cache=True)
def _projection_sum(
    apart: np.ndarray, projection: Projection, occluded: bool, seen: np.ndarray, terms: np.ndarray
) -> float:
    """Return the first sum of eq. 8, over the projection's graph; infinite if empty."""
    edges, weights, n_edges = projection.edges, projection.weights, projection.n_edges
    for edge in range(n_edges):
        i, j = edges[0, edge], edges[1, edge]
        x, y = apart[0, i] - apart[0, j], apart[1, i] - apart[1, j]
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


@numba.njit(cache=True)
def _sum(terms: np.ndarray, n_terms: int) -> float:
    """Return a sum with four accumulators, for instruction-level parallelism."""
    a, b, c, d = 0.0, 0.0, 0.0, 0.0
    whole = n_terms - n_terms % 4
    for k in range(0, whole, 4):
        a, b, c, d = a + terms[k], b + terms[k + 1], c + terms[k + 2], d + terms[k + 3]
    for k in range(whole, n_terms):
        a += terms[k]
    return (a + b) + (c + d)


@numba.njit(cache=True)
def _root_mean_square(apart: np.ndarray, seen: np.ndarray, n_visible: int) -> float:
    """Return the root-mean-square distance of the visible joints, mean difference removed."""
    if n_visible == 0:
        return np.inf
    sum_x, sum_y, square = 0.0, 0.0, 0.0
    for joint in range(apart.shape[1]):
        sum_x += seen[joint] * apart[0, joint]
        sum_y += seen[joint] * apart[1, joint]
    mean_x, mean_y = sum_x / n_visible, sum_y / n_visible
    for joint in range(apart.shape[1]):
        x, y = apart[0, joint] - mean_x, apart[1, joint] - mean_y
        square += seen[joint] * (x * x + y * y)
    return np.sqrt(square / n_visible)
