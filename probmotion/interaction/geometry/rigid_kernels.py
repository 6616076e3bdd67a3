"""Compiled least-squares rotation of one 3D pose onto another."""

from __future__ import annotations

import numpy as np

from probmotion.extras import numba

__all__ = ["align", "residual"]

_NEWTON_STEPS = 60  # maximum number of Newton steps
_CONVERGED = 1e-15  # relative size of the last Newton step
_FLAT = 1e-6
"""Smallest slope of the characteristic polynomial relative to λ³: below it the largest eigenvalue
is nearly degenerate (collinear or mirrored poses)."""


@numba.njit(cache=True)
def align(first: np.ndarray, second: np.ndarray, rotation: np.ndarray, horn: np.ndarray) -> float:
    """Write the least-squares rotation of ``second`` onto ``first``; return Σ‖difference‖².

    The rotation is Horn's (1987) quaternion, the leading eigenvector of a traceless symmetric 4×4
    matrix. The eigenvalue λ comes from Newton's method on the characteristic polynomial, the
    eigenvector from the adjugate (Theobald 2005). The poses (J, 3) must be centred. The returned
    sum has an error of about 1e-16 of their sum of squares. ``horn`` (4, 4) is a workspace.
    """
    square = _fill(first, second, horn)
    # The characteristic polynomial is λ⁴ + c₂ λ² + c₁ λ + c₀.
    c2 = 0.0
    for i in range(4):
        for k in range(4):
            c2 -= 0.5 * horn[i, k] * horn[i, k]
    c1, c0 = _linear_coefficient(horn), _determinant(horn)
    top = 0.5 * square
    for _ in range(_NEWTON_STEPS):
        slope = (4.0 * top * top + 2.0 * c2) * top + c1
        if slope <= _FLAT * top * top * top:
            values, v = np.linalg.eigh(horn)
            _write_rotation(v[0, 3], v[1, 3], v[2, 3], v[3, 3], rotation)
            return square - 2.0 * values[3]
        step = (((top * top + c2) * top + c1) * top + c0) / slope
        top -= step
        if abs(step) <= _CONVERGED * top:
            break
    for i in range(4):
        horn[i, i] -= top
    _adjugate_rotation(horn, rotation)
    return square - 2.0 * top


@numba.njit(cache=True)
def residual(
    first: np.ndarray, second: np.ndarray, rotation: np.ndarray, differences: np.ndarray
) -> float:
    """Write ``first − rotation · second`` to ``differences`` (J, 3); return its sum of squares."""
    total = 0.0
    for j in range(first.shape[0]):
        for i in range(3):
            rotated = rotation[i, 0] * second[j, 0] + rotation[i, 1] * second[j, 1]
            difference = first[j, i] - rotated - rotation[i, 2] * second[j, 2]
            differences[j, i] = difference
            total += difference * difference
    return total


@numba.njit(cache=True)
def _fill(first: np.ndarray, second: np.ndarray, horn: np.ndarray) -> float:
    """Write Horn's matrix; return the sum of squares of both poses."""
    xx = xy = xz = yx = yy = yz = zx = zy = zz = square = 0.0
    for j in range(first.shape[0]):
        a, b, c = first[j, 0], first[j, 1], first[j, 2]
        x, y, z = second[j, 0], second[j, 1], second[j, 2]
        square += (a * a + b * b + c * c) + (x * x + y * y + z * z)
        xx, xy, xz = xx + x * a, xy + x * b, xz + x * c
        yx, yy, yz = yx + y * a, yy + y * b, yz + y * c
        zx, zy, zz = zx + z * a, zy + z * b, zz + z * c
    horn[0, 0], horn[1, 1] = xx + yy + zz, xx - yy - zz
    horn[2, 2], horn[3, 3] = yy - xx - zz, zz - xx - yy
    horn[0, 1] = horn[1, 0] = yz - zy
    horn[0, 2] = horn[2, 0] = zx - xz
    horn[0, 3] = horn[3, 0] = xy - yx
    horn[1, 2] = horn[2, 1] = xy + yx
    horn[1, 3] = horn[3, 1] = zx + xz
    horn[2, 3] = horn[3, 2] = yz + zy
    return square


@numba.njit(cache=True)
def _linear_coefficient(horn: np.ndarray) -> float:
    """Return c₁ of the characteristic polynomial, minus the sum of the principal 3×3 minors."""
    total = 0.0
    for left_out in range(4):
        i = 0 if left_out > 0 else 1
        j = 1 if left_out > 1 else 2
        k = 2 if left_out > 2 else 3
        total += horn[i, i] * (horn[j, j] * horn[k, k] - horn[j, k] * horn[j, k])
        total -= horn[i, j] * (horn[i, j] * horn[k, k] - horn[j, k] * horn[i, k])
        total += horn[i, k] * (horn[i, j] * horn[j, k] - horn[j, j] * horn[i, k])
    return -total


@numba.njit(cache=True)
def _minors(m: np.ndarray, i: int, k: int) -> tuple[float, float, float, float, float, float]:
    """Return the 2×2 minors of rows i and k and columns 01, 02, 03, 12, 13 and 23."""
    return (
        m[i, 0] * m[k, 1] - m[i, 1] * m[k, 0],
        m[i, 0] * m[k, 2] - m[i, 2] * m[k, 0],
        m[i, 0] * m[k, 3] - m[i, 3] * m[k, 0],
        m[i, 1] * m[k, 2] - m[i, 2] * m[k, 1],
        m[i, 1] * m[k, 3] - m[i, 3] * m[k, 1],
        m[i, 2] * m[k, 3] - m[i, 3] * m[k, 2],
    )


@numba.njit(cache=True)
def _determinant(m: np.ndarray) -> float:
    s01, s02, s03, s12, s13, s23 = _minors(m, 0, 1)
    c01, c02, c03, c12, c13, c23 = _minors(m, 2, 3)
    return s01 * c23 - s02 * c13 + s03 * c12 + s12 * c03 - s13 * c02 + s23 * c01


@numba.njit(cache=True)
def _adjugate_rotation(m: np.ndarray, rotation: np.ndarray) -> None:
    """Write the rotation of the quaternion q in the null space of m.

    The adjugate is a multiple of q qᵀ; its row with the largest diagonal entry is most accurate.
    """
    s01, s02, s03, s12, s13, s23 = _minors(m, 0, 1)
    _, c02, c03, c12, c13, c23 = _minors(m, 2, 3)
    a00 = m[1, 1] * c23 - m[1, 2] * c13 + m[1, 3] * c12
    a11 = m[0, 0] * c23 - m[0, 2] * c03 + m[0, 3] * c02
    a22 = m[3, 0] * s13 - m[3, 1] * s03 + m[3, 3] * s01
    a33 = m[2, 0] * s12 - m[2, 1] * s02 + m[2, 2] * s01
    a01 = m[0, 2] * c13 - m[0, 1] * c23 - m[0, 3] * c12
    a02 = m[3, 1] * s23 - m[3, 2] * s13 + m[3, 3] * s12
    a03 = m[2, 2] * s13 - m[2, 1] * s23 - m[2, 3] * s12
    a12 = m[3, 2] * s03 - m[3, 0] * s23 - m[3, 3] * s02
    a13 = m[2, 0] * s23 - m[2, 2] * s03 + m[2, 3] * s02
    a23 = m[2, 1] * s03 - m[2, 0] * s13 - m[2, 3] * s01
    largest = max(abs(a00), abs(a11), abs(a22), abs(a33))
    if abs(a00) == largest:
        _write_rotation(a00, a01, a02, a03, rotation)
    elif abs(a11) == largest:
        _write_rotation(a01, a11, a12, a13, rotation)
    elif abs(a22) == largest:
        _write_rotation(a02, a12, a22, a23, rotation)
    else:
        _write_rotation(a03, a13, a23, a33, rotation)


@numba.njit(cache=True)
def _write_rotation(w: float, x: float, y: float, z: float, rotation: np.ndarray) -> None:
    """Write the rotation matrix of a quaternion (w, x, y, z) of any length above 0."""
    scale = 2.0 / (w * w + x * x + y * y + z * z)
    rotation[0, 0] = 1.0 - scale * (y * y + z * z)
    rotation[1, 1] = 1.0 - scale * (x * x + z * z)
    rotation[2, 2] = 1.0 - scale * (x * x + y * y)
    rotation[0, 1], rotation[1, 0] = scale * (x * y - w * z), scale * (x * y + w * z)
    rotation[0, 2], rotation[2, 0] = scale * (x * z + w * y), scale * (x * z - w * y)
    rotation[1, 2], rotation[2, 1] = scale * (y * z - w * x), scale * (y * z + w * x)
