"""Shape contexts of joints: from each joint, where do the others lie? (Belongie et al. 2002.)

A joint's shape context is a histogram of the other joints' distances and directions. In the plane
directions are angles to the image's x axis; in space they are heights above the horizontal and
angles about the vertical, so that turning a pair about the vertical changes nothing (after
Körtgen et al. 2003). Joints carry labels, hence corresponding ones are compared and no matching
is sought. Characters have one height, 1.7 m; distances are binned at fixed numbers of metres.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from probmotion.validation import check_finite, check_shape

__all__ = [
    "N_ANGLES",
    "RING_EDGES",
    "shape_context_distance",
    "shape_context_distances",
    "shape_contexts",
]

RING_EDGES = (0.15, 0.3, 0.6, 1.2)
"""Distances between the five rings, metres; the last ring has no end, so every joint counts."""
N_ANGLES = 12
"""Bins of the angle in the plane."""
_N_BANDS, _N_SECTORS = 4, 8
"""Bins in space: of the sine of the height's angle (equal areas), and about the vertical."""


def shape_contexts(points: np.ndarray, visible: np.ndarray | None = None) -> np.ndarray:
    """Return one histogram of the other visible joints per joint, as counts.

    In the plane 5 rings × 12 angles. In space 5 rings × 4 bands × 8 sectors; sectors count from
    the pair's own heading on the ground: from the mean of the first half of the joints to the mean
    of the second half, which is from one character to the other where there are two.

    Parameters
    ----------
    points : numpy.ndarray
        Joints, shape (…, J, D), metres; D = 2, or D = 3 with Y up. At most 256 joints.
    visible : numpy.ndarray, optional
        Which joints count, bool, shape (…, J); all by default.

    Returns
    -------
    numpy.ndarray
        Shape (…, J, 60) or (…, J, 160), uint8; 0 in the rows of hidden joints.

    Raises
    ------
    ValueError
        If shapes do not fit, there are over 256 joints, or ``points`` is not finite.
    """
    points = np.asarray(points, dtype=np.float64)
    check_shape("points", points, ("…", "J", 3 if points.shape[-1:] == (3,) else 2))
    check_finite("points", points)
    *batch, n_joints, n_axes = points.shape
    if n_joints > 256:
        raise ValueError(f"points has {n_joints} joints, expected at most 256")
    visible = np.ones(n_joints, dtype=bool) if visible is None else np.asarray(visible, dtype=bool)
    check_shape("visible", visible, ("…", n_joints))
    flat = points.reshape(-1, n_joints, n_axes)
    shown = np.broadcast_to(visible, (*batch, n_joints)).reshape(-1, n_joints)
    n_bins = (len(RING_EDGES) + 1) * (N_ANGLES if n_axes == 2 else _N_BANDS * _N_SECTORS)
    counts = np.zeros((len(flat), n_joints, n_bins), dtype=np.uint8)
    rows = np.arange(n_joints)[:, None]
    for item, (joints, seen) in enumerate(zip(flat, shown, strict=True)):
        bins = _bins_in_plane(joints) if n_axes == 2 else _bins_in_space(joints)
        counted = seen[:, None] & seen[None, :] & ~np.eye(n_joints, dtype=bool)
        np.add.at(counts[item], (np.broadcast_to(rows, bins.shape)[counted], bins[counted]), 1)
    return counts.reshape(*batch, n_joints, n_bins)


def shape_context_distance(
    first: np.ndarray, second: np.ndarray, visible: np.ndarray | None = None
) -> np.ndarray:
    """Return the mean χ² cost of corresponding joints' shape contexts, in [0, 1].

    The cost of two histograms is ``½ Σ_k (h_k − g_k)² / (h_k + g_k)`` with h and g normalised to
    sum 1 (Belongie et al. 2002, eq. 2).

    Parameters
    ----------
    first, second : numpy.ndarray
        From :func:`shape_contexts` with the same visible joints, shape (…, J, K).
    visible : numpy.ndarray, optional
        Which joints count, bool, shape (…, J); all by default.

    Returns
    -------
    numpy.ndarray
        Shape (…); infinite where fewer than two joints are visible.

    Raises
    ------
    ValueError
        If shapes do not fit.
    """
    check_shape("first", first, ("…", "J", "K"))
    check_shape("second", second, ("…", *first.shape[-2:]))
    visible = np.ones(first.shape[-2], dtype=bool) if visible is None else visible
    check_shape("visible", visible, ("…", first.shape[-2]))
    h, g = _normalised(first), _normalised(second)
    both = h + g
    cost = 0.5 * ((h - g) ** 2 / np.where(both > 0, both, 1.0)).sum(axis=-1)
    counted = np.broadcast_to(visible, cost.shape)
    n_counted = counted.sum(axis=-1)
    mean = np.where(counted, cost, 0.0).sum(axis=-1) / np.maximum(n_counted, 1)
    return np.where(n_counted > 1, mean, np.inf)


def shape_context_distances(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return :func:`shape_context_distance` of each with each, compiled.

    Parameters
    ----------
    first, second : numpy.ndarray
        From :func:`shape_contexts` of wholly visible pairs, shapes (n, J, K) and (m, J, K), uint8.

    Returns
    -------
    numpy.ndarray
        Shape (n, m), in [0, 1].

    Raises
    ------
    ValueError
        If shapes do not fit, or joints are hidden.
    """
    check_shape("first", first, ("n", "J", "K"))
    check_shape("second", second, ("m", *first.shape[1:]))
    others = first.shape[1] - 1
    for name, counts in (("first", first), ("second", second)):
        if counts.dtype != np.uint8 or (counts.sum(axis=-1, dtype=np.int64) != others).any():
            raise ValueError(
                f"{name} has joints whose counts do not sum to {others}, expected shape contexts "
                "of wholly visible pairs, uint8"
            )
    if others < 1:
        return np.full((len(first), len(second)), np.inf)
    return _distances(
        np.ascontiguousarray(first), np.ascontiguousarray(second), shared_table(others)
    )


def shared_table(most: int) -> np.ndarray:
    """Return ``2 h g / (h + g)`` for counts up to ``most``, shape (most + 1, most + 1).

    With as many counts N in both histograms the χ² cost is ``1 − Σ_k 2 h_k g_k / (h_k + g_k) / N``.
    """
    h, g = np.ogrid[: most + 1, : most + 1]
    return 2.0 * h * g / np.maximum(h + g, 1)


def _normalised(counts: np.ndarray) -> np.ndarray:
    total = counts.sum(axis=-1, keepdims=True, dtype=np.float64)
    return counts / np.maximum(total, 1.0)


def _bins_in_plane(joints: np.ndarray) -> np.ndarray:
    """Return the bin of joint j as seen from joint i, (J, J)."""
    apart = joints[None] - joints[:, None]
    angle = np.arctan2(apart[..., 1], apart[..., 0])
    return _rings(apart) * N_ANGLES + _sectors(angle, N_ANGLES)


def _bins_in_space(joints: np.ndarray) -> np.ndarray:
    """Return the bin of joint j as seen from joint i, (J, J)."""
    half = len(joints) // 2
    heading = joints[-half:].sum(axis=0) - joints[:half].sum(axis=0) if half else np.zeros(3)
    apart = joints[None] - joints[:, None]
    distance = np.sqrt((apart**2).sum(axis=-1))
    sine = apart[..., 1] / np.where(distance > 0, distance, 1.0)
    band = np.clip(np.floor(0.5 * _N_BANDS * (sine + 1)), 0, _N_BANDS - 1).astype(np.int64)
    # The angle about the vertical from the heading, by its sine and cosine.
    along = apart[..., 0] * heading[0] + apart[..., 2] * heading[2]
    across = apart[..., 0] * heading[2] - apart[..., 2] * heading[0]
    sector = _sectors(np.arctan2(across, along), _N_SECTORS)
    return (_rings(apart) * _N_BANDS + band) * _N_SECTORS + sector


def _rings(apart: np.ndarray) -> np.ndarray:
    distance = np.sqrt((apart**2).sum(axis=-1))
    return np.searchsorted(RING_EDGES, distance, side="right")


def _sectors(angle: np.ndarray, n_sectors: int) -> np.ndarray:
    return np.floor(angle * (n_sectors / (2 * math.pi))).astype(np.int64) % n_sectors


@numba.njit(cache=True)
def _distances(first: np.ndarray, second: np.ndarray, shared: np.ndarray) -> np.ndarray:
    """Return the distances; only bins that ``first`` fills can be shared."""
    n, n_joints, n_bins = first.shape
    m = second.shape[0]
    most = shared.shape[0] - 1
    flat, rows = second.reshape(m, n_joints * n_bins), shared.reshape(-1)
    where = np.empty(n_joints * most, dtype=np.uint32)
    row = np.empty(n_joints * most, dtype=np.uint32)
    out = np.empty((n, m))
    for a in range(n):
        n_filled = 0
        for joint in range(n_joints):
            for k in range(n_bins):
                if first[a, joint, k] > 0:
                    where[n_filled] = joint * n_bins + k
                    row[n_filled] = first[a, joint, k] * (most + 1)
                    n_filled += 1
        for b in range(m):
            total = 0.0
            for filled in range(n_filled):
                total += rows[row[filled] + flat[b, where[filled]]]
            out[a, b] = 1.0 - total / (most * n_joints)
    return out
