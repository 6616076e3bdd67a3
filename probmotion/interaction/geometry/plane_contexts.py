"""Shape contexts of projections, compiled: turned by adding an angle, never binned from scratch."""

from __future__ import annotations

import math

import numba
import numpy as np

from probmotion.interaction.geometry.shape_context import N_ANGLES, RING_EDGES

__all__ = ["context_cost", "polar_bins"]

_EDGES = np.array(RING_EDGES)
_PER_RADIAN = N_ANGLES / (2 * math.pi)


@numba.njit(cache=True)
def polar_bins(joints: np.ndarray) -> np.ndarray:
    """Return where joint j lies as seen from joint i: its ring's first bin, its angle in bins.

    Parameters
    ----------
    joints : numpy.ndarray
        Shape (2, J), metres.

    Returns
    -------
    numpy.ndarray
        Shape (2, J, J).
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


@numba.njit(cache=True)
def context_cost(
    bins: np.ndarray,
    turn: float,
    seen: np.ndarray,
    contexts: np.ndarray,
    shared: np.ndarray,
    best: float,
) -> float:
    """Return the mean χ² cost of a projection turned by ``turn`` and an annotation.

    Infinity as soon as it is certain to exceed ``best``.

    Parameters
    ----------
    bins : numpy.ndarray
        From :func:`polar_bins`, (2, J, J).
    turn : float
        Radians.
    seen, contexts : numpy.ndarray
        1 for the annotation's visible joints, (J,), and shape contexts over them, (J, 60) uint8.
    shared : numpy.ndarray
        From :func:`~probmotion.interaction.geometry.shape_context.shared_table`, J − 1 counts at
        most.
    best : float
        The least cost so far.
    """
    n_joints, n_visible = contexts.shape[0], 0
    for joint in range(n_joints):
        n_visible += 1 if seen[joint] > 0 else 0
    if n_visible < 2:
        return np.inf
    total, looked_at, turned = 0.0, 0, turn * _PER_RADIAN
    # Rounding must not abandon a cost that equals the best.
    enough = (best + 1e-9) * n_visible * (n_visible - 1)
    counts = np.empty(contexts.shape[1], dtype=np.uint8)
    for i in range(n_joints):
        if seen[i] == 0:
            continue
        counts[:] = 0
        for j in range(n_joints):
            if seen[j] > 0 and j != i:
                sector = np.int64(np.floor(bins[1, i, j] + turned))
                # Both angles are within half a turn: one turn brings their sum into [0, N).
                if sector < 0:
                    sector += N_ANGLES
                elif sector >= N_ANGLES:
                    sector -= N_ANGLES
                counts[np.int64(bins[0, i, j]) + sector] += 1
        for k in range(counts.size):
            total += shared[counts[k], contexts[i, k]]
        looked_at += 1
        # What is left may agree wholly, and then adds nothing.
        if looked_at * (n_visible - 1) - total > enough:
            return np.inf
    return 1.0 - total / (n_visible * (n_visible - 1))
