"""Compiled geometry of three numbers: frames from lines, least rotations, cells on a sphere.

Every function writes into an array that it is given: kernels call them by the million.
"""

from __future__ import annotations

import numba
import numpy as np

__all__ = [
    "cell_of",
    "closeness_of",
    "from_frame",
    "in_frame",
    "least_rotation",
    "line_frame",
    "normalise",
    "product",
]

_TINY = 1e-12


@numba.njit(cache=True)
def cell_of(direction: np.ndarray, rings: np.ndarray) -> int:
    """Return the cell of a unit vector on a sphere cut into rings about the second axis."""
    height = min(1.0, max(-1.0, direction[1]))
    ring = min(len(rings) - 1, int(np.arccos(height) / np.pi * len(rings)))
    cells = rings[ring, 0]
    turn = np.arctan2(direction[0], direction[2]) / (2.0 * np.pi)
    place = int(np.floor(turn * cells))
    return rings[ring, 1] + place % cells


@numba.njit(cache=True)
def normalise(v: np.ndarray) -> bool:
    """Scale ``v`` to length 1; return False, and leave it, where it has no length."""
    length = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    if length < _TINY:
        return False
    for i in range(3):
        v[i] /= length
    return True


@numba.njit(cache=True)
def line_frame(left: np.ndarray, right: np.ndarray, up: np.ndarray, frame: np.ndarray) -> None:
    """Write the frame whose left axis is left − right and whose up axis is nearest ``up``.

    Where the two lines have no direction or the same one, a fixed direction stands in: the bones
    are then far from any that was seen, and are found invalid.
    """
    x, y = np.empty(3), np.empty(3)
    for i in range(3):
        x[i] = left[i] - right[i]
    if not normalise(x):
        x[:] = 0.0
        x[np.argmin(np.abs(up))] = 1.0
        along = x[0] * up[0] + x[1] * up[1] + x[2] * up[2]
        for i in range(3):
            x[i] -= along * up[i]
        normalise(x)
    along = x[0] * up[0] + x[1] * up[1] + x[2] * up[2]
    for i in range(3):
        y[i] = up[i] - along * x[i]
    if not normalise(y):
        y[:] = 0.0
        axis = np.argmin(np.abs(x))
        y[axis] = 1.0
        for i in range(3):
            y[i] -= x[axis] * x[i]
        normalise(y)
    frame[:, 0] = x
    frame[:, 1] = y
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        frame[i, 2] = x[j] * y[k] - x[k] * y[j]


@numba.njit(cache=True)
def in_frame(frame: np.ndarray, direction: np.ndarray, out: np.ndarray) -> None:
    """Write a direction's components along the axes of a frame, which are its columns."""
    for i in range(3):
        out[i] = (
            frame[0, i] * direction[0] + frame[1, i] * direction[1] + frame[2, i] * direction[2]
        )


@numba.njit(cache=True)
def from_frame(frame: np.ndarray, local: np.ndarray, out: np.ndarray) -> None:
    """Write the direction that has the components ``local`` in a frame."""
    for i in range(3):
        out[i] = frame[i, 0] * local[0] + frame[i, 1] * local[1] + frame[i, 2] * local[2]


@numba.njit(cache=True)
def least_rotation(a: np.ndarray, b: np.ndarray, out: np.ndarray) -> None:
    """Write the rotation by the least angle that takes the unit vector ``a`` to ``b``."""
    c = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    if c < -1.0 + 1e-9:
        # Half a turn about any axis across: the axis is fixed, so that the result is too.
        axis = np.zeros(3)
        least = np.argmin(np.abs(a))
        axis[least] = 1.0
        for i in range(3):
            axis[i] -= a[least] * a[i]
        normalise(axis)
        for i in range(3):
            for j in range(3):
                out[i, j] = 2.0 * axis[i] * axis[j] - (1.0 if i == j else 0.0)
        return
    v0, v1, v2 = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    k = 1.0 / (1.0 + c)
    out[0, 0], out[0, 1], out[0, 2] = c + k * v0 * v0, k * v0 * v1 - v2, k * v0 * v2 + v1
    out[1, 0], out[1, 1], out[1, 2] = k * v0 * v1 + v2, c + k * v1 * v1, k * v1 * v2 - v0
    out[2, 0], out[2, 1], out[2, 2] = k * v0 * v2 - v1, k * v1 * v2 + v0, c + k * v2 * v2


@numba.njit(cache=True)
def product(a: np.ndarray, b: np.ndarray, out: np.ndarray) -> None:
    """Write the product of two 3 × 3 matrices."""
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@numba.njit(cache=True)
def closeness_of(
    parents: np.ndarray,
    directions: np.ndarray,
    bin_rings: np.ndarray,
    bins: np.ndarray,
    cell_rings: np.ndarray,
    centres: np.ndarray,
    bin_reach: float,
) -> np.ndarray:
    """Return the cosine of each cell's centre to the nearest direction seen, (bins, cells).

    A row counts the directions whose parent is in the bin, or at a cosine of ``bin_reach`` or more
    to its centre. A cell into which a direction fell has 1, and one without any has -2. It is
    compiled not for speed alone: sums are taken in one order on every machine.
    """
    closeness = np.full((len(bins), len(centres)), -2.0)
    for sample in range(len(parents)):
        p, u = parents[sample], directions[sample]
        own_bin, own_cell = cell_of(p, bin_rings), cell_of(u, cell_rings)
        for row in range(len(bins)):
            c = p[0] * bins[row, 0] + p[1] * bins[row, 1] + p[2] * bins[row, 2]
            if row != own_bin and c < bin_reach:
                continue
            for cell in range(len(centres)):
                c = u[0] * centres[cell, 0] + u[1] * centres[cell, 1] + u[2] * centres[cell, 2]
                closeness[row, cell] = max(closeness[row, cell], c)
            closeness[row, own_cell] = 1.0
    return closeness
