"""Test of uniformity: exact probabilities, level and power."""

from itertools import product
from math import factorial, prod

import numpy as np
import pytest
from arviz_stats.ecdf_utils import ecdf_pit
from scipy.stats import binom

from probmotion.metrics.uniformity import (
    adjusted_p_values,
    ecdf_band,
    evaluation_points,
    uniformity_p_value,
)


def cumulative(values):
    return np.searchsorted(np.sort(values), evaluation_points(len(values)), side="right")


def enumeration(n):
    """Return all distributions of n numbers over n equal bins, with γ and probability."""
    points = evaluation_points(n)
    histograms = [bins for bins in product(range(n + 1), repeat=n) if sum(bins) == n]
    gammas, masses = [], []
    for bins in histograms:
        counts = np.cumsum(bins)[:-1]
        below, above = binom.cdf(counts, n, points), binom.sf(counts - 1, n, points)
        gammas.append(2 * np.minimum(below, above).min())
        masses.append(factorial(n) / prod(map(factorial, bins)) / n**n)
    return histograms, np.array(gammas), np.array(masses)


def test_p_values_agree_with_enumeration():
    histograms, gammas, masses = enumeration(5)
    assert masses.sum() == pytest.approx(1)
    for bins, gamma in zip(histograms, gammas, strict=True):
        values = np.repeat((np.arange(5) + 0.5) / 5, bins)
        expected = masses[gammas <= gamma * (1 + 1e-9)].sum()
        assert uniformity_p_value(values) == pytest.approx(expected, abs=1e-12)


def test_the_band_is_left_if_and_only_if_p_is_small():
    rng = np.random.default_rng(1)
    lower, upper = ecdf_band(80, 0.9)
    exits = 0
    for _ in range(150):
        values = rng.random(80) ** rng.uniform(0.7, 1.4)
        ecdf = cumulative(values) / 80
        outside = bool(((ecdf < lower) | (ecdf > upper)).any())
        assert outside == (uniformity_p_value(values) <= 0.1)
        exits += outside
    assert 15 < exits < 135


def test_the_band_agrees_with_arviz():
    rng = np.random.default_rng(2)
    points, _, *theirs = ecdf_pit(rng.random(100), 0.95, 2000, rng=rng)
    np.testing.assert_allclose(points, evaluation_points(100))
    # ArviZ uses 2000 simulations, so its counts may differ by one.
    differences = 100 * np.abs(np.array(ecdf_band(100, 0.95)) - theirs)
    assert differences.max() < 1.01
    assert (differences < 0.01).mean() > 0.8


def test_very_small_p_values_are_exact():
    # All n numbers are below 1/m, which is the least likely count at the first point.
    n = 150
    values = np.full(n, 0.001)
    assert evaluation_points(n)[0] == 0.01
    p = uniformity_p_value(values)
    assert p == pytest.approx(2 * 0.01**n, rel=1e-6)
    assert uniformity_p_value(np.full(1000, 0.5)) < 1e-290


def test_holm_adjustment():
    p = np.array([0.04, 0.01, 0.03, 0.9])
    np.testing.assert_allclose(adjusted_p_values(p), [0.09, 0.04, 0.09, 0.9])
    np.testing.assert_allclose(adjusted_p_values(np.array([0.6, 0.7])), [1, 1])
    np.testing.assert_allclose(adjusted_p_values(np.array([0.2])), [0.2])


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([-0.5, 0.5], r"values must be in \[0, 1\], got -0.5 to 0.5"),
        ([np.nan, 0.5], "values must be finite, got 1 values that are NaN"),
        ([0.5], "n must be an integer of at least 2, got 1"),
    ],
)
def test_invalid_arguments(values, message):
    with pytest.raises(ValueError, match=message):
        uniformity_p_value(np.array(values))
    with pytest.raises(ValueError, match="level must be between 0 and 1, got 1"):
        ecdf_band(10, 1)
