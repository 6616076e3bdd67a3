"""Interaction coordinates of pose-pairs and their dissimilarity (Yin et al. 2018, eqs. 7-8).

The edges are those of :mod:`probmotion.interaction.geometry.graphs`, for any number of people.
"""

from __future__ import annotations

import numpy as np

from probmotion.arrays import Array, array_namespace, constant, to_numpy
from probmotion.interaction.geometry.graphs import check_graph, graph_edges
from probmotion.validation import check_positive, check_shape

__all__ = [
    "align_motions", "align_rigidly", "cartesian_distance", "dissimilarity",
    "interaction_coordinates", "interaction_distance",
]  # fmt: skip


def align_rigidly(source: Array, target: Array, visible: Array | None = None) -> Array:
    """Return ``source`` rigidly aligned to ``target`` by least squares (Kabsch 1976).

    A rotation and a translation are fitted to the visible joints and applied to all joints.

    Parameters
    ----------
    source, target : Array, (…, J, D)
        Joints, D = 2 or 3, metres; batch axes broadcast.
    visible : Array of bool, (…, J), optional
        Mask of the joints to fit; all by default. Occluded joints of ``target`` are ignored.

    Returns
    -------
    Array, (…, J, D)
        Aligned joints, metres.
    """
    _check_pairs(source, target, visible)
    xp = array_namespace(source, target)
    counted = _weights(source, visible)[..., None]
    total = xp.sum(counted, axis=-2, keepdims=True)
    total = xp.where(total > 0, total, xp.ones_like(total))
    if visible is not None:
        target = xp.where(counted > 0, target, xp.zeros_like(target))
    source_centre = xp.sum(counted * source, axis=-2, keepdims=True) / total
    target_centre = xp.sum(counted * target, axis=-2, keepdims=True) / total
    centred = source - source_centre
    moments = xp.matrix_transpose(counted * centred) @ (target - target_centre)
    left, _, right = xp.linalg.svd(moments, full_matrices=False)
    # Undo a reflection by flipping the direction of the smallest singular value.
    mirrored = (xp.linalg.det(left) * xp.linalg.det(right) < 0)[..., None, None]
    last_axis = constant([0.0] * (source.shape[-1] - 1) + [1.0], source)[:, None]
    right = xp.where(mirrored, right * (1 - 2 * last_axis), right)
    return centred @ (left @ right) + target_centre


def align_motions(motions: Array, target: Array) -> Array:
    """Return each motion aligned to ``target`` by one rigid transform for all its frames.

    ``motions`` (…, L, J, 3) and ``target`` (L, J, 3), metres; see :func:`align_rigidly`.
    """
    xp = array_namespace(motions, target)
    points = xp.reshape(motions, (*motions.shape[:-3], -1, 3))
    return xp.reshape(align_rigidly(points, xp.reshape(target, (-1, 3))), motions.shape)


def interaction_coordinates(points: Array, edges: Array) -> Array:
    """Return the edge vectors ``p_i − p_j`` (eq. 7), (…, E, D), metres.

    Parameters
    ----------
    points : Array, (…, J, D)
        Joints, metres.
    edges : Array of int, (E, 2)
        Edges (i, j).
    """
    check_shape("points", points, ("…", "J", "D"))
    first, second = _ends(edges, points)
    xp = array_namespace(points)
    return xp.take(points, first, axis=-2) - xp.take(points, second, axis=-2)


def dissimilarity(
    first: Array,
    second: Array,
    first_edges: Array,
    second_edges: Array,
    epsilon: float = 0.05,
    visible: Array | None = None,
) -> Array:
    """Return the dissimilarity of two pose-pairs in interaction coordinates (eq. 8), metres.

    ``d = Σ_{T₁} w₁ ‖u₁ − u₂‖ / W₁ + Σ_{T₂} w₂ ‖u₁ − u₂‖ / W₂``, with edges T_k, coordinates u_k
    (eq. 7) and weights ``w_k = 1 / max(ε, ‖u_k‖)`` of sum W_k of pair k. Pairs are not aligned.

    Parameters
    ----------
    first, second : Array, (…, J, D)
        Joints, metres; batch axes broadcast.
    first_edges, second_edges : Array of int, (E, 2)
        Edges of each pair's graph; E may differ.
    epsilon : float
        Minimum edge length ε in the weights, metres.
    visible : Array of bool, (…, J), optional
        Mask of visible joints. Edges with an occluded end are excluded from all sums.

    Returns
    -------
    Array, (…)
        Dissimilarities, metres; infinite if a graph has no visible edge.
    """
    _check_pairs(first, second, visible)
    check_positive("epsilon", epsilon)
    xp = array_namespace(first, second)
    counted = _weights(first, visible)
    total = None
    for pair, edges in ((first, first_edges), (second, second_edges)):
        i, j = _ends(edges, pair)
        difference = interaction_coordinates(first, edges) - interaction_coordinates(second, edges)
        length = _norm(interaction_coordinates(pair, edges))
        both = xp.take(counted, i, axis=-1) * xp.take(counted, j, axis=-1)
        weight = both / xp.where(length > epsilon, length, xp.full_like(length, epsilon))
        # Occluded joints may be NaN; a zero weight alone would not remove them.
        distance = _norm(difference)
        term = _mean(xp.where(both > 0, distance, xp.zeros_like(distance)), weight)
        total = term if total is None else total + term
    return total


def interaction_distance(
    first: Array, second: Array, graph: str = "delaunay", epsilon: float = 0.05
) -> Array:
    """Return the dissimilarity (eq. 8) of pose-pairs after rigid alignment, metres.

    The distance is symmetric and invariant to rigid motion of either pair.

    Parameters
    ----------
    first, second : Array, (…, J, D)
        Joints, D = 2 or 3, metres; batch axes broadcast.
    graph : str
        One of :data:`~probmotion.interaction.geometry.graphs.GRAPHS`.
    epsilon : float
        ε of eq. 8, metres.
    """
    _check_pairs(first, second, None)
    check_graph(graph)
    xp = array_namespace(first, second)
    first, second = xp.broadcast_arrays(first, second)
    *batch, n_joints, n_axes = first.shape
    first, second = (xp.reshape(pairs, (-1, n_joints, n_axes)) for pairs in (first, second))
    aligned = align_rigidly(first, second)
    distances = [xp.zeros(0, dtype=first.dtype)]
    for k in range(first.shape[0]):
        one, other = (graph_edges(to_numpy(pairs[k, ...]), graph) for pairs in (first, second))
        distance = dissimilarity(aligned[k, ...], second[k, ...], one, other, epsilon)
        distances.append(distance[None])
    return xp.reshape(xp.concat(distances), tuple(batch))


def cartesian_distance(first: Array, second: Array, visible: Array | None = None) -> Array:
    """Return the root-mean-square joint distance after rigid alignment, metres.

    This is the Cartesian baseline of the paper. The distance is infinite if no joint is visible.

    Parameters
    ----------
    first, second : Array, (…, J, D)
        Joints, metres; batch axes broadcast.
    visible : Array of bool, (…, J), optional
        Mask of visible joints; all by default.
    """
    _check_pairs(first, second, visible)
    xp = array_namespace(first, second)
    weight = _weights(first, visible)
    if visible is not None:
        second = xp.where(weight[..., None] > 0, second, xp.zeros_like(second))
    squared = xp.sum((align_rigidly(first, second, visible) - second) ** 2, axis=-1)
    squared = xp.where(weight > 0, squared, xp.zeros_like(squared))
    return _root(_mean(squared, weight))


def _check_pairs(first: Array, second: Array, visible: Array | None) -> None:
    check_shape("first", first, ("…", "J", "D"))
    check_shape("second", second, ("…", *first.shape[-2:]))
    if visible is not None:
        check_shape("visible", visible, ("…", first.shape[-2]))


def _weights(points: Array, visible: Array | None) -> Array:
    """Return 1 for visible and 0 for occluded joints, (…, J)."""
    xp = array_namespace(points)
    if visible is None:
        return xp.ones(points.shape[-2:-1], dtype=points.dtype)
    return constant(to_numpy(visible), points)


def _ends(edges: Array, like: Array) -> tuple[Array, Array]:
    """Return both joint indices of each edge, in the array library of ``like``."""
    numbers = to_numpy(edges)
    check_shape("edges", numbers, ("E", 2))
    xp = array_namespace(like)
    indices = xp.asarray(numbers.astype(np.int64))
    return indices[:, 0], indices[:, 1]


def _norm(vectors: Array) -> Array:
    """Return the lengths of vectors, (…, D) → (…), with gradient 0 at 0."""
    return _root(array_namespace(vectors).sum(vectors**2, axis=-1))


def _root(squared: Array) -> Array:
    xp = array_namespace(squared)
    positive = squared > 0
    return xp.where(positive, xp.sqrt(xp.where(positive, squared, xp.ones_like(squared))), squared)


def _mean(values: Array, weight: Array) -> Array:
    """Return the weighted mean over the last axis, infinite if all weights are 0."""
    xp = array_namespace(values)
    weight = xp.broadcast_to(weight, values.shape)
    total = xp.sum(weight, axis=-1)
    empty = total <= 0
    mean = xp.sum(values * weight, axis=-1) / xp.where(empty, xp.ones_like(total), total)
    return xp.where(empty, xp.full_like(mean, float("inf")), mean)
