"""Support vector machine: predictions of scikit-learn, and optimality of the dual variables."""

import numpy as np
import pytest
from sklearn.model_selection import StratifiedKFold, cross_val_score
from sklearn.svm import SVC

from probmotion.metrics.support_vectors import _kernel, _solved, cross_validated_accuracy


@pytest.mark.parametrize("n", [5, 13, 100, 400])
@pytest.mark.parametrize("shift", [0.0, 0.5, 3.0])
def test_accuracies_are_those_of_scikit_learn(n, shift, rng):
    for dim in (1, 6, 30):
        features = rng.normal(size=(2 * n, dim))
        features[n:] = 1.1 * features[n:] + shift * (np.arange(dim) == 0)
        labels, seed = np.repeat([0, 1], n), int(rng.integers(2**32))
        folds = StratifiedKFold(5, shuffle=True, random_state=seed)
        expected = cross_val_score(SVC(), features, labels, cv=folds).mean()
        assert cross_validated_accuracy(features, labels, 5, seed) == expected


def test_kernel_of_close_points_is_at_most_one(rng):
    """Also if differences are lost to rounding."""
    points = 1e3 + 1e-6 * rng.normal(size=(50, 6))
    kernel = _kernel(points, points, 1 / (6 * points.var()))
    assert kernel.max() <= 1


@pytest.mark.parametrize("outlier", [1e8, 1e12])
def test_accuracy_with_a_diverged_point_is_that_of_scikit_learn(outlier, rng):
    features, labels = rng.normal(size=(200, 6)), np.repeat([0, 1], 100)
    features[0] *= outlier
    folds = StratifiedKFold(5, shuffle=True, random_state=0)
    expected = cross_val_score(SVC(), features, labels, cv=folds).mean()
    assert cross_validated_accuracy(features, labels, 5, 0) == pytest.approx(expected, abs=0.03)


def test_ties_are_resolved_as_by_scikit_learn():
    # At the start, all points are equally steep.
    labels = np.repeat([0, 1], 60)
    for seed in range(25):
        features = np.random.default_rng(seed).normal(size=(120, 2))
        features[60:] *= 1.1
        folds = StratifiedKFold(5, shuffle=True, random_state=seed)
        expected = cross_val_score(SVC(), features, labels, cv=folds).mean()
        assert cross_validated_accuracy(features, labels, 5, seed) == expected


def test_an_offset_without_free_variables_is_in_the_middle_of_its_range():
    # Both variables are at their bound C = 1; margins of at most 1 allow offsets from 0 to 1/2.
    alpha, offset = _solved(np.diag([1.0, 0.5]), np.array([1.0, -1.0]))
    np.testing.assert_array_equal(alpha, 1)
    assert offset == 0.25


def test_equal_points_of_both_classes_are_classified_as_by_scikit_learn(rng):
    points = rng.normal(size=(30, 4)).round(1)
    features, labels = np.concatenate([points, points]), np.repeat([0, 1], 30)
    folds = StratifiedKFold(5, shuffle=True, random_state=1)
    expected = cross_val_score(SVC(), features, labels, cv=folds).mean()
    assert cross_validated_accuracy(features, labels, 5, 1) == expected


def test_dual_variables_satisfy_the_conditions_of_optimality(rng):
    points = rng.normal(size=(300, 3))
    signs = np.repeat([1.0, -1.0], 150)
    points[150:, 0] += 1
    alpha, offset = _solved(_kernel(points, points, 0.5), signs)
    assert alpha.min() >= 0
    assert alpha.max() <= 1
    assert alpha @ signs == pytest.approx(0, abs=1e-12)
    margins = signs * (_kernel(points, points, 0.5) @ (alpha * signs) - offset)
    free = (alpha > 0) & (alpha < 1)
    assert free.sum() > 10
    np.testing.assert_allclose(margins[free], 1, atol=2e-3)
    assert margins[alpha == 0].min() > 1 - 2e-3
    assert margins[alpha == 1].max() < 1 + 2e-3
