"""Compiled nearest-draw shape-context distances of 3D poses after rigid alignment.

Bins are those of :func:`probmotion.interaction.geometry.shape_context.shape_contexts` in 3D,
recomputed for every pair of poses because rotation changes them. Ring counts are invariant to
rotation and give a lower bound (merging bins never increases a χ² cost) for stopping early.
"""

from __future__ import annotations

import numpy as np

from probmotion.extras import numba
from probmotion.interaction.geometry.rigid_kernels import align
from probmotion.interaction.geometry.shape_context import N_BANDS, N_SECTORS, RING_EDGES

__all__ = ["ring_counts", "shape_minima"]

_N_RINGS = len(RING_EDGES) + 1
_N_BINS = _N_RINGS * N_BANDS * N_SECTORS
_SQUARED_EDGES = tuple(edge**2 for edge in RING_EDGES)
_TOLERANCE = 1e-12
"""Tolerance of the early stop, for rounding errors."""


@numba.njit(cache=True)
def ring_counts(poses: np.ndarray) -> np.ndarray:
    """Return the number of joints in each ring around each joint, (n, J, 5) uint8."""
    counts = np.zeros((poses.shape[0], poses.shape[1], _N_RINGS), dtype=np.uint8)
    for n in range(poses.shape[0]):
        for i in range(poses.shape[1]):
            for j in range(poses.shape[1]):
                if j != i:
                    squared = 0.0
                    for axis in range(3):
                        squared += (poses[n, j, axis] - poses[n, i, axis]) ** 2
                    counts[n, i, _ring(squared)] += 1
    return counts


@numba.njit(cache=True)
def shape_minima(
    truths: np.ndarray,
    truth_rings: np.ndarray,
    draws: np.ndarray,
    draw_rings: np.ndarray,
    minima: np.ndarray,
) -> None:
    """Lower ``minima`` (G,) to the mean χ² cost of each true pose and its nearest draw.

    Draws are rotated onto the true pose, which defines the vertical.
    """
    n_joints = truths.shape[1]
    gains = _gains(n_joints - 1)
    rotation, horn, rotated = np.empty((3, 3)), np.empty((4, 4)), np.empty((n_joints, 3))
    contexts = np.empty((n_joints, _N_BINS), dtype=np.uint8)
    counts, bins = np.zeros(_N_BINS, dtype=np.uint8), np.empty(n_joints, dtype=np.int64)
    rest = np.empty(n_joints)
    for g in range(truths.shape[0]):
        _fill_contexts(truths[g], contexts, bins)
        for s in range(draws.shape[0]):
            if _ring_costs(truth_rings[g], draw_rings[s], gains, rest) > minima[g] + _TOLERANCE:
                continue
            align(truths[g], draws[s], rotation, horn)
            _turn(draws[s], rotation, rotated)
            cost = _cost(rotated, contexts, gains, rest, minima[g], counts, bins)
            minima[g] = min(minima[g], cost)


@numba.njit(cache=True)
def _gains(max_count: int) -> np.ndarray:
    """Return the cost decrease [h, k] by the k-th joint in a bin with h of the other pose."""
    gains = np.zeros((max_count + 1, max_count + 1))
    for h in range(1, max_count + 1):
        for k in range(1, max_count + 1):
            before = 2.0 * h * (k - 1) / (h + k - 1)
            gains[h, k] = (2.0 * h * k / (h + k) - before) / (max_count * (max_count + 1))
    return gains


@numba.njit(cache=True)
def _ring_costs(
    first: np.ndarray, second: np.ndarray, gains: np.ndarray, after: np.ndarray
) -> float:
    """Return the cost of the ring counts; write to ``after`` the part of the joints after i."""
    n_joints = first.shape[0]
    total = 0.0
    for i in range(n_joints - 1, -1, -1):
        after[i] = total
        total += 1.0 / n_joints
        for ring in range(_N_RINGS):
            h = first[i, ring]
            for k in range(1, second[i, ring] + 1):
                total -= gains[h, k]
    return total


@numba.njit(cache=True)
def _cost(
    joints: np.ndarray,
    contexts: np.ndarray,
    gains: np.ndarray,
    after: np.ndarray,
    limit: float,
    counts: np.ndarray,
    bins: np.ndarray,
) -> float:
    """Return the mean χ² cost of a pose and shape contexts, infinite beyond ``limit``.

    For histograms of N joints each, the cost is ``1 − Σ_k 2 h_k g_k / (h_k + g_k) / N``.
    """
    n_joints = joints.shape[0]
    across, along = _heading(joints)
    total = 0.0
    for i in range(n_joints):
        _fill_bins(joints, i, across, along, bins)
        total += 1.0 / n_joints
        for j in range(n_joints):
            if j != i:
                counts[bins[j]] += 1
                total -= gains[contexts[i, bins[j]], counts[bins[j]]]
        for j in range(n_joints):
            counts[bins[j]] = 0
        if total + after[i] > limit + _TOLERANCE:
            return np.inf
    return max(total, 0.0)


@numba.njit(cache=True)
def _fill_contexts(joints: np.ndarray, contexts: np.ndarray, bins: np.ndarray) -> None:
    """Write the shape contexts of a pose, (J, bins)."""
    contexts[:] = 0
    across, along = _heading(joints)
    for i in range(joints.shape[0]):
        _fill_bins(joints, i, across, along, bins)
        for j in range(joints.shape[0]):
            if j != i:
                contexts[i, bins[j]] += 1


@numba.njit(cache=True)
def _heading(joints: np.ndarray) -> tuple[float, float]:
    """Return the horizontal offset (x, z) from the first to the second half of the joints."""
    half = joints.shape[0] // 2
    x = z = 0.0
    for j in range(half):
        other = joints.shape[0] - half + j
        x += joints[other, 0] - joints[j, 0]
        z += joints[other, 2] - joints[j, 2]
    return x, z


@numba.njit(cache=True)
def _fill_bins(
    joints: np.ndarray, i: int, heading_x: float, heading_z: float, bins: np.ndarray
) -> None:
    """Write the bin of each joint in the context of joint i."""
    for j in range(joints.shape[0]):
        x = joints[j, 0] - joints[i, 0]
        y = joints[j, 1] - joints[i, 1]
        z = joints[j, 2] - joints[i, 2]
        squared = x * x + y * y + z * z
        # Bands of equal area: sin > ½ where 4 y² > d².
        steep = 4.0 * y * abs(y)
        band = int(steep >= -squared) + int(y >= 0.0) + int((steep >= squared) & (squared > 0.0))
        sector = _octant(x * heading_z - z * heading_x, x * heading_x + z * heading_z)
        bins[j] = (_ring(squared) * N_BANDS + band) * N_SECTORS + sector


# The functions below are branch-free so that the compiler can vectorise them.


@numba.njit(cache=True)
def _ring(squared: float) -> int:
    a, b, c, d = _SQUARED_EDGES
    return int(squared >= a) + int(squared >= b) + int(squared >= c) + int(squared >= d)


@numba.njit(cache=True)
def _octant(across: float, along: float) -> int:
    """Return the octant (0 to 7) of atan2(across, along)."""
    lower = (across < 0.0) | ((across == 0.0) & (along < 0.0))
    up, right = (-across, -along) if lower else (across, along)
    left = (right <= 0.0) & (up > 0.0)
    opposite, adjacent = (-right, up) if left else (up, right)
    steep = (opposite >= adjacent) & (opposite > 0.0)
    return 4 * int(lower) + 2 * int(left) + int(steep)


@numba.njit(cache=True)
def _turn(joints: np.ndarray, rotation: np.ndarray, rotated: np.ndarray) -> None:
    for j in range(joints.shape[0]):
        for i in range(3):
            rotated[j, i] = (
                rotation[i, 0] * joints[j, 0]
                + rotation[i, 1] * joints[j, 1]
                + rotation[i, 2] * joints[j, 2]
            )
