"""The pose network: each frame's pose from its own joints, once for each view that may be right.

Source: Ponymation, section 3.2 (the rigid pose and the bones' turns of a single image, with a
hypothesis for each quarter of the circle). It is trained first, and teaches the motion VAE; its
rigid poses stay in use, because they are not part of the latent code.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import nn

from probmotion import seeds
from probmotion.geometry.rotations import six_numbers_to_matrix, vector_to_matrix
from probmotion.models.vae.layers import (
    BoneDecoder,
    FrameEncoder,
    ImageFeatures,
    Readout,
    mixed_precision,
)
from probmotion.models.vae.settings import MotionVAESettings

__all__ = ["PoseGuesses", "PoseNetwork"]


@dataclass(frozen=True, eq=False)
class PoseGuesses:
    """Poses of the frames of B sequences under each of H views.

    Parameters
    ----------
    rotation : Tensor, (B, H, T, 3, 3)
        Rigid rotation, from the body to the camera (x right, y up, z towards the camera).
    translation : Tensor, (B, H, T, 2)
        Of the root in the picture, metres: x right, y up.
    turns : Tensor, (B, H, T, bones, 3)
        Rotation vectors of bones, radians.
    log_lengths : Tensor, (B, H, G)
        Logarithms of bone lengths over the rest pose's, of each group; one for all frames.
    """

    rotation: torch.Tensor
    translation: torch.Tensor
    turns: torch.Tensor
    log_lengths: torch.Tensor


class PoseNetwork(nn.Module):
    """2D joints of a frame → its pose, for each view that may be right.

    Frames do not look at each other; only bone lengths are found from their mean.

    Parameters
    ----------
    settings : MotionVAESettings
        Its size.
    n_joints : int
        J.
    n_bones : int
        Bones whose turns are found.
    n_groups : int
        G, groups of bones that share a length.
    seed : int
        Of the first weights.
    """

    quarters: torch.Tensor

    def __init__(
        self,
        settings: MotionVAESettings,
        n_joints: int,
        n_bones: int,
        n_groups: int,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.settings, width = settings, settings.width
        self.n_joints, self.n_bones, self.n_groups = n_joints, n_bones, n_groups
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seeds.integer(seed, "pose weights"))
            self.frame_encoder = FrameEncoder(settings, n_joints)
            self.views = nn.Parameter(torch.randn(settings.hypotheses, width))
            # Six numbers of the rotation and two of the translation.
            self.rigid = nn.Sequential(nn.Linear(width, width), nn.GELU(), Readout(width, 8))
            self.bone_decoder = BoneDecoder(settings, n_bones)
            self.log_lengths = Readout(width, n_groups)
        self.register_buffer("quarters", _quarters(settings.hypotheses), persistent=False)

    def forward(
        self,
        keypoints: torch.Tensor,
        confidence: torch.Tensor,
        rest: torch.Tensor,
        features: ImageFeatures | None = None,
    ) -> PoseGuesses:
        """Return the poses of frames under every view.

        Arguments are those of :meth:`MotionVAENetwork.encode`, with any number T of frames.

        Raises
        ------
        ValueError
            If a shape does not fit, or features are missing or not expected.
        """
        with mixed_precision(self, keypoints.device):
            frames = self.frame_encoder(keypoints, confidence, rest, features)
            guesses = frames[:, None] + self.views[:, None]
            rigid = self.rigid(guesses)
            turns = self.bone_decoder(guesses)
            log_lengths = self.log_lengths(guesses.mean(dim=2))
        # The product of rotations is part of no network: it is exact whatever trains.
        with torch.autocast(keypoints.device.type, enabled=False):
            identity = rigid.new_tensor([1.0, 0, 0, 0, 1, 0])
            rotation = six_numbers_to_matrix(identity + rigid[..., :6]) @ self.quarters[:, None]
        return PoseGuesses(rotation, rigid[..., 6:], turns, log_lengths)


def _quarters(hypotheses: int) -> torch.Tensor:
    """Return turns about Y by π/4 + h π/2, (H, 3, 3)."""
    angles = math.pi / 4 + math.pi / 2 * torch.arange(hypotheses)
    return vector_to_matrix(angles[:, None] * torch.tensor([0.0, 1.0, 0.0]))
