"""Are these numbers uniform on [0, 1]? The simultaneous test of an empirical distribution function.

Säilynoja, Bürkner & Vehtari (2022), "Graphical test for discrete uniformity and its applications in
goodness-of-fit evaluation and multiple sample comparison", section 3. Nothing is simulated: the
probability that the function leaves a band is computed exactly, after Steck (1971).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.special import bdtr, bdtrc
from scipy.stats import poisson

from probmotion.validation import check_count, check_finite, check_shape

__all__ = ["adjusted_p_values", "ecdf_band", "evaluation_points", "uniformity_p_value"]

_MOST_POINTS = 100
# Two tails that are equal by symmetry differ in their last bits.
_EQUAL = 1 + 1e-9
_HALVINGS = 40


def evaluation_points(n: int) -> np.ndarray:
    """Return where the distribution function of n numbers is looked at: 1/m, 2/m, …, (m − 1)/m.

    m is n, but 100 at most.
    """
    check_count("n", n, least=2)
    m = min(n, _MOST_POINTS)
    return np.arange(1, m) / m


def uniformity_p_value(values: np.ndarray) -> float:
    """Return the probability that n uniform numbers look as little uniform as these, or less so.

    The statistic γ is twice the smallest tail probability of F(z) = #{u ≤ z} ~ Binomial(n, z) over
    the points z (eq. 7); its distribution is exact, so that p may be very small. p < α where, and
    only where, F leaves :func:`ecdf_band` of level 1 − α.

    Parameters
    ----------
    values : ndarray, (n,)
        Numbers in [0, 1]; n is 2 or more.

    Raises
    ------
    ValueError
        If there are fewer than two, or one is outside [0, 1] or not finite.
    """
    check_shape("values", values, ("n",))
    check_finite("values", values)
    n = len(values)
    points = evaluation_points(n)
    if values.min() < 0 or values.max() > 1:
        raise ValueError(
            f"values run from {values.min():g} to {values.max():g}, expected numbers in [0, 1]"
        )
    counts = np.searchsorted(np.sort(values), points, side="right")
    gamma = _tails(n)[np.arange(len(points)), counts].min()
    return _probability_of_leaving(n, float(gamma))


def ecdf_band(n: int, level: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
    """Return between what F(z) of n uniform numbers stays at all points at once.

    Parameters
    ----------
    n : int
        How many numbers.
    level : float
        With at least this probability, and as little more as counts allow.

    Returns
    -------
    lower, upper : ndarray, (m − 1,)
        At :func:`evaluation_points`.

    Raises
    ------
    ValueError
        If ``level`` is not between 0 and 1.
    """
    check_count("n", n, least=2)
    if not 0 < level < 1:
        raise ValueError(f"level must be a number between 0 and 1, got {level!r}")
    inside = _tails(n) > _EQUAL * _gamma(n, level)
    lowest = inside.argmax(axis=1)
    highest = n - inside[:, ::-1].argmax(axis=1)
    return lowest / n, highest / n


def adjusted_p_values(p_values: np.ndarray) -> np.ndarray:
    """Return p-values that may be compared with one level all together (Holm 1979).

    They hold whatever the tests have to do with each other. The smallest is the p-value of all:
    that no hypothesis is wrong.

    Parameters
    ----------
    p_values : ndarray, (m,)
        One per hypothesis.
    """
    check_shape("p_values", p_values, ("m",))
    order = np.argsort(p_values, kind="stable")
    scaled = p_values[order] * np.arange(len(p_values), 0, -1)
    adjusted = np.empty(len(p_values))
    adjusted[order] = np.minimum(1.0, np.maximum.accumulate(scaled))
    return adjusted


@lru_cache(maxsize=8)
def _tails(n: int) -> np.ndarray:
    """Twice the smaller tail of every count at every point, (m − 1, n + 1)."""
    z = evaluation_points(n)[:, None]
    counts = np.arange(n + 1)
    # P(X ≥ 0) is 1; bdtrc(k, …) is P(X > k).
    above = np.where(counts > 0, bdtrc(np.maximum(counts - 1, 0), n, z), 1.0)
    return 2 * np.minimum(bdtr(counts, n, z), above)


def _probability_of_leaving(n: int, gamma: float) -> float:
    """P(at some point the tail of the count is γ or less), for n uniform numbers.

    Counts between points are independent Poisson numbers of mean n/m, given that all are n. The
    sum is of the ways to leave for the first time, so that a small probability is exact too.
    """
    step, finish = _poisson(n)
    there = np.zeros(n + 1)
    there[0] = 1.0
    left = 0.0
    for stays, ends in zip(_tails(n) > _EQUAL * gamma, finish, strict=True):
        there = np.convolve(there, step)[: n + 1]
        left += float(there[~stays] @ ends[~stays])
        there[~stays] = 0.0
    return min(1.0, left)


@lru_cache(maxsize=8)
def _poisson(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Probabilities of the count between two points, and of the rest, over that of n in all.

    Shapes (n + 1,) and (m − 1, n + 1).
    """
    points = evaluation_points(n)
    counts = np.arange(n + 1)
    rest = poisson.pmf(n - counts, n * (1 - points[:, None]))
    return poisson.pmf(counts, n / (len(points) + 1)), rest / poisson.pmf(n, n)


@lru_cache(maxsize=64)
def _gamma(n: int, level: float) -> float:
    """The largest γ that n uniform numbers come down to with a probability of 1 − level or less."""
    low, high = 0.0, 1.0
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        if _probability_of_leaving(n, middle) <= 1 - level:
            low = middle
        else:
            high = middle
    return low
