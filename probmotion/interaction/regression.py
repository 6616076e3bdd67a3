"""Completion of the occluded joints of 2D pairs by regression on the nearest annotations.

Annotations are aligned to the visible joints; the occluded joints are regressed on the visible ones
over the nearest annotations, which are weighted by a Gaussian kernel of their distance.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from probmotion.interaction.geometry.coordinates import align_rigidly
from probmotion.validation import check_count, check_finite, check_positive, check_shape

__all__ = ["RidgeCompletion", "ridge_completion"]

_MIN_VISIBLE = 4  # minimum number of visible joints
_KERNEL_RANK = 30  # the kernel's bandwidth is the distance of the 30th nearest annotation


class RidgeCompletion(NamedTuple):
    """Completed annotation ``positions`` (J, 2) and standard deviations ``sd`` (J, 2), metres.

    Visible joints are unchanged and have sd 0; sd are those of leave-one-out residuals.
    """

    positions: np.ndarray
    sd: np.ndarray


def ridge_completion(
    keypoints: np.ndarray,
    visible: np.ndarray,
    annotated: np.ndarray,
    *,
    n_nearest: int = 1000,
    ridge: float = 0.15,
) -> RidgeCompletion:
    """Complete the occluded joints of an annotation by ridge regression on the nearest ones.

    Parameters
    ----------
    keypoints : ndarray, (J, 2)
        Joints, metres; occluded joints are ignored.
    visible : ndarray of bool, (J,)
        Mask of visible joints; at least four.
    annotated : ndarray, (n, J, 2)
        Complete annotations, metres; one with a missing joint (NaN) is left out.
    n_nearest : int
        Number of nearest annotations, by the rms distance of the visible joints after alignment.
    ridge : float
        Standard deviation, metres, of the noise of which one regression coefficient of size 1
        weighs as much: larger values shrink the coefficients.
    """
    keypoints, visible = np.asarray(keypoints, dtype=np.float64), np.asarray(visible, dtype=bool)
    check_shape("keypoints", keypoints, ("J", 2))
    check_shape("visible", visible, (len(keypoints),))
    if visible.sum() < _MIN_VISIBLE:
        raise ValueError(f"visible must mark at least {_MIN_VISIBLE} joints, got {visible.sum()}")
    check_finite("keypoints", keypoints[visible])
    annotated = np.asarray(annotated, dtype=np.float64)
    check_shape("annotated", annotated, ("n", len(keypoints), 2))
    annotated = annotated[np.isfinite(annotated).all(axis=(1, 2))]
    check_count("n_nearest", n_nearest, 2)
    if len(annotated) < n_nearest:
        raise ValueError(
            f"annotated must have at least n_nearest ({n_nearest}) complete annotations, got "
            f"{len(annotated)}"
        )
    check_positive("ridge", ridge)
    target = np.where(visible[:, None], keypoints, 0.0)
    masks = np.broadcast_to(visible, annotated.shape[:2])
    aligned = align_rigidly(annotated, np.broadcast_to(target, annotated.shape), masks)
    distances = np.sqrt(((aligned - target)[:, visible] ** 2).sum(axis=-1).mean(axis=-1))
    nearest = np.argsort(distances, kind="stable")[:n_nearest]
    distances, aligned = distances[nearest], aligned[nearest]
    bandwidth = max(distances[min(_KERNEL_RANK, n_nearest) - 1], 1e-9)
    weights = np.exp(-((distances - distances[0]) * (distances + distances[0])) / 2 / bandwidth**2)
    weights /= weights.sum()
    mean = np.einsum("n,nja->ja", weights, aligned)
    roots = np.sqrt(weights)[:, None]
    inputs = roots * (aligned - mean)[:, visible].reshape(n_nearest, -1)
    outputs = roots * (aligned - mean)[:, ~visible].reshape(n_nearest, -1)
    # Weights sum to 1, so that the ridge is relative to the effective number of annotations.
    penalty = ridge**2 * (weights**2).sum()
    inverse = np.linalg.inv(inputs.T @ inputs + penalty * np.eye(inputs.shape[1]))
    coefficients = inverse @ (inputs.T @ outputs)
    leverage = np.einsum("ni,ij,nj->n", inputs, inverse, inputs) + weights
    residuals = (outputs - inputs @ coefficients) / np.maximum(1 - leverage, 1e-6)[:, None]
    positions, sd = target.copy(), np.zeros_like(target)
    shift = (target - mean)[visible].reshape(-1) @ coefficients
    positions[~visible] = mean[~visible] + shift.reshape(-1, 2)
    sd[~visible] = np.sqrt((residuals**2).sum(axis=0)).reshape(-1, 2)
    return RidgeCompletion(positions, sd)
