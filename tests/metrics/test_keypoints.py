"""Measures of keypoints: numbers worked out by hand, plain loops, and what changes nothing."""

from __future__ import annotations

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
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture
def truth(rng: np.random.Generator) -> np.ndarray:
    return rng.normal(size=(N, L, J, 2))


@pytest.fixture
def predicted(rng: np.random.Generator, truth: np.ndarray) -> np.ndarray:
    return truth + 0.3 * rng.normal(size=truth.shape)


@pytest.fixture
def visible(rng: np.random.Generator) -> np.ndarray:
    return rng.random((N, L, J)) < 0.7


def hidden(keypoints: np.ndarray, visible: np.ndarray) -> np.ndarray:
    return np.where(visible[..., None], keypoints, np.nan)


class TestCorrectKeypoints:
    def test_by_hand(self) -> None:
        truth = np.zeros((1, 4, 2))
        # Errors 0.5, 0.9, 1 and 5 (3-4-5); of a picture 10 across, .1 is 1, and 1 is not below it.
        predicted = np.array([[[0.5, 0], [0, -0.9], [1, 0], [3, 4]]])
        assert percentage_of_correct_keypoints(predicted, truth, 10.0) == 50
        assert percentage_of_correct_keypoints(predicted, truth, 10.1) == 75
        assert percentage_of_correct_keypoints(predicted, truth, 10.0, share=0.51) == 100
        seen = np.array([[True, False, True, False]])
        assert percentage_of_correct_keypoints(predicted, truth, 10.0, visible=seen) == 50
        seen = np.array([[True, True, True, False]])
        assert percentage_of_correct_keypoints(
            predicted, truth, 10.0, visible=seen
        ) == pytest.approx(200 / 3)

    def test_every_frame_or_sequence_has_its_size(self) -> None:
        predicted = np.zeros((2, 2, 1, 2))
        predicted[..., 0] = [[[1], [1]], [[1], [1]]]
        truth = np.zeros_like(predicted)

        def percentage(size: list[float] | list[list[float]]) -> float:
            return percentage_of_correct_keypoints(predicted, truth, np.array(size))

        assert percentage([11, 9]) == 50
        assert percentage([[11, 11], [11, 9]]) == 75

    def test_a_plain_loop_says_the_same(
        self, predicted: np.ndarray, truth: np.ndarray, visible: np.ndarray
    ) -> None:
        size = image_extent(truth)
        right = total = 0
        for n in range(N):
            for t in range(L):
                for j in range(J):
                    if visible[n, t, j]:
                        x, y = predicted[n, t, j] - truth[n, t, j]
                        right += (x * x + y * y) ** 0.5 < 0.1 * size[n]
                        total += 1
        assert percentage_of_correct_keypoints(
            predicted, hidden(truth, visible), size, visible=visible
        ) == pytest.approx(100 * right / total)
        assert 0 < right < total

    def test_place_turn_and_scale_of_the_picture_change_nothing(
        self, predicted: np.ndarray, truth: np.ndarray
    ) -> None:
        found = percentage_of_correct_keypoints(predicted, truth, 4.0)
        moved = percentage_of_correct_keypoints(3 * predicted @ TURN + 5, 3 * truth @ TURN + 5, 12)
        assert moved == found
        assert percentage_of_correct_keypoints(truth, truth, 4.0) == 100

    def test_worse_is_worse(self, predicted: np.ndarray, truth: np.ndarray) -> None:
        further = truth + 2 * (predicted - truth)
        swapped = truth[:, :, ::-1]
        good = percentage_of_correct_keypoints(predicted, truth, 4.0)
        assert percentage_of_correct_keypoints(further, truth, 4.0) < good
        assert percentage_of_correct_keypoints(swapped, truth, 4.0) < good

    def test_bad_input(self, truth: np.ndarray) -> None:
        with pytest.raises(ValueError, match=r"size must have shape one number, or, got \(7,\)"):
            percentage_of_correct_keypoints(truth, truth, np.ones(L))
        with pytest.raises(ValueError, match="size has entries that are not finite numbers above"):
            percentage_of_correct_keypoints(truth, truth, 0.0)
        with pytest.raises(ValueError, match="visible has no keypoint in any frame"):
            percentage_of_correct_keypoints(
                truth, truth, 1.0, visible=np.zeros(truth.shape[:-1], bool)
            )
        with pytest.raises(ValueError, match="visible has entries of float64, expected truth"):
            percentage_of_correct_keypoints(truth, truth, 1.0, visible=np.ones(truth.shape[:-1]))
        with pytest.raises(ValueError, match="predicted has shape"):
            percentage_of_correct_keypoints(truth[:, :, 1:], truth, 1.0)
        unseen = hidden(truth, np.arange(N * L * J).reshape(N, L, J) > 0)
        with pytest.raises(
            ValueError, match="truth must be finite, got 2 values that are NaN or infinite"
        ):
            percentage_of_correct_keypoints(truth, unseen, 1.0)


class TestPictureSize:
    def test_by_hand(self) -> None:
        # x from 0 to 4, y from -1 to 2 over both frames; without the last keypoint x ends at 1.
        keypoints = np.array([[[0, 0], [1, 2]], [[0.5, -1], [4, 0]]])
        assert image_extent(keypoints) == 4
        seen = np.array([[True, True], [True, False]])
        assert image_extent(hidden(keypoints, seen), seen) == 3
        np.testing.assert_array_equal(image_extent(np.stack([keypoints, 2 * keypoints])), [4, 8])

    def test_a_point_has_no_size(self) -> None:
        for seen in (np.eye(2, dtype=bool)[:1], np.zeros((1, 2), bool)):
            with pytest.raises(ValueError, match="keypoints has a sequence whose visible ones are"):
                image_extent(np.array([[[0.0, 1.0], [2.0, 3.0]]]), seen)


class TestVelocityError:
    def test_by_hand(self) -> None:
        # Two joints; the truth's displacements: (3, 0 | 0, 4), length 5; then (1, 0 | 0, 0).
        truth = np.array([[[0, 0], [0, 0]], [[3, 0], [0, 4]], [[4, 0], [0, 4]]], float)
        # Predicted displacements: (3, 0 | 0, 1), off by 3; then (1, 0 | 2, 0), off by 2.
        predicted = np.array([[[9, 9], [5, 5]], [[12, 9], [5, 6]], [[13, 9], [7, 6]]], float)
        assert velocity_error(predicted, truth) == pytest.approx((3 / 5 + 2 / 1) / 2)
        # The second joint hidden in the last frame: only the first joint's last step counts.
        seen = np.array([[True, True], [True, True], [True, False]])
        assert velocity_error(predicted, hidden(truth, seen), seen) == pytest.approx(3 / 5 / 2)

    def test_a_frame_without_motion_does_not_count(self) -> None:
        truth = np.array([[[0, 0]], [[2, 0]], [[2, 0]], [[2, 4]]], float)
        predicted = np.array([[[0, 0]], [[1, 0]], [[7, 0]], [[7, 3]]], float)
        assert velocity_error(predicted, truth) == pytest.approx((1 / 2 + 1 / 4) / 2)
        with pytest.raises(ValueError, match="truth has a sequence without any visible keypoint"):
            velocity_error(np.stack([predicted, predicted]), np.stack([truth, 0 * truth]))
        with pytest.raises(ValueError, match="truth has a sequence without any visible keypoint"):
            velocity_error(predicted, truth, np.array([[True], [False], [True], [False]]))

    def test_a_plain_loop_says_the_same(
        self, predicted: np.ndarray, truth: np.ndarray, visible: np.ndarray
    ) -> None:
        means = []
        for n in range(N):
            ratios = []
            for t in range(1, L):
                off = length = 0.0
                for j in range(J):
                    if visible[n, t, j] and visible[n, t - 1, j]:
                        for axis in range(2):
                            step = truth[n, t, j, axis] - truth[n, t - 1, j, axis]
                            guess = predicted[n, t, j, axis] - predicted[n, t - 1, j, axis]
                            off += (guess - step) ** 2
                            length += step**2
                if length:
                    ratios.append((off / length) ** 0.5)
            means.append(sum(ratios) / len(ratios))
        assert velocity_error(predicted, hidden(truth, visible), visible) == pytest.approx(
            np.mean(means)
        )

    def test_known_predictions(self, truth: np.ndarray) -> None:
        place = np.array([3.0, -2.0])
        assert velocity_error(truth + place, truth) == pytest.approx(0, abs=1e-12)
        assert velocity_error(0 * truth, truth) == pytest.approx(1)
        assert velocity_error(2 * truth, truth) == pytest.approx(1)
        assert velocity_error(-truth, truth) == pytest.approx(2)

    def test_turn_and_scale_of_the_picture_change_nothing(
        self, predicted: np.ndarray, truth: np.ndarray
    ) -> None:
        found = velocity_error(predicted, truth)
        assert velocity_error(3 * predicted @ TURN, 3 * truth @ TURN) == pytest.approx(found)

    def test_trembling_is_worse(
        self, predicted: np.ndarray, truth: np.ndarray, rng: np.random.Generator
    ) -> None:
        trembling = predicted + 0.3 * rng.normal(size=truth.shape)
        assert velocity_error(trembling, truth) > velocity_error(predicted, truth)


class TestLinearMap:
    def test_by_hand(self) -> None:
        # One frame of two joints: 2 equations for 2 weights. w₀ (1, 0) + w₁ (1, 2) = (5, 4).
        predicted = np.array([[[1, 0], [1, 2]]], float)
        np.testing.assert_allclose(fit_linear_map(predicted, np.array([[[5.0, 4.0]]])), [[3, 2]])

    def test_a_linear_map_is_found_again(
        self, truth: np.ndarray, visible: np.ndarray, rng: np.random.Generator
    ) -> None:
        weights = rng.normal(size=(4, J))
        annotated = weights @ truth
        seen = visible[..., :4]
        np.testing.assert_allclose(fit_linear_map(truth, annotated), weights, atol=1e-10)
        found = fit_linear_map(truth, hidden(annotated, seen), seen)
        np.testing.assert_allclose(found @ truth, annotated, atol=1e-10)

    def test_no_other_weights_are_nearer(self, truth: np.ndarray, rng: np.random.Generator) -> None:
        annotated = rng.normal(size=(N, L, 4, 2))
        weights = fit_linear_map(truth, annotated)

        def error(w: np.ndarray) -> float:
            return float(((w @ truth - annotated) ** 2).sum())

        for _ in range(20):
            assert error(weights + 0.01 * rng.normal(size=weights.shape)) > error(weights)
        # x and y are alike: a turned picture has the same weights.
        np.testing.assert_allclose(fit_linear_map(truth @ TURN, annotated @ TURN), weights)

    def test_the_root_at_the_origin_has_no_weight(
        self, truth: np.ndarray, rng: np.random.Generator
    ) -> None:
        centred = truth - truth[:, :, 2:3]
        weights = rng.normal(size=(4, J))
        weights[:, 2] = 0
        np.testing.assert_allclose(fit_linear_map(centred, weights @ centred), weights, atol=1e-10)

    def test_mapped_joints_are_measured(self, truth: np.ndarray, rng: np.random.Generator) -> None:
        annotated = truth[:, :, ::-1]  # the same joints in another order
        mapped = fit_linear_map(truth, annotated) @ truth
        assert percentage_of_correct_keypoints(mapped, annotated, 1.0) == 100
        assert percentage_of_correct_keypoints(truth, annotated, 1.0) < 50

    def test_too_few_frames_are_refused(self, truth: np.ndarray) -> None:
        # Two frames have four equations, for the weights of five joints.
        with pytest.raises(ValueError, match=r"2 frames for keypoint 0 that determine 4 of the"):
            fit_linear_map(truth[0, :2], truth[0, :2])
        seen = np.ones((L, J), bool)
        seen[1:, 3] = False
        with pytest.raises(ValueError, match=r"1 frames for keypoint 3 that determine 2 of the"):
            fit_linear_map(truth[0], truth[0], seen)
        twins = truth[0][:, [0, 1, 2, 3, 3]]
        with pytest.raises(ValueError, match="determine 4 of the weights of 5 joints"):
            fit_linear_map(twins, truth[0])
        with pytest.raises(ValueError, match="annotated has shape"):
            fit_linear_map(truth[0], truth[0, 1:])
