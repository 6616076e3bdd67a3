"""Conversions between rotation vectors, matrices, quaternions, 6D vectors and Euler angles.

All functions accept NumPy, torch and JAX arrays of any batch shape, work under ``jax.jit`` and have
finite gradients at the identity and at half turns. Rotations are active: ``R @ x`` rotates x.
Quaternions are (w, x, y, z); angles are in radians.
"""

from __future__ import annotations

import numpy as np

from probmotion.arrays import Array, array_namespace, constant
from probmotion.validation import check_shape

__all__ = [
    "euler_to_matrix", "geodesic_angle", "matrix_to_euler", "matrix_to_quaternion",
    "matrix_to_rotation_6d", "matrix_to_vector", "quaternion_product", "quaternion_to_matrix",
    "quaternion_to_vector", "rotation_6d_to_matrix", "slerp", "vector_to_matrix",
    "vector_to_quaternion",
]  # fmt: skip

# Squared angle below which Taylor series are exact in float64; omitted terms are below 1e-18.
_SMALL = 1e-6


def vector_to_matrix(vector: Array) -> Array:
    """Return the matrix of a rotation vector (axis times angle): ``(…, 3) → (…, 3, 3)``.

    Rodrigues' formula, ``R = I + sin θ/θ K + (1 − cos θ)/θ² K²``, θ = ‖vector‖, K x = vector × x.
    """
    check_shape("vector", vector, ("…", 3))
    xp = array_namespace(vector)
    square = xp.sum(vector**2, axis=-1)[..., None, None]
    small = square < _SMALL
    angle = _safe_sqrt(square, small)
    first = xp.where(small, 1 - square / 6 + square**2 / 120, xp.sin(angle) / angle)
    # (1 − cos θ)/θ² from the sine of the half angle, without cancellation at small angles.
    half = xp.where(small, 1 - square / 24 + square**2 / 1920, 2 * xp.sin(angle / 2) / angle)
    cross = _cross_matrix(vector)
    return constant(np.eye(3), vector) + first * cross + half**2 / 2 * xp.matmul(cross, cross)


def matrix_to_vector(matrix: Array) -> Array:
    """Return the rotation vector of a matrix: ``(…, 3, 3) → (…, 3)``, of length at most π."""
    return quaternion_to_vector(matrix_to_quaternion(matrix))


def vector_to_quaternion(vector: Array) -> Array:
    """Return the unit quaternion of a rotation vector: ``(…, 3) → (…, 4)``."""
    check_shape("vector", vector, ("…", 3))
    xp = array_namespace(vector)
    square = xp.sum(vector**2, axis=-1, keepdims=True)
    small = square < _SMALL
    angle = _safe_sqrt(square, small)
    real = xp.where(small, 1 - square / 8 + square**2 / 384, xp.cos(angle / 2))
    ratio = xp.where(small, 0.5 - square / 48 + square**2 / 3840, xp.sin(angle / 2) / angle)
    return xp.concat([real, ratio * vector], axis=-1)


def quaternion_to_vector(quaternion: Array) -> Array:
    """Return the rotation vector of a quaternion: ``(…, 4) → (…, 3)``, of length at most π.

    The quaternion need not be normalised.
    """
    quaternion = _nonnegative_real(_unit(quaternion))
    xp = array_namespace(quaternion)
    real, imaginary = quaternion[..., :1], quaternion[..., 1:]
    square = xp.sum(imaginary**2, axis=-1, keepdims=True)
    small = square < _SMALL
    sine = _safe_sqrt(square, small)
    # 2 atan(s/w)/s; the series in s/w is used only for w close to 1.
    cosine = xp.where(small, real, xp.ones_like(real))
    tangent = square / cosine**2
    series = 2 * (1 - tangent / 3 + tangent**2 / 5) / cosine
    return xp.where(small, series, 2 * xp.atan2(sine, real) / sine) * imaginary


def quaternion_to_matrix(quaternion: Array) -> Array:
    """Return the matrix of a quaternion of any nonzero length: ``(…, 4) → (…, 3, 3)``."""
    quaternion = _unit(quaternion)
    xp = array_namespace(quaternion)
    real = quaternion[..., :1, None]
    cross = _cross_matrix(quaternion[..., 1:])
    # R = I + 2 w K + 2 K², where K x is the cross product of the imaginary part and x.
    return constant(np.eye(3), quaternion) + 2 * real * cross + 2 * xp.matmul(cross, cross)


def matrix_to_quaternion(matrix: Array) -> Array:
    """Return the unit quaternion of a matrix, w at least 0: ``(…, 3, 3) → (…, 4)``.

    The matrix 4 q qᵀ is linear in R. Its row with the largest diagonal entry is q times a factor of
    magnitude 2 or more.
    """
    check_shape("matrix", matrix, ("…", 3, 3))
    xp = array_namespace(matrix)
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (
        [matrix[..., row, column] for column in range(3)] for row in range(3)
    )
    entries = [
        [1 + xx + yy + zz, zy - yz, xz - zx, yx - xy],
        [zy - yz, 1 + xx - yy - zz, xy + yx, xz + zx],
        [xz - zx, xy + yx, 1 - xx + yy - zz, yz + zy],
        [yx - xy, xz + zx, yz + zy, 1 - xx - yy + zz],
    ]
    products = xp.stack([xp.stack(row, axis=-1) for row in entries], axis=-2)
    diagonal = xp.stack([entries[index][index] for index in range(4)], axis=-1)
    largest = xp.astype(xp.argmax(diagonal, axis=-1), matrix.dtype)
    chosen = largest[..., None] == constant(np.arange(4), matrix)
    row = xp.sum(xp.where(chosen[..., None], products, xp.zeros_like(products)), axis=-2)
    return _nonnegative_real(_unit(row))


def quaternion_product(first: Array, second: Array) -> Array:
    """Return the Hamilton product (``second`` acts first): ``(…, 4), (…, 4) → (…, 4)``."""
    check_shape("first", first, ("…", 4))
    check_shape("second", second, ("…", 4))
    xp = array_namespace(first, second)
    a, b, c, d = (first[..., index] for index in range(4))
    w, x, y, z = (second[..., index] for index in range(4))
    return xp.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ],
        axis=-1,
    )


def rotation_6d_to_matrix(numbers: Array) -> Array:
    """Return the rotation matrix of a 6D vector by Gram-Schmidt: ``(…, 6) → (…, 3, 3)``.

    Entries 0:3 and 3:6 determine the first two columns and must not be parallel (Zhou et al. 2019,
    "On the continuity of rotation representations in neural networks", eq. 15).
    """
    check_shape("numbers", numbers, ("…", 6))
    xp = array_namespace(numbers)
    first = _unit(numbers[..., :3])
    second = numbers[..., 3:]
    second = _unit(second - xp.sum(first * second, axis=-1, keepdims=True) * first)
    third = xp.linalg.cross(first, second)
    return xp.stack([first, second, third], axis=-1)


def matrix_to_rotation_6d(matrix: Array) -> Array:
    """Return the first two columns of a matrix, concatenated: ``(…, 3, 3) → (…, 6)``."""
    check_shape("matrix", matrix, ("…", 3, 3))
    xp = array_namespace(matrix)
    return xp.concat([matrix[..., :, 0], matrix[..., :, 1]], axis=-1)


def euler_to_matrix(angles: Array, order: str) -> Array:
    """Return the matrix of intrinsic Euler angles: ``(…, 3) → (…, 3, 3)``.

    Parameters
    ----------
    angles : Array, (…, 3)
        Angles about the axes of ``order``, radians.
    order : str
        Three of ``X``, ``Y``, ``Z`` without adjacent repeats: ``"ZXY"`` is ``R_z R_x R_y``, the
        BVH channels ``Zrotation Xrotation Yrotation``.

    Raises
    ------
    ValueError
        If ``order`` is invalid.
    """
    check_shape("angles", angles, ("…", 3))
    axes = _axes(order)
    xp = array_namespace(angles)
    turns = [_turn(angles[..., index], axis) for index, axis in enumerate(axes)]
    return xp.matmul(xp.matmul(turns[0], turns[1]), turns[2])


def matrix_to_euler(matrix: Array, order: str) -> Array:
    """Return the intrinsic Euler angles of a matrix: ``(…, 3, 3) → (…, 3)``.

    The middle angle is in [−π/2, π/2], or in [0, π] if the first and last axes are equal. At gimbal
    lock the first angle is 0.

    Parameters
    ----------
    matrix : Array, (…, 3, 3)
        Rotation matrices.
    order : str
        Order of the axes, as in :func:`euler_to_matrix`.
    """
    check_shape("matrix", matrix, ("…", 3, 3))
    i, j, last = _axes(order)
    k = 3 - i - j
    parity = 1.0 if (j - i) % 3 == 1 else -1.0
    xp = array_namespace(matrix)
    if last == i:
        sine, cosine = matrix[..., j, i], -parity * matrix[..., k, i]
    else:
        sine, cosine = -parity * matrix[..., j, k], matrix[..., k, k]
    square = sine**2 + cosine**2
    locked = square < float(xp.finfo(matrix.dtype).eps) ** 2
    radius = xp.where(locked, xp.zeros_like(square), _safe_sqrt(square, locked))
    zero, one = xp.zeros_like(sine), xp.ones_like(cosine)
    first = xp.atan2(xp.where(locked, zero, sine), xp.where(locked, one, cosine))
    # After undoing the first turn, this row depends on the last angle only. It has length 1 even
    # if the first angle is ill-conditioned.
    row = xp.cos(first)[..., None] * matrix[..., j, :]
    row = row + parity * xp.sin(first)[..., None] * matrix[..., k, :]
    if last == i:
        middle = xp.atan2(radius, matrix[..., i, i])
        third = xp.atan2(-parity * row[..., k], row[..., j])
    else:
        middle = xp.atan2(parity * matrix[..., i, k], radius)
        third = xp.atan2(parity * row[..., i], row[..., j])
    return xp.stack([first, middle, third], axis=-1)


def geodesic_angle(first: Array, second: Array) -> Array:
    """Return the angle between rotation matrices, in [0, π]: ``(…, 3, 3), (…, 3, 3) → (…)``.

    The gradient at equal rotations is 0.
    """
    xp = array_namespace(first, second)
    quaternion = matrix_to_quaternion(xp.matmul(xp.matrix_transpose(first), second))
    square = xp.sum(quaternion[..., 1:] ** 2, axis=-1)
    none = square == 0
    sine = xp.where(none, xp.zeros_like(square), _safe_sqrt(square, none))
    return 2 * xp.atan2(sine, quaternion[..., 0])


def slerp(first: Array, second: Array, fraction: Array) -> Array:
    """Return rotations between ``first`` and ``second`` at constant angular velocity.

    Parameters
    ----------
    first, second : Array, (…, 3, 3)
        Rotation matrices.
    fraction : Array, (…)
        Interpolation weight: 0 at ``first``, 1 at ``second``; broadcast against the batch axes.

    Returns
    -------
    Array, (…, 3, 3)
        Rotations along the shorter arc.
    """
    xp = array_namespace(first, second)
    step = matrix_to_vector(xp.matmul(xp.matrix_transpose(first), second))
    return xp.matmul(first, vector_to_matrix(fraction[..., None] * step))


def _axes(order: str) -> tuple[int, int, int]:
    axes = tuple("XYZ".find(letter) for letter in order.upper())
    if len(axes) != 3 or -1 in axes or axes[0] == axes[1] or axes[1] == axes[2]:
        raise ValueError(
            "order must be three of X, Y and Z without adjacent repeats, such as 'ZXY', got "
            f"{order!r}"
        )
    return axes[0], axes[1], axes[2]


def _turn(angle: Array, axis: int) -> Array:
    """Return the rotation matrices about one axis: ``(…) → (…, 3, 3)``."""
    xp = array_namespace(angle)
    fixed, cosine, sine = np.zeros((3, 3, 3))
    j, k = (axis + 1) % 3, (axis + 2) % 3
    fixed[axis, axis] = 1
    cosine[j, j] = cosine[k, k] = 1
    sine[j, k], sine[k, j] = -1, 1
    rotation = xp.cos(angle)[..., None, None] * constant(cosine, angle)
    rotation = constant(fixed, angle) + rotation
    return rotation + xp.sin(angle)[..., None, None] * constant(sine, angle)


def _cross_matrix(vector: Array) -> Array:
    """Return K with ``K @ x = vector × x``: ``(…, 3) → (…, 3, 3)``."""
    xp = array_namespace(vector)
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    zero = xp.zeros_like(x)
    entries = xp.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1)
    return xp.reshape(entries, (*x.shape, 3, 3))


def _safe_sqrt(square: Array, excluded: Array) -> Array:
    """Return √square, 1 where ``excluded``, so that gradients stay finite at 0."""
    xp = array_namespace(square)
    return xp.sqrt(xp.where(excluded, xp.ones_like(square), square))


def _unit(vector: Array) -> Array:
    xp = array_namespace(vector)
    return vector / xp.sqrt(xp.sum(vector**2, axis=-1, keepdims=True))


def _nonnegative_real(quaternion: Array) -> Array:
    """Return q or −q, whichever has w at least 0."""
    xp = array_namespace(quaternion)
    return xp.where(quaternion[..., :1] < 0, -quaternion, quaternion)
