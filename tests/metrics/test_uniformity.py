"""The test of uniformity: its probabilities are exact, and it finds what is not uniform."""

from __future__ import annotations

from itertools import product
from math import factorial, prod

import numpy as np
import pytest
from arviz_stats.ecdf_utils import ecdf_pit
from scipy.stats import binom, binomtest

from probmotion.metrics.uniformity import (
    adjusted_p_values,
    ecdf_band,
    evaluation_points,
    uniformity_p_value,
)


def counted(values):
    return np.searchsorted(np.sort(values), evaluation_points(len(values)), side="right")


def by_counting(n):
    """γ and probability of every way to put n numbers into n equal cells."""
    points = evaluation_points(n)
    ways = [cells for cells in product(range(n + 1), repeat=n) if sum(cells) == n]
    gammas, chances = [], []
    for cells in ways:
        counts = np.cumsum(cells)[:-1]
        below, above = binom.cdf(counts, n, points), binom.sf(counts - 1, n, points)
        gammas.append(2 * np.minimum(below, above).min())
        chances.append(factorial(n) / prod(map(factorial, cells)) / n**n)
    return ways, np.array(gammas), np.array(chances)


def test_it_is_exact_for_all_ways_that_five_numbers_can_fall():
    ways, gammas, chances = by_counting(5)
    assert chances.sum() == pytest.approx(1)
    for cells, gamma in zip(ways, gammas, strict=True):
        values = np.repeat((np.arange(5) + 0.5) / 5, cells)
        expected = chances[gammas <= gamma * (1 + 1e-9)].sum()
        assert uniformity_p_value(values) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("n", [40, 120])
def test_uniform_numbers_are_rejected_as_often_as_the_level_says(n):
    rng = np.random.default_rng(0)
    p_values = np.array([uniformity_p_value(rng.random(n)) for _ in range(300)])
    for level in (0.05, 0.2, 0.5):
        rejected = int((p_values <= level).sum())
        assert binomtest(rejected, 300, level, alternative="greater").pvalue > 1e-3
        # The statistic is discrete, but its steps are small.
        assert binomtest(rejected, 300, level, alternative="less").pvalue > 1e-3


def test_the_band_is_left_where_and_only_where_p_is_small():
    rng = np.random.default_rng(1)
    lower, upper = ecdf_band(80, 0.9)
    left = 0
    for _ in range(150):
        values = rng.random(80) ** rng.uniform(0.7, 1.4)
        share = counted(values) / 80
        outside = bool(((share < lower) | (share > upper)).any())
        assert outside == (uniformity_p_value(values) <= 0.1)
        left += outside
    assert 15 < left < 135


@pytest.mark.parametrize("n", [30, 100])
def test_the_band_is_that_which_another_implementation_simulates(n):
    rng = np.random.default_rng(2)
    points, _, lower, upper = ecdf_pit(rng.random(n), 0.95, 2000, rng=rng)
    np.testing.assert_allclose(points, evaluation_points(n))
    ours = ecdf_band(n, 0.95)
    # Its level is of 2000 simulations: a count more or less.
    assert np.abs(ours[0] - lower).max() * n < 1.01
    assert np.abs(ours[1] - upper).max() * n < 1.01
    assert np.mean(np.abs(ours[0] - lower) * n < 0.01) > 0.8


def test_what_is_not_uniform_is_found():
    rng = np.random.default_rng(3)
    u = rng.random(150)
    assert uniformity_p_value(u) > 0.05
    assert uniformity_p_value(u**1.7) < 1e-3
    assert uniformity_p_value(0.5 + 0.65 * (u - 0.5)) < 1e-3
    assert uniformity_p_value(np.where(u < 0.5, 4 * u**3, 1 - 4 * (1 - u) ** 3)) < 1e-3


def test_a_very_small_probability_is_exact_too():
    # All of n numbers below 1/m: no count is less likely than n at the first point.
    n = 150
    values = np.full(n, 0.001)
    assert evaluation_points(n)[0] == 0.01
    p = uniformity_p_value(values)
    assert p == pytest.approx(2 * 0.01**n, rel=1e-6)
    assert uniformity_p_value(np.full(1000, 0.5)) < 1e-290


def test_holm():
    p = np.array([0.04, 0.01, 0.03, 0.9])
    np.testing.assert_allclose(adjusted_p_values(p), [0.09, 0.04, 0.09, 0.9])
    np.testing.assert_allclose(adjusted_p_values(np.array([0.6, 0.7])), [1, 1])
    np.testing.assert_allclose(adjusted_p_values(np.array([0.2])), [0.2])


def test_wrong_input_is_named():
    with pytest.raises(ValueError, match=r"values run from -0.5 to 0.5, expected numbers in \[0"):
        uniformity_p_value(np.array([-0.5, 0.5]))
    with pytest.raises(ValueError, match="values must be finite, got 1 values that are NaN"):
        uniformity_p_value(np.array([np.nan, 0.5]))
    with pytest.raises(ValueError, match="n must be an integer of at least 2, got 1"):
        uniformity_p_value(np.array([0.5]))
    with pytest.raises(ValueError, match="level must be a number between 0 and 1, got 1"):
        ecdf_band(10, 1)
