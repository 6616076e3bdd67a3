"""Indirect lifting: the drawn 3D pose-pair that a 2D pair looks like (Yin et al. 2018, section 6).

No 2D pair is ever lifted by itself: it is looked up among the pictures of the posterior's draws.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from probmotion.interaction.annotations.views import project_to_views
from probmotion.interaction.geometry.nearest import PairComparer
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count, check_finite, check_shape

__all__ = ["Retrieved", "retrieve", "view_grid", "views_around"]

_PICTURES = 4096
"""Pictures compared at once; does not change what is found."""


class Retrieved(NamedTuple):
    """The n draws that look most like each 2D pair, the nearest first.

    ``indices`` (…, n) into the draws, ``views`` (…, n, 2) in which each looks most like it,
    radians, and ``distances`` (…, n) there, metres.
    """

    indices: np.ndarray
    views: np.ndarray
    distances: np.ndarray


def view_grid(n_azimuths: int = 16, n_heights: int = 3) -> np.ndarray:
    """Return views (φ, θ) all around a pair, (V, 2), radians.

    φ is even over the circle, from −π on; θ is even between 50° and 100°, from well above to a
    little below the pair's own horizon, where videos are taken from, or 90° alone.
    """
    check_count("n_azimuths", n_azimuths)
    check_count("n_heights", n_heights)
    azimuths = np.arange(n_azimuths) * (2 * np.pi / n_azimuths) - np.pi
    low, high = np.radians((50.0, 100.0))
    heights = np.linspace(low, high, n_heights) if n_heights > 1 else [np.pi / 2]
    return np.stack(np.meshgrid(azimuths, heights, indexing="ij"), axis=-1).reshape(-1, 2)


def views_around(view: np.ndarray) -> np.ndarray:
    """Return 15 views around an estimated one, (15, 2), radians: up to 30° in φ and 15° in θ."""
    check_shape("view", view, (2,))
    check_finite("view", np.asarray(view))
    turns, tilts = np.radians((-30.0, -15.0, 0.0, 15.0, 30.0)), np.radians((-15.0, 0.0, 15.0))
    offsets = np.stack(np.meshgrid(turns, tilts, indexing="ij"), axis=-1).reshape(-1, 2)
    return view + offsets


def retrieve(
    keypoints: np.ndarray,
    draws: np.ndarray,
    skeleton: Skeleton,
    *,
    views: np.ndarray | None = None,
    visible: np.ndarray | None = None,
    n: int = 1,
    measure: str = "interaction",
) -> Retrieved:
    """Return the draws whose projections are nearest to 2D pairs, each in its best view.

    A draw is as near as its nearest projection over ``views``, rigidly aligned in the image. A
    pose that a chain repeats counts once, by its first index. All 2D pairs are looked up in one
    pass over the draws' pictures.

    Parameters
    ----------
    keypoints : ndarray, (…, J, 2)
        2D pairs, metres, x right, y up.
    draws : ndarray, (S, J, 3)
        3D pose-pairs, metres.
    skeleton : Skeleton
        The J joints.
    views : ndarray, (V, 2), optional
        Views (φ, θ) in the pairs' own frame (eqs. 3-5), radians: :func:`view_grid` by default.
        Where the view of a 2D pair is estimated, hand in views around the estimate.
    visible : ndarray of bool, (…, J), optional
        Joints that are annotated; all by default.
    n : int
        How many draws.
    measure : str
        As in :class:`probmotion.interaction.geometry.nearest.PairComparer`.

    Returns
    -------
    retrieved : Retrieved

    Raises
    ------
    ValueError
        If shapes do not fit, a value is not finite, there is no view, or there are fewer than n
        different draws.
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
        raise ValueError("views must contain at least one, got none")
    batch = keypoints.shape[:-2]
    seen = np.ones(keypoints.shape[:-1], dtype=bool) if visible is None else np.asarray(visible)
    check_shape("visible", seen, keypoints.shape[:-1])
    first = np.sort(np.unique(draws, axis=0, return_index=True)[1])
    if n > len(first):
        raise ValueError(f"n must be at most {len(first)}, the different draws, got {n}")
    comparer = PairComparer(
        keypoints.reshape(-1, *keypoints.shape[-2:]),
        seen.reshape(-1, skeleton.n_joints),
        measure=measure,
    )
    distances, best = _nearest_views(comparer, draws[first], views, skeleton)
    order = np.argsort(distances, axis=0, kind="stable")[:n].T
    pairs = np.arange(len(order))[:, None]
    unlike = np.count_nonzero(~np.isfinite(distances[order, pairs]))
    if unlike:
        raise ValueError(
            f"visible shares no edge with {unlike} of the draws that were wanted, expected more "
            "visible joints"
        )
    return Retrieved(
        first[order].reshape(*batch, n),
        views[best[order, pairs]].reshape(*batch, n, 2),
        distances[order, pairs].reshape(*batch, n),
    )


def _nearest_views(
    comparer: PairComparer, draws: np.ndarray, views: np.ndarray, skeleton: Skeleton
) -> tuple[np.ndarray, np.ndarray]:
    """Return how near each draw comes to each 2D pair and in which view, (S, Q) each."""
    distances, best = [], []
    step = max(1, _PICTURES // len(views))
    for start in range(0, len(draws), step):
        pictures = project_to_views(draws[start : start + step], views, skeleton)
        found = comparer.distances(pictures.reshape(-1, *pictures.shape[-2:]))
        found = found.reshape(len(pictures), len(views), -1)
        best.append(found.argmin(axis=1))
        distances.append(found.min(axis=1))
    return np.concatenate(distances), np.concatenate(best)
