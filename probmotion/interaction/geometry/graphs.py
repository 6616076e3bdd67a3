"""Graphs over the joints of a pose-pair in 2D and 3D.

Reference implementation in NumPy and SciPy. The compiled 2D version is
:mod:`probmotion.interaction.geometry.graph_kernels`.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import Delaunay, QhullError

from probmotion.seeds import generator
from probmotion.validation import check_finite, check_shape

__all__ = [
    "GRAPHS", "JOGGLE", "N_NEIGHBOURS", "check_graph", "graph_edges", "is_degenerate",
    "joggle_offsets",
]  # fmt: skip

GRAPHS = ("delaunay", "nearest-neighbours", "gabriel", "complete")
N_NEIGHBOURS = 6  # number of nearest joints in the nearest-neighbour graph
JOGGLE = 1e-5
"""Displacement of degenerate joints, in units of their extent."""

# Determinants of joints in the unit box below this size have an uncertain sign.
_TIE = 1e-13


def graph_edges(points: np.ndarray, graph: str = "delaunay") -> np.ndarray:
    """Return the edges of a graph over joints.

    - ``delaunay``: the Delaunay triangulation (Qhull). Degenerate joints
      (:func:`is_degenerate`) are first joggled: moved by small fixed offsets.
    - ``nearest-neighbours``: edge i–j if either is one of the other's six nearest joints.
    - ``gabriel``: edge i–j if no joint lies strictly inside the ball with diameter i–j; a subgraph
      of the Delaunay triangulation.
    - ``complete``: all pairs of joints.

    Parameters
    ----------
    points : ndarray, (J, D)
        Joints, D = 2 or 3, in any unit.
    graph : str
        One of :data:`GRAPHS`.

    Returns
    -------
    ndarray of int, (E, 2)
        Edges (i, j) with i < j, rows in lexicographic order.
    """
    points = _checked(points)
    check_graph(graph)
    if graph == "delaunay":
        adjacent = _delaunay_adjacency(points)
    elif graph == "nearest-neighbours":
        adjacent = _neighbour_adjacency(points)
    elif graph == "gabriel":
        adjacent = _gabriel_adjacency(points)
    else:
        adjacent = np.ones((points.shape[0],) * 2, dtype=bool)
    return np.argwhere(np.triu(adjacent, 1))


def is_degenerate(points: np.ndarray) -> bool:
    """Return whether the Delaunay triangulation of joints, (J, 2) or (J, 3), is not unique.

    True if joints coincide, are collinear (3D: coplanar), or if the joints of two neighbouring
    triangles are cocircular (tetrahedra: cospherical).
    """
    points = _checked(points)
    if len(np.unique(points, axis=0)) < len(points):
        return True
    return len(points) > points.shape[1] and _triangulation(points) is None


def check_graph(graph: str) -> None:
    """Raise ``ValueError`` unless ``graph`` is one of :data:`GRAPHS`."""
    if graph not in GRAPHS:
        raise ValueError(f"graph must be one of {', '.join(GRAPHS)}, got {graph!r}")


def joggle_offsets(n_joints: int, n_axes: int) -> np.ndarray:
    """Return the fixed offsets in [-1, 1] for joggling degenerate joints, (J, D)."""
    return 2.0 * generator(0, "joggle").random((n_joints, 3))[:, :n_axes].copy() - 1.0


def _checked(points: np.ndarray) -> np.ndarray:
    points = np.asarray(points, dtype=np.float64)
    check_shape("points", points, ("J", 3 if points.shape[-1:] == (3,) else 2))
    check_finite("points", points)
    return points


def _delaunay_adjacency(points: np.ndarray) -> np.ndarray:
    """Return the adjacency matrix of the Delaunay triangulation, (J, J) bool."""
    n_joints, n_axes = points.shape
    if n_joints <= n_axes:
        return np.ones((n_joints, n_joints), dtype=bool)
    simplices = _triangulation(points)
    if simplices is None:
        unit = _in_unit_box(points)
        simplices = Delaunay(unit + JOGGLE * joggle_offsets(n_joints, n_axes)).simplices
    adjacent = np.zeros((n_joints, n_joints), dtype=bool)
    adjacent[simplices[:, :, None], simplices[:, None, :]] = True
    return adjacent


def _triangulation(points: np.ndarray) -> np.ndarray | None:
    """Return the joints of each triangle or tetrahedron, None if degenerate."""
    unit = _in_unit_box(points)
    try:
        triangulation = Delaunay(unit)
    except QhullError:
        return None
    simplices = triangulation.simplices
    if len(np.unique(simplices)) < len(unit) or _has_ties(unit, triangulation):
        return None
    # Rounding can produce a flat triangle from a joint between two others on the hull.
    legs = unit[simplices[:, 1:]] - unit[simplices[:, :1]]
    return simplices[np.abs(np.linalg.det(legs)) >= _TIE]


def _in_unit_box(points: np.ndarray) -> np.ndarray:
    """Return the joints centred and scaled to the unit box."""
    low, high = points.min(axis=0), points.max(axis=0)
    extent = (high - low).max()
    return (points - 0.5 * (low + high)) / (extent if extent > 1e-150 else 1.0)


def _has_ties(unit: np.ndarray, triangulation: Delaunay) -> bool:
    """Return whether a joint lies on the circumcircle (3D: circumsphere) of a neighbour."""
    simplices, neighbours = triangulation.simplices, triangulation.neighbors
    simplex, side = np.nonzero(neighbours >= 0)
    other = simplices[neighbours[simplex, side]]
    opposite = other[~(other[:, :, None] == simplices[simplex][:, None, :]).any(axis=-1)]
    # Cocircular joints are coplanar once lifted to the paraboloid: the determinant is 0.
    differences = unit[simplices[simplex]] - unit[opposite][:, None]
    lifted = np.concatenate([differences, (differences**2).sum(axis=-1, keepdims=True)], axis=-1)
    return bool((np.abs(np.linalg.det(lifted)) < _TIE).any())


def _neighbour_adjacency(points: np.ndarray) -> np.ndarray:
    """Return the symmetric nearest-neighbour matrix, (J, J) bool; the lower index breaks ties."""
    squared = ((points[:, None] - points[None]) ** 2).sum(axis=-1)
    np.fill_diagonal(squared, np.inf)
    nearest = np.argsort(squared, axis=1, kind="stable")[:, : min(N_NEIGHBOURS, len(points) - 1)]
    adjacent = np.zeros(squared.shape, dtype=bool)
    np.put_along_axis(adjacent, nearest, True, axis=1)
    return adjacent | adjacent.T


def _gabriel_adjacency(points: np.ndarray) -> np.ndarray:
    """Return the adjacency matrix of the Gabriel graph, (J, J) bool."""
    differences = points[:, None] - points[None]  # [i, k]: from k to i
    # k is inside the ball with diameter i–j if and only if the angle i–k–j is obtuse.
    products = np.einsum("ikd,jkd->ijk", differences, differences)
    return ~(products < 0).any(axis=-1)
