"""Losses of the motion VAE: projection, closed forms and hypothesis selection."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from probmotion.geometry.cameras import Cameras
from probmotion.geometry.rotations import vector_to_matrix
from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.models.vae.losses import (
    best_hypothesis,
    hypothesis_losses,
    project_to_image,
    reconstruction,
    roughness,
    weighted_sum,
)
from probmotion.models.vae.pose_network import PoseHypotheses
from probmotion.models.vae.settings import MotionVAESettings
from probmotion.motion.skeleton import Skeleton

B, H, L = 3, 4, 5
SKELETON = Skeleton(["pelvis", "neck", "left_hip", "left_knee", "ankle"], [-1, 0, 0, 2, 3])
REST = np.array([[0, 0, 0], [0, 0.5, 0], [0.1, 0, 0], [0, -0.4, 0.05], [0, -0.4, -0.05]])
BODY = ArticulatedBody(SKELETON, REST)


def random_hypotheses() -> PoseHypotheses:
    rng = np.random.default_rng(0)
    return PoseHypotheses(
        torch.tensor(vector_to_matrix(rng.normal(size=(B, H, L, 3)))),
        torch.tensor(0.1 * rng.normal(size=(B, H, L, 2))),
        torch.tensor(0.3 * rng.normal(size=(B, H, L, len(BODY.bones), 3))),
        torch.tensor(0.1 * rng.normal(size=(B, H, BODY.n_groups))),
    )


@pytest.mark.parametrize("perspective", [True, False])
def test_projection_matches_cameras(perspective):
    rng = np.random.default_rng(0)
    points = rng.normal(size=(4, 6, 3))
    camera = Cameras.around([0.7], [0.0], distance=7.0, perspective=perspective)
    # The camera axes have y up and z towards the camera.
    in_camera = np.einsum("ij,...j->...i", camera.rotation[0], points) * [1, -1, -1]
    projected = project_to_image(torch.tensor(in_camera), 7.0 if perspective else None)
    np.testing.assert_allclose(projected, camera.project(points)[0], atol=1e-12)


def test_reconstruction_ignores_occluded_joints():
    rng = np.random.default_rng(1)
    positions = torch.tensor(rng.normal(size=(B, L, 5, 3)))
    keypoints = torch.tensor(rng.normal(size=(B, L, 5, 2)))
    weight = torch.tensor((rng.random((B, L, 5)) < 0.7).astype(float))
    expected = np.zeros(B)
    for b, t, j in zip(*np.nonzero(weight.numpy()), strict=True):
        error = positions[b, t, j, :2].numpy() * [1, -1] - keypoints[b, t, j].numpy()
        expected[b] += error @ error
    loss = reconstruction(positions, keypoints, weight, None)
    np.testing.assert_allclose(loss, expected, rtol=1e-12)


def test_roughness_of_a_uniform_rotation():
    step = torch.tensor([0.0, 0.2, 0.0], dtype=torch.float64)
    times = torch.arange(L, dtype=torch.float64)
    rotation = vector_to_matrix(times[:, None] * step)
    turns = (0.1 * times)[:, None, None].expand(L, 2, 3)
    translation = torch.stack([0.3 * times, torch.zeros_like(times)], dim=-1)
    # Each step adds ½‖R − I‖² = 2(1 − cos a), six terms of bone rotations and one of the path.
    each = 2 * (1 - np.cos(0.2)) + 6 * 0.1**2 + 0.3**2
    loss = float(roughness(turns, rotation, translation))
    assert loss == pytest.approx((L - 1) * each, rel=1e-12)


def test_loss_terms_of_the_true_hypothesis():
    hypotheses = random_hypotheses()
    translation = torch.nn.functional.pad(hypotheses.translation, (0, 1))
    positions = BODY.positions(
        hypotheses.turns, hypotheses.rotation, translation, hypotheses.log_lengths
    )
    truth = project_to_image(positions[:, 2], 7.0)
    terms = hypothesis_losses(BODY, hypotheses, truth, torch.ones(B, L, 5), 7.0)
    np.testing.assert_allclose(terms["reconstruction"][:, 2], 0, atol=1e-20)
    assert terms["reconstruction"][:, [0, 1, 3]].min() > 0.1
    np.testing.assert_allclose(terms["ranges"], BODY.range_excess(hypotheses.turns).sum(dim=-1))
    lengths = L * (hypotheses.log_lengths**2).sum(dim=-1)
    np.testing.assert_allclose(terms["lengths"], lengths)
    parts = (getattr(hypotheses, name)[1, 3] for name in ("turns", "rotation", "translation"))
    assert float(terms["smoothness"][1, 3]) == pytest.approx(float(roughness(*parts)))


def test_weighted_sum_uses_the_settings():
    terms = {"reconstruction": torch.tensor([1.0, 2.0]), "kl": torch.tensor([10.0, 0.0])}
    settings = replace(MotionVAESettings.tiny(), reconstruction=3.0, kl=0.5)
    np.testing.assert_allclose(weighted_sum(terms, settings), [8.0, 6.0])


def test_best_hypothesis_is_selected_per_sequence():
    hypotheses = random_hypotheses()
    losses = torch.tensor([[3.0, 1, 2, 4], [0, 1, 2, 3], [3, 2, 1, 0.5]])
    best = best_hypothesis(hypotheses, losses)
    for b, h in enumerate((1, 0, 3)):
        for name in ("rotation", "translation", "turns", "log_lengths"):
            np.testing.assert_array_equal(getattr(best, name)[b], getattr(hypotheses, name)[b, h])
