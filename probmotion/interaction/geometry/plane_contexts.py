"""Compiled 2D shape contexts of projections; a rotation adds an angle to the polar bins."""

from __future__ import annotations

import math

import numpy as np

from probmotion.extras import numba
from probmotion.interaction.geometry.shape_context import N_ANGLES, RING_EDGES

__all__ = ["context_cost", "polar_bins"]

_EDGES = np.array(RING_EDGES)
_PER_RADIAN = N_ANGLES / (2 * math.pi)  # angular bins per radian


@numba.njit(cache=True)
def polar_bins(joints: np.ndarray) -> np.ndarray:
    """Return the first bin of the ring of joint j around i, and its angle in bins, (2, J, J).

    ``joints`` is (2, J), metres.
    """
    n_joints = joints.shape[1]
    bins = np.zeros((2, n_joints, n_joints))
    for i in range(n_joints):
        for j in range(n_joints):
            x, y = joints[0, j] - joints[0, i], joints[1, j] - joints[1, i]
            distance = np.sqrt(x * x + y * y)
            for edge in _EDGES:
                if distance >= edge:
                    bins[0, i, j] += N_ANGLES
            bins[1, i, j] = np.arctan2(y, x) * _PER_RADIAN
    return bins


# By default, options are those of the caller, which allocates no arrays.
@numba.njit(cache=True, _nrt=True)
def context_cost(
    bins: np.ndarray,
    turn: float,
    seen: np.ndarray,
    contexts: np.ndarray,
    shared: np.ndarray,
    best: float,
) -> float:
    """Return the mean χ² cost of a rotated projection, infinite once it exceeds ``best``.

    ``bins`` (2, J, J) are from :func:`polar_bins`; ``turn`` is the rotation, radians; ``seen`` (J,)
    and ``contexts`` (J, 60) uint8 describe the annotation; ``shared`` is the
    :func:`~probmotion.interaction.geometry.shape_context.shared_table` of J − 1.
    """
    n_joints, n_visible = contexts.shape[0], int(seen.sum())
    if n_visible < 2:
        return np.inf
    total, n_rows, turn_in_bins = 0.0, 0, turn * _PER_RADIAN
    # The tolerance preserves ties despite rounding errors.
    limit = (best + 1e-9) * n_visible * (n_visible - 1)
    counts = np.empty(contexts.shape[1], dtype=np.uint8)
    for i in range(n_joints):
        if seen[i] == 0:
            continue
        counts[:] = 0
        for j in range(n_joints):
            if seen[j] > 0 and j != i:
                sector = np.int64(np.floor(bins[1, i, j] + turn_in_bins))
                # Both angles are in [−π, π], so one turn brings their sum into [0, N_ANGLES).
                if sector < 0:
                    sector += N_ANGLES
                elif sector >= N_ANGLES:
                    sector -= N_ANGLES
                counts[np.int64(bins[0, i, j]) + sector] += 1
        for k in range(counts.size):
            total += shared[counts[k], contexts[i, k]]
        n_rows += 1
        # Lower bound of the cost: the remaining joints may match exactly.
        if n_rows * (n_visible - 1) - total > limit:
            return np.inf
    return 1.0 - total / (n_visible * (n_visible - 1))
