"""The prior on a tiny network with fresh weights: coordinates, densities, gradients, files."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats

from probmotion import Skeleton
from probmotion.models.bodies.body_states import BodyStates, turned_about_vertical
from probmotion.models.dvae.latent_rollouts import rollout
from probmotion.models.dvae.motion_dvae import KIND, MotionDVAE, description_of
from probmotion.models.dvae.network import DVAEModel
from probmotion.models.dvae.settings import DVAESettings
from probmotion.models.training.checkpoints import Checkpoint, CheckpointError, save_checkpoint
from probmotion.posteriors.protocols import (
    DenoisesCoordinates,
    HasLogDensity,
    MotionPrior,
    Samplable,
)

BODY = Skeleton(
    ["hips", "chest", "left_hand", "right_hand", "left_foot", "right_foot"], [-1, 0, 1, 1, 0, 0]
)
REST = np.array(
    [[0, 0, 0], [0, 0.5, 0], [0.4, 0.1, 0], [-0.4, 0.1, 0], [0.1, -0.8, 0], [-0.1, -0.8, 0]]
)
TINY = replace(DVAESettings.tiny(), frames=5, latent=3)
RANK = 4


def fresh(size=TINY, seed=0, **options):
    """A prior with fresh weights and made standards: bodies that stand, and move a little."""
    states = BodyStates(BODY, REST)
    model = DVAEModel(size, states.dim, BODY.n_joints, RANK, seed)
    rng = np.random.default_rng(seed)
    upright = np.tile([1.0, 0, 0, 0, 1, 0], len(states.turning))
    mean = np.concatenate([[0, 0.9, 0], upright])
    for name, value in (
        ("state_mean", mean),
        ("state_deviation", rng.uniform(0.1, 0.3, states.dim)),
        ("joint_mean", 0.1 * rng.normal(size=(6, 3))),
        ("joint_deviation", rng.uniform(0.2, 0.5, (6, 3))),
        ("initial_mean", mean),
        ("initial_factor", 0.1 * rng.normal(size=(states.dim, RANK))),
    ):
        getattr(model, name).copy_(torch.as_tensor(value))
    # Scales of z that differ from frame to frame, as after training.
    with torch.no_grad():
        model.generative.latent_prior[-1].weight.mul_(3.0)
    card = {"network": description_of(size, states, 30.0, RANK)}
    return MotionDVAE(model, size, states, 30.0, card=card, **options)


def drawn(prior, n=3, seed=1):
    return prior.initial(np.random.default_rng(seed), n)


@pytest.fixture(scope="module")
def prior():
    return fresh()


def test_it_is_a_prior_with_standard_normal_coordinates(prior):
    for protocol in (MotionPrior, Samplable, HasLogDensity, DenoisesCoordinates):
        assert isinstance(prior, protocol)
    assert (prior.frames, prior.fps, prior.rank) == (5, 30.0, RANK)
    assert prior.dim == 4 + RANK + 4 * 3
    assert prior.skeleton == BODY
    theta = drawn(prior)
    np.testing.assert_allclose(prior.log_density(theta), stats.norm.logpdf(theta).sum(-1))
    many = drawn(prior, 4000)
    assert stats.kstest(many.ravel(), "norm").pvalue > 1e-4
    # E[θ | θ_t]: the posterior mean of a standard normal number, by quadrature of one.
    grid = np.linspace(-8, 8, 4001)
    weight = stats.norm.pdf(grid) * stats.norm.pdf(0.7, math.sqrt(0.3) * grid, math.sqrt(0.7))
    wanted = (grid * weight).sum() / weight.sum()
    assert prior.denoise_coordinates(np.array([0.7]), 0.3) == pytest.approx(wanted)


def test_samples_are_motions_of_draws_and_reproducible(prior):
    first = prior.sample(np.random.default_rng(3), 4)
    assert first.shape == (4, 5, 6, 3)
    np.testing.assert_array_equal(prior.sample(np.random.default_rng(3), 4), first)
    np.testing.assert_array_equal(prior.motion(drawn(prior, 4, 3)), first)
    assert abs(prior.sample(np.random.default_rng(4), 4) - first).max() > 0.1
    assert prior.sample(np.random.default_rng(3), 0).shape == (0, 5, 6, 3)


@pytest.mark.parametrize("decoder", ["cumulative", "direct"])
def test_motion_is_the_network_walked_by_hand(decoder):
    """h₀ = d_ini(x₀), z_t = μ_z + σ_z ε_t of h_{t−1}, h_t = LSTM(h_{t−1}, z_t), x_t = d_x(h_t)."""
    prior = fresh(replace(TINY, decoder=decoder))
    theta = drawn(prior, 2)
    model = fresh(replace(TINY, decoder=decoder)).model.double()
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
            said = network.decoder(hidden)[0]
            if decoder == "cumulative":
                said = standard + said + network.straight(z)[0]
            standard = said
            motion.append(model.state_mean + model.state_deviation * standard)
        states = torch.stack(motion).detach().numpy()
        wanted = prior.states.positions(states, REST)
        wanted = turned_about_vertical(wanted, math.atan2(place[3], place[2]))
        wanted = wanted + 3.0 * np.array([place[0], 0.0, place[1]])
        np.testing.assert_allclose(prior.motion(row), wanted, atol=1e-9)


def test_the_density_of_latents_is_that_of_innovations_by_change_of_variables(prior):
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


def test_motion_is_differentiable_and_numpy_agrees_with_torch(prior):
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


def test_batches_of_any_shape(prior):
    theta = drawn(prior, 6).reshape(2, 3, -1)
    found = prior.motion(theta)
    assert found.shape == (2, 3, 5, 6, 3)
    for i in range(2):
        for j in range(3):
            np.testing.assert_allclose(prior.motion(theta[i, j]), found[i, j], atol=1e-12)
            got = prior.motion(torch.tensor(theta[i, j]))
            assert got.shape == (5, 6, 3)
            np.testing.assert_allclose(got.numpy(), found[i, j], atol=1e-12)
    assert prior.log_density(theta).shape == (2, 3)
    assert prior.motion(torch.tensor(theta)).shape == found.shape
    # More than are walked at once.
    many = drawn(prior, 300)
    np.testing.assert_allclose(prior.motion(many)[290:], prior.motion(many[290:]), atol=1e-12)


def test_where_it_stands_and_looks_are_coordinates_of_their_own(prior):
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


def test_the_density_does_not_change_with_the_heading(prior):
    """Two standard normal numbers point everywhere alike: headings are uniform."""
    headings = np.arctan2(drawn(prior, 4000)[:, 3], drawn(prior, 4000)[:, 2])
    assert stats.kstest((headings + np.pi) / (2 * np.pi), "uniform").pvalue > 1e-4


def test_coordinates_are_those_of_what_was_rolled(prior):
    model = prior._double
    rng = np.random.default_rng(5)
    ground, heading, first = rng.normal(size=(3, 2)), rng.normal(size=3), rng.normal(size=(3, RANK))
    start = model.first_states(torch.tensor(first))
    rolled = rollout(
        model.generative, model.standardised(start), torch.tensor(rng.normal(size=(3, 4, 3)))
    )
    states = torch.cat([start[:, None], model.decoded(rolled)], 1).numpy()
    motion = turned_about_vertical(prior.states.positions(states, REST), heading)
    motion += np.stack([ground[:, 0], 0 * heading, ground[:, 1]], -1)[:, None, None]
    theta = prior.coordinates(ground, heading, first, rolled.innovations.numpy())
    assert theta.shape == (3, prior.dim)
    np.testing.assert_allclose(prior.motion(theta), motion, atol=1e-9)
    # And back: a θ is the coordinates of its parts, but for the length of the heading's numbers.
    other = drawn(prior)
    heading = np.arctan2(other[:, 3], other[:, 2])
    parts = other[:, 4 + RANK :].reshape(3, 4, 3)
    again = prior.coordinates(3.0 * other[:, :2], heading, other[:, 4 : 4 + RANK], parts)
    again[:, 2:4] *= np.linalg.norm(other[:, 2:4], axis=-1, keepdims=True)
    np.testing.assert_allclose(again, other, atol=1e-12)


def test_other_lengths_and_bodies_share_the_network(prior):
    long = prior.of(frames=8)
    assert (long.frames, long.dim, prior.frames) == (8, 4 + RANK + 7 * 3, 5)
    theta = drawn(long)
    # What comes later does not change what was.
    begun = prior.motion(theta[:, : prior.dim])
    np.testing.assert_allclose(long.motion(theta)[:, :5], begun, atol=1e-12)
    small = prior.of(body=0.5 * REST, frames=2)
    assert small.frames == 2
    found = small.motion(drawn(small))
    for joint, parent in BODY.bones:
        bones = np.linalg.norm(found[..., joint, :] - found[..., parent, :], axis=-1)
        np.testing.assert_allclose(bones, 0.5 * np.linalg.norm(REST[joint]), atol=1e-9)
    assert small.of(frames=3).body is small.body
    assert prior.inference_network is None
    beside = object()
    assert prior.of(inference_network=beside).of(frames=4).inference_network is beside


def test_it_comes_back_from_a_file(prior, tmp_path):
    theta = drawn(prior)
    prior.save(tmp_path / "whole.safetensors")
    whole = MotionDVAE.load(tmp_path / "whole.safetensors")
    np.testing.assert_array_equal(whole.motion(theta), prior.motion(theta))
    assert (whole.fps, whole.settings, whole.joint_scale) == (30.0, TINY, pytest.approx(0.1))
    assert whole.skeleton == BODY
    prior.save(tmp_path / "half.safetensors", half=True)
    half = MotionDVAE.load(tmp_path / "half.safetensors")
    assert half.model.initial_mean.dtype == torch.float32
    np.testing.assert_allclose(half.motion(theta), prior.motion(theta), atol=0.02)
    assert abs(half.motion(theta) - prior.motion(theta)).max() > 1e-6
    sizes = [(tmp_path / f"{name}.safetensors").stat().st_size for name in ("half", "whole")]
    assert sizes[0] < 0.7 * sizes[1]
    other = MotionDVAE.load(tmp_path / "half.safetensors", frames=3, body=2 * REST, spread=1.0)
    assert (other.frames, other.spread, other.body[1, 1]) == (3, 1.0, 1.0)


def test_what_cannot_be_loaded_is_said_in_a_sentence(prior, tmp_path):
    path = tmp_path / "a.safetensors"
    weights, network = prior.model.state_dict(), prior.card["network"]

    def saved(kind=KIND, settings=network, tensors=weights):
        save_checkpoint(path, Checkpoint(kind, {"network": settings}, tensors))

    with pytest.raises(FileNotFoundError, match="there is no checkpoint nothing, expected a file"):
        MotionDVAE.load("nothing")
    saved(kind="evaluator")
    with pytest.raises(CheckpointError, match="holds a evaluator, expected a motion-dvae"):
        MotionDVAE.load(path)
    saved(settings=network | {"size": network["size"] | {"hidden": 64}})
    with pytest.raises(CheckpointError, match="holds weights of another network than its settings"):
        MotionDVAE.load(path)
    for wrong in (
        {"size": network["size"]},
        network | {"size": network["size"] | {"groups": 7}},
        network | {"size": network["size"] | {"wings": 2}},
        network | {"rest": network["rest"][1:]},
    ):
        saved(settings=wrong)
        with pytest.raises(CheckpointError, match="has settings that are no Motion-DVAE's: "):
            MotionDVAE.load(path)
    saved()
    whole = path.read_bytes()
    path.write_bytes(whole[:-100])
    with pytest.raises(CheckpointError, match="is damaged or no safetensors file"):
        MotionDVAE.load(path)
    harmed = bytearray(whole)
    harmed[-100] ^= 1
    path.write_bytes(bytes(harmed))
    with pytest.raises(CheckpointError, match="is damaged: it does not hold what was written"):
        MotionDVAE.load(path)
    path.write_bytes(whole.replace(b'\\"format\\": 1', b'\\"format\\": 9'))
    with pytest.raises(CheckpointError, match="is a checkpoint of version 9, expected version 1"):
        MotionDVAE.load(path)
    nameless = MotionDVAE(prior.model, TINY, prior.states, 30.0)
    with pytest.raises(ValueError, match="the prior has no card, expected one that was trained or"):
        nameless.save(tmp_path / "b.safetensors")


def test_bad_input_is_refused_in_a_sentence(prior):
    with pytest.raises(ValueError, match=r"theta must have shape \(…, 20\), got \(2, 19\)"):
        prior.motion(np.zeros((2, 19)))
    with pytest.raises(ValueError, match=r"theta must have shape \(…, 20\), got \(21,\)"):
        prior.log_density(np.zeros(21))
    import jax.numpy as jnp

    with pytest.raises(TypeError, match="theta is a JAX array, expected NumPy's or torch's"):
        prior.motion(jnp.zeros((2, 20)))
    with pytest.raises(TypeError, match=r"^theta is a list, expected NumPy's or torch's"):
        prior.motion([0.0] * 20)
    with pytest.raises(
        ValueError, match=r"^theta must be finite, got 1 values that are NaN or infinite, the fi"
    ):
        prior.motion(np.where(np.arange(20) == 3, np.nan, 0.0))
    flat, giant = REST.copy(), REST.copy()
    flat[4], giant[2] = 0.0, [400.0, 0.0, 0.0]
    for options, message in (
        ({"body": 0 * REST}, "^body has a bone of no length, to chest, expected all bones to"),
        ({"body": flat}, "^body has a bone of no length, to left_foot, expected all bones to"),
        ({"body": giant}, "^body has a bone of length 400, to left_hand, expected metres, at most"),
        ({"frames": 1}, "frames must be an integer of at least 2, got 1"),
        ({"spread": 0.0}, "spread must be a finite number above 0, got 0.0"),
        ({"body": REST[1:]}, r"body must have shape \(6, 3\), got \(5, 3\)"),
        ({"body": REST * np.nan}, "body must be finite, got 18 values that are NaN or infinite"),
    ):
        with pytest.raises(ValueError, match=message):
            fresh(**options)
    with pytest.raises(ValueError, match="frames must be an integer of at least 2, got 1"):
        prior.of(frames=1)
    for name, value in [("frames", 1), ("latent", 0), ("hidden", 33), ("decoder", "other")]:
        with pytest.raises(ValueError, match=f"^{name} is .*, expected"):
            replace(TINY, **{name: value})
    with pytest.raises(ValueError, match="decoder_scale must be one of learned, unit, got 'one'"):
        replace(TINY, decoder_scale="one")


def test_sizes_are_as_published():
    paper = DVAESettings.paper()
    assert (paper.frames, paper.latent, paper.hidden, paper.groups) == (30, 48, 1024, 16)
    assert paper.decoder == "direct"


def test_fresh_weights_follow_the_seed_and_leave_torch_alone():
    torch.manual_seed(0)
    wanted = torch.rand(2)
    torch.manual_seed(0)
    one, same, other = (fresh(seed=seed).model.generative.recurrent.weight_ih for seed in (1, 1, 2))
    assert torch.equal(torch.rand(2), wanted)
    assert torch.equal(one, same)
    assert not torch.equal(one, other)
