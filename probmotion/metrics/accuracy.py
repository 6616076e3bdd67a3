"""Position and acceleration errors of motions relative to the true motion."""

from __future__ import annotations

from probmotion.arrays import Array, array_namespace, constant
from probmotion.validation import check_positive, check_shape

__all__ = [
    "acceleration_error",
    "acceleration_ratio",
    "aligned_by_root",
    "aligned_by_similarity",
    "joint_errors",
    "mean_over",
]


def joint_errors(motions: Array, truth: Array) -> Array:
    """Return the error of each joint in each frame, ``(…, L, J, 3), (L, J, 3) → (…, L, J)``.

    The mean of these distances is the global MPJPE (G-MPJPE) without alignment, the MPJPE after
    :func:`aligned_by_root`, and the PA-MPJPE after :func:`aligned_by_similarity`.
    """
    xp = array_namespace(motions, truth)
    check_shape("motions", motions, ("…", *truth.shape))
    return xp.sqrt(xp.sum((motions - truth) ** 2, axis=-1))


def mean_over(errors: Array, mask: Array | None = None) -> Array:
    """Return the mean error of each motion, ``(…, L, J) → (…)``.

    Entries outside ``mask``, (L, J) bool, are ignored; an empty mask raises ``ValueError``.
    """
    xp = array_namespace(errors)
    if mask is None:
        return xp.mean(errors, axis=(-2, -1))
    check_shape("mask", mask, tuple(errors.shape[-2:]))
    weights = constant(mask, errors)
    total = float(xp.sum(weights))
    if total == 0:
        raise ValueError("mask must select at least one joint in a frame, got none")
    return xp.sum(errors * weights, axis=(-2, -1)) / total


def aligned_by_root(motions: Array, root: int = 0) -> Array:
    """Return the motions with joint ``root`` at the origin in every frame, ``(…, L, J, 3)``."""
    return motions - motions[..., root : root + 1, :]


def aligned_by_similarity(motions: Array, truth: Array) -> Array:
    """Align each frame to the truth by a similarity without reflection (Umeyama 1991).

    ``(…, L, J, 3), (L, J, 3) → (…, L, J, 3)``. Frames with coincident joints are only translated.
    """
    xp = array_namespace(motions, truth)
    check_shape("motions", motions, ("…", *truth.shape))
    centre = xp.mean(motions, axis=-2, keepdims=True)
    target = xp.mean(truth, axis=-2, keepdims=True)
    x, y = motions - centre, truth - target
    left, size, right = xp.linalg.svd(xp.matmul(xp.matrix_transpose(x), y), full_matrices=False)
    # x R ≈ y with R = U diag(1, 1, s) Vᵀ, s = det(U Vᵀ) so that R is a rotation.
    sign = xp.linalg.det(xp.matmul(left, right))
    ones = xp.ones_like(sign)
    signs = xp.stack([ones, ones, sign], axis=-1)
    rotation = xp.matmul(left * signs[..., None, :], right)
    square = xp.sum(x**2, axis=(-2, -1))
    scale = xp.sum(size * signs, axis=-1) / xp.where(square == 0, ones, square)
    return scale[..., None, None] * xp.matmul(x, rotation) + target


def acceleration_error(motions: Array, truth: Array, fps: float) -> Array:
    """Return the mean acceleration error, m/s²: ``(…, L, J, 3), (L, J, 3) → (…)``.

    Accelerations are second differences in time, which require at least three frames.
    """
    check_positive("fps", fps)
    _check_frames(motions, truth)
    return _mean_acceleration(motions - truth) * fps**2


def acceleration_ratio(motions: Array, truth: Array) -> Array:
    """Return the mean acceleration relative to the truth's: ``(…, L, J, 3), (L, J, 3) → (…)``.

    Plausible ratios are 0.5 to 2 (Motion-DVAE, appendix H.1); lower ones indicate oversmoothing,
    higher ones jitter. Raises ``ValueError`` for fewer than three frames or no true acceleration.
    """
    _check_frames(motions, truth)
    size = float(_mean_acceleration(truth))
    if size == 0:
        raise ValueError("truth must have a nonzero acceleration in at least one frame, got 0")
    return _mean_acceleration(motions) / size


def _check_frames(motions: Array, truth: Array) -> None:
    check_shape("motions", motions, ("…", *truth.shape))
    if truth.shape[-3] < 3:
        raise ValueError(f"truth must have at least 3 frames, got {truth.shape[-3]}")


def _mean_acceleration(paths: Array) -> Array:
    """Return the mean length of second differences, ``(…, L, J, 3) → (…)``."""
    xp = array_namespace(paths)
    bend = paths[..., 2:, :, :] - 2 * paths[..., 1:-1, :, :] + paths[..., :-2, :, :]
    return xp.mean(xp.sqrt(xp.sum(bend**2, axis=-1)), axis=(-2, -1))
