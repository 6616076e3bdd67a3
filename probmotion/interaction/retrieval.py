"""Indirect lifting: retrieval of the draws closest to a 2D pair (Yin et al. 2018, section 6)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from probmotion.interaction.annotations.views import project_to_views
from probmotion.interaction.geometry.nearest import PairComparer
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count, check_finite, check_shape

__all__ = ["RetrievalResult", "retrieve", "view_grid", "views_around"]

_BLOCK = 4096  # number of projections per block; does not affect the result


class RetrievalResult(NamedTuple):
    """Retrieved draws: the n closest to each 2D pair, nearest first.

    ``indices`` (…, n) are those of the draws, ``views`` (…, n, 2) the best view of each draw in
    radians, and ``distances`` (…, n) are in metres (dimensionless for shape contexts).
    """

    indices: np.ndarray
    views: np.ndarray
    distances: np.ndarray


def view_grid(n_azimuths: int = 16, n_heights: int = 3) -> np.ndarray:
    """Return a grid of views (φ, θ), (V, 2), radians.

    φ is uniform on the circle; θ is uniform from 50° to 100°, the usual range in videos, or 90° if
    ``n_heights`` is 1.
    """
    check_count("n_azimuths", n_azimuths)
    check_count("n_heights", n_heights)
    azimuths = np.arange(n_azimuths) * (2 * np.pi / n_azimuths) - np.pi
    low, high = np.radians((50.0, 100.0))
    heights = np.linspace(low, high, n_heights) if n_heights > 1 else np.array([np.pi / 2])
    return np.stack(np.meshgrid(azimuths, heights, indexing="ij"), axis=-1).reshape(-1, 2)


def views_around(view: np.ndarray) -> np.ndarray:
    """Return 15 views (15, 2), radians, within 30° in φ and 15° in θ of a view (2,)."""
    check_shape("view", view, (2,))
    check_finite("view", np.asarray(view))
    turns, tilts = np.radians((-30.0, -15.0, 0.0, 15.0, 30.0)), np.radians((-15.0, 0.0, 15.0))
    return view + np.stack(np.meshgrid(turns, tilts, indexing="ij"), axis=-1).reshape(-1, 2)


def retrieve(
    keypoints: np.ndarray,
    draws: np.ndarray,
    skeleton: Skeleton,
    *,
    views: np.ndarray | None = None,
    visible: np.ndarray | None = None,
    n: int = 1,
    measure: str = "interaction",
) -> RetrievalResult:
    """Return the n draws with the smallest distance to each 2D pair over all views.

    Projections are rigidly aligned to the pair. Only the first of identical draws is considered.

    Parameters
    ----------
    keypoints : ndarray, (…, J, 2)
        2D pairs, metres, x right, y up.
    draws : ndarray, (S, J, 3)
        3D pose-pairs, metres.
    skeleton : Skeleton
        Skeleton of the J joints.
    views : ndarray, (V, 2), optional
        Views (φ, θ) in the local frame (eqs. 3-5), radians. Default: :func:`view_grid`. Use
        :func:`views_around` if an estimate of the view is available.
    visible : ndarray of bool, (…, J), optional
        Mask of annotated joints; all by default.
    n : int
        Number of distinct draws to return.
    measure : str
        Distance measure of :class:`probmotion.interaction.geometry.nearest.PairComparer`.
    """
    keypoints = np.asarray(keypoints, dtype=np.float64)
    check_shape("keypoints", keypoints, ("…", skeleton.n_joints, 2))
    draws = np.asarray(draws, dtype=np.float64)
    check_shape("draws", draws, ("S", skeleton.n_joints, 3))
    check_finite("draws", draws)
    views = view_grid() if views is None else np.asarray(views, dtype=np.float64)
    check_shape("views", views, ("V", 2))
    check_count("n", n)
    if len(views) == 0:
        raise ValueError("views must contain at least one view, got none")
    batch = keypoints.shape[:-2]
    seen = np.ones(keypoints.shape[:-1], dtype=bool) if visible is None else np.asarray(visible)
    check_shape("visible", seen, keypoints.shape[:-1])
    distinct = np.sort(np.unique(draws, axis=0, return_index=True)[1])
    if n > len(distinct):
        raise ValueError(f"n must be at most the {len(distinct)} distinct draws, got {n}")
    comparer = PairComparer(
        keypoints.reshape(-1, *keypoints.shape[-2:]),
        seen.reshape(-1, skeleton.n_joints),
        measure=measure,
    )
    distances, best = _nearest_views(comparer, draws[distinct], views, skeleton)
    order = np.argsort(distances, axis=0, kind="stable")[:n].T
    pairs = np.arange(len(order))[:, None]
    if not np.isfinite(distances[order, pairs]).all():
        raise ValueError(
            f"visible must share an edge with at least {n} draws, got too few visible joints"
        )
    return RetrievalResult(
        distinct[order].reshape(*batch, n),
        views[best[order, pairs]].reshape(*batch, n, 2),
        distances[order, pairs].reshape(*batch, n),
    )


def _nearest_views(
    comparer: PairComparer, draws: np.ndarray, views: np.ndarray, skeleton: Skeleton
) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance and best view of each draw and 2D pair, (S, Q) each."""
    distances, best = [], []
    step = max(1, _BLOCK // len(views))
    for start in range(0, len(draws), step):
        projections = project_to_views(draws[start : start + step], views, skeleton)
        block = comparer.distances(projections.reshape(-1, *projections.shape[-2:]))
        block = block.reshape(len(projections), len(views), -1)
        best.append(block.argmin(axis=1))
        distances.append(block.min(axis=1))
    return np.concatenate(distances), np.concatenate(best)
