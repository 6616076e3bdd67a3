"""Compiled 2D Delaunay triangulation of a few dozen joints (Bowyer 1981, Watson 1981).

Joints are inserted one at a time: triangles with the new joint in their circumcircle form a cavity,
and the boundary of the cavity is connected to the joint. Each hull edge has a ghost triangle with a
vertex at infinity, so that joints outside the hull need no special case. The reference
implementation is :mod:`probmotion.interaction.geometry.graphs`.
"""

from __future__ import annotations

import numpy as np

from probmotion.extras import numba
from probmotion.interaction.geometry.graphs import JOGGLE, joggle_offsets
from probmotion.validation import check_finite, check_shape

__all__ = ["delaunay_edges", "is_obtuse", "max_planar_edges", "write_delaunay"]

# Determinants of joints in the unit box have errors of about 1e-15; below this size their sign is
# uncertain.
_TIE = 1e-13


def delaunay_edges(points: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return the edges of the 2D Delaunay triangulation and whether the joints were degenerate.

    Degenerate joints (coincident, collinear, or four of them cocircular) are first moved by
    :func:`~probmotion.interaction.geometry.graphs.joggle_offsets`.

    Parameters
    ----------
    points : ndarray, (J, 2)
        Joints, in any unit.

    Returns
    -------
    edges : ndarray of int, (E, 2)
        The smaller joint index first, rows in lexicographic order.
    degenerate : bool
        Whether the joints were joggled.
    """
    points = np.asarray(points, dtype=np.float64)
    check_shape("points", points, ("J", 2))
    check_finite("points", points)
    n_joints = points.shape[0]
    edges = np.empty((max_planar_edges(n_joints), 2), dtype=np.uint16)
    n_edges, degenerate = write_delaunay(points, joggle_offsets(n_joints, 2), edges)
    return np.array(sorted(edges[:n_edges].tolist())).reshape(-1, 2), bool(degenerate)


@numba.njit(cache=True)
def max_planar_edges(n_joints: int) -> int:
    """Return the maximum number of edges of a planar graph over ``n_joints``."""
    return 3 * n_joints - 6 if n_joints > 2 else max(n_joints - 1, 0)


@numba.njit(cache=True)
def write_delaunay(points: np.ndarray, offsets: np.ndarray, edges: np.ndarray) -> tuple[int, bool]:
    """Write the triangulation's edges; return their number and whether joints were degenerate.

    ``points`` and joggle ``offsets`` are (J, 2); ``edges`` has :func:`max_planar_edges` rows.
    """
    n_joints = points.shape[0]
    if n_joints == 2:
        edges[0, 0], edges[0, 1] = 0, 1
        return 1, points[0, 0] == points[1, 0] and points[0, 1] == points[1, 1]
    if n_joints < 2:
        return 0, False
    unit = np.empty((n_joints, 3))
    _into_unit_box(points, unit)
    n_edges = 0
    for exact in (False, True):
        n_edges = _triangulate(unit, exact, edges)
        if n_edges > 0:
            break
        for joint in range(n_joints):
            unit[joint, 0] += JOGGLE * offsets[joint, 0]
            unit[joint, 1] += JOGGLE * offsets[joint, 1]
    return n_edges, exact


@numba.njit(cache=True)
def _into_unit_box(points: np.ndarray, unit: np.ndarray) -> None:
    """Write x, y and x² + y² of the joints, centred and scaled to the unit box."""
    low_x, high_x, low_y, high_y = points[0, 0], points[0, 0], points[0, 1], points[0, 1]
    for joint in range(1, points.shape[0]):
        low_x, high_x = min(low_x, points[joint, 0]), max(high_x, points[joint, 0])
        low_y, high_y = min(low_y, points[joint, 1]), max(high_y, points[joint, 1])
    extent = max(high_x - low_x, high_y - low_y)
    # The square of a smaller extent underflows: treat the joints as coincident.
    extent = extent if extent > 1e-150 else 1.0
    middle_x, middle_y = 0.5 * (low_x + high_x), 0.5 * (low_y + high_y)
    for joint in range(points.shape[0]):
        x = (points[joint, 0] - middle_x) / extent
        y = (points[joint, 1] - middle_y) / extent
        unit[joint, 0], unit[joint, 1], unit[joint, 2] = x, y, x * x + y * y


@numba.njit(cache=True)
def _triangulate(unit: np.ndarray, exact: bool, edges: np.ndarray) -> int:
    """Write the edges and return their number, or 0 if the sign of a determinant was uncertain.

    For joggled joints (``exact``), determinants of coordinate differences of any size are accepted.
    Otherwise each triangle stores the plane through its joints lifted to the paraboloid
    z = x² + y²; a joint below the plane is inside the circumcircle.
    """
    n_joints = ghost = unit.shape[0]
    order = np.empty(n_joints, dtype=np.int64)
    if not _first_triangle(unit, order, exact):
        return 0
    capacity = 4 * n_joints + 8
    corner = np.empty((capacity, 3), dtype=np.int64)
    plane = np.empty((4, capacity))
    inside = np.empty(capacity)
    seen = np.full((n_joints + 1) * (n_joints + 1), -1, dtype=np.int64)
    cavity = np.empty(capacity, dtype=np.int64)
    boundary = np.empty((3 * capacity, 2), dtype=np.int64)
    a, b, c = order[0], order[1], order[2]
    first = ((a, b, c), (b, a, ghost), (c, b, ghost), (a, c, ghost))
    for slot in range(4):
        a, b, c = first[slot]
        _set_triangle(unit, corner, plane, slot, a, b, c)
    n_triangles = 4
    for position in range(3, n_joints):
        joint = order[position]
        if exact:
            _inside_by_differences(unit, corner, n_triangles, joint, inside)
        else:
            x, y, z = unit[joint, 0], unit[joint, 1], unit[joint, 2]
            for t in range(n_triangles):
                inside[t] = plane[0, t] * x + plane[1, t] * y + plane[2, t] * z + plane[3, t]
        n_cavity = 0
        for t in range(n_triangles):
            within = inside[t] > 0
            if not exact and abs(inside[t]) < _TIE:
                if corner[t, 2] != ghost:
                    return 0
                # The joint is collinear with a hull edge: include the ghost if it splits the edge.
                within = is_obtuse(unit, corner[t, 0], corner[t, 1], joint)
            if within:
                cavity[n_cavity] = t
                n_cavity += 1
        n_boundary = _boundary(corner, cavity, n_cavity, seen, position, n_joints + 1, boundary)
        if n_cavity == 0 or n_boundary != n_cavity + 2 or n_triangles + 2 > capacity:
            return 0
        for edge in range(n_boundary):
            slot = cavity[edge] if edge < n_cavity else n_triangles + edge - n_cavity
            _set_triangle(unit, corner, plane, slot, boundary[edge, 0], boundary[edge, 1], joint)
        n_triangles += 2
    return _collect(corner, n_triangles, n_joints, edges)


@numba.njit(cache=True)
def _first_triangle(unit: np.ndarray, order: np.ndarray, exact: bool) -> bool:
    """Write the insertion order, a large triangle first; return False if there is no triangle."""
    n_joints = unit.shape[0]
    second, farthest = 0, -1.0
    for joint in range(1, n_joints):
        x, y = unit[joint, 0] - unit[0, 0], unit[joint, 1] - unit[0, 1]
        if x * x + y * y > farthest:
            second, farthest = joint, x * x + y * y
    third, widest = 0, -1.0
    for joint in range(1, n_joints):
        area = abs(_turn(unit, 0, second, joint))
        if joint != second and area > widest:
            third, widest = joint, area
    if widest <= (0.0 if exact else _TIE):
        return False
    order[0], order[1], order[2] = 0, second, third
    if _turn(unit, 0, second, third) < 0:
        order[1], order[2] = third, second
    position = 3
    for joint in range(1, n_joints):
        if joint not in (second, third):
            order[position] = joint
            position += 1
    return True


@numba.njit(cache=True)
def _turn(unit: np.ndarray, a: int, b: int, c: int) -> float:
    """Return twice the signed area of a triangle, positive if counter-clockwise."""
    x, y = unit[a, 0], unit[a, 1]
    return (unit[b, 0] - x) * (unit[c, 1] - y) - (unit[b, 1] - y) * (unit[c, 0] - x)


@numba.njit(cache=True)
def is_obtuse(points: np.ndarray, a: int, b: int, vertex: int) -> bool:
    """Return whether the angle at ``vertex`` is obtuse, or 180° if the points are collinear."""
    x, y = points[vertex, 0], points[vertex, 1]
    return (points[a, 0] - x) * (points[b, 0] - x) + (points[a, 1] - y) * (points[b, 1] - y) < 0


@numba.njit(cache=True)
def _set_triangle(
    unit: np.ndarray, corner: np.ndarray, plane: np.ndarray, slot: int, a: int, b: int, c: int
) -> None:
    """Write a triangle, with a ghost vertex last, and the plane through its lifted joints."""
    ghost = unit.shape[0]
    if a == ghost:
        a, b, c = b, c, a
    elif b == ghost:
        a, b, c = c, a, b
    corner[slot, 0], corner[slot, 1], corner[slot, 2] = a, b, c
    ax, ay, az = unit[a, 0], unit[a, 1], unit[a, 2]
    ux, uy, uz = unit[b, 0] - ax, unit[b, 1] - ay, unit[b, 2] - az
    if c == ghost:
        # The circle through infinity is the half-plane left of the edge.
        nx, ny, nz = -uy, ux, 0.0
    else:
        vx, vy, vz = unit[c, 0] - ax, unit[c, 1] - ay, unit[c, 2] - az
        nx, ny, nz = uz * vy - uy * vz, ux * vz - uz * vx, uy * vx - ux * vy
    plane[0, slot], plane[1, slot], plane[2, slot] = nx, ny, nz
    plane[3, slot] = -(nx * ax + ny * ay + nz * az)


@numba.njit(cache=True)
def _inside_by_differences(
    unit: np.ndarray, corner: np.ndarray, n_triangles: int, joint: int, inside: np.ndarray
) -> None:
    """Write the in-circle determinants relative to ``joint``, which have small relative errors."""
    ghost = unit.shape[0]
    px, py = unit[joint, 0], unit[joint, 1]
    for t in range(n_triangles):
        a, b, c = corner[t, 0], corner[t, 1], corner[t, 2]
        ax, ay, bx, by = unit[a, 0] - px, unit[a, 1] - py, unit[b, 0] - px, unit[b, 1] - py
        if c == ghost:
            inside[t] = ax * by - ay * bx
        else:
            cx, cy = unit[c, 0] - px, unit[c, 1] - py
            inside[t] = (
                (ax * ax + ay * ay) * (bx * cy - by * cx)
                + (bx * bx + by * by) * (cx * ay - cy * ax)
                + (cx * cx + cy * cy) * (ax * by - ay * bx)
            )


@numba.njit(cache=True)
def _boundary(
    corner: np.ndarray,
    cavity: np.ndarray,
    n_cavity: int,
    seen: np.ndarray,
    stamp: int,
    stride: int,
    boundary: np.ndarray,
) -> int:
    """Write the directed boundary edges of the cavity; return their number."""
    for k in range(n_cavity):
        for side in range(3):
            a, b = corner[cavity[k], side], corner[cavity[k], (side + 1) % 3]
            seen[a * stride + b] = stamp
    n_boundary = 0
    for k in range(n_cavity):
        for side in range(3):
            a, b = corner[cavity[k], side], corner[cavity[k], (side + 1) % 3]
            if seen[b * stride + a] != stamp:
                boundary[n_boundary, 0], boundary[n_boundary, 1] = a, b
                n_boundary += 1
    return n_boundary


@numba.njit(cache=True)
def _collect(corner: np.ndarray, n_triangles: int, n_joints: int, edges: np.ndarray) -> int:
    """Write each edge once, although two triangles contain it; return the number of edges."""
    n_edges = 0
    for t in range(n_triangles):
        for side in range(3):
            a, b = corner[t, side], corner[t, (side + 1) % 3]
            if a < b < n_joints:
                edges[n_edges, 0], edges[n_edges, 1] = a, b
                n_edges += 1
    return n_edges
