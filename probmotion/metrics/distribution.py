"""How far is a set of draws from the distribution they claim to be of?

Sets of draws are arrays (n, D): motions flattened, metres.
"""

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
    """Return n directions uniform on the sphere, (n, dim)."""
    check_count("n", n)
    directions = rng.standard_normal((n, dim))
    return directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def sliced_wasserstein(x: Array, y: Array, directions: np.ndarray) -> Array:
    """Return the sliced 2-Wasserstein distance of two sets of as many draws.

    The root of the mean, over directions, of the squared 2-Wasserstein distance of the
    projections (Bonneel et al. 2015).

    Parameters
    ----------
    x, y : Array, (n, D)
        The sets, in any array library.
    directions : ndarray, (P, D)
        Unit vectors to project on.

    Raises
    ------
    ValueError
        If the shapes disagree.
    """
    xp = array_namespace(x, y)
    check_shape("x", x, ("n", directions.shape[-1]))
    check_shape("y", y, tuple(x.shape))
    axes = constant(directions.T, x)
    apart = xp.sort(x @ axes, axis=0) - xp.sort(y @ axes, axis=0)
    return xp.sqrt(xp.mean(apart**2))


def sliced_wasserstein_ratio(
    draws: Array, references: Sequence[Array], directions: np.ndarray
) -> float:
    """Return the sliced Wasserstein distance to exact draws over that of two exact sets.

    1: indistinguishable from exact draws by this measure.

    Parameters
    ----------
    draws : Array, (n, D)
        What is judged.
    references : sequence of Array, each (n, D)
        Independent sets of as many exact draws; numerator and floor are means over them.
    directions : ndarray, (P, D)
        Unit vectors to project on.

    Raises
    ------
    ValueError
        If there are fewer than two reference sets.
    """
    if len(references) < 2:
        raise ValueError(f"references has {len(references)} sets, expected at least 2")
    pairs = zip(references, [*references[1:], references[0]], strict=True)
    floor = np.mean([float(sliced_wasserstein(a, b, directions)) for a, b in pairs])
    found = np.mean([float(sliced_wasserstein(draws, r, directions)) for r in references])
    return float(found / floor)


def trace_ratio(draws: Array, reference: Array) -> Array:
    """Return tr Cov[draws] / tr Cov[reference], ``(n, D), (m, D) → ()``; < 1 is over-confident."""
    return _total_variance(draws) / _total_variance(reference)


def mean_error(draws: Array, reference: Array) -> Array:
    """Return ‖mean(draws) − mean(reference)‖ / √tr Cov[reference], ``(n, D), (m, D) → ()``.

    About √(1/n + 1/m) for independent exact draws.
    """
    xp = array_namespace(draws, reference)
    apart = xp.mean(draws, axis=0) - xp.mean(reference, axis=0)
    return xp.sqrt(xp.sum(apart**2) / _total_variance(reference))


def precision_recall(
    draws: np.ndarray, reference: np.ndarray, neighbours: int = 3
) -> tuple[float, float]:
    """Return precision and recall of k-nearest-neighbour manifolds (Kynkäänniemi et al. 2019).

    Precision: the share of draws that lie within the k-th neighbour's distance of some reference
    draw; recall: the same with the roles swapped.

    Parameters
    ----------
    draws, reference : ndarray, (n, D) and (m, D)
        The sets.
    neighbours : int
        k.

    Raises
    ------
    ValueError
        If a set has k points or fewer.
    """
    for name, points in (("draws", draws), ("reference", reference)):
        if len(points) <= neighbours:
            raise ValueError(
                f"{name} has {len(points)} points, expected more than neighbours={neighbours}"
            )
    apart = _distances(draws, reference)
    precision = (apart <= _radii(reference, neighbours)[None, :]).any(axis=1).mean()
    recall = (apart <= _radii(draws, neighbours)[:, None]).any(axis=0).mean()
    return float(precision), float(recall)


def _total_variance(points: Array) -> Array:
    xp = array_namespace(points)
    apart = points - xp.mean(points, axis=0)
    return xp.sum(apart**2) / (points.shape[0] - 1)


def _radii(points: np.ndarray, neighbours: int) -> np.ndarray:
    """Distance of each point to its k-th nearest other point, (n,)."""
    apart = _distances(points, points)
    np.fill_diagonal(apart, math.inf)
    return np.partition(apart, neighbours - 1, axis=1)[:, neighbours - 1]


def _distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    from scipy.spatial.distance import cdist

    return cdist(a, b)
