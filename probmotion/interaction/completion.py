"""Completion of hidden joints from a posterior's draws (Yin et al. 2018, section 6, figure 12).

In space (as a depth sensor sees) or in the image plane, always in three steps: the nearest draws
on the visible joints, their median, and its deformation onto the visible joints.
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
    "BANDWIDTH",
    "Completed",
    "blend",
    "complete",
    "complete_keypoints",
    "nearest_annotation_completion",
    "occluded_joint_error",
]

BANDWIDTH = 0.3
"""How far a visible joint's displacement reaches, metres."""

_FEWEST = 4
"""Visible joints that are compared: fewer have no tetrahedron."""


class Completed(NamedTuple):
    """A completed pair.

    ``positions`` (J, D), metres, the visible joints as they were given; ``median`` (J, D), what was
    deformed onto them; ``indices`` (n,) of the draws whose median it is, the nearest first.
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
) -> Completed:
    """Return a 3D pose-pair whose hidden joints are filled in from draws.

    1. The ``n_nearest`` draws: by the interaction coordinates of the visible joints alone, after
       the best rigid alignment of these.
    2. M: each joint's median, coordinate by coordinate, over these draws as aligned.
    3. M is deformed onto the visible joints by :func:`blend`.

    Parameters
    ----------
    pose : ndarray, (J, 3)
        Joints, metres; those that are hidden are never read.
    visible : ndarray of bool, (J,)
        Which are seen; at least four.
    draws : ndarray, (S, J, 3)
        The posterior's draws, metres; any place and heading.
    skeleton : Skeleton
        The J joints.
    n_nearest : int
        How many draws make the median.
    bandwidth : float
        How far a visible joint's displacement reaches, metres.
    measure : str
        One of :data:`probmotion.interaction.geometry.pose_distances.MEASURES`.

    Raises
    ------
    ValueError
        If shapes do not fit, a visible value is not finite, fewer than four joints are visible, or
        there are fewer draws than ``n_nearest``.
    """
    pose, visible = _checked("pose", pose, visible, skeleton, 3)
    draws = np.asarray(draws, dtype=np.float64)
    check_shape("draws", draws, ("S", skeleton.n_joints, 3))
    check_finite("draws", draws)
    _check_nearest(n_nearest, len(draws))
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
) -> Completed:
    """Return a 2D pair whose hidden joints are filled in from draws' projections.

    As :func:`complete`, in the image plane: the nearest draws are those of
    :func:`probmotion.interaction.retrieval.retrieve`, each in the view in which it fits best.

    Parameters
    ----------
    keypoints : ndarray, (J, 2)
        2D pair, metres, x right, y up; hidden joints are never read.
    visible : ndarray of bool, (J,)
        Which are annotated; at least four.
    draws : ndarray, (S, J, 3)
        The posterior's draws, metres.
    skeleton : Skeleton
        The J joints.
    views : ndarray, (V, 2), optional
        Views to look from; see :func:`probmotion.interaction.retrieval.retrieve`.
    n_nearest : int
        How many different draws make the median.
    bandwidth : float
        How far a visible joint's displacement reaches, metres.

    Raises
    ------
    ValueError
        As :func:`complete` does.
    """
    keypoints, visible = _checked("keypoints", keypoints, visible, skeleton, 2)
    found = retrieve(keypoints, draws, skeleton, views=views, visible=visible, n=n_nearest)
    pictures = np.stack(
        [
            project_to_views(draws[index][None], view[None], skeleton)[0, 0]
            for index, view in zip(found.indices, found.views, strict=True)
        ]
    )
    return _deformed_median(pictures, found.indices, keypoints, visible, bandwidth)


def nearest_annotation_completion(
    keypoints: np.ndarray,
    visible: np.ndarray,
    annotated: np.ndarray,
    skeleton: Skeleton,
    annotated_visible: np.ndarray | None = None,
) -> Completed:
    """Return a 2D pair whose hidden joints are one annotation's: what no model can do, too.

    The annotation is the one that is nearest in the interaction coordinates of the visible joints,
    of those that know every hidden joint. Its hidden joints are taken after the best rigid
    alignment in the image.

    Parameters
    ----------
    keypoints : ndarray, (J, 2)
        2D pair, metres; hidden joints are never read.
    visible : ndarray of bool, (J,)
        Which are annotated; at least four.
    annotated : ndarray, (n, J, 2)
        Annotated 2D pairs, metres.
    skeleton : Skeleton
        The J joints.
    annotated_visible : ndarray of bool, (n, J), optional
        Which joints they have; all by default.

    Raises
    ------
    ValueError
        If shapes do not fit, fewer than four joints are visible, or no annotation knows every
        hidden joint.
    """
    keypoints, visible = _checked("keypoints", keypoints, visible, skeleton, 2)
    annotated = np.asarray(annotated, dtype=np.float64)
    check_shape("annotated", annotated, ("n", skeleton.n_joints, 2))
    known = np.ones(annotated.shape[:2], dtype=bool)
    if annotated_visible is not None:
        known = np.asarray(annotated_visible, dtype=bool)
        check_shape("annotated_visible", known, annotated.shape[:2])
    candidates = np.flatnonzero(known[:, ~visible].all(axis=1))
    if len(candidates) == 0:
        raise ValueError("annotated has no pair with every hidden joint, expected at least one")
    comparer = PairComparer(annotated[candidates][:, visible], known[candidates][:, visible])
    index = candidates[comparer.distances(keypoints[visible][None])[0].argmin()]
    median = np.asarray(align_rigidly(annotated[index], keypoints, visible & known[index]))
    positions = np.where(visible[:, None], keypoints, median)
    return Completed(positions, median, np.array([index]))


def blend(
    median: np.ndarray, target: np.ndarray, visible: np.ndarray, bandwidth: float = BANDWIDTH
) -> np.ndarray:
    """Return ``median`` deformed onto the visible joints of ``target``, which it then has exactly.

    A hidden joint h is displaced by a Gaussian-weighted mean of the visible joints' displacements,

        Δ_h = Σ_v w_hv (target_v − median_v) / Σ_v w_hv,   w_hv = exp(−‖median_h − median_v‖²/2b²).

    Parameters
    ----------
    median, target : ndarray, (J, D)
        Metres; hidden joints of ``target`` are never read.
    visible : ndarray of bool, (J,)
        At least one.
    bandwidth : float
        b, metres.
    """
    check_positive("bandwidth", bandwidth)
    hidden = ~visible
    apart = median[hidden, None] - median[None, visible]
    exponents = -np.sum(apart**2, axis=-1) / (2 * bandwidth**2)
    # Relative to the nearest, so that a joint far from every visible one still has weights.
    weights = np.exp(exponents - exponents.max(axis=1, keepdims=True))
    weights /= weights.sum(axis=1, keepdims=True)
    blended = target.copy()
    blended[hidden] = median[hidden] + weights @ (target[visible] - median[visible])
    return blended


def occluded_joint_error(truth: np.ndarray, estimate: np.ndarray, hidden: np.ndarray) -> float:
    """Return the mean distance of estimated from true hidden joints, metres.

    Parameters
    ----------
    truth, estimate : ndarray, (…, J, D)
        Pairs in the same coordinates, D = 2 or 3, metres. Nothing is aligned.
    hidden : ndarray of bool, (…, J)
        Which joints count.

    Raises
    ------
    ValueError
        If shapes differ or no joint is hidden.
    """
    check_shape("truth", truth, ("…", "J", "D"))
    check_shape("estimate", estimate, truth.shape)
    check_shape("hidden", hidden, truth.shape[:-1])
    if not np.any(hidden):
        raise ValueError("hidden has no joint, expected at least one")
    return float(np.linalg.norm(truth - estimate, axis=-1)[hidden].mean())


def _deformed_median(
    poses: np.ndarray,
    indices: np.ndarray,
    target: np.ndarray,
    visible: np.ndarray,
    bandwidth: float,
) -> Completed:
    """Return the completion from the nearest draws, (n, J, D)."""
    aligned = align_rigidly(poses, np.broadcast_to(target, poses.shape), visible)
    median = np.median(aligned, axis=0)
    return Completed(blend(median, target, visible, bandwidth), median, indices)


def _checked(
    name: str, pose: np.ndarray, visible: np.ndarray, skeleton: Skeleton, axes: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return a pose, hidden joints 0, and which joints are visible, or raise ``ValueError``."""
    pose, visible = np.asarray(pose, dtype=np.float64), np.asarray(visible, dtype=bool)
    check_shape(name, pose, (skeleton.n_joints, axes))
    check_shape("visible", visible, (skeleton.n_joints,))
    if visible.sum() < _FEWEST:
        raise ValueError(f"visible has {visible.sum()} joints, expected at least {_FEWEST}")
    check_finite(name, pose[visible])
    return np.where(visible[:, None], pose, 0.0), visible


def _check_nearest(n_nearest: int, n_draws: int) -> None:
    check_count("n_nearest", n_nearest)
    if n_nearest > n_draws:
        raise ValueError(f"n_nearest must be at most {n_draws}, the draws, got {n_nearest}")
