"""Networks of the motion VAE: masking, equivalences with torch, and gradients."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import nn
from torch.nn import functional
from torch.nn.functional import scaled_dot_product_attention

from probmotion.models.diffusion.motion_transformer import sinusoids
from probmotion.models.vae import layers as motion_vae_layers
from probmotion.models.vae.layers import BoneDecoder, FrameEncoder, TransformerLayer
from probmotion.models.vae.network import MotionVAENetwork, TimeDecoder
from probmotion.models.vae.pose_network import PoseNetwork
from probmotion.models.vae.settings import MotionVAESettings
from probmotion.models.vae.short_attention import short_attention

TINY = replace(MotionVAESettings.tiny(), layers=2)
B, T, J, BONES, F = 3, 10, 5, 4, 6
DOUBLE = torch.float64


def random_input(dtype=torch.float32, seed=0):
    """Return keypoints with occlusions, confidences and a rest pose."""
    generator = torch.Generator().manual_seed(seed)
    keypoints = torch.randn(B, T, J, 2, generator=generator, dtype=dtype)
    confidence = torch.rand(B, T, J, generator=generator, dtype=dtype)
    confidence[confidence < 0.3] = 0.0
    assert (confidence == 0).any()
    return keypoints, confidence, torch.randn(J, 3, generator=generator, dtype=dtype)


def random_features(seed=1):
    generator = torch.Generator().manual_seed(seed)
    sizes = (B, T, F), (B, T, J, F)
    return tuple(torch.randn(size, generator=generator) for size in sizes)


def amplified(network):
    """Increase the outputs of random networks."""
    with torch.no_grad():
        for part in network.modules():
            if isinstance(part, motion_vae_layers.Readout):
                part.weight.normal_(0, 0.3, generator=torch.Generator().manual_seed(1))
    return network


def occluded_input(value):
    """Return inputs with another value at occluded joints."""
    keypoints, confidence, rest = random_input()
    hidden = torch.where(confidence[..., None] > 0, keypoints, value)
    return hidden, confidence, rest


def test_published_and_shipped_sizes():
    paper, small = MotionVAESettings.paper(), MotionVAESettings.small()
    assert (paper.frames, paper.width, paper.layers, paper.heads, paper.latent) == (
        *(10, 256, 4),
        *(4, 256),
    )
    assert (paper.smoothness, paper.kl, paper.teacher) == (1.0, 0.001, 1.0)
    vae, pose = MotionVAENetwork(small, 21, 20), PoseNetwork(small, 21, 20, 12)
    numbers = sum(weight.numel() for part in (vae, pose) for weight in part.parameters())
    assert numbers <= 1.2e6


def as_torch_layer(layer, memory=False):
    """Return torch's layer with the same weights."""
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


def test_layers_match_torch():
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
def test_first_tokens_match_the_whole_layer(first):
    layer, tokens = TransformerLayer(TINY).double(), torch.randn(6, J, TINY.width, dtype=DOUBLE)
    seen = torch.rand(6, J) > 0.4
    seen[:, 0] = True
    for mask in (None, seen):
        whole = layer(tokens, seen=mask)
        torch.testing.assert_close(layer(tokens, seen=mask, first=first), whole[:, :first])


@pytest.mark.parametrize("kind", [TimeDecoder, BoneDecoder])
def test_shared_queries_match_separate_queries(kind):
    decoder = (kind(TINY) if kind is TimeDecoder else kind(TINY, BONES)).double()
    bones = kind is BoneDecoder
    memory = torch.randn(6, TINY.width if bones else TINY.latent, dtype=DOUBLE)
    queries = decoder.bones if bones else sinusoids(torch.arange(T), TINY.width).double()
    tokens = queries.expand(6, -1, -1)
    for layer in decoder.layers:
        tokens = layer(tokens, memory)
    wanted = decoder.norm(tokens)
    torch.testing.assert_close(decoder(memory), decoder.leave(wanted) if bones else wanted)


def test_joint_order_matters_only_through_the_embedding():
    encoder = FrameEncoder(TINY, J).double()
    keypoints, confidence, rest = random_input(DOUBLE)
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
def test_occluded_inputs_have_no_effect(spatial, value):
    settings = replace(TINY, spatial=spatial, image_features=F)
    network = amplified(MotionVAENetwork(settings, J, BONES))
    features, (keypoints, confidence, rest) = random_features(), random_input()
    local = torch.where(confidence[..., None] > 0, features[1], value)
    found = []
    for read in (
        (keypoints, confidence, rest, features),
        (*occluded_input(value), (features[0], local)),
    ):
        network.zero_grad()
        answers = network.encode(*read)
        torch.cat(answers).sum().backward()
        encoder = network.frame_encoder
        found.append([*answers, *(weight.grad.clone() for weight in encoder.parameters())])
    for one, same in zip(*found, strict=True):
        assert torch.isfinite(same).all()
        assert torch.equal(one, same)


@pytest.mark.parametrize("spatial", [True, False])
def test_gradients_reach_all_weights(spatial):
    network = MotionVAENetwork(replace(TINY, spatial=spatial), J, BONES)
    mean, log_variance = network.encode(*random_input())
    turns = network.decode(mean + (0.5 * log_variance).exp())
    (turns**2).sum().backward()
    for name, weight in network.named_parameters():
        assert weight.grad is not None, name
        assert weight.grad.abs().max() > 0, name


def test_log_variances_are_bounded_with_nonzero_gradient():
    network = MotionVAENetwork(TINY, J, BONES)
    with torch.no_grad():
        network.time_encoder.log_variance.bias.copy_(torch.linspace(-40.0, 40.0, TINY.latent))
    _, log_variance = network.encode(*random_input())
    assert log_variance.abs().max() <= 10
    bias = network.time_encoder.log_variance.bias
    (gradient,) = torch.autograd.grad(log_variance.sum(), bias)
    assert (gradient > 0).all()


def test_mixed_precision_applies_in_training_only():
    """Outputs and gradients are close to single precision and of its type."""
    single = amplified(MotionVAENetwork(TINY, J, BONES))
    mixed = amplified(MotionVAENetwork(replace(TINY, mixed_precision=True), J, BONES))
    found = []
    for network in (single, mixed):
        network.train()
        mean, log_variance = network.encode(*random_input())
        turns = network.decode(mean)
        (turns**2).mean().backward()
        gradient = torch.cat([w.grad.flatten() for w in network.parameters() if w.grad is not None])
        found.append((turns, log_variance, gradient))
    for one, near in zip(*found, strict=True):
        assert near.dtype == torch.float32
        assert 0 < (near - one).norm() / one.norm() < 0.05
    with torch.no_grad():
        for one, same in zip(
            single.eval().encode(*random_input()), mixed.eval().encode(*random_input()), strict=True
        ):
            assert torch.equal(one, same)


@pytest.mark.parametrize("spatial", [True, False])
def test_image_features_are_validated(spatial):
    network = MotionVAENetwork(replace(TINY, image_features=F, spatial=spatial), J, BONES)
    mean, _ = network.encode(*random_input(), random_features())
    assert mean.shape == (B, TINY.latent)
    frames, joints = random_features()
    for given, message in (
        (None, r"features must be a tuple \(of frames, .*=6, got NoneType"),
        ((frames[..., 1:], joints), r"features\[0\] must have shape .*, got \(3, 10, 5\)"),
        ((frames, joints[:, :, 1:]), r"features\[1\] must have shape .*, got \(3, 10, 4, 6\)"),
        ((frames,), "features must be a tuple .*, got tuple"),
        (frames, "features must be a tuple .*, got Tensor"),
    ):
        with pytest.raises(ValueError, match=message):
            network.encode(*random_input(), given)
    with pytest.raises(ValueError, match="features must be None for image_features=0"):
        MotionVAENetwork(TINY, J, BONES).encode(*random_input(), random_features())


def test_invalid_shapes_are_rejected():
    network = MotionVAENetwork(TINY, J, BONES)
    keypoints, confidence, rest = random_input()
    for name, given in (
        ("keypoints", (keypoints[:, 1:], confidence[:, 1:], rest)),
        ("confidence", (keypoints, confidence[:, 1:], rest)),
        ("rest", (keypoints, confidence, rest[1:])),
    ):
        with pytest.raises(ValueError, match=f"{name} must have shape"):
            network.encode(*given)
    with pytest.raises(ValueError, match="latents must have shape"):
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
def test_invalid_settings_are_rejected(name, value):
    with pytest.raises(ValueError, match=name):
        replace(TINY, **{name: value})


def some(dtype: torch.dtype) -> torch.Tensor:
    """Return packed Q, K and V of three items, five tokens and two heads of size four."""
    rng = torch.Generator().manual_seed(0)
    return torch.randn(3, 5, 24, generator=rng, dtype=torch.float64).to(dtype).requires_grad_()


def reference(packed: torch.Tensor, seen: torch.Tensor | None) -> torch.Tensor:
    queries, keys, values = packed.unflatten(-1, (3, 2, 4)).permute(2, 0, 3, 1, 4)
    mask = None if seen is None else seen[:, None, None]
    found = scaled_dot_product_attention(queries, keys, values, attn_mask=mask)
    return found.transpose(1, 2).flatten(2)


def half_masked() -> torch.Tensor:
    seen = torch.ones(3, 5, dtype=torch.bool)
    seen[1, 2:] = False
    return seen


@pytest.mark.parametrize("seen", [None, half_masked()])
def test_value_and_gradient_match_torch(seen):
    own, other = some(torch.bfloat16), some(torch.float64)
    found, wanted = short_attention(own, 2, seen), reference(other, seen)
    assert found.dtype == torch.bfloat16
    torch.testing.assert_close(found.double(), wanted, rtol=0.02, atol=0.02)
    pull = torch.linspace(-1, 1, wanted.numel()).reshape(wanted.shape)
    found.backward(pull.to(torch.bfloat16))
    wanted.backward(pull.double())
    torch.testing.assert_close(own.grad.double(), other.grad, rtol=0.03, atol=0.03)


def test_gradient_matches_finite_differences(monkeypatch):
    """In double precision, with the cast to single precision disabled."""
    monkeypatch.setattr(torch.Tensor, "float", lambda self: self.clone())
    assert torch.autograd.gradcheck(short_attention, (some(torch.float64), 2, half_masked()))


def test_common_offset_of_values_has_no_effect_on_scores():
    """Although rounded weights do not sum to 1."""
    errors, in_common = [], torch.arange(24) >= 16
    pull = torch.randn(3, 5, 8, generator=torch.Generator().manual_seed(1))
    for common in (0.0, 8.0):
        own, other = some(torch.bfloat16), some(torch.float64)
        short_attention(own + common * in_common, 2).backward(pull.to(torch.bfloat16))
        reference(other, None).backward(pull.double())
        errors.append(float((own.grad.double() - other.grad)[..., :8].norm()))
    assert errors[1] < 6 * errors[0]


def test_masked_tokens_get_no_gradient():
    own = some(torch.bfloat16)
    short_attention(own, 2, half_masked()).float().square().sum().backward()
    keys, values = own.grad[..., 8:16], own.grad[..., 16:]
    assert (keys[1, 2:] == 0).all()
    assert (values[1, 2:] == 0).all()
    assert (values[1, :2] != 0).any()
