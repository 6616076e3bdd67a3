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
from probmotion.models.dvae.latent_rollouts import rollout
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
def fresh(make_prior):
    return partial(make_prior, spread_latents=True)


def drawn(prior, n=3, seed=1):
    return prior.initial(np.random.default_rng(seed), n)


@pytest.fixture(scope="module")
def prior(fresh):
    return fresh()


def test_prior_has_standard_normal_coordinates(prior):
    for protocol in (MotionPrior, Samplable, HasLogDensity, DenoisesCoordinates):
        assert isinstance(prior, protocol)
    assert (prior.frames, prior.fps, prior.rank) == (5, 30.0, RANK)
    assert prior.dim == 4 + RANK + 4 * 3
    theta = drawn(prior)
    np.testing.assert_allclose(prior.log_density(theta), stats.norm.logpdf(theta).sum(-1))
    paper = DVAESettings.paper()
    assert (paper.frames, paper.latent, paper.hidden, paper.groups) == (30, 48, 1024, 16)
    assert paper.decoder == "direct"


@pytest.mark.parametrize("decoder", ["cumulative", "direct"])
def test_motion_matches_an_explicit_rollout(fresh, decoder):
    """h₀ = d_ini(x₀), z_t = μ_z + σ_z ε_t of h_{t−1}, h_t = LSTM(h_{t−1}, z_t), x_t = d_x(h_t)."""
    prior = fresh(changes={"decoder": decoder})
    theta = drawn(prior, 2)
    model = fresh(changes={"decoder": decoder}).model.double()
    network = model.generative
    for row in theta:
        place, first, noise = row[:4], row[4 : 4 + RANK], row[4 + RANK :].reshape(4, 3)
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
        wanted = prior.states.positions(states, prior.states.rest)
        wanted = turned_about_vertical(wanted, math.atan2(place[3], place[2]))
        wanted = wanted + 3.0 * np.array([place[0], 0.0, place[1]])
        np.testing.assert_allclose(prior.motion(row), wanted, atol=1e-9)


def test_latent_density_follows_from_innovations_by_change_of_variables(prior):
    """log N(ε; 0, I) = Σ log p(z_t | z_<t, x₀) + log |dz/dε|, the Jacobian by autograd."""
    model = prior._double
    theta = torch.tensor(drawn(prior, 1))
    start = model.standardised(model.first_states(theta[:, 4 : 4 + RANK]))
    noise = theta[:, 4 + RANK :].reshape(1, 4, 3)

    def latents(epsilon):
        return rollout(model.generative, start, epsilon.reshape(1, 4, 3)).latents.flatten()

    jacobian = torch.autograd.functional.jacobian(latents, noise.flatten())
    sign, log_volume = torch.linalg.slogdet(jacobian)
    assert sign == 1
    state, log_p = model.generative.start(start), 0.0
    for z in latents(noise).reshape(4, 1, 3):
        mean, log_scale = model.generative.priors([state])
        log_p += stats.norm.logpdf(z, mean[:, 0], log_scale[:, 0].exp()).sum()
        state = model.generative.step(state, z)
    rest = stats.norm.logpdf(theta[0, : 4 + RANK]).sum()
    assert prior.log_density(theta).item() == pytest.approx(log_p + log_volume.item() + rest)
    assert abs(log_volume) > 0.1


def test_motion_is_differentiable_and_agrees_between_numpy_and_torch(prior):
    theta = torch.tensor(drawn(prior, 2), requires_grad=True)
    assert torch.autograd.gradcheck(prior.motion, theta)
    assert torch.autograd.gradcheck(prior.log_density, theta)
    found = prior.motion(theta)
    assert found.dtype == torch.float64
    np.testing.assert_allclose(found.detach().numpy(), prior.motion(drawn(prior, 2)), atol=1e-12)
    single = prior.motion(theta.detach().float())
    assert single.dtype == torch.float32
    np.testing.assert_allclose(single.numpy(), found.detach().numpy(), atol=1e-4)
    whole = np.arange(20) % 3 - 1
    assert prior.motion(whole).dtype == np.float64
    np.testing.assert_array_equal(prior.motion(whole), prior.motion(whole.astype(float)))
    got = prior.motion(drawn(prior, 2).astype(np.float32))
    assert got.dtype == np.float32
    np.testing.assert_allclose(got, found.detach().numpy(), atol=1e-4)


def test_position_and_heading_coordinates_move_the_body(prior, fresh):
    theta = drawn(prior)
    before = prior.motion(theta)
    moved = theta.copy()
    moved[:, :2] += [0.5, -1.0]
    there = before + prior.spread * np.array([0.5, 0.0, -1.0])
    np.testing.assert_allclose(prior.motion(moved), there, atol=1e-12)
    turned = theta.copy()
    angle = 0.8
    turn = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    turned[:, 2:4] = 2.5 * theta[:, 2:4] @ turn
    ground = prior.spread * np.stack([theta[:, 0], 0 * theta[:, 0], theta[:, 1]], -1)[:, None, None]
    wanted = turned_about_vertical(before - ground, np.full(3, angle)) + ground
    np.testing.assert_allclose(prior.motion(turned), wanted, atol=1e-12)
    near = fresh(spread=0.5)
    np.testing.assert_allclose(near.motion(theta), before - ground + ground / 6, atol=1e-12)


def test_coordinates_invert_motion(prior):
    model = prior._double
    rng = np.random.default_rng(5)
    ground, heading, first = rng.normal(size=(3, 2)), rng.normal(size=3), rng.normal(size=(3, RANK))
    start = model.first_states(torch.tensor(first))
    rolled = rollout(
        model.generative, model.standardised(start), torch.tensor(rng.normal(size=(3, 4, 3)))
    )
    states = torch.cat([start[:, None], model.decoded(rolled)], 1).numpy()
    motion = turned_about_vertical(prior.states.positions(states, prior.states.rest), heading)
    motion += np.stack([ground[:, 0], 0 * heading, ground[:, 1]], -1)[:, None, None]
    theta = prior.coordinates(ground, heading, first, rolled.innovations.numpy())
    assert theta.shape == (3, prior.dim)
    np.testing.assert_allclose(prior.motion(theta), motion, atol=1e-9)
    # The inverse holds up to the length of the two heading numbers.
    other = drawn(prior)
    heading = np.arctan2(other[:, 3], other[:, 2])
    parts = other[:, 4 + RANK :].reshape(3, 4, 3)
    again = prior.coordinates(3.0 * other[:, :2], heading, other[:, 4 : 4 + RANK], parts)
    again[:, 2:4] *= np.linalg.norm(other[:, 2:4], axis=-1, keepdims=True)
    np.testing.assert_allclose(again, other, atol=1e-12)


def test_prior_adapts_to_other_lengths_and_bodies(prior):
    long = prior.of(frames=8)
    assert (long.frames, long.dim, prior.frames) == (8, 4 + RANK + 7 * 3, 5)
    theta = drawn(long)
    # Longer motions extend shorter ones.
    begun = prior.motion(theta[:, : prior.dim])
    np.testing.assert_allclose(long.motion(theta)[:, :5], begun, atol=1e-12)
    small = prior.of(body=0.5 * prior.states.rest, frames=2)
    assert small.frames == 2
    found = small.motion(drawn(small))
    for joint, parent in prior.skeleton.bones:
        bones = np.linalg.norm(found[..., joint, :] - found[..., parent, :], axis=-1)
        np.testing.assert_allclose(bones, 0.5 * np.linalg.norm(prior.states.rest[joint]), atol=1e-9)
    assert small.of(frames=3).body is small.body
    assert prior.inference_network is None
    network = object()
    assert prior.of(inference_network=network).of(frames=4).inference_network is network


def test_checkpoint_round_trip(prior, tmp_path):
    theta = drawn(prior)
    prior.save(tmp_path / "whole.safetensors")
    whole = MotionDVAE.load(tmp_path / "whole.safetensors")
    np.testing.assert_array_equal(whole.motion(theta), prior.motion(theta))
    assert (whole.fps, whole.settings, whole.joint_scale) == (30.0, TINY, pytest.approx(0.1))
    assert whole.skeleton == prior.skeleton
    prior.save(tmp_path / "half.safetensors", half=True)
    half = MotionDVAE.load(tmp_path / "half.safetensors")
    assert half.model.initial_mean.dtype == torch.float32
    np.testing.assert_allclose(half.motion(theta), prior.motion(theta), atol=0.02)
    assert abs(half.motion(theta) - prior.motion(theta)).max() > 1e-6
    sizes = [(tmp_path / f"{name}.safetensors").stat().st_size for name in ("half", "whole")]
    assert sizes[0] < 0.7 * sizes[1]
    other = MotionDVAE.load(
        tmp_path / "half.safetensors", frames=3, body=2 * prior.states.rest, spread=1.0
    )
    assert (other.frames, other.spread, other.body[1, 1]) == (3, 1.0, 1.0)


def test_invalid_checkpoints_are_rejected(prior, tmp_path):
    path = tmp_path / "a.safetensors"
    weights, network = prior.model.state_dict(), prior.card["network"]

    def saved(kind=KIND, settings=network, tensors=weights):
        save_checkpoint(path, Checkpoint(kind, {"network": settings}, tensors))

    with pytest.raises(FileNotFoundError, match="there is no checkpoint nothing; use a file"):
        MotionDVAE.load("nothing")
    saved(kind="evaluator")
    with pytest.raises(CheckpointError, match="contains a evaluator, expected a motion-dvae"):
        MotionDVAE.load(path)
    saved(settings=network | {"size": network["size"] | {"hidden": 64}})
    with pytest.raises(CheckpointError, match="weights do not match its"):
        MotionDVAE.load(path)
    for wrong in (
        {"size": network["size"]},
        network | {"size": network["size"] | {"groups": 7}},
        network | {"size": network["size"] | {"wings": 2}},
        network | {"rest": network["rest"][1:]},
    ):
        saved(settings=wrong)
        with pytest.raises(CheckpointError, match="does not contain valid Motion-DVAE settings: "):
            MotionDVAE.load(path)
    nameless = MotionDVAE(prior.model, TINY, prior.states, 30.0)
    with pytest.raises(ValueError, match="prior must have a training record to be saved"):
        nameless.save(tmp_path / "b.safetensors")


def test_invalid_arguments_are_rejected(prior, fresh):
    import jax.numpy as jnp

    for theta, error, message in (
        (np.zeros((2, 19)), ValueError, r"theta must have shape \(…, 20\), got \(2, 19\)"),
        (jnp.zeros((2, 20)), TypeError, "theta"),
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
