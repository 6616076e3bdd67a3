"""Compiled geometry of poses: vectors, frames, minimal rotations and cells of the sphere.

Vectors are tuples, and matrices are tuples of columns; Numba compiles both to registers.
"""

from __future__ import annotations

import numpy as np

from probmotion.extras import NO_ALLOCATION, numba

__all__ = [
    "NO_LENGTH", "Frame", "Vector", "between", "cell_of", "closeness_of", "cross", "dot",
    "from_frame", "in_frame", "least_rotation", "length_of", "line_frame", "overwrite", "product",
    "row_of", "unit",
]  # fmt: skip

Vector = tuple[float, float, float]
Frame = tuple[Vector, Vector, Vector]
NO_LENGTH = (0.0, 0.0, 0.0)  # direction of a vector of length 0
_TINY = 1e-12  # length below which a vector counts as 0


@numba.njit(**NO_ALLOCATION)
def cell_of(direction: Vector, rings: np.ndarray) -> int:
    """Return the index of the cell of a unit vector; ``rings`` are about the second axis."""
    height = min(1.0, max(-1.0, direction[1]))
    ring = min(len(rings) - 1, int(np.arccos(height) / np.pi * len(rings)))
    cells = rings[ring, 0]
    angle = np.arctan2(direction[0], direction[2]) / (2.0 * np.pi)
    index = int(np.floor(angle * cells))
    return rings[ring, 1] + index % cells


@numba.njit(**NO_ALLOCATION)
def unit(v: Vector) -> Vector:
    """Return ``v`` normalised, or ``NO_LENGTH`` if its length is 0."""
    length = length_of(v)
    if length < _TINY:
        return NO_LENGTH
    return (v[0] / length, v[1] / length, v[2] / length)


@numba.njit(**NO_ALLOCATION)
def line_frame(left: Vector, right: Vector, up: Vector) -> Frame:
    """Return the frame with left axis left − right and the up axis closest to ``up``.

    If an axis is undefined, a deterministic orthogonal direction replaces it.
    """
    x = unit((left[0] - right[0], left[1] - right[1], left[2] - right[2]))
    if x == NO_LENGTH:
        x = _any_orthogonal(up)
    along = dot(x, up)
    y = unit((up[0] - along * x[0], up[1] - along * x[1], up[2] - along * x[2]))
    if y == NO_LENGTH:
        y = _any_orthogonal(x)
    return (x, y, cross(x, y))


@numba.njit(**NO_ALLOCATION)
def in_frame(frame: Frame, direction: Vector) -> Vector:
    """Return the components of a direction in a frame."""
    return (dot(frame[0], direction), dot(frame[1], direction), dot(frame[2], direction))


@numba.njit(**NO_ALLOCATION)
def from_frame(frame: Frame, local: Vector) -> Vector:
    """Return the direction with components ``local`` in a frame."""
    x, y, z = frame
    return (
        x[0] * local[0] + y[0] * local[1] + z[0] * local[2],
        x[1] * local[0] + y[1] * local[1] + z[1] * local[2],
        x[2] * local[0] + y[2] * local[1] + z[2] * local[2],
    )


@numba.njit(**NO_ALLOCATION)
def least_rotation(a: Vector, b: Vector) -> Frame:
    """Return the rotation by the smallest angle from the unit vector ``a`` to ``b``."""
    c = dot(a, b)
    if c < -1.0 + 1e-9:
        # A half turn: the axis is arbitrary but deterministic.
        x, y, z = _any_orthogonal(a)
        return (
            (2.0 * x * x - 1.0, 2.0 * y * x, 2.0 * z * x),
            (2.0 * x * y, 2.0 * y * y - 1.0, 2.0 * z * y),
            (2.0 * x * z, 2.0 * y * z, 2.0 * z * z - 1.0),
        )
    v = cross(a, b)
    k = 1.0 / (1.0 + c)
    return (
        (c + k * v[0] * v[0], k * v[0] * v[1] + v[2], k * v[0] * v[2] - v[1]),
        (k * v[0] * v[1] - v[2], c + k * v[1] * v[1], k * v[1] * v[2] + v[0]),
        (k * v[0] * v[2] + v[1], k * v[1] * v[2] - v[0], c + k * v[2] * v[2]),
    )


@numba.njit(**NO_ALLOCATION)
def product(a: Frame, b: Frame) -> Frame:
    """Return the product of two 3 × 3 matrices."""
    return (from_frame(a, b[0]), from_frame(a, b[1]), from_frame(a, b[2]))


@numba.njit(**NO_ALLOCATION)
def overwrite(target: np.ndarray, source: np.ndarray) -> None:
    """Copy an array; the assignment of a slice would allocate a buffer."""
    for i in range(source.size):
        target.flat[i] = source.flat[i]


@numba.njit(**NO_ALLOCATION)
def row_of(rows: np.ndarray, number: int) -> Vector:
    """Return a row of an array (n, 3)."""
    return (rows[number, 0], rows[number, 1], rows[number, 2])


@numba.njit(**NO_ALLOCATION)
def between(pose: np.ndarray, start: int, end: int) -> Vector:
    """Return the vector from one joint to another."""
    return (
        pose[end, 0] - pose[start, 0],
        pose[end, 1] - pose[start, 1],
        pose[end, 2] - pose[start, 2],
    )


@numba.njit(**NO_ALLOCATION)
def length_of(v: Vector) -> float:
    """Return the length of a vector."""
    return np.sqrt(dot(v, v))


@numba.njit(**NO_ALLOCATION)
def dot(a: Vector, b: Vector) -> float:
    """Return the inner product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@numba.njit(**NO_ALLOCATION)
def cross(a: Vector, b: Vector) -> Vector:
    """Return the cross product of two vectors."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@numba.njit(**NO_ALLOCATION)
def _any_orthogonal(v: Vector) -> Vector:
    """Return a deterministic unit vector orthogonal to ``v``."""
    x, y, z = abs(v[0]), abs(v[1]), abs(v[2])
    if x <= y and x <= z:
        return unit((1.0 - v[0] * v[0], -v[0] * v[1], -v[0] * v[2]))
    if y <= z:
        return unit((-v[1] * v[0], 1.0 - v[1] * v[1], -v[1] * v[2]))
    return unit((-v[2] * v[0], -v[2] * v[1], 1.0 - v[2] * v[2]))


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
    """Return the cosine between each cell's centre and the nearest sample, (bins, cells).

    A bin uses the samples with a parent direction in the bin or at a cosine of at least
    ``bin_reach`` to its centre. A cell that contains a sample has the value 1; cells of a bin
    without samples have the value -2. Compiled sums have a fixed order and are reproducible.
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
