"""Networks of the motion VAE: what they look at, shortcuts against the long way, and gradients."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import nn
from torch.nn import functional

from probmotion.models.diffusion.motion_transformer import sinusoids
from probmotion.models.vae import layers as motion_vae_layers
from probmotion.models.vae.layers import BoneDecoder, FrameEncoder, TransformerLayer
from probmotion.models.vae.network import MotionVAENetwork, TimeDecoder
from probmotion.models.vae.pose_network import PoseNetwork
from probmotion.models.vae.settings import MotionVAESettings

TINY = replace(MotionVAESettings.tiny(), layers=2)
B, T, J, BONES, F = 3, 10, 5, 4, 6
DOUBLE = torch.float64


def made_input(dtype=torch.float32, seed=0):
    """Keypoints with some not seen, and a rest pose."""
    generator = torch.Generator().manual_seed(seed)
    keypoints = torch.randn(B, T, J, 2, generator=generator, dtype=dtype)
    confidence = torch.rand(B, T, J, generator=generator, dtype=dtype)
    confidence[confidence < 0.3] = 0.0
    assert (confidence == 0).any()
    return keypoints, confidence, torch.randn(J, 3, generator=generator, dtype=dtype)


def made_features(seed=1):
    generator = torch.Generator().manual_seed(seed)
    sizes = (B, T, F), (B, T, J, F)
    return tuple(torch.randn(size, generator=generator) for size in sizes)


def awake(network):
    """Fresh networks hardly move: let what they return depend on what they read."""
    with torch.no_grad():
        for part in network.modules():
            if isinstance(part, motion_vae_layers.Readout):
                part.weight.normal_(0, 0.3, generator=torch.Generator().manual_seed(1))
    return network


def other(value):
    """Keypoints and a rest pose that differ from those of `made_input` where joints hide."""
    keypoints, confidence, rest = made_input()
    hidden = torch.where(confidence[..., None] > 0, keypoints, value)
    return hidden, confidence, rest


@pytest.mark.parametrize("spatial", [True, False])
@pytest.mark.parametrize("size", ["tiny", "small"])
def test_shapes(size, spatial):
    settings = replace(getattr(MotionVAESettings, size)(), spatial=spatial)
    network = MotionVAENetwork(settings, J, BONES)
    mean, log_variance = network.encode(*made_input())
    assert mean.shape == log_variance.shape == (B, settings.latent)
    turns = network.decode(mean)
    assert turns.shape == (B, T, BONES, 3)
    assert {mean.dtype, log_variance.dtype, turns.dtype} == {torch.float32}


def test_published_sizes_and_sizes_that_ship():
    paper, small = MotionVAESettings.paper(), MotionVAESettings.small()
    assert (paper.frames, paper.width, paper.layers, paper.heads, paper.latent) == (
        *(10, 256, 4),
        *(4, 256),
    )
    assert (paper.smoothness, paper.kl, paper.teacher) == (1.0, 0.001, 1.0)
    vae, pose = MotionVAENetwork(small, 21, 20), PoseNetwork(small, 21, 20, 12)
    numbers = sum(weight.numel() for part in (vae, pose) for weight in part.parameters())
    assert numbers <= 1.2e6


def test_first_motions_are_near_the_rest_pose_and_differ():
    turns = MotionVAENetwork(TINY, J, BONES).decode(torch.randn(50, TINY.latent))
    assert turns.abs().max() < 0.3
    assert turns.std(dim=0).min() > 1e-4


def test_attention_to_one_token_is_a_linear_map_of_it():
    """nn.MultiheadAttention of the same weights, whatever is asked."""
    attention = nn.MultiheadAttention(8, 2, kdim=6, vdim=6, batch_first=True, dtype=DOUBLE)
    layer = TransformerLayer(replace(TINY, width=8), memory=6).double()
    with torch.no_grad():
        attention.in_proj_bias.normal_()
        attention.out_proj.bias.normal_()
        out = attention.out_proj.weight
        layer.told.weight.copy_(out @ attention.v_proj_weight)
        layer.told.bias.copy_(out @ attention.in_proj_bias[16:] + attention.out_proj.bias)
    queries, memory = torch.randn(7, 3, 8, dtype=DOUBLE), torch.randn(7, 6, dtype=DOUBLE)
    wanted, _ = attention(queries, memory[:, None], memory[:, None])
    found = layer.told(memory)[:, None].expand_as(wanted)
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-12)


def as_torch_layer(layer, memory=False):
    """Torch's own layer with the weights of ours: an independent implementation."""
    width, heads = layer.attended.in_features, layer.heads
    hidden = layer.perceptron[0].out_features
    options = {
        "dropout": 0.0,
        "activation": functional.gelu,
        "batch_first": True,
        "norm_first": True,
        "dtype": DOUBLE,
    }
    kind = nn.TransformerDecoderLayer if memory else nn.TransformerEncoderLayer
    made = kind(width, heads, hidden, **options)
    pairs = [
        (made.self_attn.out_proj, layer.attended),
        (made.linear1, layer.perceptron[0]),
        (made.linear2, layer.perceptron[2]),
        (made.norm1, layer.attention_norm),
        (made.norm3 if memory else made.norm2, layer.perceptron_norm),
    ]
    for one, same in pairs:
        one.load_state_dict(same.state_dict())
    with torch.no_grad():
        made.self_attn.in_proj_weight.copy_(layer.asked_keys_values.weight)
        made.self_attn.in_proj_bias.copy_(layer.asked_keys_values.bias)
        if memory:
            made.multihead_attn.in_proj_weight[2 * width :].copy_(layer.told.weight)
            made.multihead_attn.in_proj_bias[2 * width :].copy_(layer.told.bias)
            made.multihead_attn.out_proj.weight.copy_(torch.eye(width))
            made.multihead_attn.out_proj.bias.zero_()
    return made


def test_layers_are_torch_s():
    tokens = torch.randn(6, J, TINY.width, dtype=DOUBLE)
    seen = torch.rand(6, J) > 0.4
    seen[:, 0] = True
    layer = TransformerLayer(TINY).double()
    wanted = as_torch_layer(layer)(tokens, src_key_padding_mask=~seen)
    torch.testing.assert_close(layer(tokens, seen=seen), wanted)
    memory = torch.randn(6, TINY.width, dtype=DOUBLE)
    layer = TransformerLayer(TINY, TINY.width).double()
    wanted = as_torch_layer(layer, memory=True)(tokens, memory[:, None])
    torch.testing.assert_close(layer(tokens, memory), wanted)


@pytest.mark.parametrize("first", [1, 2])
def test_the_first_tokens_alone_are_those_of_the_whole_layer(first):
    layer, tokens = TransformerLayer(TINY).double(), torch.randn(6, J, TINY.width, dtype=DOUBLE)
    seen = torch.rand(6, J) > 0.4
    seen[:, 0] = True
    for mask in (None, seen):
        whole = layer(tokens, seen=mask)
        torch.testing.assert_close(layer(tokens, seen=mask, first=first), whole[:, :first])


@pytest.mark.parametrize("kind", [TimeDecoder, BoneDecoder])
def test_queries_that_go_through_once_are_as_if_each_memory_had_its_own(kind):
    decoder = (kind(TINY) if kind is TimeDecoder else kind(TINY, BONES)).double()
    bones = kind is BoneDecoder
    memory = torch.randn(6, TINY.width if bones else TINY.latent, dtype=DOUBLE)
    queries = decoder.bones if bones else sinusoids(torch.arange(T), TINY.width).double()
    tokens = queries.expand(6, -1, -1)
    for layer in decoder.layers:
        tokens = layer(tokens, memory)
    wanted = decoder.norm(tokens)
    torch.testing.assert_close(decoder(memory), decoder.leave(wanted) if bones else wanted)


def test_the_order_of_joints_matters_by_their_index_alone():
    encoder = FrameEncoder(TINY, J).double()
    keypoints, confidence, rest = made_input(DOUBLE)
    order = torch.tensor([3, 0, 4, 1, 2])
    permuted = keypoints[:, :, order], confidence[:, :, order], rest[order]
    before = encoder(keypoints, confidence, rest)
    assert (encoder(*permuted) - before).abs().max() > 1e-3
    with torch.no_grad():
        encoder.joints.copy_(encoder.joints[order].clone())
    torch.testing.assert_close(encoder(*permuted), before)
    with torch.no_grad():
        encoder.joints.zero_()
    torch.testing.assert_close(encoder(*permuted), encoder(keypoints, confidence, rest))


@pytest.mark.parametrize("value", [1e6, float("nan"), float("inf")])
@pytest.mark.parametrize("spatial", [True, False])
def test_what_is_not_seen_does_not_matter(spatial, value):
    settings = replace(TINY, spatial=spatial, image_features=F)
    network = awake(MotionVAENetwork(settings, J, BONES))
    features, (keypoints, confidence, rest) = made_features(), made_input()
    local = torch.where(confidence[..., None] > 0, features[1], value)
    found = []
    for read in (
        (keypoints, confidence, rest, features),
        (*other(value), (features[0], local)),
    ):
        network.zero_grad()
        answers = network.encode(*read)
        torch.cat(answers).sum().backward()
        encoder = network.frame_encoder
        found.append([*answers, *(weight.grad.clone() for weight in encoder.parameters())])
    for one, same in zip(*found, strict=True):
        assert torch.isfinite(same).all()
        assert torch.equal(one, same)


def test_a_joint_that_is_never_seen_is_as_if_it_were_not_there():
    whole, less = FrameEncoder(TINY, J).double(), FrameEncoder(TINY, J - 1).double()
    weights = whole.state_dict()
    less.load_state_dict({**weights, "joints": weights["joints"][:-1]})
    keypoints, confidence, rest = made_input(DOUBLE)
    confidence[..., -1] = 0
    # As far from the root as the others are on average: the body is of the same size without it.
    rest[-1] *= rest[:-1].norm(dim=-1).mean() / rest[-1].norm()
    found = whole(keypoints, confidence, rest)
    wanted = less(keypoints[:, :, :-1], confidence[:, :, :-1], rest[:-1])
    torch.testing.assert_close(found, wanted)
    # A frame in which nothing is seen is no division by 0.
    assert torch.isfinite(whole(keypoints, torch.zeros_like(confidence), rest)).all()


@pytest.mark.parametrize("spatial", [True, False])
def test_every_part_of_the_descriptor_is_read(spatial):
    network = awake(
        MotionVAENetwork(replace(TINY, spatial=spatial, image_features=F), J, BONES)
    ).double()
    read = [*made_input(DOUBLE), *(part.double() for part in made_features())]
    for part in read:
        part.requires_grad_(True)
    mean, log_variance = network.encode(*read[:3], (read[3], read[4]))
    (mean.sum() + log_variance.sum()).backward()
    seen = read[1] > 0
    for name, part in zip(["keypoints", "confidence", "rest"], read, strict=False):
        assert part.grad.abs().max() > 1e-9, name
    assert (read[0].grad[~seen] == 0).all()
    assert (read[3].grad.abs().amax(dim=-1) > 0).all()
    # As published, the ablation reads the frames' features alone.
    assert (read[4].grad is None) if not spatial else (read[4].grad[seen].abs() > 0).any()


@pytest.mark.parametrize("spatial", [True, False])
def test_gradients_reach_all_weights(spatial):
    network = MotionVAENetwork(replace(TINY, spatial=spatial), J, BONES)
    mean, log_variance = network.encode(*made_input())
    turns = network.decode(mean + (0.5 * log_variance).exp())
    (turns**2).sum().backward()
    for name, weight in network.named_parameters():
        assert weight.grad is not None, name
        assert weight.grad.abs().max() > 0, name


@pytest.mark.parametrize("spatial", [True, False])
def test_a_row_does_not_depend_on_those_beside_it(spatial):
    network = awake(MotionVAENetwork(replace(TINY, spatial=spatial), J, BONES)).double()
    keypoints, confidence, rest = made_input(DOUBLE)
    whole = network.encode(keypoints, confidence, rest)
    turns = network.decode(whole[0])
    for row in range(B):
        alone = network.encode(keypoints[row : row + 1], confidence[row : row + 1], rest)
        torch.testing.assert_close(alone[0], whole[0][row : row + 1])
        torch.testing.assert_close(alone[1], whole[1][row : row + 1])
        torch.testing.assert_close(network.decode(alone[0]), turns[row : row + 1])
    assert turns.std(dim=0).min() > 1e-6


def test_frames_that_go_through_in_parts_give_the_same(monkeypatch):
    network = awake(MotionVAENetwork(TINY, J, BONES)).double()
    whole = network.encode(*made_input(DOUBLE))
    turns = network.decode(whole[0])
    monkeypatch.setattr(motion_vae_layers, "FRAMES_AT_ONCE", 7)
    for found, wanted in zip(network.encode(*made_input(DOUBLE)), whole, strict=True):
        torch.testing.assert_close(found, wanted)
    torch.testing.assert_close(network.decode(whole[0]), turns)


def test_the_order_of_frames_matters():
    network = MotionVAENetwork(TINY, J, BONES).double()
    keypoints, confidence, rest = made_input(DOUBLE)
    forwards, _ = network.encode(keypoints, confidence, rest)
    backwards, _ = network.encode(keypoints.flip(1), confidence.flip(1), rest)
    assert (forwards - backwards).abs().max() > 1e-3
    assert awake(network).decode(forwards).std(dim=1).min() > 1e-3


def test_log_variances_are_bounded_and_keep_their_gradient():
    network = MotionVAENetwork(TINY, J, BONES)
    with torch.no_grad():
        network.time_encoder.log_variance.bias.copy_(torch.linspace(-40.0, 40.0, TINY.latent))
    _, log_variance = network.encode(*made_input())
    assert log_variance.abs().max() <= 10
    bias = network.time_encoder.log_variance.bias
    (gradient,) = torch.autograd.grad(log_variance.sum(), bias)
    assert (gradient > 0).all()


def test_seeds_make_weights_and_leave_torch_s_own_numbers_alone():
    torch.manual_seed(0)
    wanted = torch.rand(3)
    torch.manual_seed(0)
    one, same, another = (MotionVAENetwork(TINY, J, BONES, seed) for seed in (1, 1, 2))
    assert torch.equal(torch.rand(3), wanted)
    assert torch.equal(one.time_encoder.asked, same.time_encoder.asked)
    assert not torch.equal(one.time_encoder.asked, another.time_encoder.asked)


def test_mixed_precision_is_that_of_training_alone():
    """Its answers and gradients are near those of single precision, and of its type."""
    single = awake(MotionVAENetwork(TINY, J, BONES))
    mixed = awake(MotionVAENetwork(replace(TINY, mixed_precision=True), J, BONES))
    found = []
    for network in (single, mixed):
        network.train()
        mean, log_variance = network.encode(*made_input())
        turns = network.decode(mean)
        (turns**2).mean().backward()
        gradient = torch.cat([w.grad.flatten() for w in network.parameters() if w.grad is not None])
        found.append((turns, log_variance, gradient))
    for one, near in zip(*found, strict=True):
        assert near.dtype == torch.float32
        assert 0 < (near - one).norm() / one.norm() < 0.05
    with torch.no_grad():
        for one, same in zip(
            single.eval().encode(*made_input()), mixed.eval().encode(*made_input()), strict=True
        ):
            assert torch.equal(one, same)


@pytest.mark.parametrize("spatial", [True, False])
def test_image_features_have_their_shapes(spatial):
    network = MotionVAENetwork(replace(TINY, image_features=F, spatial=spatial), J, BONES)
    mean, _ = network.encode(*made_input(), made_features())
    assert mean.shape == (B, TINY.latent)
    frames, joints = made_features()
    for given, message in (
        (None, "features must be image features of image_features=6 numbers, got None"),
        ((frames[..., 1:], joints), r"features\[0\] has shape \(3, 10, 5\)"),
        ((frames, joints[:, :, 1:]), r"features\[1\] has shape \(3, 10, 4, 6\)"),
        ((frames,), "features is a tuple, expected a tuple of two tensors"),
        (frames, "features is a Tensor, expected a tuple of two tensors"),
    ):
        with pytest.raises(ValueError, match=message):
            network.encode(*made_input(), given)
    with pytest.raises(ValueError, match="expected None where image_features is 0"):
        MotionVAENetwork(TINY, J, BONES).encode(*made_input(), made_features())


def test_shapes_that_do_not_fit_are_named():
    network = MotionVAENetwork(TINY, J, BONES)
    keypoints, confidence, rest = made_input()
    for read, message in (
        ((keypoints[:, 1:], confidence[:, 1:], rest), "keypoints has shape"),
        ((keypoints, confidence[:, 1:], rest), "confidence has shape"),
        ((keypoints, confidence, rest[1:]), "rest has shape"),
    ):
        with pytest.raises(ValueError, match=message):
            network.encode(*read)
    with pytest.raises(ValueError, match="latents has shape"):
        network.decode(torch.zeros(2, TINY.latent + 1))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("frames", 1),
        ("width", 33),
        ("width", 0),
        ("layers", 1.5),
        ("heads", 3),
        ("feedforward", 0),
        ("latent", True),
        ("spatial", 1),
        ("mixed_precision", "yes"),
        ("hypotheses", 5),
        ("image_features", -1),
        ("reconstruction", float("nan")),
        ("kl", -0.1),
        ("smoothness", True),
        ("ranges", "0.1"),
        ("lengths", float("inf")),
        ("teacher", None),
    ],
)
def test_settings_out_of_range_are_named(name, value):
    with pytest.raises(ValueError, match=name):
        replace(TINY, **{name: value})
