"""How well do draws cover real poses? (Yin et al. 2018, eq. 13)."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np

from probmotion.interaction.geometry.pose_distances import MEASURES, check_measure, pose_distances
from probmotion.validation import check_count, check_finite, check_shape

__all__ = ["coverage", "nearest_draw_distances", "pose_distances"]

_BLOCK = 256
"""Draws looked at together: their graphs stay in a core's cache while every truth meets them."""


def coverage(
    ground_truth: np.ndarray,
    draws: np.ndarray,
    measure: str = "cartesian",
    counts: Sequence[int] | None = None,
) -> float | np.ndarray:
    """Return C(G; S) = (1/|G|) Σ_g min_{s ∈ S} D(g, s) (eq. 13): lower is better.

    Parameters
    ----------
    ground_truth : ndarray, (G, J, 3)
        Real poses, metres.
    draws : ndarray, (S, J, 3)
        Draws, metres; a memory map will do, as a few hundred are looked at together. A pose that
        a chain repeats is measured once.
    measure : str
        One of :data:`probmotion.interaction.geometry.pose_distances.MEASURES`; every one is taken
        after the best rigid alignment of the two poses.
    counts : sequence of int, optional
        Numbers of draws, in any order: coverage by the first so many draws, from one pass.

    Returns
    -------
    coverage : float, or ndarray (len(counts),)
        Metres, or without unit for shape contexts.

    Raises
    ------
    ValueError
        If a set is empty, shapes differ, a value is not finite, the measure is unknown, or a
        count is not between 1 and S.
    """
    wanted = [len(draws)] if counts is None else list(counts)
    least = nearest_draw_distances(ground_truth, draws, measure, wanted)
    means = least.mean(axis=1)
    return float(means[0]) if counts is None else means


def nearest_draw_distances(
    ground_truth: np.ndarray, draws: np.ndarray, measure: str, counts: Sequence[int]
) -> np.ndarray:
    """Return min_{s ≤ count} D(g, s) for every count and real pose, (len(counts), G).

    Arguments and errors are those of :func:`coverage`.
    """
    check_measure(measure)
    ground_truth = np.asarray(ground_truth, dtype=np.float64)
    check_shape("ground_truth", ground_truth, ("G", "J", 3))
    check_finite("ground_truth", ground_truth)
    check_shape("draws", draws, ("S", ground_truth.shape[1], 3))
    for name, poses in (("ground_truth", ground_truth), ("draws", draws)):
        if len(poses) == 0:
            raise ValueError(f"{name} must contain at least one pose, got none")
    if len(counts) == 0:
        raise ValueError("counts must contain at least one number of draws, got none")
    for count in counts:
        check_count("counts", count)
        if count > len(draws):
            raise ValueError(f"counts has {count}, expected at most {len(draws)}, the draws")
    prepare, _, lower_minima = MEASURES[measure]
    truths = prepare(ground_truth)
    least = np.full(len(ground_truth), np.inf)
    seen: set[bytes] = set()
    found: dict[int, np.ndarray] = {}
    done = 0
    for count in sorted(set(counts)):
        for start in range(done, count, _BLOCK):
            block = np.asarray(draws[start : min(start + _BLOCK, count)], dtype=np.float64)
            check_finite("draws", block)
            new = block[_first_seen(block, seen)]
            lower_minima(*truths, *prepare(new), least)
        done = count
        found[count] = least.copy()
    return np.stack([found[count] for count in counts])


def _first_seen(poses: np.ndarray, seen: set[bytes]) -> list[int]:
    """Return the indices of poses that were not seen before, and remember them.

    By a digest of 128 bits: two poses that differ share one with odds of 1e-28 in 100 000.
    """
    new = []
    for index, pose in enumerate(poses):
        digest = hashlib.blake2b(pose.tobytes(), digest_size=16).digest()
        if digest not in seen:
            seen.add(digest)
            new.append(index)
    return new
