"""Keypoint errors: hand-computed values, plain loops and invalid arguments."""

from functools import partial

import numpy as np
import pytest

from probmotion.metrics.keypoints import (
    fit_linear_map,
    image_extent,
    percentage_of_correct_keypoints as pck,
    velocity_error,
)

N, L, J = 3, 7, 5


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
    # The errors are 0.5, 0.9, 1 and 5; the threshold for size 10 is 1, exclusive.
    predicted = np.array([[[0.5, 0], [0, -0.9], [1, 0], [3, 4]]])
    assert pck(predicted, truth, 10.0) == 50
    assert pck(predicted, truth, 10.1) == 75
    assert pck(predicted, truth, 10.0, threshold=0.51) == 100
    seen = np.array([[True, True, True, False]])
    assert pck(predicted, truth, 10.0, visible=seen) == pytest.approx(200 / 3)


@pytest.mark.parametrize(("size", "expected"), [([11, 9], 50), ([[11, 11], [11, 9]], 75)])
def test_pck_with_a_size_per_sequence_or_frame(size, expected):
    predicted = np.zeros((2, 2, 1, 2))
    predicted[..., 0] = 1
    assert pck(predicted, 0 * predicted, np.array(size)) == expected


def test_pck_agrees_with_a_plain_loop(predicted, truth, visible):
    size = image_extent(truth)
    right = total = 0
    for n, t, j in np.argwhere(visible):
        x, y = predicted[n, t, j] - truth[n, t, j]
        right += (x * x + y * y) ** 0.5 < 0.1 * size[n]
        total += 1
    result = pck(predicted, occluded(truth, visible), size, visible=visible)
    assert result == pytest.approx(100 * right / total)
    assert 0 < right < total


def test_image_extent_by_hand():
    # Over both frames x is in [0, 4] and y in [-1, 2]; without the last keypoint x is in [0, 1].
    keypoints = np.array([[[0, 0], [1, 2]], [[0.5, -1], [4, 0]]])
    assert image_extent(keypoints) == 4
    seen = np.array([[True, True], [True, False]])
    assert image_extent(occluded(keypoints, seen), seen) == 3
    np.testing.assert_array_equal(image_extent(np.stack([keypoints, 2 * keypoints])), [4, 8])


def test_static_frames_have_no_velocity_error():
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
            estimate = (predicted[n, t] - predicted[n, t - 1])[both]
            if both.any():
                ratios.append(np.linalg.norm(estimate - step) / np.linalg.norm(step))
        means.append(np.mean(ratios))
    result = velocity_error(predicted, occluded(truth, visible), visible)
    assert result == pytest.approx(np.mean(means))


def test_linear_map_is_recovered(truth, visible, rng):
    weights = rng.normal(size=(4, J))
    annotated = weights @ truth
    seen = visible[..., :4]
    np.testing.assert_allclose(fit_linear_map(truth, annotated), weights, atol=1e-10)
    result = fit_linear_map(truth, occluded(annotated, seen), seen)
    np.testing.assert_allclose(result, weights, atol=1e-10)
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
ALTERNATING = np.arange(L)[:, None] % 2 < np.ones(J)


@pytest.mark.parametrize(
    ("function", "arguments", "message"),
    [
        (pck, (GOOD, GOOD, np.ones(L)), "size must be a number, or one per sequence"),
        (pck, (GOOD, GOOD, 0.0), "size must be finite and above 0"),
        (pck, (GOOD[:, :, 1:], GOOD, 1.0), "predicted must have shape"),
        (pck, (GOOD, BROKEN, 1.0), "truth must be finite, got 2"),
        (partial(pck, visible=~ALL), (GOOD, GOOD, 1.0), "visible must contain at least one"),
        (partial(pck, visible=1.0 * ALL), (GOOD, GOOD, 1.0), "visible must be boolean, got float6"),
        (image_extent, (GOOD[:, :1, :1],), "keypoints must have an extent above 0"),
        (velocity_error, (GOOD[:2], STATIC), "truth must have a moving visible keypoint"),
        (velocity_error, (GOOD[0], GOOD[0], ALTERNATING), "truth must have a moving visible"),
        (fit_linear_map, (GOOD[0, :2], GOOD[0, :2]), "got rank 4 from the 2 frames of keypoint 0"),
        (fit_linear_map, (GOOD[0], GOOD[0], PARTLY), "rank 2 from the 1 frames of keypoint 3"),
        (fit_linear_map, (GOOD[0][:, [0, 1, 2, 3, 3]], GOOD[0]), "all 5 joints, got rank 4"),
        (fit_linear_map, (GOOD[0], GOOD[0, 1:]), "annotated must have shape"),
    ],
)
def test_invalid_arguments(function, arguments, message):
    with pytest.raises(ValueError, match=message):
        function(*arguments)
