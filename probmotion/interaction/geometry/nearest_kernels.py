"""One projection against annotations, compiled: align, compare, abandon what cannot be nearest.

No sum here is reordered by the compiler, so a projection's result is the same bits whatever else
is in its batch and however many threads share it.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from probmotion.interaction.geometry.graph_kernels import edge_room, graph_into
from probmotion.interaction.geometry.plane_contexts import context_cost, polar_bins

__all__ = [
    "CARTESIAN",
    "INTERACTION",
    "SHAPE_CONTEXT",
    "Prepared",
    "all_distances",
    "centred",
    "distance_by_its_graph",
    "distances_to",
    "look",
    "nearest_in_batch",
    "nearest_in_batch_on_threads",
    "nearest_of",
]

INTERACTION, CARTESIAN, SHAPE_CONTEXT = range(3)
_SMALLEST = 1e-300  # keeps the weights of no edges from being divided by 0


class Prepared(NamedTuple):
    """What is computed of n annotations once; joints about their visible mean, 0 where hidden."""

    joints: np.ndarray
    """(n, 2, J) float64, metres."""
    seen: np.ndarray
    """(n, J) float64, 1 where visible and 0 where hidden."""
    n_visible: np.ndarray
    """(n,) int64."""
    square: np.ndarray
    """(n,) sums of squared coordinates."""
    edge_start: np.ndarray
    """(n + 1,) where each annotation's edges begin."""
    edges: np.ndarray
    """(2, E) uint16."""
    weights: np.ndarray
    """(E,) w_ij / W of eq. 8."""
    contexts: np.ndarray
    """(n, J, 60) uint8 shape contexts."""
    shared: np.ndarray
    """(J, J) of :func:`~probmotion.interaction.geometry.shape_context.shared_table`."""
    offsets: np.ndarray
    """(J, 2) what degenerate joints are moved by."""


@numba.njit(cache=True)
def _nearest_at(
    flat: int,
    projections: np.ndarray,
    candidates: np.ndarray,
    prepared: Prepared,
    measure: int,
    graph: int,
    epsilon: float,
) -> tuple[float, int]:
    item, view = divmod(flat, projections.shape[1])
    return nearest_of(
        projections[item, view], candidates[view], prepared, measure, graph, epsilon, np.inf
    )


# Two loops, and not one that is compiled twice: files of compiled code are found by a function's
# name, whatever it was compiled for, and one thread would be given the code for several.
@numba.njit(cache=True)
def nearest_in_batch(
    projections: np.ndarray,
    candidates: np.ndarray,
    prepared: Prepared,
    measure: int,
    graph: int,
    epsilon: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the least distance and its annotation for (B, V, J, 2) and (V, N)."""
    shape = projections.shape[:2]
    distances, indices = np.empty(shape[0] * shape[1]), np.empty(shape[0] * shape[1], np.int64)
    for flat in range(distances.size):
        distances[flat], indices[flat] = _nearest_at(
            flat, projections, candidates, prepared, measure, graph, epsilon
        )
    return distances.reshape(shape), indices.reshape(shape)


@numba.njit(cache=True, parallel=True)
def nearest_in_batch_on_threads(
    projections: np.ndarray,
    candidates: np.ndarray,
    prepared: Prepared,
    measure: int,
    graph: int,
    epsilon: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return what :func:`nearest_in_batch` does, on as many threads as Numba has."""
    shape = projections.shape[:2]
    distances, indices = np.empty(shape[0] * shape[1]), np.empty(shape[0] * shape[1], np.int64)
    for flat in numba.prange(distances.size):
        distances[flat], indices[flat] = _nearest_at(
            np.int64(flat), projections, candidates, prepared, measure, graph, epsilon
        )
    return distances.reshape(shape), indices.reshape(shape)


@numba.njit(cache=True)
def all_distances(
    projections: np.ndarray, prepared: Prepared, measure: int, graph: int, epsilon: float
) -> np.ndarray:
    """Return the distances of (B, J, 2) to all n annotations, (B, n)."""
    n_items, n_annotations = projections.shape[0], prepared.joints.shape[0]
    out, every = np.empty((n_items, n_annotations)), np.arange(n_annotations)
    for item in range(n_items):
        points = projections[item]
        joints, edges, weights, n_edges, bins = look(points, prepared, measure, graph, epsilon)
        distances_to(
            joints, edges, weights, n_edges, bins, every, prepared, measure, out[item]
        )  # fmt: skip
    return out


@numba.njit(cache=True)
def nearest_of(
    points: np.ndarray,
    candidates: np.ndarray,
    prepared: Prepared,
    measure: int,
    graph: int,
    epsilon: float,
    within: float,
) -> tuple[float, int]:
    """Return the least distance of one projection to its candidates, and which it is.

    Where none is within ``within`` that is what is returned, and −1.
    """
    joints, edges, weights, n_edges, bins = look(points, prepared, measure, graph, epsilon)
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
    apart, terms = np.empty_like(joints), np.empty(edges.shape[1])
    best, where = within, n_candidates
    # What aligns best is likely nearest: visited first, it lets others be abandoned soon.
    for position in np.argsort(left):
        found = _distance(
            joints, edges, weights, n_edges, bins, candidates[position], turns[0, position],
            turns[1, position], prepared, measure, best, apart, terms,
        )  # fmt: skip
        if found < best or (found == best and position < where):
            best, where = found, position
    return best, int(candidates[where]) if where < n_candidates else -1


@numba.njit(cache=True)
def distances_to(
    joints: np.ndarray,
    edges: np.ndarray,
    weights: np.ndarray,
    n_edges: int,
    bins: np.ndarray,
    candidates: np.ndarray,
    prepared: Prepared,
    measure: int,
    found: np.ndarray,
) -> None:
    """Write the distances to all candidates of a projection that was looked at before."""
    apart, terms = np.empty_like(joints), np.empty(edges.shape[1])
    for position in range(len(candidates)):
        k = candidates[position]
        cosine, sine, _ = _rotation(joints, prepared.joints[k])
        found[position] = _distance(
            joints, edges, weights, n_edges, bins, k, cosine, sine, prepared, measure,
            np.inf, apart, terms,
        )  # fmt: skip


@numba.njit(cache=True)
def distance_by_its_graph(
    joints: np.ndarray, k: int, prepared: Prepared, apart: np.ndarray, terms: np.ndarray
) -> float:
    """Return eq. 8 with annotation k's graph in place of the projection's too."""
    cosine, sine, _ = _rotation(joints, prepared.joints[k])
    _turned_less(joints, prepared.joints[k], cosine, sine, apart)
    return 2.0 * _annotated_part(apart, k, prepared, terms)


@numba.njit(cache=True)
def centred(points: np.ndarray) -> np.ndarray:
    """Return a projection's joints about their mean, ``(J, 2) → (2, J)``."""
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
def look(
    points: np.ndarray, prepared: Prepared, measure: int, graph: int, epsilon: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int, np.ndarray]:
    """Return a projection's joints about their mean, its graph and weights, or its polar bins."""
    n_joints, joints = points.shape[0], centred(points)
    n_edges = 0
    most = edge_room(n_joints, graph) if measure == INTERACTION else 0
    edges, weights = np.empty((2, most), dtype=np.uint16), np.empty(most)
    bins = np.empty((2, 0, 0))
    if measure == INTERACTION:
        rows = np.empty((most, 2), dtype=np.uint16)
        n_edges, _ = graph_into(points, graph, prepared.offsets, rows)
        for edge in range(n_edges):
            i, j = rows[edge, 0], rows[edge, 1]
            x, y = joints[0, i] - joints[0, j], joints[1, i] - joints[1, j]
            edges[0, edge], edges[1, edge] = i, j
            weights[edge] = 1.0 / max(epsilon, np.sqrt(x * x + y * y))
        weights[:n_edges] /= max(_sum(weights, n_edges), _SMALLEST)
    elif measure == SHAPE_CONTEXT:
        bins = polar_bins(joints)
    return joints, edges, weights, n_edges, bins


@numba.njit(cache=True)
def _rotation(source: np.ndarray, target: np.ndarray) -> tuple[float, float, float]:
    """Return cos and sin of the least-squares rotation and Σ target · (rotated source).

    ``target`` is about its mean and 0 where hidden, so ``source`` may be about any point.
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
    """Return the sum of squared distances of the visible joints from their mean."""
    square, sum_x, sum_y = 0.0, 0.0, 0.0
    for joint in range(joints.shape[1]):
        x, y = seen[joint] * joints[0, joint], seen[joint] * joints[1, joint]
        sum_x, sum_y, square = sum_x + x, sum_y + y, square + x * x + y * y
    return square - (sum_x * sum_x + sum_y * sum_y) / max(n_visible, 1)


@numba.njit(cache=True)
def _distance(
    joints: np.ndarray,
    edges: np.ndarray,
    weights: np.ndarray,
    n_edges: int,
    bins: np.ndarray,
    k: int,
    cosine: float,
    sine: float,
    prepared: Prepared,
    measure: int,
    best: float,
    apart: np.ndarray,
    terms: np.ndarray,
) -> float:
    """Return the distance to annotation k, or infinity once it is certain to be above ``best``."""
    seen = prepared.seen[k]
    if measure == SHAPE_CONTEXT:
        angle = np.arctan2(sine, cosine)
        return context_cost(bins, angle, seen, prepared.contexts[k], prepared.shared, best)
    _turned_less(joints, prepared.joints[k], cosine, sine, apart)
    if measure == CARTESIAN:
        return _root_mean_square(apart, seen, prepared.n_visible[k])
    hidden = prepared.n_visible[k] < joints.shape[1]
    total = _own_part(apart, edges, weights, n_edges, hidden, seen, terms)
    if total > best or prepared.edge_start[k] == prepared.edge_start[k + 1]:
        return np.inf
    return total + _annotated_part(apart, k, prepared, terms)


@numba.njit(cache=True)
def _turned_less(
    joints: np.ndarray, target: np.ndarray, cosine: float, sine: float, apart: np.ndarray
) -> None:
    """Write a projection's joints, turned onto an annotation's, less those."""
    for joint in range(joints.shape[1]):
        x, y = joints[0, joint], joints[1, joint]
        apart[0, joint] = cosine * x - sine * y - target[0, joint]
        apart[1, joint] = sine * x + cosine * y - target[1, joint]


@numba.njit(cache=True)
def _annotated_part(apart: np.ndarray, k: int, prepared: Prepared, terms: np.ndarray) -> float:
    """Return the second sum of eq. 8, over the annotation's graph."""
    start, stop = prepared.edge_start[k], prepared.edge_start[k + 1]
    for edge in range(start, stop):
        i, j = prepared.edges[0, edge], prepared.edges[1, edge]
        x, y = apart[0, i] - apart[0, j], apart[1, i] - apart[1, j]
        terms[edge - start] = prepared.weights[edge] * np.sqrt(x * x + y * y)
    return _sum(terms, stop - start)


@numba.njit(cache=True)
def _own_part(
    apart: np.ndarray,
    edges: np.ndarray,
    weights: np.ndarray,
    n_edges: int,
    hidden: bool,
    seen: np.ndarray,
    terms: np.ndarray,
) -> float:
    """Return the first sum of eq. 8, over the projection's graph, infinite if it is empty."""
    for edge in range(n_edges):
        i, j = edges[0, edge], edges[1, edge]
        x, y = apart[0, i] - apart[0, j], apart[1, i] - apart[1, j]
        terms[edge] = weights[edge] * np.sqrt(x * x + y * y)
    if not hidden:
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
    """Return a sum in four strands, which the processor can add side by side."""
    a, b, c, d = 0.0, 0.0, 0.0, 0.0
    whole = n_terms - n_terms % 4
    for k in range(0, whole, 4):
        a, b, c, d = a + terms[k], b + terms[k + 1], c + terms[k + 2], d + terms[k + 3]
    for k in range(whole, n_terms):
        a += terms[k]
    return (a + b) + (c + d)


@numba.njit(cache=True)
def _root_mean_square(apart: np.ndarray, seen: np.ndarray, n_visible: int) -> float:
    """Return the root mean square over visible joints, their mean difference taken off."""
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
