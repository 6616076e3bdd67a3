"""Errors against the truth: known values, agreement with roma and between array libraries."""

import array_api_strict
import jax
import numpy as np
import pytest
import roma
import torch

from probmotion.arrays import to_numpy
from probmotion.metrics.accuracy import (
    acceleration_error,
    acceleration_ratio,
    aligned_by_root,
    aligned_by_similarity,
    joint_errors,
    mean_over,
)

L, J = 6, 5
MAKE = {"strict": array_api_strict.asarray, "torch": torch.asarray, "jax": jax.numpy.asarray}


@pytest.fixture
def truth(rng):
    return rng.normal(size=(L, J, 3))


def test_means_of_the_errors_of_shifted_joints(truth):
    np.testing.assert_allclose(mean_over(joint_errors(truth + np.array([3, 0, 4]), truth)), 5)
    changed = truth.copy()
    changed[2, 1, 0] += 0.5
    mask = np.zeros((L, J), dtype=bool)
    mask[2, :2] = True
    errors = joint_errors(np.stack([changed, truth]), truth)
    np.testing.assert_allclose(mean_over(errors, mask), [0.25, 0])
    np.testing.assert_allclose(mean_over(errors, ~mask), [0, 0])
    with pytest.raises(ValueError, match="mask must select at least one joint"):
        mean_over(errors, np.zeros((L, J), dtype=bool))


def test_root_alignment_is_invariant_to_the_root_path(truth, rng):
    path = rng.normal(size=(L, 1, 3))
    expected = aligned_by_root(truth, root=2)
    np.testing.assert_allclose(aligned_by_root(truth + path, root=2), expected, atol=1e-12)
    assert (expected[:, 2] == 0).all()


def test_similarity_alignment_agrees_with_roma(truth, rng):
    motions = rng.normal(size=(4, L, J, 3))
    x, y = torch.asarray(motions), torch.asarray(truth).expand(4, L, J, 3)
    rotation, shift, scale = roma.rigid_points_registration(x, y, compute_scaling=True)
    expected = scale[..., None, None] * (x @ rotation.mT) + shift[..., None, :]
    np.testing.assert_allclose(aligned_by_similarity(motions, truth), expected, atol=1e-12)
    # Coincident joints are translated only.
    expected = np.broadcast_to(truth.mean(axis=1, keepdims=True), truth.shape)
    result = aligned_by_similarity(np.ones((L, J, 3)), truth)
    np.testing.assert_allclose(result, expected, atol=1e-12)


def test_acceleration_of_a_parabola(truth):
    time = np.arange(L)[:, None, None] / 30.0
    fall = np.array([0.0, -9.81, 0.0]) / 2 * time**2
    assert acceleration_error(truth + fall, truth, 30.0) == pytest.approx(9.81)
    steady = np.array([1.0, 2.0, 3.0]) * time + 4
    assert acceleration_error(truth + steady, truth, 30.0) == pytest.approx(0, abs=1e-9)


def test_acceleration_ratio_by_hand():
    time = np.arange(L)[:, None, None] / 30.0
    falls = 0.5 * time**2 * np.array([[0, -9.81, 0], [3, 0, 4]])  # 9.81 and 5 m/s²
    steady = np.array([1.0, 2.0, 3.0]) * time + 4
    motions = np.stack([falls, steady + 2 * falls, -0.5 * falls, falls[:, ::-1], 0 * falls])
    np.testing.assert_allclose(acceleration_ratio(motions, falls), [1, 2, 0.5, 1, 0], atol=1e-10)
    pair = np.stack([falls[:, 0], steady[:, 0]], axis=1)
    assert acceleration_ratio(pair, falls) == pytest.approx(9.81 / 14.81)
    # A joint displaced in one frame has the second differences 1, 2 and 1.
    jump = np.zeros((5, 1, 3))
    jump[2, 0, 0] = 1
    curve = np.arange(5.0)[:, None, None] ** 2 * [0, 0, 0.5]
    assert acceleration_ratio(jump, curve) == pytest.approx((1 + 2 + 1) / 3)
    with pytest.raises(ValueError, match="truth must have a nonzero acceleration"):
        acceleration_ratio(falls, np.zeros_like(falls))
    with pytest.raises(ValueError, match="truth must have at least 3 frames, got 2"):
        acceleration_ratio(falls[:2], falls[:2])


@pytest.mark.parametrize(("library", "batch"), [*((name, 3) for name in MAKE), ("torch", 0)])
def test_all_libraries_agree(truth, rng, library, batch):
    motions = truth + 0.2 * rng.normal(size=(batch, L, J, 3))
    make = MAKE[library]
    functions = [
        joint_errors,
        aligned_by_similarity,
        lambda x, y: aligned_by_root(x),
        lambda x, y: mean_over(joint_errors(x, y), np.eye(L, J) > 0),
        lambda x, y: acceleration_error(x, y, 30.0),
        acceleration_ratio,
    ]
    with jax.enable_x64(True):
        for function in functions:
            result = to_numpy(function(make(motions), make(truth)))
            np.testing.assert_allclose(result, function(motions, truth), rtol=1e-10, atol=1e-12)
