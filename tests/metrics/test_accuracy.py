"""Errors against the truth: known answers, roma as an oracle, every array library."""

from __future__ import annotations

import array_api_strict
import jax
import numpy as np
import pytest
import roma
import torch
from scipy.spatial.transform import Rotation

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


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture
def truth(rng):
    return rng.normal(size=(L, J, 3))


def test_a_shift_is_its_length(truth):
    errors = joint_errors(truth + np.array([3.0, 0.0, 4.0]), truth)
    np.testing.assert_allclose(errors, 5)
    assert mean_over(errors) == pytest.approx(5)


def test_a_mask_chooses_what_counts(truth):
    moved = truth.copy()
    moved[2, 1, 0] += 0.5
    mask = np.zeros((L, J), dtype=bool)
    mask[2, :2] = True
    errors = joint_errors(np.stack([moved, truth]), truth)
    np.testing.assert_allclose(mean_over(errors, mask), [0.25, 0])
    np.testing.assert_allclose(mean_over(errors, ~mask), [0, 0])
    with pytest.raises(ValueError, match="mask keeps no joint"):
        mean_over(errors, np.zeros((L, J), dtype=bool))


def test_root_alignment_forgets_where_the_root_is(truth, rng):
    path = rng.normal(size=(L, 1, 3))
    np.testing.assert_allclose(
        aligned_by_root(truth + path, root=2), aligned_by_root(truth, root=2), atol=1e-12
    )
    assert (aligned_by_root(truth, root=2)[:, 2] == 0).all()


def test_similarity_alignment_undoes_a_similarity_per_frame(truth):
    turns = Rotation.random(L, rng=np.random.default_rng(1)).as_matrix()
    moved = 1.7 * np.einsum("lij,lkj->lki", turns, truth) + np.arange(L)[:, None, None]
    np.testing.assert_allclose(aligned_by_similarity(moved, truth), truth, atol=1e-12)


def test_similarity_alignment_is_romas(truth, rng):
    motions = rng.normal(size=(4, L, J, 3))
    x, y = torch.asarray(motions), torch.asarray(truth).expand(4, L, J, 3)
    turn, shift, scale = roma.rigid_points_registration(x, y, compute_scaling=True)
    expected = scale[..., None, None] * (x @ turn.mT) + shift[..., None, :]
    np.testing.assert_allclose(aligned_by_similarity(motions, truth), expected, atol=1e-12)


def test_similarity_alignment_never_mirrors(truth):
    mirrored = truth * np.array([-1.0, 1.0, 1.0])
    assert joint_errors(aligned_by_similarity(mirrored, truth), truth).mean() > 0.1
    # In a plane a mirror image is a rotation's.
    flat = truth * np.array([1.0, 1.0, 0.0])
    flipped = flat * np.array([-1.0, 1.0, 1.0])
    np.testing.assert_allclose(aligned_by_similarity(flipped, flat), flat, atol=1e-12)


def test_similarity_alignment_is_at_least_as_good_as_any_other(truth, rng):
    motion = truth + 0.3 * rng.normal(size=truth.shape)
    best = ((aligned_by_similarity(motion, truth) - truth) ** 2).sum(axis=(1, 2))
    for turn in Rotation.random(50, rng=rng):
        other = motion @ turn.as_matrix().T * rng.uniform(0.5, 1.5)
        other += (truth - other).mean(axis=1, keepdims=True)
        assert (best <= ((other - truth) ** 2).sum(axis=(1, 2)) + 1e-12).all()


def test_coincident_joints_are_moved_alone(truth):
    point = np.ones((L, J, 3))
    expected = np.broadcast_to(truth.mean(axis=1, keepdims=True), truth.shape)
    np.testing.assert_allclose(aligned_by_similarity(point, truth), expected, atol=1e-12)


def test_acceleration_of_a_parabola(truth):
    time = np.arange(L)[:, None, None] / 30.0
    fall = np.array([0.0, -9.81, 0.0]) / 2 * time**2
    assert acceleration_error(truth + fall, truth, 30.0) == pytest.approx(9.81)
    steady = np.array([1.0, 2.0, 3.0]) * time + 4
    assert acceleration_error(truth + steady, truth, 30.0) == pytest.approx(0, abs=1e-9)
    with pytest.raises(ValueError, match="truth has 2 frames, expected at least 3"):
        acceleration_error(truth[:2], truth[:2], 30.0)


def test_acceleration_ratio_by_hand(truth):
    time = np.arange(L)[:, None, None] / 30.0
    falls = 0.5 * time**2 * np.array([[0, -9.81, 0], [3, 0, 4]])  # 9.81 and 5 m/s²
    steady = np.array([1.0, 2.0, 3.0]) * time + 4
    # The size of accelerations is compared, whatever way they point.
    motions = np.stack([falls, steady + 2 * falls, -0.5 * falls, falls[:, ::-1], 0 * falls])
    np.testing.assert_allclose(acceleration_ratio(motions, falls), [1, 2, 0.5, 1, 0], atol=1e-10)
    one = np.stack([falls[:, 0], steady[:, 0]], axis=1)
    assert acceleration_ratio(one, falls) == pytest.approx(9.81 / 14.81)
    # A jump to and fro in one frame of one joint: second differences 1, 2 and 1.
    jump = np.zeros((5, 1, 3))
    jump[2, 0, 0] = 1
    curve = np.arange(5.0)[:, None, None] ** 2 * [0, 0, 0.5]
    assert acceleration_ratio(jump, curve) == pytest.approx((1 + 2 + 1) / 3)
    with pytest.raises(ValueError, match="truth has no acceleration in any frame"):
        acceleration_ratio(falls, np.zeros_like(falls))
    with pytest.raises(ValueError, match="truth has 2 frames, expected at least 3"):
        acceleration_ratio(truth[:2], truth[:2])


@pytest.mark.parametrize("library", ["strict", "torch", "jax"])
@pytest.mark.parametrize("batch", [(3,), (0,), ()])
def test_every_library_computes_the_same(truth, rng, library, batch):
    motions = truth + 0.2 * rng.normal(size=(*batch, L, J, 3))
    make = {
        "strict": array_api_strict.asarray,
        "torch": torch.asarray,
        "jax": jax.numpy.asarray,
    }[library]
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
            found = to_numpy(function(make(motions), make(truth)))
            np.testing.assert_allclose(found, function(motions, truth), rtol=1e-10, atol=1e-12)


def test_alignment_runs_under_jit_and_has_a_gradient(truth, rng):
    motion = truth + 0.2 * rng.normal(size=truth.shape)

    with jax.enable_x64(True):
        target = jax.numpy.asarray(truth)

        def error(x):
            return joint_errors(aligned_by_similarity(x, target), target).mean()

        x = jax.numpy.asarray(motion)
        assert float(jax.jit(error)(x)) == pytest.approx(
            joint_errors(aligned_by_similarity(motion, truth), truth).mean(), rel=1e-10
        )
        slope = jax.grad(error)(x)
        step = 1e-6 * jax.numpy.asarray(rng.normal(size=motion.shape))
        rise = float(error(x + step) - error(x - step)) / 2
        assert rise == pytest.approx(float((slope * step).sum()), rel=1e-5)
