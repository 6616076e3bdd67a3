"""Networks of the motion VAE: masking, equivalences with torch, gradients and hypotheses."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import nn
from torch.nn import functional

from probmotion.geometry.rotations import geodesic_angle, vector_to_matrix
from probmotion.models.diffusion.motion_transformer import sinusoids
from probmotion.models.vae.layers import BoneDecoder, FrameEncoder, Readout, TransformerLayer
from probmotion.models.vae.network import MotionVAENetwork, TimeDecoder
from probmotion.models.vae.pose_network import PoseNetwork
from probmotion.models.vae.settings import MotionVAESettings
from probmotion.models.vae.short_attention import short_attention

TINY = replace(MotionVAESettings.tiny(), layers=2)
B, T, J, BONES, G, H, F = 3, 10, 5, 4, 3, 4, 6
DOUBLE = torch.float64


def random_input(dtype=torch.float32, seed=0):
    """Return keypoints with occlusions, confidences and a rest pose."""
    generator = torch.Generator().manual_seed(seed)
    keypoints = torch.randn(B, T, J, 2, generator=generator, dtype=dtype)
    confidence = torch.rand(B, T, J, generator=generator, dtype=dtype)
    confidence[confidence < 0.3] = 0.0
    assert (confidence == 0).any()
    return keypoints, confidence, torch.randn(J, 3, generator=generator, dtype=dtype)


def random_features():
    generator = torch.Generator().manual_seed(1)
    return tuple(torch.randn(size, generator=generator) for size in ((B, T, F), (B, T, J, F)))


def amplified(network, size=0.3):
    """Return the network with larger random output weights."""
    with torch.no_grad():
        for part in network.modules():
            if isinstance(part, Readout):
                part.weight.normal_(0, size, generator=torch.Generator().manual_seed(1))
    return network


def as_torch_layer(layer, memory=False):
    """Return torch's layer with the same weights."""
    width, hidden = layer.attended.in_features, layer.perceptron[0].out_features
    kind = nn.TransformerDecoderLayer if memory else nn.TransformerEncoderLayer
    options = {"activation": functional.gelu, "batch_first": True, "norm_first": True}
    reference = kind(width, layer.heads, hidden, dropout=0.0, dtype=DOUBLE, **options)
    pairs = [
        (reference.self_attn.out_proj, layer.attended),
        (reference.linear1, layer.perceptron[0]),
        (reference.linear2, layer.perceptron[2]),
        (reference.norm1, layer.attention_norm),
        (reference.norm3 if memory else reference.norm2, layer.perceptron_norm),
    ]
    for target, source in pairs:
        target.load_state_dict(source.state_dict())
    with torch.no_grad():
        reference.self_attn.in_proj_weight.copy_(layer.asked_keys_values.weight)
        reference.self_attn.in_proj_bias.copy_(layer.asked_keys_values.bias)
        if memory:
            reference.multihead_attn.in_proj_weight[2 * width :].copy_(layer.told.weight)
            reference.multihead_attn.in_proj_bias[2 * width :].copy_(layer.told.bias)
            reference.multihead_attn.out_proj.weight.copy_(torch.eye(width))
            reference.multihead_attn.out_proj.bias.zero_()
    return reference


def random_mask(n):
    seen = torch.rand(n, J, generator=torch.Generator().manual_seed(2)) > 0.4
    seen[:, 0] = True
    return seen


def test_layers_match_torch():
    tokens, seen = torch.randn(6, J, TINY.width, dtype=DOUBLE), random_mask(6)
    layer = TransformerLayer(TINY).double()
    expected = as_torch_layer(layer)(tokens, src_key_padding_mask=~seen)
    torch.testing.assert_close(layer(tokens, seen=seen), expected)
    for first in (1, 2):
        torch.testing.assert_close(layer(tokens, seen=seen, first=first), expected[:, :first])
    memory = torch.randn(6, TINY.width, dtype=DOUBLE)
    layer = TransformerLayer(TINY, TINY.width).double()
    expected = as_torch_layer(layer, memory=True)(tokens, memory[:, None])
    torch.testing.assert_close(layer(tokens, memory), expected)


@pytest.mark.parametrize("kind", [TimeDecoder, BoneDecoder])
def test_shared_queries_match_separate_queries(kind):
    decoder = (kind(TINY) if kind is TimeDecoder else kind(TINY, BONES)).double()
    bones = kind is BoneDecoder
    memory = torch.randn(6, TINY.width if bones else TINY.latent, dtype=DOUBLE)
    queries = decoder.bones if bones else sinusoids(torch.arange(T), TINY.width).double()
    tokens = queries.expand(6, -1, -1)
    for layer in decoder.layers:
        tokens = layer(tokens, memory)
    expected = decoder.norm(tokens)
    torch.testing.assert_close(decoder(memory), decoder.leave(expected) if bones else expected)


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


@pytest.mark.parametrize("spatial", [True, False])
def test_occluded_inputs_have_no_effect(spatial):
    network = MotionVAENetwork(replace(TINY, spatial=spatial, image_features=F), J, BONES)
    keypoints, confidence, rest = random_input()
    frames, joints = random_features()
    seen, results = confidence[..., None] > 0, []
    for value in (0.0, torch.nan):
        network.zero_grad()
        features = frames, torch.where(seen, joints, value)
        outputs = network.encode(torch.where(seen, keypoints, value), confidence, rest, features)
        torch.cat(outputs).sum().backward()
        results.append([*outputs, *(w.grad.clone() for w in network.frame_encoder.parameters())])
    for first, second in zip(*results, strict=True):
        assert torch.isfinite(second).all()
        assert torch.equal(first, second)


@pytest.mark.parametrize("spatial", [True, False])
def test_gradients_reach_all_weights(spatial):
    network = MotionVAENetwork(replace(TINY, spatial=spatial), J, BONES)
    mean, log_variance = network.encode(*random_input())
    network.decode(mean + (0.5 * log_variance).exp()).square().sum().backward()
    pose = PoseNetwork(TINY, J, BONES, G)
    outputs = vars(pose(*random_input())).values()
    sum((part * torch.randn_like(part)).sum() for part in outputs).backward()
    for name, weight in [*network.named_parameters(), *pose.named_parameters()]:
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
    results = []
    for network in (single, mixed):
        mean, log_variance = network.train().encode(*random_input())
        turns = network.decode(mean)
        turns.square().mean().backward()
        gradient = torch.cat([w.grad.flatten() for w in network.parameters() if w.grad is not None])
        results.append((turns, log_variance, gradient))
    for expected, result in zip(*results, strict=True):
        assert result.dtype == torch.float32
        assert 0 < (result - expected).norm() / expected.norm() < 0.05
    means = (torch.cat(network.eval().encode(*random_input())) for network in (single, mixed))
    assert torch.equal(*means)


def test_invalid_inputs_are_rejected():
    plain = MotionVAENetwork(TINY, J, BONES)
    encode = MotionVAENetwork(replace(TINY, image_features=F), J, BONES).encode
    keypoints, confidence, rest = inputs = random_input()
    frames, joints = random_features()
    for call, message in (
        (lambda: encode(*inputs), r"features must be a tuple .*=6, got NoneType"),
        (lambda: encode(*inputs, (frames,)), "features must be a tuple .*, got tuple"),
        (lambda: encode(*inputs, (frames[..., 1:], joints)), r"features\[0\] must have shape"),
        (lambda: encode(*inputs, (frames, joints[:, :, 1:])), r"features\[1\] must have shape"),
        (lambda: plain.encode(*inputs, (frames, joints)), "features must be None"),
        (lambda: plain.encode(keypoints[:, 1:], confidence[:, 1:], rest), "keypoints must have sh"),
        (lambda: plain.encode(keypoints, confidence[:, 1:], rest), "confidence must have shape"),
        (lambda: plain.encode(keypoints, confidence, rest[1:]), "rest must have shape"),
        (lambda: plain.decode(torch.zeros(2, TINY.latent + 1)), "latents must have shape"),
    ):
        with pytest.raises(ValueError, match=message):
            call()


def test_invalid_settings_are_rejected():
    for name, value in [("frames", 1), ("width", 33), ("layers", 1.5), ("heads", 3),
                        ("feedforward", 0), ("latent", True), ("spatial", 1),
                        ("mixed_precision", "yes"), ("hypotheses", 5), ("image_features", -1),
                        ("reconstruction", float("nan")), ("kl", -0.1), ("smoothness", True),
                        ("ranges", "0.1"), ("lengths", torch.inf), ("teacher", None)]:  # fmt: skip
        with pytest.raises(ValueError, match=name):
            replace(TINY, **{name: value})


def random_heads(dtype):
    """Return packed Q, K and V of three items, five tokens and two heads of size four."""
    generator = torch.Generator().manual_seed(0)
    return torch.randn(3, 5, 24, generator=generator, dtype=DOUBLE).to(dtype).requires_grad_()


def torch_attention(packed, seen):
    queries, keys, values = packed.unflatten(-1, (3, 2, 4)).permute(2, 0, 3, 1, 4)
    mask = None if seen is None else seen[:, None, None]
    result = functional.scaled_dot_product_attention(queries, keys, values, attn_mask=mask)
    return result.transpose(1, 2).flatten(2)


@pytest.mark.parametrize("masked", [False, True])
def test_attention_and_gradient_match_torch(masked):
    seen = random_mask(3) if masked else None
    half, double = random_heads(torch.bfloat16), random_heads(DOUBLE)
    result, expected = short_attention(half, 2, seen), torch_attention(double, seen)
    assert result.dtype == torch.bfloat16
    torch.testing.assert_close(result.double(), expected, rtol=0.02, atol=0.02)
    upstream = torch.linspace(-1, 1, expected.numel()).reshape(expected.shape)
    result.backward(upstream.to(torch.bfloat16))
    expected.backward(upstream.double())
    torch.testing.assert_close(half.grad.double(), double.grad, rtol=0.03, atol=0.03)
    if masked:
        assert (half.grad[..., 8:][~seen] == 0).all()


def test_gradient_matches_finite_differences(monkeypatch):
    """The check uses double precision, with the cast to single precision disabled."""
    monkeypatch.setattr(torch.Tensor, "float", lambda self: self.clone())
    assert torch.autograd.gradcheck(short_attention, (random_heads(DOUBLE), 2, random_mask(3)))


def test_common_offset_of_values_has_no_effect_on_scores():
    """The offset cancels although rounded weights do not sum to 1."""
    errors, in_common = [], torch.arange(24) >= 16
    upstream = torch.randn(3, 5, 8, generator=torch.Generator().manual_seed(1))
    for common in (0.0, 8.0):
        half, double = random_heads(torch.bfloat16), random_heads(DOUBLE)
        short_attention(half + common * in_common, 2).backward(upstream.to(torch.bfloat16))
        torch_attention(double, None).backward(upstream.double())
        errors.append(float((half.grad.double() - double.grad)[..., :8].norm()))
    assert errors[1] < 6 * errors[0]


@pytest.fixture(scope="module")
def pose_network():
    return amplified(PoseNetwork(TINY, J, BONES, G), 0.1)


def test_initial_hypotheses_lie_in_their_quadrants():
    poses = PoseNetwork(TINY, J, BONES, G)(*random_input())
    for view in range(H):
        angle = math.pi / 4 + view * math.pi / 2
        expected = vector_to_matrix(torch.tensor([0.0, angle, 0.0])).expand(B, T, 3, 3)
        assert geodesic_angle(poses.rotation[:, view], expected).max() < 0.3
        # The front, +Z, faces the camera in the first and last quadrant.
        front = poses.rotation[:, view, :, :, 2]
        assert (front[..., 0].sign() == (1 if view < 2 else -1)).all()
        assert (front[..., 2].sign() == (1 if view in (0, 3) else -1)).all()
    for part in (poses.translation, poses.turns, poses.log_lengths):
        assert part.abs().max() < 0.3


@pytest.mark.parametrize("mixed", [False, True])
def test_rotations_are_orthonormal(mixed):
    network = amplified(PoseNetwork(replace(TINY, mixed_precision=mixed), J, BONES, G), 0.1)
    poses = network.train()(*random_input())
    assert {part.dtype for part in vars(poses).values()} == {torch.float32}
    identity = torch.eye(3).expand_as(poses.rotation)
    torch.testing.assert_close(poses.rotation @ poses.rotation.mT, identity, atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(poses.rotation), torch.ones(B, H, T))
    assert geodesic_angle(poses.rotation[:, :, 1:], poses.rotation[:, :, :-1]).mean() > 1e-2


def test_predicted_rotation_follows_the_quarter_turn():
    """A camera tilt is the same for all hypotheses."""
    network = PoseNetwork(TINY, J, BONES, G)
    with torch.no_grad():
        for weights in network.rigid[-1].parameters():
            weights.zero_()
        # Predict a rotation about X by 0.2: two columns minus those of the identity.
        tilt = [0, 0, 0, 0, math.cos(0.2) - 1, math.sin(0.2)]
        network.rigid[-1].bias[:6] = torch.tensor(tilt)
        rotation = network(*random_input()).rotation
    up = torch.tensor([0.0, math.cos(0.2), math.sin(0.2)])
    torch.testing.assert_close(rotation[..., 1], up.expand(B, H, T, 3))


def test_frames_are_independent_except_for_lengths(pose_network):
    keypoints, confidence, rest = random_input()
    before = pose_network(keypoints, confidence, rest)
    keypoints = torch.where(confidence[..., None] > 0, keypoints, torch.nan)
    keypoints[1, 3] += 0.5
    after = pose_network(keypoints, confidence, rest)
    others = torch.ones(B, T, dtype=torch.bool)
    others[1, 3] = False
    for name in ("rotation", "translation", "turns"):
        old, new = (getattr(poses, name).transpose(1, 2) for poses in (before, after))
        torch.testing.assert_close(old[others], new[others], rtol=1e-5, atol=1e-6)
        assert (old[1, 3] - new[1, 3]).abs().max() > 1e-3
    assert (after.log_lengths - before.log_lengths)[1].abs().min() > 1e-6
    torch.testing.assert_close(after.log_lengths[::2], before.log_lengths[::2])
