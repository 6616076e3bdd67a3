"""Errors of predicted 2D keypoints (Sun et al. 2024, "Ponymation", sections 4.2.2 and 4.3).

Keypoints have x right and y down, in any image unit.
"""

from __future__ import annotations

import numpy as np

from probmotion.validation import check_finite, check_positive, check_shape

__all__ = [
    "fit_linear_map",
    "image_extent",
    "percentage_of_correct_keypoints",
    "velocity_error",
]


def percentage_of_correct_keypoints(
    predicted: np.ndarray,
    truth: np.ndarray,
    size: float | np.ndarray,
    *,
    visible: np.ndarray | None = None,
    threshold: float = 0.1,
) -> float:
    """Return PCK: the percentage of visible keypoints with error below ``threshold · size``.

    Parameters
    ----------
    predicted, truth : ndarray, (…, L, J, 2)
        Keypoints; invisible ones may be NaN in the truth.
    size : float or ndarray
        max(height, width) of the image in the unit of the keypoints: one value, or one per sequence
        (…) or frame (…, L). For tracks without an image, use :func:`image_extent`.
    visible : ndarray of bool, (…, L, J), optional
        Mask of visible keypoints; all by default.
    threshold : float
        Threshold relative to the size; 0.1 for PCK@0.1.

    Returns
    -------
    float
        Percentage of the visible keypoints of all sequences, 0 to 100.
    """
    seen = _check_keypoints(predicted, truth, visible)
    check_positive("threshold", threshold)
    sizes = np.asarray(size, np.float64)
    if sizes.ndim > truth.ndim - 2 or sizes.shape != truth.shape[: sizes.ndim]:
        raise ValueError(
            f"size must be a number, or one per sequence or frame {truth.shape[:-2]}, got shape "
            f"{sizes.shape}"
        )
    if not (np.isfinite(sizes) & (sizes > 0)).all():
        raise ValueError(f"size must be finite and above 0, got {size}")
    if not seen.any():
        raise ValueError("visible must contain at least one keypoint, got none")
    sizes = sizes.reshape(*sizes.shape, *[1] * (truth.ndim - 1 - sizes.ndim))
    errors = np.linalg.norm(_masked(predicted - truth, seen), axis=-1)
    return 100 * float((errors < threshold * sizes)[seen].mean())


def image_extent(keypoints: np.ndarray, visible: np.ndarray | None = None) -> np.ndarray:
    """Return the longer side of the bounding box of each sequence: ``(…, L, J, 2) → (…)``.

    The box contains the visible keypoints of all frames; its longer side must be above 0.
    """
    seen = _check_keypoints(keypoints, keypoints, visible, ("keypoints", "keypoints"))[..., None]
    low = np.where(seen, keypoints, np.inf).min(axis=(-3, -2))
    high = np.where(seen, keypoints, -np.inf).max(axis=(-3, -2))
    sides: np.ndarray = (high - low).max(axis=-1)
    if not (sides > 0).all():
        raise ValueError(
            "keypoints must have an extent above 0 in every sequence, got one with all visible "
            "keypoints at one point"
        )
    return sides


def velocity_error(
    predicted: np.ndarray, truth: np.ndarray, visible: np.ndarray | None = None
) -> float:
    """Return the relative error of the keypoints' displacements between frames.

    It is (1/T) Σ_t ‖δ̂_t − δ_t‖ / ‖δ_t‖ (section 4.2.2), averaged over sequences. δ̂_t and δ_t stack
    the predicted and true displacements of all keypoints visible in both frames. Frames with
    δ_t = 0 are skipped. A static prediction has error 1.

    Parameters
    ----------
    predicted, truth : ndarray, (…, L, J, 2)
        Keypoints; invisible ones may be NaN in the truth.
    visible : ndarray of bool, (…, L, J), optional
        Mask of visible keypoints; all by default.
    """
    seen = _check_keypoints(predicted, truth, visible)
    in_both = seen[..., 1:, :] & seen[..., :-1, :]
    steps = _masked(np.diff(truth, axis=-3), in_both)
    errors = _masked(np.diff(predicted, axis=-3) - np.diff(truth, axis=-3), in_both)
    length = np.sqrt((steps**2).sum(axis=(-2, -1)))
    error_length = np.sqrt((errors**2).sum(axis=(-2, -1)))
    moving = length > 0
    n_moving = moving.sum(axis=-1)
    if not (n_moving > 0).all():
        raise ValueError(
            "truth must have a moving visible keypoint in every sequence, got a static sequence"
        )
    ratios = np.divide(error_length, length, out=np.zeros_like(error_length), where=moving)
    return float((ratios.sum(axis=-1) / n_moving).mean())


def fit_linear_map(
    predicted: np.ndarray, annotated: np.ndarray, visible: np.ndarray | None = None
) -> np.ndarray:
    """Return weights W that map predicted joints to the keypoints of another skeleton.

    W minimises Σ ‖W u − k‖² over frames with joints u and visible keypoints k (section 4.2.2: "a
    linear transformation" of x and y). Apply ``W @ u`` only to views centred in the same manner.

    Parameters
    ----------
    predicted : ndarray, (…, J, 2)
        Predicted 2D joints.
    annotated : ndarray, (…, K, 2)
        Keypoints of the same frames; invisible ones may be NaN.
    visible : ndarray of bool, (…, K), optional
        Mask of visible keypoints; all by default.

    Returns
    -------
    ndarray, (K, J)
        Weights W, 0 for joints at the origin in every frame.

    Raises
    ------
    ValueError
        If an argument is invalid or the weights of a keypoint are underdetermined.
    """
    check_shape("predicted", predicted, ("…", "J", 2))
    check_finite("predicted", predicted)
    check_shape("annotated", annotated, (*predicted.shape[:-2], "K", 2))
    seen = _check_keypoints(annotated, annotated, visible, names=("annotated", "annotated"))
    n_joints, n_keypoints = predicted.shape[-2], annotated.shape[-2]
    joints = np.asarray(predicted, np.float64).reshape(-1, n_joints, 2)
    targets = np.asarray(annotated, np.float64).reshape(-1, n_keypoints, 2)
    seen = seen.reshape(-1, n_keypoints)
    used = (joints != 0).any(axis=(0, 2))
    weights = np.zeros((n_keypoints, n_joints))
    for keypoint, frames in enumerate(seen.T):
        system = joints[frames][:, used].transpose(0, 2, 1).reshape(-1, int(used.sum()))
        solution, _, rank, _ = np.linalg.lstsq(system, targets[frames, keypoint].ravel())
        if rank < system.shape[1]:
            raise ValueError(
                f"predicted must determine the weights of all {system.shape[1]} joints, got rank "
                f"{int(rank)} from the {int(frames.sum())} frames of keypoint {keypoint}"
            )
        weights[keypoint, used] = solution
    return weights


def _check_keypoints(
    predicted: np.ndarray,
    truth: np.ndarray,
    visible: np.ndarray | None,
    names: tuple[str, str] = ("predicted", "truth"),
) -> np.ndarray:
    """Check shapes and values; return the visibility mask (…, L, J)."""
    check_shape(names[1], truth, ("…", "L", "J", 2))
    check_shape(names[0], predicted, truth.shape)
    if visible is None:
        seen = np.ones(truth.shape[:-1], bool)
    else:
        check_shape("visible", visible, truth.shape[:-1])
        if visible.dtype != bool:
            raise ValueError(f"visible must be boolean, got {visible.dtype}")
        seen = visible
    for name, values in zip(names, (predicted, truth), strict=True):
        check_finite(name, _masked(values, seen))
    return seen


def _masked(values: np.ndarray, seen: np.ndarray) -> np.ndarray:
    return np.where(seen[..., None], values, 0.0)
