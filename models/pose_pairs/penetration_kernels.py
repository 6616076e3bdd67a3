"""Compiled distances between segments and penetration depths of capsules."""

from __future__ import annotations

import numpy as np

from probmotion.extras import NO_ALLOCATION, numba

__all__ = ["capsule_depth", "segment_distance", "total_depth", "total_depths"]

_TINY = 1e-18  # squared length below which a segment counts as a point, m²


@numba.njit(cache=True, inline="always")
def _within(x: float) -> float:
    return min(1.0, max(0.0, x))


@numba.njit(**NO_ALLOCATION)
def segment_distance(p: np.ndarray, q: np.ndarray, r: np.ndarray, s: np.ndarray) -> float:
    """Return the distance between the segments p–q and r–s, metres; their length may be 0.

    The algorithm is that of Ericson, Real-Time Collision Detection (2005), section 5.1.9.
    """
    a = e = f = b = c = 0.0
    for i in range(3):
        u, v, w = q[i] - p[i], s[i] - r[i], p[i] - r[i]
        a += u * u
        e += v * v
        b += u * v
        c += u * w
        f += v * w
    along = across = 0.0
    if a <= _TINY and e > _TINY:
        across = _within(f / e)
    elif a > _TINY and e <= _TINY:
        along = _within(-c / a)
    elif a > _TINY and e > _TINY:
        # For parallel lines, any starting point is valid.
        volume = a * e - b * b
        along = _within((b * f - c * e) / volume) if volume > 1e-12 * a * e else 0.0
        across = (b * along + f) / e
        if across < 0.0:
            across, along = 0.0, _within(-c / a)
        elif across > 1.0:
            across, along = 1.0, _within((b - c) / a)
    square = 0.0
    for i in range(3):
        gap = p[i] - r[i] + along * (q[i] - p[i]) - across * (s[i] - r[i])
        square += gap * gap
    return np.sqrt(square)


@numba.njit(**NO_ALLOCATION)
def capsule_depth(
    pose: np.ndarray, bones: np.ndarray, radii: np.ndarray, first: int, second: int
) -> float:
    """Return the penetration depth of two capsules, metres; 0 if they are apart."""
    p, q = pose[bones[first, 0]], pose[bones[first, 1]]
    r, s = pose[bones[second, 0]], pose[bones[second, 1]]
    return max(0.0, radii[first] + radii[second] - segment_distance(p, q, r, s))


@numba.njit(**NO_ALLOCATION)
def total_depth(
    pose: np.ndarray, bones: np.ndarray, radii: np.ndarray, pairs: np.ndarray, spheres: np.ndarray
) -> float:
    """Return the total depth ρ of a pose; skip pairs with disjoint bounding spheres.

    ``spheres`` (bones, 4) is a workspace array for their centres and radii.
    """
    for bone in range(len(bones)):
        square = 0.0
        for i in range(3):
            end, start = pose[bones[bone, 0], i], pose[bones[bone, 1], i]
            spheres[bone, i] = 0.5 * (end + start)
            square += (end - start) ** 2
        spheres[bone, 3] = 0.5 * np.sqrt(square) + radii[bone]
    total = 0.0
    for k in range(len(pairs)):
        first, second = pairs[k, 0], pairs[k, 1]
        square = 0.0
        for i in range(3):
            square += (spheres[first, i] - spheres[second, i]) ** 2
        if square < (spheres[first, 3] + spheres[second, 3]) ** 2:
            total += capsule_depth(pose, bones, radii, first, second)
    return total


@numba.njit(cache=True)
def total_depths(
    poses: np.ndarray, bones: np.ndarray, radii: np.ndarray, pairs: np.ndarray
) -> np.ndarray:
    """Return the :func:`total_depth` of each pose, (n,)."""
    total, spheres = np.empty(len(poses)), np.empty((len(bones), 4))
    for n in range(len(poses)):
        total[n] = total_depth(poses[n], bones, radii, pairs, spheres)
    return total
