"""Compiled 2D versions of the graphs of :mod:`probmotion.interaction.geometry.graphs`."""

from __future__ import annotations

import numpy as np

from probmotion.extras import numba
from probmotion.interaction.geometry.delaunay import is_obtuse, max_planar_edges, write_delaunay
from probmotion.interaction.geometry.graphs import GRAPHS, N_NEIGHBOURS

__all__ = ["graphs_of_visible", "max_edges", "write_graph"]

_DELAUNAY, _NEAREST_NEIGHBOURS, _GABRIEL, _COMPLETE = range(len(GRAPHS))  # indices into GRAPHS


@numba.njit(cache=True)
def max_edges(n_joints: int, graph: int) -> int:
    """Return the maximum number of edges of a graph over ``n_joints``."""
    return max_planar_edges(n_joints) if graph == _DELAUNAY else n_joints * (n_joints - 1) // 2


@numba.njit(cache=True)
def write_graph(
    points: np.ndarray, graph: int, offsets: np.ndarray, edges: np.ndarray
) -> tuple[int, bool]:
    """Write a graph's edges; return their number and whether joints were joggled.

    ``points`` and joggle ``offsets`` are (J, 2), ``graph`` is the index into
    :data:`~probmotion.interaction.geometry.graphs.GRAPHS`, and ``edges`` (E, 2), uint16, has at
    least :func:`max_edges` rows.
    """
    if graph == _DELAUNAY:
        return write_delaunay(points, offsets, edges)
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
    """Mark the nearest neighbours of each joint; ties go to the lower index."""
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
    """Return whether no joint is strictly inside the circle with diameter i–j."""
    for k in range(points.shape[0]):  # noqa: SIM110  Numba has no `all` of a generator.
        if is_obtuse(points, i, j, k):
            return False
    return True


@numba.njit(cache=True)
def graphs_of_visible(
    points: np.ndarray, visible: np.ndarray, graph: int, epsilon: float, offsets: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the graphs over the visible joints of n pose-pairs and the weights of eq. 8.

    ``points`` are (n, J, 2) and ``visible`` is (n, J). The results are the numbers of edges (n,),
    the edges (n, E, 2) uint16 and their weights (n, E), which sum to 1 for each graph.
    """
    n, n_joints = visible.shape
    capacity = max_edges(n_joints, graph)
    n_edges = np.zeros(n, dtype=np.int64)
    edges = np.zeros((n, capacity, 2), dtype=np.uint16)
    weights = np.zeros((n, capacity))
    for k in range(n):
        shown = np.flatnonzero(visible[k])
        joints = points[k][shown]
        n_edges[k], _ = write_graph(joints, graph, offsets, edges[k])
        total = 0.0
        for edge in range(n_edges[k]):
            i, j = edges[k, edge, 0], edges[k, edge, 1]
            x, y = joints[i, 0] - joints[j, 0], joints[i, 1] - joints[j, 1]
            edges[k, edge, 0], edges[k, edge, 1] = shown[i], shown[j]
            weights[k, edge] = 1.0 / max(epsilon, np.sqrt(x * x + y * y))
            total += weights[k, edge]
        for edge in range(n_edges[k]):
            weights[k, edge] /= max(total, 1e-300)
    return n_edges, edges, weights
