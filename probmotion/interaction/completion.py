"""Completion of occluded joints from posterior draws (Yin et al. 2018, section 6, figure 12).

The completion, in 3D or in the image, is the median of the draws that are nearest in the visible
joints, deformed so that it matches the visible joints exactly.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from probmotion.interaction.annotations.views import project_to_views
from probmotion.interaction.geometry.coordinates import align_rigidly
from probmotion.interaction.geometry.nearest import PairComparer
from probmotion.interaction.geometry.pose_distances import pose_distances
from probmotion.interaction.retrieval import retrieve
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count, check_finite, check_positive, check_shape

__all__ = [
    "BANDWIDTH", "CompletionResult", "blend", "complete", "complete_keypoints",
    "nearest_annotation_completion", "occluded_joint_error",
]  # fmt: skip

BANDWIDTH = 0.3
"""Default bandwidth of :func:`blend`, metres."""

_MIN_VISIBLE = 4  # minimum number of visible joints, enough for a tetrahedron in 3D


class CompletionResult(NamedTuple):
    """Completed pose-pair and the draws (or annotation) it is computed from.

    ``positions`` (J, D), D = 2 or 3, metres, contain the visible joints unchanged; ``median``
    (J, D) is the median before deformation; ``indices`` (n,) are those of its draws, nearest first.
    """

    positions: np.ndarray
    median: np.ndarray
    indices: np.ndarray


def complete(
    pose: np.ndarray,
    visible: np.ndarray,
    draws: np.ndarray,
    skeleton: Skeleton,
    *,
    n_nearest: int = 100,
    bandwidth: float = BANDWIDTH,
    measure: str = "interaction",
) -> CompletionResult:
    """Complete the occluded joints of a 3D pose-pair from draws.

    1. Select the ``n_nearest`` draws by the distance of the visible joints.
    2. Align them rigidly to the visible joints and take the coordinate-wise median.
    3. Deform the median onto the visible joints with :func:`blend`.

    Parameters
    ----------
    pose : ndarray, (J, 3)
        Joints, metres; occluded joints are ignored.
    visible : ndarray of bool, (J,)
        Mask of visible joints; at least four.
    draws : ndarray, (S, J, 3)
        Posterior draws, metres, at arbitrary positions and headings.
    skeleton : Skeleton
        Skeleton of the J joints.
    n_nearest : int
        Number of draws in the median.
    bandwidth : float
        Bandwidth of the deformation, metres.
    measure : str
        Distance, one of :data:`probmotion.interaction.geometry.pose_distances.MEASURES`.
    """
    pose, visible = _checked("pose", pose, visible, skeleton, 3)
    draws = np.asarray(draws, dtype=np.float64)
    check_shape("draws", draws, ("S", skeleton.n_joints, 3))
    check_finite("draws", draws)
    check_count("n_nearest", n_nearest)
    if n_nearest > len(draws):
        raise ValueError(
            f"n_nearest must be at most {len(draws)}, the number of draws, got {n_nearest}"
        )
    distances = pose_distances(pose[visible][None], draws[:, visible], measure)[0]
    indices = np.argsort(distances, kind="stable")[:n_nearest]
    return _deformed_median(draws[indices], indices, pose, visible, bandwidth)


def complete_keypoints(
    keypoints: np.ndarray,
    visible: np.ndarray,
    draws: np.ndarray,
    skeleton: Skeleton,
    *,
    views: np.ndarray | None = None,
    n_nearest: int = 100,
    bandwidth: float = BANDWIDTH,
) -> CompletionResult:
    """Complete the occluded joints of a 2D pair (J, 2) from projections of draws.

    Like :func:`complete`, but in the image (metres, x right, y up).
    :func:`~probmotion.interaction.retrieval.retrieve` selects the draws and the best view of each.
    """
    keypoints, visible = _checked("keypoints", keypoints, visible, skeleton, 2)
    nearest = retrieve(keypoints, draws, skeleton, views=views, visible=visible, n=n_nearest)
    pairs = zip(draws[nearest.indices], nearest.views, strict=True)
    projections = [project_to_views(d[None], view[None], skeleton)[0, 0] for d, view in pairs]
    return _deformed_median(np.stack(projections), nearest.indices, keypoints, visible, bandwidth)


def nearest_annotation_completion(
    keypoints: np.ndarray,
    visible: np.ndarray,
    annotated: np.ndarray,
    skeleton: Skeleton,
    annotated_visible: np.ndarray | None = None,
) -> CompletionResult:
    """Complete the occluded joints of a 2D pair (J, 2) from the nearest annotation (baseline).

    Selects the nearest annotation, in interaction coordinates of the visible joints, among those
    that contain every occluded joint, and aligns it rigidly in the image.

    Parameters
    ----------
    keypoints, visible, skeleton
        See :func:`complete_keypoints`.
    annotated : ndarray, (n, J, 2)
        Annotated 2D pairs, metres.
    annotated_visible : ndarray of bool, (n, J), optional
        Mask of the annotated joints; all by default.
    """
    keypoints, visible = _checked("keypoints", keypoints, visible, skeleton, 2)
    annotated = np.asarray(annotated, dtype=np.float64)
    check_shape("annotated", annotated, ("n", skeleton.n_joints, 2))
    known = np.ones(annotated.shape[:2]) if annotated_visible is None else annotated_visible
    known = np.asarray(known, dtype=bool)
    check_shape("annotated_visible", known, annotated.shape[:2])
    candidates = np.flatnonzero(known[:, ~visible].all(axis=1))
    if len(candidates) == 0:
        raise ValueError("annotated must contain a pair with every occluded joint, got none")
    comparer = PairComparer(annotated[candidates][:, visible], known[candidates][:, visible])
    index = candidates[comparer.distances(keypoints[visible][None])[0].argmin()]
    median = np.asarray(align_rigidly(annotated[index], keypoints, visible & known[index]))
    positions = np.where(visible[:, None], keypoints, median)
    return CompletionResult(positions, median, np.array([index]))


def blend(
    median: np.ndarray, target: np.ndarray, visible: np.ndarray, bandwidth: float = BANDWIDTH
) -> np.ndarray:
    """Deform ``median`` onto the visible joints of ``target``, which are matched exactly.

    The displacement of an occluded joint h is a Gaussian-weighted mean over the visible joints v,

        Δ_h = Σ_v w_hv (target_v − median_v) / Σ_v w_hv,   w_hv = exp(−‖median_h − median_v‖²/2b²).

    ``median`` and ``target`` (J, D) and the bandwidth b are in metres; a joint must be visible.
    """
    check_positive("bandwidth", bandwidth)
    hidden = ~visible
    difference = median[hidden, None] - median[None, visible]
    exponents = -np.sum(difference**2, axis=-1) / (2 * bandwidth**2)
    # Subtract the maximum so that the weights of distant joints do not all underflow.
    weights = np.exp(exponents - exponents.max(axis=1, keepdims=True))
    weights /= weights.sum(axis=1, keepdims=True)
    blended = target.copy()
    blended[hidden] = median[hidden] + weights @ (target[visible] - median[visible])
    return blended


def occluded_joint_error(truth: np.ndarray, estimate: np.ndarray, hidden: np.ndarray) -> float:
    """Return the mean error of the occluded joints, metres, without alignment.

    Parameters
    ----------
    truth, estimate : ndarray, (…, J, D)
        Pose-pairs, D = 2 or 3, metres.
    hidden : ndarray of bool, (…, J)
        Mask of occluded joints; at least one.
    """
    check_shape("truth", truth, ("…", "J", "D"))
    check_shape("estimate", estimate, truth.shape)
    check_shape("hidden", hidden, truth.shape[:-1])
    if not np.any(hidden):
        raise ValueError("hidden must mark at least one joint, got none")
    return float(np.linalg.norm(truth - estimate, axis=-1)[hidden].mean())


def _deformed_median(
    poses: np.ndarray,
    indices: np.ndarray,
    target: np.ndarray,
    visible: np.ndarray,
    bandwidth: float,
) -> CompletionResult:
    """Return the completion of ``target`` (J, D) from the nearest draws ``poses`` (n, J, D)."""
    aligned = align_rigidly(poses, np.broadcast_to(target, poses.shape), visible)
    median = np.median(aligned, axis=0)
    return CompletionResult(blend(median, target, visible, bandwidth), median, indices)


def _checked(
    name: str, pose: np.ndarray, visible: np.ndarray, skeleton: Skeleton, axes: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the pose with occluded joints set to 0, and the mask of visible joints."""
    pose, visible = np.asarray(pose, dtype=np.float64), np.asarray(visible, dtype=bool)
    check_shape(name, pose, (skeleton.n_joints, axes))
    check_shape("visible", visible, (skeleton.n_joints,))
    if visible.sum() < _MIN_VISIBLE:
        raise ValueError(f"visible must mark at least {_MIN_VISIBLE} joints, got {visible.sum()}")
    check_finite(name, pose[visible])
    return np.where(visible[:, None], pose, 0.0), visible
