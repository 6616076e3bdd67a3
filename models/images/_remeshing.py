"""Coarser mesh of a smooth union, with well-shaped triangles: collapses, flips and smoothing."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from probmotion.models.images._capsule_union import CapsuleUnion

__all__ = ["border_of", "remeshed"]

_ROUND = 0.25  # part of the vertices that are removed between two steps of smoothing
_BEND = 0.3  # cosine of the largest turn of a triangle at once
_SMOOTH = 0.5  # part of the way to the mean of the neighbours
_SHARP = 0.5  # sharpness of vertices that stay
_LAST = 5  # steps of flips and smoothing in the end
_EXACT = 6  # Newton steps to the surface in the end


class _Edges(NamedTuple):
    ends: np.ndarray  # (E, 2), in the direction of the first triangle
    tips: np.ndarray  # (E, 2), third vertices of both triangles; the second is -1 at the border
    triangles: np.ndarray  # (E, 2), likewise


def remeshed(
    points: np.ndarray, triangles: np.ndarray, vertices: int, union: CapsuleUnion
) -> tuple[np.ndarray, np.ndarray]:
    """Return a mesh of the same surface with fewer vertices, more of them where it is thin.

    Edges are about as long as the square root of the local radius, so that every limb has a number
    of vertices proportional to its length. A mesh with a border is one half of a symmetric mesh:
    its border stays in the plane x = 0, and no other edge joins two vertices of the border.

    Parameters
    ----------
    points, triangles : ndarray, (N, 3)
        Manifold mesh.
    vertices : int
        Largest number of vertices, of both halves. More remain if fewer change the topology.
    union : CapsuleUnion
        Function that is 0 at the surface.

    Returns
    -------
    points, triangles : ndarray, (M, 3)
        Manifold mesh of the same topology.
    """
    border = border_of(triangles, len(points))
    while (excess := _count(border) - vertices) > 0:
        most = min(excess, int(np.ceil(_ROUND * _count(border))))
        fewer = _collapsed(points, triangles, border, union, most)
        if len(fewer[0]) == len(points):
            break
        points, triangles, border = fewer
        triangles = _flipped(points, triangles, border)
        points = _smoothed(points, triangles, border, union)
    for _ in range(_LAST):
        triangles = _flipped(points, triangles, border)
        points = _smoothed(points, triangles, border, union)
    points = union.projected(points, _EXACT)
    points[border, 0] = 0.0
    return points, triangles


def border_of(triangles: np.ndarray, n_points: int) -> np.ndarray:
    """Return whether vertices are at the border of a mesh, (N,)."""
    edges, border = _edges(triangles), np.zeros(n_points, dtype=bool)
    border[edges.ends[edges.tips[:, 1] < 0]] = True
    return border


def _count(border: np.ndarray) -> int:
    """Return the number of vertices of the whole, closed mesh."""
    return 2 * len(border) - int(border.sum()) if border.any() else len(border)


def _edges(triangles: np.ndarray) -> _Edges:
    ends = np.concatenate([triangles[:, [k, (k + 1) % 3]] for k in range(3)])
    tips = np.concatenate([triangles[:, (k + 2) % 3] for k in range(3)])
    key = ends.min(axis=1) * (triangles.max() + 1) + ends.max(axis=1)
    order = np.argsort(key, kind="stable")
    _, first, counts = np.unique(key[order], return_index=True, return_counts=True)
    one, other = order[first], order[np.minimum(first + 1, len(order) - 1)]
    two = counts == 2
    owner = np.arange(len(ends)) % len(triangles)
    return _Edges(
        ends[one],
        np.stack([tips[one], np.where(two, tips[other], -1)], axis=-1),
        np.stack([owner[one], np.where(two, owner[other], -1)], axis=-1),
    )


def _neighbours(edges: _Edges, n_points: int) -> list[set[int]]:
    result: list[set[int]] = [set() for _ in range(n_points)]
    for a, b in edges.ends.tolist():
        result[a].add(b)
        result[b].add(a)
    return result


def _collapsed(
    points: np.ndarray, triangles: np.ndarray, border: np.ndarray, union: CapsuleUnion, most: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Collapse the shortest edges relative to thickness, until ``most`` vertices are removed."""
    edges, n_points = _edges(triangles), len(points)
    around = _neighbours(edges, n_points)
    near = union.at(points)
    sharp = _sharpness(points, triangles, border, _unit(near.slopes))
    # The end at the border is kept, or else the sharper one, such as the tip of a tail.
    rank = sharp + 1e6 * border
    swap = (rank[edges.ends[:, 0]] < rank[edges.ends[:, 1]])[:, None]
    ends = np.where(swap, edges.ends[:, ::-1], edges.ends)
    fixed = _turned(points, triangles, ends) | (sharp[ends[:, 1]] > _SHARP)
    outer = edges.tips[:, 1] < 0
    chord = border[ends].all(axis=1) & ~outer
    inner = border[ends[:, 0]] & ~border[ends[:, 1]]
    valence, locked = [len(some) for some in around], set()
    kept = np.arange(n_points)
    lengths = np.linalg.norm(points[ends[:, 0]] - points[ends[:, 1]], axis=-1)
    order = np.argsort(lengths / np.sqrt(near.radii)[ends].sum(axis=1), kind="stable")
    for at in order[~(fixed | chord)[order]].tolist():
        if most <= 0:
            break
        a, b = ends[at].tolist()
        if a in locked or b in locked:
            continue
        common = around[a] & around[b]
        if (
            len(common) != 2 - outer[at]
            or any(valence[c] <= 3 for c in common)
            or (inner[at] and border[list(around[b] - common - {a})].any())
        ):
            continue
        kept[b] = a
        locked |= around[a] | around[b]
        for c in common:
            valence[c] -= 1
        most -= 2 if border.any() and not border[b] else 1
    left = kept == np.arange(n_points)
    corners = kept[triangles]
    whole = (corners != np.roll(corners, 1, axis=1)).all(axis=1)
    return points[left], (np.cumsum(left) - 1)[corners[whole]], border[left]


def _turned(points: np.ndarray, triangles: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Return whether a triangle turns by much if the second end of an edge moves to the first."""
    degree = np.bincount(triangles.ravel(), minlength=len(points))
    fans, start = np.argsort(triangles.ravel(), kind="stable") // 3, np.cumsum(degree) - degree
    a, b = ends.T
    edge = np.repeat(np.arange(len(ends)), degree[b])
    within = np.arange(len(edge)) - np.repeat(np.cumsum(degree[b]) - degree[b], degree[b])
    old = triangles[fans[start[b[edge]] + within]]
    other = (old != a[edge, None]).all(axis=1)
    edge, old = edge[other], old[other]
    new = np.where(old == b[edge, None], a[edge, None], old)
    turns = _turns(points[old], points[new])
    return np.asarray(np.bincount(edge, weights=turns, minlength=len(ends)) > 0)


def _flipped(points: np.ndarray, triangles: np.ndarray, border: np.ndarray) -> np.ndarray:
    """Flip edges with opposite angles of more than 180 degrees in total (Delaunay's criterion)."""
    edges, triangles = _edges(triangles), triangles.copy()
    around = _neighbours(edges, len(points))
    inside = np.flatnonzero(edges.tips[:, 1] >= 0)
    sides = points[edges.ends[inside]][:, :, None] - points[edges.tips[inside]][:, None]
    dot = (sides[:, 0] * sides[:, 1]).sum(axis=-1)
    cross = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=-1)
    angles = np.arctan2(cross, dot).sum(axis=-1)
    locked: set[int] = set()
    for which in np.argsort(-angles, kind="stable").tolist():
        if angles[which] <= np.pi + 1e-6:
            break
        at = inside[which]
        (a, b), (c, d) = edges.ends[at].tolist(), edges.tips[at].tolist()
        if (
            not locked.isdisjoint((a, b, c, d))
            or d in around[c]
            or (border[c] and border[d])
            or min(len(around[a]), len(around[b])) <= 3
        ):
            continue
        old, new = np.array([[a, b, c], [b, a, d]]), np.array([[a, d, c], [d, b, c]])
        if _turns(points[old[[0, 0, 1, 1]]], points[new[[0, 1, 0, 1]]]).any():
            continue
        triangles[edges.triangles[at]] = new
        locked |= {a, b, c, d}
    return triangles


def _turns(old: np.ndarray, new: np.ndarray) -> np.ndarray:
    """Return whether triangles (…, 3, 3) turn by much."""
    first, second = (
        np.cross(some[..., 1, :] - some[..., 0, :], some[..., 2, :] - some[..., 0, :])
        for some in (old, new)
    )
    dot = (first * second).sum(axis=-1)
    area = np.linalg.norm(first, axis=-1) * np.linalg.norm(second, axis=-1)
    return np.asarray(dot <= _BEND * area)


def _means(
    points: np.ndarray, triangles: np.ndarray, border: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    """Return weighted means of the neighbours of every vertex; of the border, in both halves."""
    total, counts = np.zeros_like(points), np.zeros(len(points))
    for k in range(3):
        for other in (triangles[:, k - 1], triangles[:, k - 2]):
            np.add.at(total, triangles[:, k], points[other] * weights[other, None])
            np.add.at(counts, triangles[:, k], weights[other])
    means = total / counts[:, None]
    means[border, 0] = 0.0
    return means


def _sharpness(
    points: np.ndarray, triangles: np.ndarray, border: np.ndarray, normals: np.ndarray
) -> np.ndarray:
    """Return the heights (N,) of vertices over their neighbours' mean, of the mean edge length."""
    heights = points - _means(points, triangles, border, np.ones(len(points)))
    lengths = np.linalg.norm(points[triangles] - points[np.roll(triangles, 1, axis=1)], axis=-1)
    around = lengths + np.roll(lengths, -1, axis=1)
    total = np.bincount(triangles.ravel(), weights=around.ravel()) / 2
    return (heights * normals).sum(axis=-1) * np.bincount(triangles.ravel()) / total


def _unit(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _smoothed(
    points: np.ndarray, triangles: np.ndarray, border: np.ndarray, union: CapsuleUnion
) -> np.ndarray:
    """Move vertices towards the mean of their neighbours along the surface, and back to it."""
    near = union.at(points)
    normals = _unit(near.slopes)
    moves = _means(points, triangles, border, 1 / np.sqrt(near.radii)) - points
    moves -= (moves * normals).sum(axis=-1, keepdims=True) * normals
    sharp = _sharpness(points, triangles, border, normals)
    moves *= _SMOOTH * np.clip(2 - 2 * sharp / _SHARP, 0.0, 1.0)[:, None]
    moved = union.projected(points + moves)
    moved[border, 0] = 0.0
    return moved
