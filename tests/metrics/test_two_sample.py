"""MMD and C2ST against closed forms, a double loop and their own chance level."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from probmotion.metrics.two_sample import (
    classifier_two_sample,
    discrepancy_p_value,
    maximum_mean_discrepancy,
    median_distance,
    principal_coordinates,
    squared_distances,
)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def within(values, expected):
    """Whether the mean is the expected one within four standard errors."""
    return abs(np.mean(values) - expected) < 4 * np.std(values, ddof=1) / math.sqrt(len(values))


def expected_kernel(variance, shift, length_scale):
    """E exp(−‖u‖²/2ℓ²), u ~ N(shift, variance I): a Gaussian integral."""
    widened = length_scale**2 + variance
    dim = len(shift)
    return (length_scale**2 / widened) ** (dim / 2) * math.exp(-shift @ shift / (2 * widened))


def test_squared_distances_are_those_of_subtraction_even_far_from_zero(rng):
    points = rng.normal(size=(20, 7)) + 1e3
    expected = ((points[:, None] - points) ** 2).sum(axis=-1)
    np.testing.assert_allclose(squared_distances(points), expected, rtol=1e-10, atol=1e-12)


def test_median_distance_by_hand():
    # Distances 3, 4, 5, and the median of four points on a line: 1, 1, 1, 2, 2, 3.
    assert median_distance(np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 4.0]])) == pytest.approx(4)
    assert median_distance(np.arange(4.0)[:, None]) == pytest.approx(math.sqrt(2.5))


def test_mmd_is_a_double_loop(rng):
    x, y = rng.normal(size=(9, 3)), rng.normal(size=(12, 3)) + 0.4
    apart = [np.linalg.norm(a - b) for i, a in enumerate(y) for b in y[:i]]
    scale = math.sqrt(np.median(np.square(apart)))

    def mean_kernel(a, b, same):
        found = [
            math.exp(-sum((p - q) ** 2) / (2 * scale**2))
            for i, p in enumerate(a)
            for j, q in enumerate(b)
            if not (same and i == j)
        ]
        return sum(found) / len(found)

    expected = mean_kernel(x, x, True) + mean_kernel(y, y, True) - 2 * mean_kernel(x, y, False)
    assert maximum_mean_discrepancy(x, y) == pytest.approx(expected, rel=1e-10)
    assert maximum_mean_discrepancy(x, y, length_scale=scale) == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize(("shift", "spread"), [(0.0, 1.0), (0.7, 1.0), (0.0, 0.6)])
def test_mmd_of_two_gaussians_is_unbiased(rng, shift, spread):
    offset = np.array([shift, 0.0, 0.0])
    expected = (
        expected_kernel(2.0, 0 * offset, 1.3)
        + expected_kernel(2 * spread**2, 0 * offset, 1.3)
        - 2 * expected_kernel(1 + spread**2, offset, 1.3)
    )
    for n in (3, 30):
        found = [
            maximum_mean_discrepancy(
                spread * rng.normal(size=(n, 3)) + offset,
                rng.normal(size=(20, 3)),
                length_scale=1.3,
            )
            for _ in range(300)
        ]
        assert within(found, expected)
    assert shift == 0 == spread - 1 or abs(expected) > 0.01


def test_mmd_does_not_depend_on_units_place_or_axes(rng):
    x, y = rng.normal(size=(15, 4)), rng.normal(size=(15, 4)) + 0.5
    turned = np.linalg.qr(rng.normal(size=(4, 4)))[0]
    expected = maximum_mean_discrepancy(x, y)
    found = maximum_mean_discrepancy(1000 * x @ turned + 7, 1000 * y @ turned + 7)
    assert found == pytest.approx(expected, rel=1e-9)


def test_the_ruler_is_the_references(rng):
    # Far away draws are as different as can be: 1 + E k(y, y'), whatever they are far by.
    y = rng.normal(size=(20, 2))
    huddled = np.zeros((20, 2))
    values = [maximum_mean_discrepancy(huddled + far, y) for far in (1e3, 1e9)]
    kernel = np.exp(-squared_distances(y) / (2 * median_distance(y) ** 2))
    expected = 1 + (kernel.sum() - 20) / (20 * 19)
    np.testing.assert_allclose(values[0], expected, rtol=1e-9)
    # So far away draws are told from the reference, but no longer from each other.
    assert expected - 1 - 1e-9 < values[1] < expected + 1e-9


def test_p_values_of_exact_sets_are_uniform_and_of_others_small(rng):
    ranks = [
        discrepancy_p_value(rng.normal(size=(20, 3)), rng.normal(size=(30, 3)), i, permutations=19)
        for i in range(200)
    ]
    counts = np.bincount(np.rint(20 * np.array(ranks)).astype(int), minlength=21)[1:]
    assert stats.chisquare(counts).pvalue > 1e-4
    far = rng.normal(size=(40, 3)) + 2
    assert discrepancy_p_value(far, rng.normal(size=(40, 3)), 0) == pytest.approx(1 / 201)


def test_p_value_of_two_points_each_by_enumeration():
    # Of the six labellings of {0, 0.1, 5, 5.1} the two that part near from far are the extremes.
    x, y = np.array([[0.0], [0.1]]), np.array([[5.0], [5.1]])
    found = discrepancy_p_value(x, y, 0, permutations=3000)
    assert found == pytest.approx(1 / 3, abs=4 * math.sqrt(2 / 9 / 3000))


def test_a_classifier_is_blind_to_two_exact_sets(rng):
    n, repeats = 40, 40
    found = [
        classifier_two_sample(rng.normal(size=(n, 8)), rng.normal(size=(n, 8)), seed)
        for seed in range(repeats)
    ]
    assert within(found, 0.5)
    # Folds make guesses depend on each other a little: the binomial deviation within a half.
    assert 0.6 < np.std(found, ddof=1) / math.sqrt(1 / (8 * n)) < 1.6


def test_a_classifier_tells_well_separated_sets(rng):
    for dim in (2, 300):
        x, y = rng.normal(size=(50, dim)), rng.normal(size=(50, dim))
        assert classifier_two_sample(x + 10, y, 0) == 1


@pytest.mark.parametrize("shift", [1.0, 2.0])
def test_a_classifier_comes_near_the_best_there_is(rng, shift):
    # Φ(Δ/2) is the accuracy of who knows both Gaussians; learning costs some of it.
    best = stats.norm.cdf(shift / 2)
    found = []
    for seed in range(8):
        x, y = rng.normal(size=(2, 200, 5))
        x[:, 0] += shift
        found.append(classifier_two_sample(x, y, seed))
    error = np.std(found, ddof=1) / math.sqrt(len(found))
    assert best - 0.05 < np.mean(found) < best + 4 * error


def test_a_classifier_sees_overconfidence(rng):
    # Same mean, four fifths of the spread in forty dimensions: no plane parts them.
    found = [
        classifier_two_sample(0.8 * rng.normal(size=(100, 40)), rng.normal(size=(100, 40)), seed)
        for seed in range(4)
    ]
    assert min(found) > 0.7


def test_a_classifier_sees_what_lies_off_the_manifold(rng):
    # As motions are: twelve directions of metres, and millimetres, here too wide, in all others.
    frame = np.linalg.qr(rng.normal(size=(600, 12)))[0]

    def motions(noise):
        return rng.normal(size=(60, 12)) @ frame.T + noise * rng.normal(size=(60, 600))

    assert classifier_two_sample(motions(0.002), motions(0.001), 0) > 0.95
    assert abs(classifier_two_sample(motions(0.001), motions(0.001), 0) - 0.5) < 4 * 0.05


def test_a_classifier_is_the_same_at_a_seed_and_in_other_units(rng):
    x, y = rng.normal(size=(2, 40, 6))
    expected = classifier_two_sample(x, y + 0.3, 5)
    assert classifier_two_sample(x, y + 0.3, 5) == expected
    assert classifier_two_sample(1000 * x + 7, 1000 * (y + 0.3) + 7, 5) == expected


def test_principal_coordinates_are_standard_and_uncorrelated_and_lose_no_length(rng):
    points = rng.normal(size=(50, 9)) * np.arange(9, 0, -1) + 4
    features = principal_coordinates(points, 4)
    assert features.shape == (50, 5)
    np.testing.assert_allclose(features.mean(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(features.std(axis=0), 1, rtol=1e-12)
    np.testing.assert_allclose(features[:, :4].T @ features[:, :4] / 50, np.eye(4), atol=1e-10)
    # What is left, by the pseudo-inverse: the distance from the span of the first four axes.
    apart = points - points.mean(axis=0)
    _, _, axes = np.linalg.svd(apart, full_matrices=False)
    rest = np.log(((apart @ axes[4:].T) ** 2).sum(axis=1))
    np.testing.assert_allclose(features[:, 4], (rest - rest.mean()) / rest.std(), rtol=1e-8)


def test_principal_coordinates_of_a_flat_set_have_nothing_left(rng):
    flat = rng.normal(size=(30, 2)) @ rng.normal(size=(2, 9))
    assert principal_coordinates(flat, 4).shape == (30, 2)
    assert principal_coordinates(rng.normal(size=(30, 3)), 4).shape == (30, 3)


@pytest.mark.parametrize("test", [maximum_mean_discrepancy, discrepancy_p_value])
def test_sets_are_checked(rng, test):
    more = () if test is maximum_mean_discrepancy else (0,)
    good, hole = rng.normal(size=(8, 3)), np.full((8, 3), np.nan)
    with pytest.raises(ValueError, match=r"reference must have shape \(m, 3\), got \(8, 2\)"):
        test(good, good[:, :2], *more)
    with pytest.raises(
        ValueError, match="draws must be finite, got 24 values that are NaN or infinite"
    ):
        test(hole, good, *more)
    with pytest.raises(ValueError, match="reference has 1 points, expected at least 2"):
        test(good, good[:1], *more)
    with pytest.raises(ValueError, match="points have median distance 0"):
        test(0 * good, 0 * good, *more)


def test_a_classifier_checks_its_sets(rng):
    good = rng.normal(size=(8, 3))
    with pytest.raises(ValueError, match=r"reference must have shape \(8, 3\), got \(7, 3\)"):
        classifier_two_sample(good, good[:7], 0)
    with pytest.raises(ValueError, match="draws has 4 points, expected at least 5"):
        classifier_two_sample(good[:4], good[:4], 0)
    with pytest.raises(ValueError, match="points are 16 times the same"):
        classifier_two_sample(0 * good, 0 * good, 0)
    with pytest.raises(ValueError, match="length_scale must be a finite number above 0, got 0"):
        maximum_mean_discrepancy(good, good, length_scale=0)
