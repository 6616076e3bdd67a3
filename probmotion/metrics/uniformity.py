"""Ranks on [0, 1]: levels of credible sets, and a test of uniformity with simultaneous bands.

Source: Säilynoja, Bürkner & Vehtari (2022), "Graphical test for discrete uniformity and its
applications in goodness-of-fit evaluation and multiple sample comparison", section 3. The
probability that the function leaves a band is computed exactly (Steck 1971).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.special import bdtr, bdtrc
from scipy.stats import poisson

from probmotion.validation import check_count, check_finite, check_shape

__all__ = [
    "DENSITY",
    "DISTANCE",
    "adjusted_p_values",
    "credible_level",
    "ecdf_band",
    "evaluation_points",
    "uniformity_p_value",
]

# Quantities whose credible sets are not central intervals.
DENSITY, DISTANCE = "log density", "distance"

_MAX_POINTS = 100  # maximum number of evaluation points, plus 1
# Tolerance of comparisons of tail probabilities: those equal by symmetry differ by rounding.
_TOLERANCE = 1 + 1e-9
_BISECTIONS = 40  # bisection steps


def credible_level(quantity: str, ranks: np.ndarray) -> np.ndarray:
    """Return the level of the smallest credible set that contains the truth of rank in [0, 1].

    The set is a highest-density region for :data:`DENSITY` (Hermans et al. 2022, "A crisis in
    simulation-based inference?"), a ball around a random point for :data:`DISTANCE` (Lemos et al.
    2023, "Sampling-based accuracy testing of posterior estimators") and else a central interval.
    """
    if quantity == DENSITY:
        return 1 - ranks
    return ranks if quantity == DISTANCE else np.abs(2 * ranks - 1)


def evaluation_points(n: int) -> np.ndarray:
    """Return the evaluation points 1/m, 2/m, …, (m − 1)/m for n values, with m = min(n, 100)."""
    check_count("n", n, least=2)
    m = min(n, _MAX_POINTS)
    return np.arange(1, m) / m


def uniformity_p_value(values: np.ndarray) -> float:
    """Return the p-value of the test that n values in [0, 1] are uniform, (n,) → ().

    The statistic γ is twice the smallest tail probability of the counts #{u ≤ z} ~ Binomial(n, z)
    over :func:`evaluation_points` z (eq. 7); its distribution is exact. p < α if and only if the
    empirical distribution function leaves :func:`ecdf_band` of level 1 − α.

    Raises
    ------
    ValueError
        If there are fewer than two values, or one is outside [0, 1] or not finite.
    """
    check_shape("values", values, ("n",))
    check_finite("values", values)
    n = len(values)
    points = evaluation_points(n)
    if values.min() < 0 or values.max() > 1:
        raise ValueError(f"values must be in [0, 1], got {values.min():g} to {values.max():g}")
    counts = np.searchsorted(np.sort(values), points, side="right")
    gamma = _tails(n)[np.arange(len(points)), counts].min()
    return _probability_of_leaving(n, float(gamma))


def ecdf_band(n: int, level: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
    """Return the simultaneous band of the empirical distribution function F of n uniform values.

    Parameters
    ----------
    n : int
        Number of values.
    level : float
        Minimum coverage probability.

    Returns
    -------
    lower, upper : ndarray, (m − 1,)
        Bounds of F at the :func:`evaluation_points`.
    """
    check_count("n", n, least=2)
    if not 0 < level < 1:
        raise ValueError(f"level must be between 0 and 1, got {level!r}")
    inside = _tails(n) > _TOLERANCE * _gamma(n, level)
    lowest = inside.argmax(axis=1)
    highest = n - inside[:, ::-1].argmax(axis=1)
    return lowest / n, highest / n


def adjusted_p_values(p_values: np.ndarray) -> np.ndarray:
    """Return p-values (m,) adjusted for multiple testing under any dependence (Holm 1979).

    The smallest adjusted p-value is that of the joint hypothesis.
    """
    check_shape("p_values", p_values, ("m",))
    order = np.argsort(p_values, kind="stable")
    scaled = p_values[order] * np.arange(len(p_values), 0, -1)
    adjusted = np.empty(len(p_values))
    adjusted[order] = np.minimum(1.0, np.maximum.accumulate(scaled))
    return adjusted


@lru_cache(maxsize=8)
def _tails(n: int) -> np.ndarray:
    """Return twice the smaller tail probability of each count at each point, (m − 1, n + 1)."""
    z = evaluation_points(n)[:, None]
    counts = np.arange(n + 1)
    # P(X ≥ 0) is 1; bdtrc(k, …) is P(X > k).
    above = np.where(counts > 0, bdtrc(np.maximum(counts - 1, 0), n, z), 1.0)
    return 2 * np.minimum(bdtr(counts, n, z), above)


def _probability_of_leaving(n: int, gamma: float) -> float:
    """Return P(twice the smaller tail is at most γ at some point) for n uniform values.

    Counts between points are Poisson with mean n/m, conditioned on their sum n. The sum over the
    first point outside the band is accurate even for small probabilities.
    """
    step, finish = _poisson(n)
    inside = np.zeros(n + 1)
    inside[0] = 1.0
    total = 0.0
    for allowed, remaining in zip(_tails(n) > _TOLERANCE * gamma, finish, strict=True):
        inside = np.convolve(inside, step)[: n + 1]
        total += float(inside[~allowed] @ remaining[~allowed])
        inside[~allowed] = 0.0
    return min(1.0, total)


@lru_cache(maxsize=8)
def _poisson(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return P(count between points), (n + 1,), and P(rest) / P(sum = n), (m − 1, n + 1)."""
    points = evaluation_points(n)
    counts = np.arange(n + 1)
    rest = poisson.pmf(n - counts, n * (1 - points[:, None]))
    return poisson.pmf(counts, n / (len(points) + 1)), rest / poisson.pmf(n, n)


@lru_cache(maxsize=64)
def _gamma(n: int, level: float) -> float:
    """Return the largest γ whose band is left with probability at most 1 − ``level``."""
    low, high = 0.0, 1.0
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        if _probability_of_leaving(n, middle) <= 1 - level:
            low = middle
        else:
            high = middle
    return low
