"""Coverage of real poses by draws (Yin et al. 2018, eq. 13)."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np

from probmotion.interaction.geometry.pose_distances import MEASURES, check_measure
from probmotion.validation import check_count, check_finite, check_shape

__all__ = ["coverage", "nearest_draw_distances"]

# Draws per block; their interaction graphs fit in the cache of a core.
_BLOCK = 256


def coverage(
    ground_truth: np.ndarray,
    draws: np.ndarray,
    measure: str = "cartesian",
    counts: Sequence[int] | None = None,
) -> float | np.ndarray:
    """Return coverage ``C(G; S) = (1/|G|) Σ_g min_{s ∈ S} D(g, s)`` (eq. 13); lower is better.

    Parameters
    ----------
    ground_truth : ndarray, (G, J, 3)
        Real poses g, metres.
    draws : ndarray, (S, J, 3)
        Draws s, metres; may be a memory map. Repeated poses are evaluated once.
    measure : str
        Distance D after the best rigid alignment of both poses, one of
        :data:`probmotion.interaction.geometry.pose_distances.MEASURES`.
    counts : sequence of int, optional
        Numbers of leading draws, in any order, for each of which coverage is computed.

    Returns
    -------
    coverage : float, or ndarray (len(counts),)
        Mean distance, metres; dimensionless for shape contexts.
    """
    requested = [len(draws)] if counts is None else list(counts)
    minima = nearest_draw_distances(ground_truth, draws, measure, requested)
    means = minima.mean(axis=1)
    return float(means[0]) if counts is None else means


def nearest_draw_distances(
    ground_truth: np.ndarray, draws: np.ndarray, measure: str, counts: Sequence[int]
) -> np.ndarray:
    """Return min_{s ≤ count} D(g, s), (len(counts), G); for parameters, see :func:`coverage`."""
    check_measure(measure)
    ground_truth = np.asarray(ground_truth, dtype=np.float64)
    check_shape("ground_truth", ground_truth, ("G", "J", 3))
    check_finite("ground_truth", ground_truth)
    check_shape("draws", draws, ("S", ground_truth.shape[1], 3))
    for name, values in (("ground_truth", ground_truth), ("draws", draws), ("counts", counts)):
        if len(values) == 0:
            raise ValueError(f"{name} must have at least one entry, got 0")
    for count in counts:
        check_count("counts", count)
        if count > len(draws):
            raise ValueError(f"counts must be at most the {len(draws)} draws, got {count}")
    prepare, lower_minima = MEASURES[measure]
    truths = prepare(ground_truth)
    minima = np.full(len(ground_truth), np.inf)
    seen: set[bytes] = set()
    by_count: dict[int, np.ndarray] = {}
    done = 0
    for count in sorted(set(counts)):
        for start in range(done, count, _BLOCK):
            block = np.asarray(draws[start : min(start + _BLOCK, count)], dtype=np.float64)
            check_finite("draws", block)
            new = block[_first_seen(block, seen)]
            lower_minima(*truths, *prepare(new), minima)
        done = count
        by_count[count] = minima.copy()
    return np.stack([by_count[count] for count in counts])


def _first_seen(poses: np.ndarray, seen: set[bytes]) -> list[int]:
    """Return the indices of poses not in ``seen`` and add their 128-bit digests to it."""
    new = []
    for index, pose in enumerate(poses):
        digest = hashlib.blake2b(pose.tobytes(), digest_size=16).digest()
        if digest not in seen:
            seen.add(digest)
            new.append(index)
    return new
