"""The graphs of :mod:`probmotion.interaction.geometry.graphs` in the plane, compiled."""

from __future__ import annotations

import numba
import numpy as np

from probmotion.interaction.geometry.delaunay import delaunay_into, most_edges
from probmotion.interaction.geometry.graphs import GRAPHS, N_NEIGHBOURS

__all__ = ["count_degenerate", "edge_room", "graph_into", "graphs_of_visible"]

_DELAUNAY, _NEAREST_NEIGHBOURS, _GABRIEL, _COMPLETE = range(len(GRAPHS))


@numba.njit(cache=True)
def edge_room(n_joints: int, graph: int) -> int:
    """Return how many edges a graph over ``n_joints`` can have."""
    return most_edges(n_joints) if graph == _DELAUNAY else n_joints * (n_joints - 1) // 2


@numba.njit(cache=True)
def graph_into(
    points: np.ndarray, graph: int, offsets: np.ndarray, edges: np.ndarray
) -> tuple[int, bool]:
    """Write a graph's edges into ``edges``; return their number and whether joints were moved.

    Parameters
    ----------
    points, offsets : numpy.ndarray
        Joints and the offsets to move degenerate ones by, shape (J, 2), float64.
    graph : int
        The graph's place in :data:`~probmotion.interaction.geometry.graphs.GRAPHS`.
    edges : numpy.ndarray
        Receives one edge a row, the smaller joint first; uint16, at least :func:`edge_room` rows.
    """
    if graph == _DELAUNAY:
        return delaunay_into(points, offsets, edges)
    n_joints, n_edges = points.shape[0], 0
    near = np.zeros((n_joints, n_joints), dtype=np.bool_)
    if graph == _NEAREST_NEIGHBOURS:
        _mark_neighbours(points, near)
    for i in range(n_joints):
        for j in range(i + 1, n_joints):
            if (
                graph == _COMPLETE
                or (graph == _NEAREST_NEIGHBOURS and (near[i, j] or near[j, i]))
                or (graph == _GABRIEL and _is_gabriel(points, i, j))
            ):
                edges[n_edges, 0], edges[n_edges, 1] = i, j
                n_edges += 1
    return n_edges, False


@numba.njit(cache=True)
def _mark_neighbours(points: np.ndarray, near: np.ndarray) -> None:
    """Mark each joint's nearest ones; of equally near ones the first come first."""
    n_joints = points.shape[0]
    squared = np.empty(n_joints)
    for i in range(n_joints):
        for j in range(n_joints):
            x, y = points[i, 0] - points[j, 0], points[i, 1] - points[j, 1]
            squared[j] = x * x + y * y
        squared[i] = np.inf
        for _ in range(min(N_NEIGHBOURS, n_joints - 1)):
            nearest = np.argmin(squared)
            near[i, nearest] = True
            squared[nearest] = np.inf


@numba.njit(cache=True)
def _is_gabriel(points: np.ndarray, i: int, j: int) -> bool:
    """Return whether no joint is strictly inside the circle whose diameter is i–j."""
    for k in range(points.shape[0]):
        toward = (points[i, 0] - points[k, 0]) * (points[j, 0] - points[k, 0]) + (
            points[i, 1] - points[k, 1]
        ) * (points[j, 1] - points[k, 1])
        if toward < 0:
            return False
    return True


@numba.njit(cache=True)
def graphs_of_visible(
    points: np.ndarray, visible: np.ndarray, graph: int, epsilon: float, offsets: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the graphs over the visible joints of many sets, and the weights of eq. 8.

    Parameters
    ----------
    points, visible : numpy.ndarray
        Shapes (n, J, 2) and (n, J).
    graph : int
        The graph's place in :data:`~probmotion.interaction.geometry.graphs.GRAPHS`.
    epsilon : float
        ε of eq. 8, in the unit of ``points``.
    offsets : numpy.ndarray
        What degenerate joints are moved by, (J, 2).

    Returns
    -------
    n_edges : numpy.ndarray
        Shape (n,).
    edges : numpy.ndarray
        Shape (n, E, 2), uint16; the first ``n_edges`` of each count.
    weights : numpy.ndarray
        Shape (n, E), each graph's sum to 1.
    """
    n, n_joints = visible.shape
    most = edge_room(n_joints, graph)
    n_edges = np.zeros(n, dtype=np.int64)
    edges = np.zeros((n, most, 2), dtype=np.uint16)
    weights = np.zeros((n, most))
    for k in range(n):
        shown = np.flatnonzero(visible[k])
        joints = points[k][shown]
        n_edges[k], _ = graph_into(joints, graph, offsets, edges[k])
        total = 0.0
        for edge in range(n_edges[k]):
            i, j = edges[k, edge, 0], edges[k, edge, 1]
            x, y = joints[i, 0] - joints[j, 0], joints[i, 1] - joints[j, 1]
            edges[k, edge, 0], edges[k, edge, 1] = shown[i], shown[j]
            weights[k, edge] = 1.0 / max(epsilon, np.sqrt(x * x + y * y))
            total += weights[k, edge]
        weights[k, : n_edges[k]] /= max(total, 1e-300)
    return n_edges, edges, weights


@numba.njit(cache=True)
def count_degenerate(points: np.ndarray, graph: int, offsets: np.ndarray) -> int:
    """Return how many of the joint sets, (n, J, 2), had to be moved."""
    edges = np.empty((edge_room(points.shape[1], graph), 2), dtype=np.uint16)
    count = 0
    for k in range(points.shape[0]):
        count += graph_into(points[k], graph, offsets, edges)[1]
    return count
