"""Motion-DVAE prior with random weights: coordinates, density, gradients and files."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from scipy import stats

from probmotion.models.bodies.body_states import turned_about_vertical
from probmotion.models.dvae.motion_dvae import KIND, MotionDVAE
from probmotion.models.dvae.settings import DVAESettings
from probmotion.models.training.checkpoints import Checkpoint, CheckpointError, save_checkpoint
from probmotion.posteriors.protocols import (
    DenoisesCoordinates,
    HasLogDensity,
    MotionPrior,
    Samplable,
)

TINY = replace(DVAESettings.tiny(), frames=5, latent=3)
RANK = 4


@pytest.fixture(scope="module")
def make(make_prior):
    return partial(make_prior, spread_latents=True)


def random_theta(prior, n=3, seed=1):
    return prior.initial(np.random.default_rng(seed), n)


@pytest.fixture(scope="module")
def prior(make):
    return make()


def test_prior_has_standard_normal_coordinates(prior):
    for protocol in (MotionPrior, Samplable, HasLogDensity, DenoisesCoordinates):
        assert isinstance(prior, protocol)
    assert (prior.frames, prior.fps, prior.rank, prior.dim) == (5, 30.0, RANK, 4 + RANK + 4 * 3)
    theta = random_theta(prior)
    np.testing.assert_allclose(prior.log_density(theta), stats.norm.logpdf(theta).sum(-1))


@pytest.mark.parametrize("decoder", ["cumulative", "direct"])
def test_motion_matches_an_explicit_rollout(make, decoder):
    """h₀ = d_ini(x₀), z_t = μ_z + σ_z ε_t of h_{t−1}, h_t = LSTM(h_{t−1}, z_t), x_t = d_x(h_t)."""
    prior = make(changes={"decoder": decoder})
    theta = random_theta(prior, 2)
    model = make(changes={"decoder": decoder}).model.double()
    network = model.generative
    for row in theta:
        placement, first, noise = row[:4], row[4 : 4 + RANK], row[4 + RANK :].reshape(4, 3)
        x = model.initial_mean + model.initial_factor @ torch.tensor(first)
        motion = [x]
        standard = (x - model.state_mean) / model.state_deviation
        hidden, cell = network.starts(standard[None]).chunk(2, dim=-1)
        hidden = torch.tanh(hidden)
        for epsilon in torch.tensor(noise):
            mean, raw = network.latent_prior(hidden).chunk(2, dim=-1)
            z = mean + torch.exp(6 * torch.tanh(raw / 6)) * epsilon
            hidden, cell = network.recurrent(z, (hidden, cell))
            decoded = network.decoder(hidden)[0]
            if decoder == "cumulative":
                decoded = standard + decoded + network.straight(z)[0]
            standard = decoded
            motion.append(model.state_mean + model.state_deviation * standard)
        states = torch.stack(motion).detach().numpy()
        expected = prior.states.positions(states, prior.states.rest)
        expected = turned_about_vertical(expected, math.atan2(placement[3], placement[2]))
        expected = expected + 3.0 * np.array([placement[0], 0.0, placement[1]])
        np.testing.assert_allclose(prior.motion(row), expected, atol=1e-9)


def test_motion_is_differentiable_and_agrees_between_numpy_and_torch(prior):
    theta = random_theta(prior, 2)
    tensor = torch.tensor(theta[:1], requires_grad=True)
    assert torch.autograd.gradcheck(prior.motion, tensor)
    exact = prior.motion(theta)
    for given, dtype in (
        (torch.tensor(theta), torch.float64),
        (torch.tensor(theta).float(), torch.float32),
        (theta.astype(np.float32), np.float32),
    ):
        motion = prior.motion(given)
        assert motion.dtype == dtype
        np.testing.assert_allclose(motion, exact, atol=1e-12 if given.dtype.itemsize > 4 else 1e-4)
    integers = np.arange(20) % 3 - 1
    np.testing.assert_array_equal(prior.motion(integers), prior.motion(integers.astype(float)))


def test_position_and_heading_coordinates_move_the_body(prior, make):
    theta = random_theta(prior)
    before = prior.motion(theta)
    shifted = theta.copy()
    shifted[:, :2] += [0.5, -1.0]
    expected = before + prior.spread * np.array([0.5, 0.0, -1.0])
    np.testing.assert_allclose(prior.motion(shifted), expected, atol=1e-12)
    rotated = theta.copy()
    angle = 0.8
    rotation = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    rotated[:, 2:4] = 2.5 * theta[:, 2:4] @ rotation
    ground = prior.spread * np.stack([theta[:, 0], 0 * theta[:, 0], theta[:, 1]], -1)[:, None, None]
    expected = turned_about_vertical(before - ground, np.full(3, angle)) + ground
    np.testing.assert_allclose(prior.motion(rotated), expected, atol=1e-12)
    closer = make(spread=0.5).motion(theta)
    np.testing.assert_allclose(closer, before - ground + ground / 6, atol=1e-12)


def test_coordinates_are_inverted_up_to_the_length_of_the_heading_vector(prior):
    theta = random_theta(prior)
    ground, heading = 3.0 * theta[:, :2], np.arctan2(theta[:, 3], theta[:, 2])
    innovations = theta[:, 4 + RANK :].reshape(3, 4, 3)
    again = prior.coordinates(ground, heading, theta[:, 4 : 4 + RANK], innovations)
    again[:, 2:4] *= np.linalg.norm(theta[:, 2:4], axis=-1, keepdims=True)
    np.testing.assert_allclose(again, theta, atol=1e-12)


def test_prior_adapts_to_other_lengths_and_bodies(prior):
    long = prior.of(frames=8)
    assert (long.frames, long.dim, prior.frames) == (8, 4 + RANK + 7 * 3, 5)
    # Longer motions extend shorter ones.
    theta = random_theta(long)
    np.testing.assert_allclose(
        long.motion(theta)[:, :5], prior.motion(theta[:, : prior.dim]), atol=1e-12
    )
    rest, network = prior.states.rest, object()
    small = prior.of(body=0.5 * rest, frames=2, inference_network=network)
    motion = small.motion(random_theta(small))
    for joint, parent in prior.skeleton.bones:
        bones = np.linalg.norm(motion[..., joint, :] - motion[..., parent, :], axis=-1)
        np.testing.assert_allclose(bones, 0.5 * np.linalg.norm(rest[joint]), atol=1e-9)
    other = small.of(frames=3)
    assert other.body is small.body
    assert other.inference_network is network


def test_checkpoint_round_trip(prior, tmp_path):
    theta, rest = random_theta(prior), prior.states.rest
    for half, tolerance in ((False, 0.0), (True, 0.02)):
        prior.save(tmp_path / "a.safetensors", half=half)
        loaded = MotionDVAE.load(tmp_path / "a.safetensors")
        np.testing.assert_allclose(loaded.motion(theta), prior.motion(theta), atol=tolerance)
    assert (loaded.fps, loaded.settings, loaded.skeleton) == (30.0, TINY, prior.skeleton)
    assert prior.joint_scale == pytest.approx(0.1)
    other = MotionDVAE.load(tmp_path / "a.safetensors", frames=3, body=2 * rest, spread=1.0)
    assert (other.frames, other.spread, other.body[1, 1]) == (3, 1.0, 1.0)


def test_invalid_checkpoints_are_rejected(prior, tmp_path):
    path = tmp_path / "a.safetensors"
    weights, network = prior.model.state_dict(), prior.card["network"]
    invalid = "must contain valid motion-dvae settings, got an error: "
    for kind, settings, message in (
        ("evaluator", network, "must contain a motion-dvae, got a evaluator"),
        (KIND, network | {"size": network["size"] | {"hidden": 64}}, "weights must match the"),
        (KIND, {"size": network["size"]}, invalid),
        (KIND, network | {"size": network["size"] | {"groups": 7}}, invalid),
        (KIND, network | {"size": network["size"] | {"wings": 2}}, invalid),
        (KIND, network | {"rest": network["rest"][1:]}, invalid),
    ):
        save_checkpoint(path, Checkpoint(kind, {"network": settings}, weights))
        with pytest.raises(CheckpointError, match=message):
            MotionDVAE.load(path)
    with pytest.raises(ValueError, match="prior must have a training record to be saved"):
        MotionDVAE(prior.model, TINY, prior.states, 30.0).save(tmp_path / "b.safetensors")


def test_invalid_arguments_are_rejected(prior):
    for theta, error, message in (
        (np.zeros((2, 19)), ValueError, r"theta must have shape \(…, 20\), got \(2, 19\)"),
        ([0.0] * 20, TypeError, "theta"),
        (np.where(np.arange(20) == 3, np.nan, 0.0), ValueError, "theta must be finite, got 1"),
    ):
        with pytest.raises(error, match=message):
            prior.motion(theta)
    rest = prior.states.rest
    for options, message in (
        ({"body": 0 * rest}, "body"),
        ({"body": rest[1:]}, r"body must have shape \(6, 3\), got \(5, 3\)"),
        ({"body": rest * np.nan}, "body must be finite"),
        ({"frames": 1}, "frames must be an integer of at least 2, got 1"),
        ({"spread": 0.0}, "spread must be a finite number above 0, got 0.0"),
    ):
        with pytest.raises(ValueError, match=message):
            MotionDVAE(prior.model, TINY, prior.states, 30.0, **options)
    for name, value in [("frames", 1), ("latent", 0), ("hidden", 33), ("decoder", "other"),
                        ("decoder_scale", "one")]:  # fmt: skip
        with pytest.raises(ValueError, match=f"^{name} must be .*, got"):
            replace(TINY, **{name: value})
