"""Shape contexts of joints in 2D and 3D (Belongie et al. 2002; Körtgen et al. 2003).

The shape context of a joint is a histogram of the distances and directions of the other joints. In
2D, directions are angles to the image's x axis. In 3D, they are elevations, and azimuths relative
to the pair's heading. The correspondence of joints is known, so no matching is needed.
"""

from __future__ import annotations

import math

import numpy as np

from probmotion.validation import check_finite, check_shape

__all__ = [
    "N_ANGLES", "N_BANDS", "N_SECTORS", "RING_EDGES", "shape_context_distance", "shape_contexts",
    "shared_table",
]  # fmt: skip

RING_EDGES = (0.15, 0.3, 0.6, 1.2)
"""Boundaries of the five distance rings, metres; the last ring is unbounded."""
N_ANGLES = 12
"""Number of angular bins in 2D."""
N_BANDS, N_SECTORS = 4, 8
"""Numbers of bins in 3D, in the sine of the elevation (equal areas) and the azimuth."""


def shape_contexts(points: np.ndarray, visible: np.ndarray | None = None) -> np.ndarray:
    """Return each joint's histogram of the other visible joints, as counts.

    Histograms have 5 rings × 12 angles in 2D and 5 rings × 4 bands × 8 sectors in 3D. Sectors are
    relative to the heading, the horizontal direction from the mean of the first half of the joints
    to the mean of the second half, i.e. from one person to the other.

    Parameters
    ----------
    points : ndarray, (…, J, D)
        Joints, metres; D = 2, or D = 3 with Y up. At most 256 joints.
    visible : ndarray of bool, (…, J), optional
        Mask of visible joints; all by default.

    Returns
    -------
    ndarray of uint8, (…, J, 60) or (…, J, 160)
        Counts; 0 in the rows of occluded joints.
    """
    points = np.asarray(points, dtype=np.float64)
    check_shape("points", points, ("…", "J", 3 if points.shape[-1:] == (3,) else 2))
    check_finite("points", points)
    *batch, n_joints, n_axes = points.shape
    if n_joints > 256:
        raise ValueError(f"points must have at most 256 joints, got {n_joints}")
    visible = np.ones(n_joints, dtype=bool) if visible is None else np.asarray(visible, dtype=bool)
    check_shape("visible", visible, ("…", n_joints))
    flat = points.reshape(-1, n_joints, n_axes)
    masks = np.broadcast_to(visible, (*batch, n_joints)).reshape(-1, n_joints)
    n_bins = (len(RING_EDGES) + 1) * (N_ANGLES if n_axes == 2 else N_BANDS * N_SECTORS)
    counts = np.zeros((len(flat), n_joints, n_bins), dtype=np.uint8)
    for item, (joints, mask) in enumerate(zip(flat, masks, strict=True)):
        bins = _bins_in_plane(joints) if n_axes == 2 else _bins_in_space(joints)
        i, j = np.nonzero(mask[:, None] & mask[None, :] & ~np.eye(n_joints, dtype=bool))
        np.add.at(counts[item], (i, bins[i, j]), 1)
    return counts.reshape(*batch, n_joints, n_bins)


def shape_context_distance(
    first: np.ndarray, second: np.ndarray, visible: np.ndarray | None = None
) -> np.ndarray:
    """Return the mean χ² cost of corresponding shape contexts, in [0, 1].

    The cost of normalised histograms h, g is ``½ Σ_k (h_k − g_k)² / (h_k + g_k)`` (Belongie et al.
    2002, eq. 2).

    Parameters
    ----------
    first, second : ndarray, (…, J, K)
        Results of :func:`shape_contexts` with the same visible joints.
    visible : ndarray of bool, (…, J), optional
        Mask of visible joints; all by default.

    Returns
    -------
    ndarray, (…)
        Mean cost; infinite where fewer than two joints are visible.
    """
    check_shape("first", first, ("…", "J", "K"))
    check_shape("second", second, ("…", *first.shape[-2:]))
    visible = np.ones(first.shape[-2], dtype=bool) if visible is None else visible
    check_shape("visible", visible, ("…", first.shape[-2]))
    h, g = _normalised(first), _normalised(second)
    total = h + g
    cost = 0.5 * ((h - g) ** 2 / np.where(total > 0, total, 1.0)).sum(axis=-1)
    mask = np.broadcast_to(visible, cost.shape)
    n_visible = mask.sum(axis=-1)
    mean = np.where(mask, cost, 0.0).sum(axis=-1) / np.maximum(n_visible, 1)
    return np.where(n_visible > 1, mean, np.inf)


def shared_table(max_count: int) -> np.ndarray:
    """Return ``2 h g / (h + g)`` for counts h, g up to ``max_count``, shape (max_count + 1,) * 2.

    For histograms of N counts each, the χ² cost is ``1 − Σ_k 2 h_k g_k / (h_k + g_k) / N``.
    """
    h, g = np.ogrid[: max_count + 1, : max_count + 1]
    return 2.0 * h * g / np.maximum(h + g, 1)


def _normalised(counts: np.ndarray) -> np.ndarray:
    total = counts.sum(axis=-1, keepdims=True, dtype=np.float64)
    return counts / np.maximum(total, 1.0)


def _bins_in_plane(joints: np.ndarray) -> np.ndarray:
    """Return the bin of joint j in the context of joint i, (J, J)."""
    difference = joints[None] - joints[:, None]
    angle = np.arctan2(difference[..., 1], difference[..., 0])
    return _rings(difference) * N_ANGLES + _sectors(angle, N_ANGLES)


def _bins_in_space(joints: np.ndarray) -> np.ndarray:
    """Return the bin of joint j in the context of joint i, (J, J)."""
    half = len(joints) // 2
    heading = joints[-half:].sum(axis=0) - joints[:half].sum(axis=0) if half else np.zeros(3)
    difference = joints[None] - joints[:, None]
    distance = np.sqrt((difference**2).sum(axis=-1))
    sine = difference[..., 1] / np.where(distance > 0, distance, 1.0)
    band = np.clip(np.floor(0.5 * N_BANDS * (sine + 1)), 0, N_BANDS - 1).astype(np.int64)
    # Components of the azimuth relative to the heading.
    along = difference[..., 0] * heading[0] + difference[..., 2] * heading[2]
    across = difference[..., 0] * heading[2] - difference[..., 2] * heading[0]
    sector = _sectors(np.arctan2(across, along), N_SECTORS)
    return (_rings(difference) * N_BANDS + band) * N_SECTORS + sector


def _rings(difference: np.ndarray) -> np.ndarray:
    distance = np.sqrt((difference**2).sum(axis=-1))
    return np.searchsorted(RING_EDGES, distance, side="right")


def _sectors(angle: np.ndarray, n_sectors: int) -> np.ndarray:
    return np.floor(angle * (n_sectors / (2 * math.pi))).astype(np.int64) % n_sectors
