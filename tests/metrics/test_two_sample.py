"""MMD and classifier two-sample test: closed forms, a double loop and chance level."""

import math
from functools import partial

import numpy as np
import pytest
from scipy import stats
from sklearn.decomposition import PCA

from probmotion.metrics.two_sample import (
    accuracy_sd,
    classifier_two_sample,
    discrepancy_p_value,
    maximum_mean_discrepancy,
    median_distance,
    principal_components,
    principal_coordinates,
    squared_distances,
)


def test_distances_by_hand_and_far_from_zero(rng):
    # The distances are 3, 4, 5 and 1, 1, 1, 2, 2, 3.
    assert median_distance(np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 4.0]])) == pytest.approx(4)
    assert median_distance(np.arange(4.0)[:, None]) == pytest.approx(math.sqrt(2.5))
    points = rng.normal(size=(20, 7)) + 1e3
    expected = ((points[:, None] - points) ** 2).sum(axis=-1)
    np.testing.assert_allclose(squared_distances(points), expected, rtol=1e-10, atol=1e-12)


def test_mmd_agrees_with_a_double_loop(rng):
    x, y = rng.normal(size=(9, 3)), rng.normal(size=(12, 3)) + 0.4
    distances = [np.linalg.norm(a - b) for i, a in enumerate(y) for b in y[:i]]
    scale = math.sqrt(np.median(np.square(distances)))

    def mean_kernel(a, b):
        values = [
            math.exp(-sum((p - q) ** 2) / (2 * scale**2))
            for i, p in enumerate(a)
            for j, q in enumerate(b)
            if a is not b or i != j
        ]
        return np.mean(values)

    expected = mean_kernel(x, x) + mean_kernel(y, y) - 2 * mean_kernel(x, y)
    assert maximum_mean_discrepancy(x, y) == pytest.approx(expected, rel=1e-10)
    assert maximum_mean_discrepancy(x, y, length_scale=scale) == pytest.approx(expected, rel=1e-10)


def test_mmd_is_invariant_to_units_position_and_axes(rng):
    x, y = rng.normal(size=(15, 4)), rng.normal(size=(15, 4)) + 0.5
    rotation = np.linalg.qr(rng.normal(size=(4, 4)))[0]
    expected = maximum_mean_discrepancy(x, y)
    result = maximum_mean_discrepancy(1000 * x @ rotation + 7, 1000 * y @ rotation + 7)
    assert result == pytest.approx(expected, rel=1e-9)


def test_mmd_of_distant_draws(rng):
    # The limit is 1 + E k(y, y'), with the length scale of the reference.
    y = rng.normal(size=(20, 2))
    kernel = np.exp(-squared_distances(y) / (2 * median_distance(y) ** 2))
    expected = 1 + (kernel.sum() - 20) / (20 * 19)
    far = np.full((20, 2), 1e3)
    assert maximum_mean_discrepancy(far, y) == pytest.approx(expected, rel=1e-9)


def test_p_values_are_uniform_for_exact_sets(rng):
    ranks = [
        discrepancy_p_value(rng.normal(size=(20, 3)), rng.normal(size=(30, 3)), i, permutations=19)
        for i in range(200)
    ]
    counts = np.bincount(np.rint(20 * np.array(ranks)).astype(int), minlength=21)[1:]
    assert stats.chisquare(counts).pvalue > 1e-4
    far = rng.normal(size=(40, 3)) + 2
    assert discrepancy_p_value(far, rng.normal(size=(40, 3)), 0) == pytest.approx(1 / 201)


def test_p_value_by_enumeration():
    # Two of the six labellings of {0, 0.1, 5, 5.1} separate small from large values.
    x, y = np.array([[0.0], [0.1]]), np.array([[5.0], [5.1]])
    result = discrepancy_p_value(x, y, 0, permutations=3000)
    assert result == pytest.approx(1 / 3, abs=4 * math.sqrt(2 / 9 / 3000))


def test_classifier_accuracy_is_a_half_for_exact_sets(rng):
    n, repeats = 40, 40
    values = [
        classifier_two_sample(rng.normal(size=(n, 8)), rng.normal(size=(n, 8)), seed)
        for seed in range(repeats)
    ]
    deviation = np.std(values, ddof=1)
    assert abs(np.mean(values) - 0.5) < 4 * deviation / math.sqrt(repeats)
    # Folds are correlated: the standard deviation is binomial within a factor.
    assert 0.6 < deviation / math.sqrt(1 / (8 * n)) < 1.6


def test_classifier_accuracy_is_close_to_optimal(rng):
    # The Bayes classifier of two Gaussians has accuracy Φ(Δ/2).
    best = stats.norm.cdf(2 / 2)
    values = []
    for seed in range(8):
        x, y = rng.normal(size=(2, 200, 5))
        x[:, 0] += 2
        values.append(classifier_two_sample(x, y, seed))
    error = np.std(values, ddof=1) / math.sqrt(len(values))
    assert best - 0.05 < np.mean(values) < best + 4 * error


def test_classifier_detects_errors_off_the_manifold(rng):
    # The variation is metres along twelve directions and millimetres along all others.
    frame = np.linalg.qr(rng.normal(size=(600, 12)))[0]

    def motions(noise):
        return rng.normal(size=(60, 12)) @ frame.T + noise * rng.normal(size=(60, 600))

    assert classifier_two_sample(motions(0.002), motions(0.001), 0) > 0.95


def test_principal_coordinates_are_standardised_and_uncorrelated(rng):
    points = rng.normal(size=(50, 9)) * np.arange(9, 0, -1) + 4
    features = principal_coordinates(points, 4)
    assert features.shape == (50, 5)
    np.testing.assert_allclose(features.mean(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(features.std(axis=0), 1, rtol=1e-12)
    np.testing.assert_allclose(features[:, :4].T @ features[:, :4] / 50, np.eye(4), atol=1e-10)
    # The residual is the distance from the span of the first four axes; flat sets lack it.
    centred = points - points.mean(axis=0)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    log_residual = np.log(((centred @ axes[4:].T) ** 2).sum(axis=1))
    np.testing.assert_allclose(features[:, 4], stats.zscore(log_residual), rtol=1e-8)
    flat = rng.normal(size=(30, 2)) @ rng.normal(size=(2, 9))
    assert principal_coordinates(flat, 4).shape == (30, 2)
    assert principal_coordinates(rng.normal(size=(30, 3)), 4).shape == (30, 3)


def test_the_deviation_of_the_accuracy_includes_the_correlation_of_folds(rng):
    pairs = rng.normal(size=(80, 2, 100, 5))
    accuracies = [classifier_two_sample(*pair, seed=0) for pair in pairs]
    # The standard error of the ratio is .08; 1/√(8n) alone would give 1.3.
    assert 0.7 < np.std(accuracies) / accuracy_sd(100) < 1.1


GOOD = np.random.default_rng(0).normal(size=(8, 3))
SAME = np.zeros((8, 3))


@pytest.mark.parametrize(
    ("test", "draws", "reference", "message"),
    [
        (maximum_mean_discrepancy, GOOD, GOOD[:, :2], r"reference must have shape \(m, 3\), got"),
        (maximum_mean_discrepancy, GOOD * np.nan, GOOD, "draws must be finite, got 24 values"),
        (maximum_mean_discrepancy, GOOD, GOOD[:1], "reference must have at least 2 points, got 1"),
        (maximum_mean_discrepancy, SAME, SAME, "points must have a median distance above 0, got 0"),
        (partial(maximum_mean_discrepancy, length_scale=0), GOOD, GOOD, "length_scale must be a"),
        (partial(discrepancy_p_value, seed=0), GOOD, GOOD[:, :2], "reference must have shape"),
        (partial(classifier_two_sample, seed=0), GOOD, GOOD[:7], r"reference must have shape \(8,"),
        (partial(classifier_two_sample, seed=0), GOOD[:4], GOOD[:4], "draws must have at least 5"),
        (partial(classifier_two_sample, seed=0), SAME, SAME, "points must differ, got 16 equal"),
    ],
)
def test_invalid_arguments(test, draws, reference, message):
    with pytest.raises(ValueError, match=message):
        test(draws, reference)


@pytest.mark.parametrize(
    ("n", "dim", "k"), [(40, 9, 9), (300, 20, 3), (600, 510, 20), (200, 700, 8), (700, 90, 80)]
)
def test_principal_components_are_those_of_scikit_learn(n, dim, k, rng):
    scales = np.geomspace(1, 0.01, dim)
    points = 3 + (rng.normal(size=(n, dim)) * scales) @ stats.ortho_group.rvs(dim, random_state=rng)
    oracle = PCA(k, random_state=0)
    coordinates, directions = principal_components(points, k)
    np.testing.assert_allclose(coordinates, oracle.fit_transform(points), atol=1e-10)
    np.testing.assert_allclose(directions, oracle.components_, atol=1e-10)
