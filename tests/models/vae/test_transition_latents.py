"""Long motions: unchanged segments and smooth transitions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from probmotion import Skeleton
from probmotion.geometry.rotations import vector_to_matrix
from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.models.vae import transition_latents
from probmotion.models.vae.motion_vae import MotionVAE
from probmotion.models.vae.network import MotionVAEModel
from probmotion.models.vae.settings import MotionVAESettings
from probmotion.models.vae.transition_latents import (
    _corrected,
    _joined,
    greatest_acceleration,
    long_motion,
)

ARMS = Skeleton(
    ["pelvis", "neck", "left_shoulder", "left_elbow", "left_wrist", "right_shoulder"],
    [-1, 0, 1, 2, 3, 1],
)
REST = np.array(
    [[0, 0, 0], [0, 0.5, 0], [0.2, 0, 0], [0.05, -0.3, 0], [0, -0.25, 0.05], [-0.2, 0, 0]]
)
BODY = ArticulatedBody(ARMS, REST)


def random_prior(speed=1.0, **options):
    """Return a prior with random weights and large motions at a given speed."""
    size = replace(MotionVAESettings.tiny(), latent=4, **options)
    model = MotionVAEModel.of(size, BODY)
    with torch.no_grad():
        model.vae.bone_decoder.leave.weight.mul_(40)
        model.vae.time_decoder.times.mul_(speed)
    return MotionVAE(model.vae, model.pose, size, BODY, 20.0)


def codes(n=3, seed=0):
    return np.random.default_rng(seed).standard_normal((n, 4))


@pytest.fixture(scope="module")
def prior():
    return random_prior()


def test_segments_are_unchanged(prior):
    z = codes()
    result = long_motion(prior, z, iterations=3, transitions=1)
    assert result.shape == (3 * 10 + 2 * 6, 6, 3)
    for number, segment in enumerate(prior.motion(z)):
        np.testing.assert_allclose(result[16 * number : 16 * number + 10], segment, atol=1e-9)


def test_acceleration_of_a_parabola():
    path = np.arange(6)[:, None, None] ** 2 * np.array([[0.0, 0, 0], [0.3, 0, -0.4]])
    assert greatest_acceleration(path) == pytest.approx(1.0)


@pytest.mark.parametrize("seed", [0, 1])
def test_transitions_accelerate_no_more_than_segments(seed):
    prior, z = random_prior(speed=0.5), codes(seed=seed)
    segments = prior.motion(z)
    allowed = max(greatest_acceleration(segment) for segment in segments)
    concatenated = greatest_acceleration(np.concatenate(segments))
    assert concatenated > 1.5 * allowed
    result = long_motion(prior, z)
    assert greatest_acceleration(result) <= allowed * (1 + 1e-9)


def test_unsmooth_transition_warns():
    """Static bodies in distant poses must accelerate between them."""
    static_prior, z = random_prior(speed=0.01), 2 * codes(2)
    with pytest.warns(UserWarning, match=r"after segment 0 has [\d.]+ times the largest accel"):
        result = long_motion(static_prior, z, iterations=3)
    within = max(greatest_acceleration(part) for part in static_prior.motion(z))
    assert greatest_acceleration(result) > within


def test_exact_transition_needs_no_correction(prior):
    """A motion of the prior is the transition between its own ends."""
    motion, other = torch.as_tensor(vector_to_matrix(prior.turns(codes(2, seed=3))))
    joined, missed = _joined([motion], motion[:2], motion[-2:])
    torch.testing.assert_close(joined, motion)
    assert float(missed) == pytest.approx(0.0, abs=1e-12)
    shared = [0, 1, 8, 9]
    corrected = _corrected(other, motion[shared])
    torch.testing.assert_close(corrected[shared], motion[shared])
    products = corrected @ corrected.mT
    torch.testing.assert_close(products, torch.eye(3, dtype=products.dtype).expand_as(products))


def test_optimisation_reduces_the_mismatch(prior, monkeypatch):
    """The mismatch before correction is recorded after 1 and 50 iterations."""
    mismatches, joined = [], transition_latents._joined

    def spy(*parts):
        result = joined(*parts)
        mismatches.append(float(result[1].detach()))
        return result

    monkeypatch.setattr(transition_latents, "_joined", spy)
    long_motion(prior, codes(2), iterations=1, transitions=1)
    initial, early = mismatches[0], mismatches[-1]
    long_motion(prior, codes(2), iterations=50, transitions=1)
    assert mismatches[-1] < 0.8 * early < 0.8 * initial


def test_root_is_fixed_and_bone_lengths_are_constant(prior):
    result = long_motion(prior, codes(2), iterations=3)
    np.testing.assert_allclose(result[:, 0], np.tile(prior.rigid.translations[0], (len(result), 1)))
    lengths = np.linalg.norm(result[:, 1:] - result[:, ARMS.parents[1:]], axis=-1)
    expected = np.broadcast_to(np.linalg.norm(REST[1:], axis=-1), lengths.shape)
    np.testing.assert_allclose(lengths, expected, atol=1e-9)


def test_invalid_arguments_are_rejected(prior):
    zero = np.zeros((2, 4))
    for z, options, sentence in (
        (zero[:, :3], {}, r"z must have shape \(S, 4\), got \(2, 3\)"),
        (zero[:0], {}, "segments must be an integer of at least 1, got 0"),
        (zero * np.nan, {}, "z must be finite, got 8 values that are NaN or infinite"),
        (zero, {"iterations": 0}, "iterations must be an integer of at least 1, got 0"),
        (zero, {"transitions": 0}, "transitions must be an integer of at least 1, got 0"),
        (zero, {"prior_weight": -1.0}, "prior_weight must be a finite number of at least 0"),
    ):
        with pytest.raises(ValueError, match=f"^{sentence}"):
            long_motion(prior, z, **options)
