"""Pose network: independent frames, view hypotheses and shared bone lengths."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from probmotion.geometry.rotations import geodesic_angle
from probmotion.models.vae.layers import Readout
from probmotion.models.vae.pose_network import PoseNetwork
from probmotion.models.vae.settings import MotionVAESettings

TINY = replace(MotionVAESettings.tiny(), layers=2)
B, T, J, BONES, G, H = 3, 7, 5, 4, 3, 4


def random_input(seed=0, frames=T):
    generator = torch.Generator().manual_seed(seed)
    keypoints = torch.randn(B, frames, J, 2, generator=generator)
    confidence = torch.rand(B, frames, J, generator=generator).add(0.1)
    confidence[:, :, 2] = 0.0
    return keypoints, confidence, torch.randn(J, 3, generator=generator)


def amplified(network):
    """Increase the outputs of random networks."""
    with torch.no_grad():
        for part in network.modules():
            if isinstance(part, Readout):
                part.weight.normal_(0, 0.1, generator=torch.Generator().manual_seed(1))
    return network


@pytest.fixture(scope="module")
def network():
    return amplified(PoseNetwork(TINY, J, BONES, G))


def test_initial_hypotheses_lie_in_their_quadrants():
    found = PoseNetwork(TINY, J, BONES, G)(*random_input())
    for view in range(H):
        angle = math.pi / 4 + view * math.pi / 2
        turn = torch.zeros(3, 3)
        turn[0, 0] = turn[2, 2] = math.cos(angle)
        turn[0, 2], turn[2, 0], turn[1, 1] = math.sin(angle), -math.sin(angle), 1.0
        assert geodesic_angle(found.rotation[:, view], turn.expand(B, T, 3, 3)).max() < 0.3
        # The front, +Z, faces the camera in the first and last quadrant.
        front = found.rotation[:, view, :, :, 2]
        assert (front[..., 0].sign() == (1 if view < 2 else -1)).all()
        assert (front[..., 2].sign() == (1 if view in (0, 3) else -1)).all()
    for near in (found.translation, found.turns, found.log_lengths):
        assert near.abs().max() < 0.3


def test_rotations_are_orthonormal(network):
    rotation = network(*random_input()).rotation
    identity = torch.eye(3).expand_as(rotation)
    torch.testing.assert_close(rotation @ rotation.mT, identity, atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(B, H, T))
    assert geodesic_angle(rotation[:, :, 1:], rotation[:, :, :-1]).mean() > 1e-2


def test_predicted_rotation_follows_the_quarter_turn():
    """A camera tilt is the same for all hypotheses."""
    network = PoseNetwork(TINY, J, BONES, G)
    with torch.no_grad():
        for weights in network.rigid[-1].parameters():
            weights.zero_()
        # Rotation about X by 0.2: its first two columns minus those of the identity.
        tilt = [0, 0, 0, 0, math.cos(0.2) - 1, math.sin(0.2)]
        network.rigid[-1].bias[:6] = torch.tensor(tilt)
        rotation = network(*random_input()).rotation
    up = torch.tensor([0.0, math.cos(0.2), math.sin(0.2)])
    torch.testing.assert_close(rotation[..., 1], up.expand(B, H, T, 3))


def test_frames_are_independent_except_for_lengths(network):
    keypoints, confidence, rest = random_input()
    before = network(keypoints, confidence, rest)
    changed = keypoints.clone()
    changed[1, 3] += 0.5
    after = network(changed, confidence, rest)
    elsewhere = torch.ones(B, T, dtype=torch.bool)
    elsewhere[1, 3] = False
    for name in ("rotation", "translation", "turns"):
        one, two = (getattr(found, name).transpose(1, 2) for found in (before, after))
        torch.testing.assert_close(one[elsewhere], two[elsewhere], rtol=1e-5, atol=1e-6)
        assert (one[1, 3] - two[1, 3]).abs().max() > 1e-3
    assert (after.log_lengths - before.log_lengths)[1].abs().min() > 1e-6
    torch.testing.assert_close(after.log_lengths[::2], before.log_lengths[::2])


def test_occluded_inputs_have_no_effect(network):
    keypoints, confidence, rest = random_input()
    before = network(keypoints, confidence, rest)
    keypoints[:, :, 2] = float("nan")
    for found, wanted in zip(
        vars(network(keypoints, confidence, rest)).values(), vars(before).values(), strict=True
    ):
        assert torch.equal(found, wanted)


def test_gradients_reach_all_weights():
    network = PoseNetwork(TINY, J, BONES, G)
    found = network(*random_input())
    sum((part * torch.randn_like(part)).sum() for part in vars(found).values()).backward()
    for name, weight in network.named_parameters():
        assert weight.grad is not None, name
        assert weight.grad.abs().max() > 0, name


def test_mixed_precision_keeps_rotations_orthonormal():
    network = amplified(PoseNetwork(replace(TINY, mixed_precision=True), J, BONES, G)).train()
    found = network(*random_input())
    assert {part.dtype for part in vars(found).values()} == {torch.float32}
    identity = torch.eye(3).expand_as(found.rotation)
    torch.testing.assert_close(found.rotation @ found.rotation.mT, identity, atol=1e-5, rtol=0)
