"""Losses for learning motion from 2D tracks (Ponymation, section 3.2, equation 1).

Camera axes: X right, Y up, Z towards the camera. Image axes: x right, y down.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from probmotion.extras import torch
from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.models.vae.pose_network import PoseHypotheses, PoseNetwork
from probmotion.models.vae.settings import MotionVAESettings

__all__ = [
    "best_hypothesis",
    "hypothesis_losses",
    "predicted_hypotheses",
    "project_to_image",
    "reconstruction",
    "roughness",
    "weighted_sum",
]


def project_to_image(positions: torch.Tensor, distance: float | None) -> torch.Tensor:
    """Project camera coordinates to the image, ``(…, 3) → (…, 2)``, metres at the subject.

    The subject is at Z = 0, ``distance`` metres from the camera; ``None``: orthographic.
    """
    x, y, z = positions.unbind(-1)
    plane = torch.stack([x, -y], dim=-1)
    return plane if distance is None else plane * (distance / (distance - z))[..., None]


def reconstruction(
    positions: torch.Tensor, keypoints: torch.Tensor, weight: torch.Tensor, distance: float | None
) -> torch.Tensor:
    """Return the reprojection loss Σ_t Σ_j c ‖p(X) − u‖², ``(…, L, J, 3) → (…)``, m².

    The projection p is :func:`project_to_image`. ``keypoints`` u (…, L, J, 2) must be finite where
    ``weight`` c (…, L, J) is 0.
    """
    square = ((project_to_image(positions, distance) - keypoints) ** 2).sum(dim=-1)
    return (weight * square).sum(dim=(-2, -1))


def roughness(
    turns: torch.Tensor, rotation: torch.Tensor, translation: torch.Tensor
) -> torch.Tensor:
    """Return the temporal regulariser R_temp = Σ_t ‖ξ_t − ξ_{t−1}‖², ``(…)``.

    ξ_t consists of ``turns`` (…, L, B, 3), rotation vectors of bones, ``rotation`` (…, L, 3, 3) of
    the body and ``translation`` (…, L, D), root positions, metres. Half the squared difference of
    two close rotation matrices approximates the squared angle between them.
    """
    bones = turns.diff(dim=-3).square().sum(dim=(-3, -2, -1))
    angles = 0.5 * rotation.diff(dim=-3).square().sum(dim=(-3, -2, -1))
    return bones + angles + translation.diff(dim=-2).square().sum(dim=(-2, -1))


def hypothesis_losses(
    body: ArticulatedBody,
    hypotheses: PoseHypotheses,
    keypoints: torch.Tensor,
    weight: torch.Tensor,
    distance: float | None,
) -> dict[str, torch.Tensor]:
    """Return the loss terms of every view hypothesis, (B, H) each.

    ``keypoints``, ``weight`` and ``distance`` are as for :func:`reconstruction`.
    """
    turns = hypotheses.turns
    translation = torch.nn.functional.pad(hypotheses.translation, (0, 1))
    positions = body.positions(turns, hypotheses.rotation, translation, hypotheses.log_lengths)
    frames = keypoints.shape[-3]
    return {
        "reconstruction": reconstruction(positions, keypoints[:, None], weight[:, None], distance),
        "smoothness": roughness(turns, hypotheses.rotation, hypotheses.translation),
        "ranges": body.range_excess(turns).sum(dim=-1),
        "lengths": frames * hypotheses.log_lengths.square().sum(dim=-1),
    }


def weighted_sum(terms: Mapping[str, torch.Tensor], settings: MotionVAESettings) -> torch.Tensor:
    """Return the sum of the loss terms, weighted by the settings of the same names."""
    weighted = (getattr(settings, name) * value for name, value in terms.items())
    return sum(weighted, torch.zeros(()))


def best_hypothesis(hypotheses: PoseHypotheses, losses: torch.Tensor) -> PoseHypotheses:
    """Return each sequence's view hypothesis with the smallest loss (B, H); drop the axis H.

    The choice is not differentiated.
    """
    rows = torch.arange(len(losses), device=losses.device)
    return hypotheses.at((rows, losses.detach().argmin(dim=1)))


@torch.no_grad()
def predicted_hypotheses(
    network: PoseNetwork,
    settings: MotionVAESettings,
    body: ArticulatedBody,
    keypoints: np.ndarray,
    confidence: np.ndarray,
    distance: float | None,
) -> tuple[PoseHypotheses, torch.Tensor]:
    """Return the network's hypotheses for keypoints (B, L, J, 2) and their losses (B, H)."""
    arrays = (keypoints, confidence, body.rest_positions)
    points, seen, rest = (torch.as_tensor(array, dtype=torch.float32) for array in arrays)
    hypotheses = network(points, seen, rest)
    terms = hypothesis_losses(body, hypotheses, points, seen, distance)
    return hypotheses, weighted_sum(terms, settings)
