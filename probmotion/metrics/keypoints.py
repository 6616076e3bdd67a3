"""How near are predicted keypoints to annotated ones, and generated sequences to filmed ones?

The measures of Sun et al. 2024 ("Ponymation", sections 4.2.2 and 4.3, appendix C), which need no
3D truth. Keypoints are in any unit of the picture, x right and y down.
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
    share: float = 0.1,
) -> float:
    """Return PCK: the percentage of visible keypoints that are nearer than ``share · size``.

    Parameters
    ----------
    predicted, truth : ndarray, (…, L, J, 2)
        Keypoints; what is not visible may be NaN in the truth.
    size : float or ndarray
        max(h, w) of the picture in the keypoints' unit: one number, or one for each sequence (…)
        or frame (…, L). See :func:`image_extent` for tracks without a picture.
    visible : ndarray of bool, (…, L, J), optional
        Keypoints that count; all by default.
    share : float
        Of the size, what an error must be below; .1 is the paper's PCK@0.1.

    Returns
    -------
    float
        0 to 100, over all visible keypoints of all sequences alike.

    Raises
    ------
    ValueError
        If shapes disagree, a visible number is not finite, a size is not above 0, or nothing is
        visible.
    """
    seen = _check_keypoints(predicted, truth, visible)
    check_positive("share", share)
    sizes = np.asarray(size, np.float64)
    if sizes.ndim > truth.ndim - 2 or sizes.shape != truth.shape[: sizes.ndim]:
        raise ValueError(
            f"size has shape {sizes.shape}, expected one number, or one for each sequence or frame "
            f"of {truth.shape[:-2]}"
        )
    if not (np.isfinite(sizes) & (sizes > 0)).all():
        raise ValueError("size has entries that are not finite numbers above 0")
    if not seen.any():
        raise ValueError("visible has no keypoint in any frame, expected at least one")
    sizes = sizes.reshape(*sizes.shape, *[1] * (truth.ndim - 1 - sizes.ndim))
    errors = np.linalg.norm(_hidden_as_zero(predicted - truth, seen), axis=-1)
    return 100 * float((errors < share * sizes)[seen].mean())


def image_extent(keypoints: np.ndarray, visible: np.ndarray | None = None) -> np.ndarray:
    """Return the larger side of the box around each sequence, for tracks without a picture.

    ``(…, L, J, 2) → (…)``: one box around all visible keypoints of all its frames, as a camera
    that does not zoom would cut it out.

    Raises
    ------
    ValueError
        If a visible keypoint is not finite, or a sequence has no extent.
    """
    seen = _check_keypoints(keypoints, keypoints, visible, names=("keypoints", "keypoints"))
    axes = (-3, -2)
    low = np.where(seen[..., None], keypoints, np.inf).min(axis=axes)
    high = np.where(seen[..., None], keypoints, -np.inf).max(axis=axes)
    sides: np.ndarray = (high - low).max(axis=-1)
    if not (sides > 0).all():
        raise ValueError(
            "keypoints has a sequence whose visible ones are all in one place, expected a box "
            "with sides above 0"
        )
    return sides


def velocity_error(
    predicted: np.ndarray, truth: np.ndarray, visible: np.ndarray | None = None
) -> float:
    """Return the relative error of the keypoints' displacements from frame to frame.

    (1/T) Σ_t ‖δ̂_t − δ_t‖ / ‖δ_t‖ (section 4.2.2), averaged over sequences. δ_t is the vector of
    the displacements of ALL keypoints that are visible in both frames: a joint that stands still
    has no relative error of its own. T counts the displacements of a sequence; a frame in which
    none of the truth's keypoints moves, or none is visible, has no relative error and does not
    count.

    Parameters
    ----------
    predicted, truth : ndarray, (…, L, J, 2)
        Keypoints; what is not visible may be NaN in the truth. A prediction that stands still has
        an error of 1, twice the displacement too.
    visible : ndarray of bool, (…, L, J), optional
        Keypoints that count; all by default.

    Raises
    ------
    ValueError
        If shapes disagree, a visible number is not finite, or a sequence of the truth does not
        move.
    """
    seen = _check_keypoints(predicted, truth, visible)
    both = seen[..., 1:, :] & seen[..., :-1, :]
    steps = _hidden_as_zero(np.diff(truth, axis=-3), both)
    errors = _hidden_as_zero(np.diff(predicted, axis=-3) - np.diff(truth, axis=-3), both)
    length = np.sqrt((steps**2).sum(axis=(-2, -1)))
    off = np.sqrt((errors**2).sum(axis=(-2, -1)))
    moves = length > 0
    counted = moves.sum(axis=-1)
    if not (counted > 0).all():
        raise ValueError(
            "truth has a sequence without any visible keypoint that moves, expected a motion to "
            "compare with"
        )
    ratios = np.divide(off, length, out=np.zeros_like(off), where=moves)
    return float((ratios.sum(axis=-1) / counted).mean())


def fit_linear_map(
    predicted: np.ndarray, annotated: np.ndarray, visible: np.ndarray | None = None
) -> np.ndarray:
    """Return the weights that make annotated keypoints of predicted joints, where skeletons differ.

    Each keypoint is a weighted sum of the joints, the same in x and y and in all frames: the
    weights W minimise Σ ‖W u − k‖² over the set's visible keypoints (section 4.2.2: "a linear
    transformation"). Apply them to any pictures that are centred alike with ``W @ u``.

    Parameters
    ----------
    predicted : ndarray, (…, J, 2)
        Joints.
    annotated : ndarray, (…, K, 2)
        Keypoints of the same frames; what is not visible may be NaN.
    visible : ndarray of bool, (…, K), optional
        Keypoints that count; all by default.

    Returns
    -------
    ndarray, (K, J)
        W. A joint that is at the origin in every frame, as the root that pictures are centred
        on, has weight 0.

    Raises
    ------
    ValueError
        If shapes disagree, a visible number is not finite, or the frames of a keypoint do not
        determine its weights.
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
    for keypoint in range(n_keypoints):
        frames = seen[:, keypoint]
        # Two equations a frame, one in x and one in y.
        system = joints[frames][:, used].transpose(0, 2, 1).reshape(-1, int(used.sum()))
        solution, _, rank, _ = np.linalg.lstsq(system, targets[frames, keypoint].ravel())
        if rank < system.shape[1]:
            raise ValueError(
                f"predicted has {int(frames.sum())} frames for keypoint {keypoint} that determine "
                f"{int(rank)} of the weights of {system.shape[1]} joints, expected all of them"
            )
        weights[keypoint, used] = solution
    return weights


def _check_keypoints(
    predicted: np.ndarray,
    truth: np.ndarray,
    visible: np.ndarray | None,
    names: tuple[str, str] = ("predicted", "truth"),
) -> np.ndarray:
    """Return what is visible, (…, L, J) bool, of keypoints that fit each other."""
    check_shape(names[1], truth, ("…", "L", "J", 2))
    check_shape(names[0], predicted, truth.shape)
    if visible is None:
        seen = np.ones(truth.shape[:-1], bool)
    else:
        check_shape("visible", visible, truth.shape[:-1])
        if visible.dtype != bool:
            raise ValueError(f"visible has entries of {visible.dtype}, expected truth values")
        seen = visible
    for name, values in zip(names, (predicted, truth), strict=True):
        check_finite(name, _hidden_as_zero(values, seen))
    return seen


def _hidden_as_zero(values: np.ndarray, seen: np.ndarray) -> np.ndarray:
    return np.where(seen[..., None], values, 0.0)
