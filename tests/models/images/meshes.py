"""Meshes of tests."""

from __future__ import annotations

import numpy as np

__all__ = ["icosphere"]


def icosphere(divisions: int) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (V, 3) on the unit sphere and triangles counterclockwise from outside."""
    golden = (1 + 5**0.5) / 2
    corners = [(0.0, s, t * golden) for s in (-1, 1) for t in (-1, 1)]
    points = np.array([np.roll(corner, k) for k in range(3) for corner in corners])
    near = ((points[:, None] - points) ** 2).sum(axis=-1) < 4.1
    triangles = np.array(
        [
            (a, b, c)
            for a in range(12)
            for b in range(a)
            for c in range(b)
            if near[a, b] and near[b, c] and near[a, c]
        ]
    )
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    inward = (np.cross(b - a, c - a) * a).sum(axis=1) < 0
    triangles[inward] = triangles[inward][:, ::-1]
    for _ in range(divisions):
        edges = np.sort(
            np.concatenate([triangles, np.roll(triangles, -1, axis=1)], axis=1)
            .reshape(-1, 2, 3)
            .swapaxes(1, 2),
            axis=2,
        )
        unique, index = np.unique(edges.reshape(-1, 2), axis=0, return_inverse=True)
        middle = len(points) + index.reshape(-1, 3)
        points = np.concatenate([points, points[unique].mean(axis=1)])
        (a, b, c), (x, y, z) = triangles.T, middle.T
        parts = [(a, x, z), (x, b, y), (z, y, c), (x, y, z)]
        triangles = np.concatenate([np.stack(part, axis=1) for part in parts])
    return points / np.linalg.norm(points, axis=1, keepdims=True), triangles
