"""Distances between sets of draws, against known cases and POT."""

import math

import array_api_strict
import jax
import numpy as np
import ot
import pytest
import torch

from probmotion.arrays import to_numpy
from probmotion.metrics.distribution import (
    mean_error,
    precision_recall,
    random_directions,
    sliced_wasserstein,
    sliced_wasserstein_ratio,
    trace_ratio,
)


@pytest.fixture
def directions(rng):
    return random_directions(rng, 64, 5)


def test_directions_are_uniform_on_the_sphere(rng):
    directions = random_directions(rng, 4000, 3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, rtol=1e-12)
    # Each coordinate has mean 0 and variance 1/3; the tolerance is four standard errors.
    assert np.abs(directions.mean(axis=0)).max() < 4 * math.sqrt(1 / 3 / 4000)
    assert np.abs((directions**2).mean(axis=0) - 1 / 3).max() < 4 * math.sqrt(4 / 45 / 4000)


def test_sliced_wasserstein_agrees_with_pot(rng, directions):
    x, y = rng.normal(size=(50, 5)), 2 * rng.normal(size=(50, 5)) + 1
    expected = ot.sliced_wasserstein_distance(x, y, projections=directions.T, p=2)
    assert sliced_wasserstein(x, y, directions) == pytest.approx(expected, rel=1e-12)


def test_the_ratio_is_one_for_exact_draws_and_grows_with_an_error(rng, directions):
    ratios = [
        [
            sliced_wasserstein_ratio(
                rng.normal(size=(200, 5)) + error, rng.normal(size=(4, 200, 5)), directions
            )
            for _ in range(20)
        ]
        for error in (0.0, 0.5, 1.0)
    ]
    exact, half, full = np.mean(ratios, axis=1)
    assert abs(exact - 1) < 4 * np.std(ratios[0], ddof=1) / math.sqrt(20)
    assert 2 < half < full - 1


def test_trace_ratio_and_mean_error_of_a_scaled_and_shifted_set(rng):
    x = rng.normal(size=(60, 4))
    assert trace_ratio(3 * x + 1, x) == pytest.approx(9)
    shift = np.array([1.0, -2.0, 0.0, 2.0])
    expected = 3 / math.sqrt(np.trace(np.cov(x.T)))
    assert mean_error(x + shift, x) == pytest.approx(expected)


@pytest.mark.parametrize("make", [array_api_strict.asarray, torch.asarray, jax.numpy.asarray])
def test_all_libraries_agree(rng, directions, make):
    x, y = rng.normal(size=(30, 5)), rng.normal(size=(30, 5)) + 0.3
    with jax.enable_x64(True):
        for function in (
            trace_ratio,
            mean_error,
            lambda a, b: sliced_wasserstein(a, b, directions),
        ):
            result = float(to_numpy(function(make(x), make(y))))
            assert result == pytest.approx(float(function(x, y)), rel=1e-12)


def test_precision_and_recall_by_hand_on_a_line():
    reference = np.array([[0.0], [1.0], [2.0], [10.0]])  # 1st neighbours' distances 1, 1, 1, 8
    draws = np.array([[2.5], [3.5], [17.0], [30.0]])  # 1, 1, 13, 13
    # 2.5 is within 1 of 2, and 3.5 and 17 within 8 of 10; 2 is within 1 of 2.5, 10 within 13 of 17.
    assert precision_recall(draws, reference, neighbours=1) == (0.75, 0.5)


def test_invalid_arguments(directions):
    points = np.zeros((40, 5))
    with pytest.raises(ValueError, match=r"y must have shape \(40, 5\), got \(30, 5\)"):
        sliced_wasserstein(points, points[:30], directions)
    with pytest.raises(ValueError, match="references must have at least 2 sets, got 1"):
        sliced_wasserstein_ratio(points, [points], directions)
    with pytest.raises(ValueError, match="draws must have more than neighbours=3 points, got 3"):
        precision_recall(points[:3], points)
