"""Weighted least-squares triangulation of joints from V views.

Each joint of each frame is an independent least-squares problem with 3 unknowns and 2 V equations.
A camera projects the point X to (u, v) = (a/c, b/c), where a, b, c are the rows of its projection
matrix times (X, 1). With a', b', c' the first three entries of the rows, (u, v) has the Jacobian

    J = [a' − u c', b' − v c'] / c,
    JᵀJ = (a'a'ᵀ + b'b'ᵀ − u (a'c'ᵀ + c'a'ᵀ) − v (b'c'ᵀ + c'b'ᵀ) + (u² + v²) c'c'ᵀ) / c²,

so the normal equations of all points are products of fixed camera matrices with a few values per
view and point. Orthographic cameras are the case c' = 0, c = 1.
"""

from __future__ import annotations

import warnings
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from probmotion.arrays import Array, array_namespace, constant, to_numpy
from probmotion.geometry.cameras import Cameras
from probmotion.validation import check_count, check_finite, check_shape

__all__ = ["triangulate"]

_WARN_CONDITION = 1e3
"""Condition number of the normal equations above which to warn (two views 3.6° apart)."""

_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Stored entries of a symmetric 3×3 matrix."""


def triangulate(
    keypoints: Array,
    cameras: Cameras,
    weights: Array | None = None,
    initial: Array | None = None,
    iterations: int = 2,
) -> Array:
    """Return argmin_X Σ_v w_v ‖p(X, v) − x_v‖² for every frame and joint (*MAS*, section 4.2).

    p(X, v) is the image of X in view v. Orthographic cameras have a closed-form solution. For
    perspective cameras, ``iterations`` steps of simplified Gauss-Newton use exact residuals and
    gradients, but the normal matrix of the first linearisation.

    Parameters
    ----------
    keypoints : Array, (…, V, L, J, 2)
        Image points x_v, image units; NumPy, torch or JAX.
    cameras : Cameras
        The V views.
    weights : Array, (V,), (…, V) or (…, V, L, J), optional
        Weights w_v, 1 by default. Keypoints of weight 0 are ignored and may be NaN.
    initial : Array, (…, L, J, 3), optional
        Initial points for perspective cameras, metres; the linear ray intersection by default.
    iterations : int
        Gauss-Newton steps for perspective cameras.

    Returns
    -------
    Array, (…, L, J, 3)
        Points in metres.

    Warns
    -----
    UserWarning
        If the views are nearly parallel (condition number of the normal equations above 1000).

    Raises
    ------
    ValueError
        If there are fewer than two views, shapes disagree, a keypoint is not finite, the views do
        not determine a point, or a point is behind a perspective camera. Conditions on values
        are not checked under JAX tracing.
    """
    V = cameras.n_views
    if V < 2:
        raise ValueError(f"cameras must contain at least two views, got {V}")
    check_shape("keypoints", keypoints, ("…", V, "L", "J", 2))
    check_count("iterations", iterations)
    xp = array_namespace(keypoints)
    *batch, _, L, J, _ = keypoints.shape
    shape = (*batch, L, J)
    if initial is not None:
        check_shape("initial", initial, (*shape, 3))
    if 0 in shape:
        return constant(np.zeros((*shape, 3)), keypoints)
    seen = _views_first(keypoints)
    weight = None
    if weights is not None:
        weights = _full_weights(weights, keypoints)
        weight = _views_first(weights[..., None])[0, ...]
        seen = xp.where(weight > 0, seen, xp.zeros_like(seen))
    equations = _equations(cameras, keypoints)
    # Singular equations divide by 0 here and are reported below.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        if cameras.orthographic or initial is None:
            normal, pull = _on_rays(xp, equations, seen, weight)
            factors = _factor(normal)
            points = xp.stack(_solve(factors, pull))
        else:
            points = xp.permute_dims(xp.reshape(initial, (-1, 3)), (1, 0))
        inverse_depth = None
        for iteration in range(0 if cameras.orthographic else iterations):
            image = equations.projection[:, :3] @ points + equations.projection[:, 3:]
            inverse_depth = 1 / image[2 * V :, :]
            image = xp.reshape(image[: 2 * V, :], seen.shape) * inverse_depth
            if iteration == 0:
                normal = _normal(xp, equations, inverse_depth, image, weight)
                factors = _factor(normal)
            pull = _pull(xp, equations, (seen - image) * inverse_depth, image, weight)
            points = points + xp.stack(_solve(factors, pull))
        if not type(points).__name__.endswith("Tracer"):
            _check_solution(xp, keypoints, weights, shape, points, normal, factors, inverse_depth)
    return xp.reshape(xp.permute_dims(points, (1, 0)), (*shape, 3))


class _Equations(NamedTuple):
    """Matrices of the normal equations that depend only on the V cameras."""

    projection: Array  # (3 V, 4): rows a, then b, then c
    square: Array  # (6, V): a'a'ᵀ + b'b'ᵀ
    cross: Array  # (6, 2 V): −(a'c'ᵀ + c'a'ᵀ), then the same with b'
    depth: Array  # (6, V): c'c'ᵀ
    pull: Array  # (3, 2 V): a', then b'
    pull_depth: Array  # (3, V): −c'


def _equations(cameras: Cameras, like: Array) -> _Equations:
    return _Equations(*(constant(matrix, like) for matrix in _numpy_equations(cameras)))


@lru_cache(maxsize=8)
def _numpy_equations(cameras: Cameras) -> _Equations:
    assert cameras.centre is not None
    metric = np.concatenate([cameras.rotation, cameras.translation[:, :, None]], axis=2)
    c = np.tile([0.0, 0.0, 0.0, 1.0], (len(metric), 1)) if cameras.orthographic else metric[:, 2]
    a, b = (
        cameras.focal[:, None] * metric[:, axis] + cameras.centre[:, axis, None] * c
        for axis in (0, 1)
    )

    def products(p: np.ndarray, q: np.ndarray) -> np.ndarray:
        return np.stack([(p[:, i] * q[:, j] + p[:, j] * q[:, i]) / 2 for i, j in _PAIRS])

    a_, b_, c_ = a[:, :3], b[:, :3], c[:, :3]
    return _Equations(
        projection=np.concatenate([a, b, c]),
        square=products(a_, a_) + products(b_, b_),
        cross=np.concatenate([-2 * products(a_, c_), -2 * products(b_, c_)], axis=1),
        depth=products(c_, c_),
        pull=np.ascontiguousarray(np.concatenate([a_, b_]).T),
        pull_depth=np.ascontiguousarray(-c_.T),
    )


def _normal(
    xp: Any, equations: _Equations, inverse_depth: Array, image: Array, weight: Array | None
) -> Array:
    """Return Σ_v w JᵀJ at the image points (2, V, N): (6, N)."""
    scale = inverse_depth * inverse_depth
    if weight is not None:
        scale = scale * weight
    first = scale * image
    second = first * image
    total = equations.square @ scale + equations.cross @ xp.reshape(first, (-1, image.shape[2]))
    return total + equations.depth @ (second[0, ...] + second[1, ...])


def _pull(
    xp: Any, equations: _Equations, residual: Array, image: Array, weight: Array | None
) -> Array:
    """Return Σ_v w Jᵀ residual with J c = [a' − u c', b' − v c'] at ``image``, (3, N)."""
    if weight is not None:
        residual = residual * weight
    along = residual * image
    across = equations.pull @ xp.reshape(residual, (-1, image.shape[2]))
    return across + equations.pull_depth @ (along[0, ...] + along[1, ...])


def _on_rays(
    xp: Any, equations: _Equations, seen: Array, weight: Array | None
) -> tuple[Array, Array]:
    """Return the normal equations of the rays (a' − u c')·X = u c₄ − a₄, and likewise for v.

    For c' = 0 these equations are exact.
    """
    V = seen.shape[1]
    origin = equations.projection[:, 3:]
    residual = seen * origin[2 * V :, :] - xp.reshape(origin[: 2 * V, :], (2, V, 1))
    pull = _pull(xp, equations, residual, seen, weight)
    return _normal(xp, equations, xp.ones_like(seen[0, ...]), seen, weight), pull


def _factor(normal: Array) -> tuple[Array, ...]:
    """Return the L D Lᵀ factors of symmetric matrices (6, N): 1/D, then L, (N,) each."""
    a, b, c, d, e, f = (normal[i, ...] for i in range(6))
    inverse_1 = 1 / a
    l21, l31 = b * inverse_1, c * inverse_1
    inverse_2 = 1 / (d - l21 * b)
    rest = e - l21 * c
    l32 = rest * inverse_2
    return inverse_1, inverse_2, 1 / (f - l31 * c - l32 * rest), l21, l31, l32


def _solve(factors: tuple[Array, ...], right: Array) -> tuple[Array, Array, Array]:
    """Return the solutions x, y, z of the factored equations, (N,) each."""
    inverse_1, inverse_2, inverse_3, l21, l31, l32 = factors
    p, q, s = right[0, :], right[1, :], right[2, :]
    q = q - l21 * p
    z = (s - l31 * p - l32 * q) * inverse_3
    y = q * inverse_2 - l32 * z
    return p * inverse_1 - l21 * y - l31 * z, y, z


def _views_first(values: Array) -> Array:
    """Move the views to the front and flatten the points: ``(…, V, L, J, C) → (C, V, N)``."""
    xp = array_namespace(values)
    V, L, J, C = values.shape[-4:]
    moved = xp.permute_dims(xp.reshape(values, (-1, V, L * J, C)), (3, 1, 0, 2))
    return xp.reshape(moved, (C, V, -1))


def _full_weights(weights: Array, keypoints: Array) -> Array:
    """Return weights of shape (…, V, L, J)."""
    xp = array_namespace(keypoints)
    weights = weights if hasattr(weights, "shape") else np.asarray(weights)
    if isinstance(weights, np.ndarray) and not isinstance(keypoints, np.ndarray):
        weights = constant(weights, keypoints)
    full = tuple(keypoints.shape[:-1])
    if tuple(weights.shape) in (full[:-2], full[-3:-2]):
        weights = weights[..., None, None]
    else:
        check_shape("weights", weights, full)
    return xp.broadcast_to(weights, full)


def _check_solution(
    xp: Any,
    keypoints: Array,
    weights: Array | None,
    shape: tuple[int, ...],
    points: Array,
    normal: Array,
    factors: tuple[Array, ...],
    inverse_depth: Array | None,
) -> None:
    """Warn about ill-conditioned views; raise if there is no solution."""
    if weights is None and not np.isfinite(_number(xp.sum(points))):
        check_finite("keypoints", keypoints)
    if weights is not None and not _number(xp.min(weights)) >= 0:
        raise ValueError(f"weights must be 0 or more, got {_number(xp.min(weights)):g}")
    # trace³/determinant is a cheap upper bound of the condition number.
    trace = normal[0, ...] + normal[3, ...] + normal[5, ...]
    bound = trace * trace * trace * (factors[0] * factors[1] * factors[2])
    if not (_number(xp.max(bound)) < _WARN_CONDITION and _number(xp.min(bound)) > 0):
        _report_condition(to_numpy(normal), shape)
    if inverse_depth is not None and not _number(xp.min(inverse_depth)) > 0:
        view, point = np.argwhere(~(to_numpy(inverse_depth) > 0))[0]
        *_, frame, joint = np.unravel_index(point, shape)
        raise ValueError(
            f"keypoints must lie in front of every camera, got joint {joint} of frame {frame} "
            f"behind camera {view}; check the cameras or pass initial"
        )


def _number(value: Array) -> float:
    return float(to_numpy(value))


def _report_condition(normal: np.ndarray, shape: tuple[int, ...]) -> None:
    matrices = np.empty((normal.shape[1], 3, 3))
    for entry, (i, j) in zip(normal, _PAIRS, strict=True):
        matrices[:, i, j] = matrices[:, j, i] = entry
    values = np.linalg.eigvalsh(np.nan_to_num(matrices))
    with np.errstate(divide="ignore", invalid="ignore"):
        condition = np.where(values[:, 0] > 0, values[:, 2] / values[:, 0], np.inf)
    worst = int(condition.argmax())
    *_, frame, joint = (int(i) for i in np.unravel_index(worst, shape))
    if not condition[worst] < 0.01 / np.finfo(normal.dtype).eps:
        raise ValueError(
            f"keypoints of joint {joint} in frame {frame} do not determine a point (condition "
            f"number {condition[worst]:.2g}); at least two non-parallel views are required"
        )
    if condition[worst] > _WARN_CONDITION:
        warnings.warn(
            f"the views are nearly parallel (condition number {condition[worst]:.3g} at joint "
            f"{joint} of frame {frame}), so depths are uncertain",
            stacklevel=3,
        )
