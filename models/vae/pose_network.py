"""Pose network: estimates the pose of a frame from its 2D joints under several view hypotheses.

Source: Ponymation, section 3.2 (rigid pose and bone rotations from a single image, with one
hypothesis per quadrant). The network is trained first and teaches the motion VAE; inference uses
its rigid poses because the latent code does not contain them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from probmotion import seeds
from probmotion.extras import nn, torch
from probmotion.geometry.rotations import rotation_6d_to_matrix, vector_to_matrix
from probmotion.models.training.devices import half_precision
from probmotion.models.vae.layers import (
    BoneDecoder,
    FrameEncoder,
    ImageFeatures,
    Readout,
    mixed_precision,
)
from probmotion.models.vae.settings import MotionVAESettings

__all__ = ["PoseHypotheses", "PoseNetwork"]


@dataclass(frozen=True, eq=False)
class PoseHypotheses:
    """Poses of B sequences under H view hypotheses.

    ``rotation`` (B, H, T, 3, 3): from the body to the camera (x right, y up, z towards the camera);
    ``translation`` (B, H, T, 2): root in the image, metres, x right and y up; ``turns``
    (B, H, T, bones, 3): rotation vectors, radians; ``log_lengths`` (B, H, G): log bone lengths
    relative to the rest pose, constant over frames.
    """

    rotation: torch.Tensor
    translation: torch.Tensor
    turns: torch.Tensor
    log_lengths: torch.Tensor

    def at(self, index: Any) -> PoseHypotheses:
        """Return the poses at an index of the leading axes."""
        return PoseHypotheses(*(part[index] for part in vars(self).values()))


class PoseNetwork(nn.Module):
    """Network that predicts the pose of a frame from its 2D joints for each view hypothesis.

    Frames are independent, except that bone lengths use the mean over frames. The body has
    ``n_joints`` joints, ``n_bones`` bones and ``n_groups`` groups of bones with a common length;
    ``seed`` determines the initial weights.
    """

    quarters: torch.Tensor  # (H, 3, 3), rotations to the centres of the quadrants

    def __init__(
        self, settings: MotionVAESettings, n_joints: int, n_bones: int, n_groups: int, seed: int = 0
    ) -> None:
        super().__init__()
        self.settings, width = settings, settings.width
        self.n_joints, self.n_bones, self.n_groups = n_joints, n_bones, n_groups
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seeds.integer(seed, "pose weights"))
            self.frame_encoder = FrameEncoder(settings, n_joints)
            self.views = nn.Parameter(torch.randn(settings.hypotheses, width))
            # Six outputs for the rotation and two for the translation.
            self.rigid = nn.Sequential(nn.Linear(width, width), nn.GELU(), Readout(width, 8))
            self.bone_decoder = BoneDecoder(settings, n_bones)
            self.log_lengths = Readout(width, n_groups)
        angles = math.pi / 4 + math.pi / 2 * torch.arange(settings.hypotheses)
        quarters = vector_to_matrix(angles[:, None] * torch.tensor([0.0, 1.0, 0.0]))
        self.register_buffer("quarters", quarters, persistent=False)

    def forward(
        self,
        keypoints: torch.Tensor,
        confidence: torch.Tensor,
        rest: torch.Tensor,
        features: ImageFeatures | None = None,
    ) -> PoseHypotheses:
        """Return the poses of frames under every view hypothesis.

        Arguments are as for :meth:`MotionVAENetwork.encode`, with any number of frames.
        """
        with mixed_precision(self, keypoints.device):
            frames = self.frame_encoder(keypoints, confidence, rest, features)
            hypotheses = frames[:, None] + self.views[:, None]
            rigid = self.rigid(hypotheses)
            turns = self.bone_decoder(hypotheses)
            log_lengths = self.log_lengths(hypotheses.mean(dim=2))
        # Compose rotations in full precision even under autocast.
        with half_precision(keypoints.device, False):
            identity = rigid.new_tensor([1.0, 0, 0, 0, 1, 0])
            rotation = rotation_6d_to_matrix(identity + rigid[..., :6]) @ self.quarters[:, None]
        return PoseHypotheses(rotation, rigid[..., 6:], turns, log_lengths)
