"""Keypoint errors by hand, against plain loops, and invariances."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from probmotion.metrics.keypoints import (
    fit_linear_map,
    image_extent,
    percentage_of_correct_keypoints,
    velocity_error,
)

N, L, J = 3, 7, 5
TURN = Rotation.from_euler("z", 40, degrees=True).as_matrix()[:2, :2]


@pytest.fixture
def truth(rng):
    return rng.normal(size=(N, L, J, 2))


@pytest.fixture
def predicted(rng, truth):
    return truth + 0.3 * rng.normal(size=truth.shape)


@pytest.fixture
def visible(rng):
    return rng.random((N, L, J)) < 0.7


def occluded(keypoints, visible):
    return np.where(visible[..., None], keypoints, np.nan)


def test_pck_by_hand():
    truth = np.zeros((1, 4, 2))
    # Errors 0.5, 0.9, 1 and 5; the threshold for size 10 is 1, exclusive.
    predicted = np.array([[[0.5, 0], [0, -0.9], [1, 0], [3, 4]]])
    assert percentage_of_correct_keypoints(predicted, truth, 10.0) == 50
    assert percentage_of_correct_keypoints(predicted, truth, 10.1) == 75
    assert percentage_of_correct_keypoints(predicted, truth, 10.0, threshold=0.51) == 100
    seen = np.array([[True, True, True, False]])
    found = percentage_of_correct_keypoints(predicted, truth, 10.0, visible=seen)
    assert found == pytest.approx(200 / 3)


@pytest.mark.parametrize(("size", "expected"), [([11, 9], 50), ([[11, 11], [11, 9]], 75)])
def test_pck_with_a_size_per_sequence_or_frame(size, expected):
    predicted = np.zeros((2, 2, 1, 2))
    predicted[..., 0] = 1
    found = percentage_of_correct_keypoints(predicted, 0 * predicted, np.array(size))
    assert found == expected


def test_pck_agrees_with_a_plain_loop(predicted, truth, visible):
    size = image_extent(truth)
    right = total = 0
    for n, t, j in np.argwhere(visible):
        x, y = predicted[n, t, j] - truth[n, t, j]
        right += (x * x + y * y) ** 0.5 < 0.1 * size[n]
        total += 1
    found = percentage_of_correct_keypoints(
        predicted, occluded(truth, visible), size, visible=visible
    )
    assert found == pytest.approx(100 * right / total)
    assert 0 < right < total


def test_image_extent_by_hand():
    # x from 0 to 4, y from -1 to 2 over both frames; without the last keypoint x ends at 1.
    keypoints = np.array([[[0, 0], [1, 2]], [[0.5, -1], [4, 0]]])
    assert image_extent(keypoints) == 4
    seen = np.array([[True, True], [True, False]])
    assert image_extent(occluded(keypoints, seen), seen) == 3
    np.testing.assert_array_equal(image_extent(np.stack([keypoints, 2 * keypoints])), [4, 8])


def test_velocity_error_by_hand():
    # Two joints; true displacements (3, 0 | 0, 4), length 5; then (1, 0 | 0, 0).
    truth = np.array([[[0, 0], [0, 0]], [[3, 0], [0, 4]], [[4, 0], [0, 4]]], float)
    # Predicted displacements (3, 0 | 0, 1), error 3; then (1, 0 | 2, 0), error 2.
    predicted = np.array([[[9, 9], [5, 5]], [[12, 9], [5, 6]], [[13, 9], [7, 6]]], float)
    assert velocity_error(predicted, truth) == pytest.approx((3 / 5 + 2 / 1) / 2)
    # Only the first joint is visible in the last step.
    seen = np.array([[True, True], [True, True], [True, False]])
    assert velocity_error(predicted, occluded(truth, seen), seen) == pytest.approx(3 / 5 / 2)
    # Static frames are skipped.
    truth = np.array([[[0, 0]], [[2, 0]], [[2, 0]], [[2, 4]]], float)
    predicted = np.array([[[0, 0]], [[1, 0]], [[7, 0]], [[7, 3]]], float)
    assert velocity_error(predicted, truth) == pytest.approx((1 / 2 + 1 / 4) / 2)


def test_velocity_error_agrees_with_a_plain_loop(predicted, truth, visible):
    means = []
    for n in range(N):
        ratios = []
        for t in range(1, L):
            both = visible[n, t] & visible[n, t - 1]
            step = (truth[n, t] - truth[n, t - 1])[both]
            guess = (predicted[n, t] - predicted[n, t - 1])[both]
            if both.any():
                ratios.append(np.linalg.norm(guess - step) / np.linalg.norm(step))
        means.append(np.mean(ratios))
    found = velocity_error(predicted, occluded(truth, visible), visible)
    assert found == pytest.approx(np.mean(means))


@pytest.mark.parametrize(("factor", "error"), [(1, 0), (0, 1), (2, 1), (-1, 2)])
def test_velocity_error_of_scaled_and_shifted_predictions(truth, factor, error):
    found = velocity_error(factor * truth + np.array([3.0, -2.0]), truth)
    assert found == pytest.approx(error, abs=1e-12)


def test_linear_map_by_hand():
    # One frame of two joints: w₀ (1, 0) + w₁ (1, 2) = (5, 4).
    predicted = np.array([[[1, 0], [1, 2]]], float)
    np.testing.assert_allclose(fit_linear_map(predicted, np.array([[[5.0, 4.0]]])), [[3, 2]])


def test_linear_map_is_recovered(truth, visible, rng):
    weights = rng.normal(size=(4, J))
    annotated = weights @ truth
    seen = visible[..., :4]
    np.testing.assert_allclose(fit_linear_map(truth, annotated), weights, atol=1e-10)
    found = fit_linear_map(truth, occluded(annotated, seen), seen)
    np.testing.assert_allclose(found, weights, atol=1e-10)
    # A root at the origin has weight 0.
    centred = truth - truth[:, :, 2:3]
    weights[:, 2] = 0
    np.testing.assert_allclose(fit_linear_map(centred, weights @ centred), weights, atol=1e-10)


GOOD = np.random.default_rng(0).normal(size=(N, L, J, 2))
ALL = np.ones((N, L, J), bool)
BROKEN = GOOD.copy()
BROKEN[0, 0, 0] = np.nan
STATIC = np.stack([GOOD[0], 0 * GOOD[0]])
PARTLY = np.ones((L, J), bool)
PARTLY[1:, 3] = False


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: percentage_of_correct_keypoints(GOOD, GOOD, np.ones(L)), "size must be a number"),
        (lambda: percentage_of_correct_keypoints(GOOD, GOOD, 0.0), "size must be finite and above"),
        (
            lambda: percentage_of_correct_keypoints(GOOD, GOOD, 1.0, visible=~ALL),
            "visible must contain at least one keypoint",
        ),
        (
            lambda: percentage_of_correct_keypoints(GOOD, GOOD, 1.0, visible=1.0 * ALL),
            "visible must be boolean, got float64",
        ),
        (
            lambda: percentage_of_correct_keypoints(GOOD[:, :, 1:], GOOD, 1.0),
            "predicted must have shape",
        ),
        (lambda: percentage_of_correct_keypoints(GOOD, BROKEN, 1.0), "truth must be finite, got 2"),
        (lambda: image_extent(GOOD[:, :1, :1]), "keypoints must have an extent above 0"),
        (lambda: velocity_error(GOOD[:2], STATIC), "truth must have a moving visible keypoint"),
        (
            lambda: velocity_error(GOOD[0], GOOD[0], np.arange(L)[:, None] % 2 < np.ones(J)),
            "truth must have a moving visible keypoint",
        ),
        (lambda: fit_linear_map(GOOD[0, :2], GOOD[0, :2]), "got rank 4 from the 2 frames of key"),
        (
            lambda: fit_linear_map(GOOD[0], GOOD[0], PARTLY),
            "rank 2 from the 1 frames of keypoint 3",
        ),
        (
            lambda: fit_linear_map(GOOD[0][:, [0, 1, 2, 3, 3]], GOOD[0]),
            "of all 5 joints, got rank 4",
        ),
        (lambda: fit_linear_map(GOOD[0], GOOD[0, 1:]), "annotated must have shape"),
    ],
)
def test_invalid_arguments(call, message):
    with pytest.raises(ValueError, match=message):
        call()
