"""Distances between draws and reference draws, both flattened motions (n, D) in metres."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from probmotion.arrays import Array, array_namespace, constant
from probmotion.validation import check_count, check_shape

__all__ = [
    "mean_error",
    "precision_recall",
    "random_directions",
    "sliced_wasserstein",
    "sliced_wasserstein_ratio",
    "trace_ratio",
]


def random_directions(rng: np.random.Generator, n: int, dim: int) -> np.ndarray:
    """Return n unit vectors, uniform on the sphere, (n, dim)."""
    check_count("n", n)
    directions = rng.standard_normal((n, dim))
    return directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def sliced_wasserstein(x: Array, y: Array, directions: np.ndarray) -> Array:
    """Return the sliced 2-Wasserstein distance between equally large sets (Bonneel et al. 2015).

    ``(n, D), (n, D) → ()``, in any array library: the root mean square of the 2-Wasserstein
    distances between projections onto ``directions`` (P, D).
    """
    check_shape("x", x, ("n", directions.shape[-1]))
    check_shape("y", y, tuple(x.shape))
    return _root_mean_square(_projections(x, directions) - _projections(y, directions))


def sliced_wasserstein_ratio(
    draws: Array, references: Sequence[Array], directions: np.ndarray
) -> float:
    """Return the sliced Wasserstein distance to exact draws, relative to that between exact sets.

    The ratio is 1 for draws that cannot be distinguished from exact ones.

    Parameters
    ----------
    draws : Array, (n, D)
        Draws to evaluate.
    references : sequence of Array, each (n, D)
        At least two independent sets of exact draws; both distances are averaged over them.
    directions : ndarray, (P, D)
        Unit vectors onto which draws are projected.
    """
    if len(references) < 2:
        raise ValueError(f"references must have at least 2 sets, got {len(references)}")
    for name, points in (("draws", draws), *(("references", r) for r in references)):
        check_shape(name, points, (len(draws), directions.shape[-1]))
    own, *sets = (_projections(points, directions) for points in (draws, *references))
    pairs = zip(sets, [*sets[1:], sets[0]], strict=True)
    floor = np.mean([float(_root_mean_square(a - b)) for a, b in pairs])
    distance = np.mean([float(_root_mean_square(own - b)) for b in sets])
    return float(distance / floor)


def _projections(points: Array, directions: np.ndarray) -> Array:
    """Return projections onto directions, each sorted: ``(n, D), (P, D) → (n, P)``."""
    xp = array_namespace(points)
    return xp.sort(points @ constant(directions.T, points), axis=0)


def _root_mean_square(differences: Array) -> Array:
    xp = array_namespace(differences)
    return xp.sqrt(xp.mean(differences**2))


def trace_ratio(draws: Array, reference: Array) -> Array:
    """Return tr Cov[draws] / tr Cov[reference], ``(n, D), (m, D) → ()``; overconfident if < 1."""
    return _total_variance(draws) / _total_variance(reference)


def mean_error(draws: Array, reference: Array) -> Array:
    """Return ‖mean(draws) − mean(reference)‖ / √tr Cov[reference], ``(n, D), (m, D) → ()``.

    For independent exact draws, the error is about √(1/n + 1/m).
    """
    xp = array_namespace(draws, reference)
    difference = xp.mean(draws, axis=0) - xp.mean(reference, axis=0)
    return xp.sqrt(xp.sum(difference**2) / _total_variance(reference))


def precision_recall(
    draws: np.ndarray, reference: np.ndarray, neighbours: int = 3
) -> tuple[float, float]:
    """Return precision and recall of k-nearest-neighbour manifolds (Kynkäänniemi et al. 2019).

    Precision is the fraction of draws that are closer to some reference draw than its k-th nearest
    reference draw is. Recall exchanges the roles of the two sets, (n, D) and (m, D). Both sets must
    have more than k = ``neighbours`` points.
    """
    for name, points in (("draws", draws), ("reference", reference)):
        if len(points) <= neighbours:
            raise ValueError(
                f"{name} must have more than neighbours={neighbours} points, got {len(points)}"
            )
    distances = _distances(draws, reference)
    precision = (distances <= _radii(reference, neighbours)[None, :]).any(axis=1).mean()
    recall = (distances <= _radii(draws, neighbours)[:, None]).any(axis=0).mean()
    return float(precision), float(recall)


def _total_variance(points: Array) -> Array:
    xp = array_namespace(points)
    centred = points - xp.mean(points, axis=0)
    return xp.sum(centred**2) / (points.shape[0] - 1)


def _radii(points: np.ndarray, neighbours: int) -> np.ndarray:
    """Return the distance of each point to its ``neighbours``-th nearest neighbour, (n,)."""
    distances = _distances(points, points)
    np.fill_diagonal(distances, math.inf)
    return np.partition(distances, neighbours - 1, axis=1)[:, neighbours - 1]


def _distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    from scipy.spatial.distance import cdist

    return cdist(a, b)
