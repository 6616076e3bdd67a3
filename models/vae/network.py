"""The networks of the motion VAE: joints of frames → one latent code → turns of bones.

Source: Ponymation, section 3.3 and table 5. Transformers over the joints of a frame, E_s, and over
frames, E_t, find q(z); transformers queried with timestamps, D_t, and with bones, D_s, decode z.
"""

from __future__ import annotations

import torch
from torch import nn

from probmotion import seeds
from probmotion.models.diffusion.motion_transformer import sinusoids
from probmotion.models.vae.layers import (
    BoneDecoder,
    FrameEncoder,
    ImageFeatures,
    Readout,
    TransformerLayer,
    body_size,
    check_frames,
    mixed_precision,
)
from probmotion.models.vae.settings import MotionVAESettings
from probmotion.validation import check_shape

__all__ = ["FrameMap", "MotionVAENetwork", "TimeDecoder", "TimeEncoder"]

_FIRST_ASKED = 0.02
_FIRST_LOG_VARIANCE = -4.0
_LOG_VARIANCE_BOUND = 10.0


class FrameMap(nn.Module):
    """What stands for E_s in the ablation: a frame's descriptor → its vector, by a linear map.

    Of image features it reads the frames' alone, as published (table 7); what is not seen is 0.

    Parameters
    ----------
    size : MotionVAESettings
        Width, and how many image features there are.
    n_joints : int
        J.
    """

    def __init__(self, size: MotionVAESettings, n_joints: int) -> None:
        super().__init__()
        self.n_joints, self.features = n_joints, size.image_features
        self.enter = nn.Linear(6 * n_joints + self.features, size.width)

    def forward(
        self,
        keypoints: torch.Tensor,
        confidence: torch.Tensor,
        rest: torch.Tensor,
        features: ImageFeatures | None = None,
    ) -> torch.Tensor:
        """Return the vectors of frames, (B, T, width); arguments as `MotionVAENetwork.encode`'s."""
        check_frames(keypoints, confidence, rest, features, self.n_joints, self.features)
        shown = torch.where(confidence[..., None] > 0, keypoints, 0.0) / body_size(rest)
        known = (rest / body_size(rest)).flatten().expand(*confidence.shape[:2], -1)
        parts = [shown.flatten(2), confidence, known]
        if features is not None:
            parts.append(features[0])
        return self.enter(torch.cat(parts, dim=-1))


class TimeEncoder(nn.Module):
    """E_t: vectors of frames → mean and logarithmic variance of z.

    Two learnt tokens, μ and σ, stand before the frames; positions are sinusoidal.

    Parameters
    ----------
    size : MotionVAESettings
        Of the transformer.
    """

    def __init__(self, size: MotionVAESettings) -> None:
        super().__init__()
        # Small: what they are asked in would else drown what they hear of the frames.
        self.asked = nn.Parameter(_FIRST_ASKED * torch.randn(2, size.width))
        self.layers = nn.ModuleList(TransformerLayer(size) for _ in range(size.layers))
        self.norm = nn.LayerNorm(size.width)
        self.mean = Readout(size.width, size.latent, quiet=False)
        self.log_variance = Readout(size.width, size.latent)
        # Codes begin sharp: what a decoder hears through noise of the prior's size it does not
        # learn to listen to for thousands of steps.
        nn.init.constant_(self.log_variance.bias, _FIRST_LOG_VARIANCE)
        places = sinusoids(torch.arange(size.frames + 2), size.width)
        self.register_buffer("places", places, persistent=False)

    def forward(self, frames: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return mean and logarithmic variance: ``(B, T, width) → (B, Z), (B, Z)``.

        The latter is 10 tanh(·/10): its exponential and that of its negative stay finite.
        """
        asked = self.asked.to(frames.dtype).expand(len(frames), -1, -1)
        tokens = torch.cat([asked, frames], dim=1) + self.places
        for layer in self.layers[:-1]:
            tokens = layer(tokens)
        found = self.norm(self.layers[-1](tokens, first=2))
        bound = _LOG_VARIANCE_BOUND
        log_variance = bound * torch.tanh(self.log_variance(found[:, 1]) / bound)
        return self.mean(found[:, 0]), log_variance


class TimeDecoder(nn.Module):
    """D_t: z → vectors of frames; queries are timestamps, the memory is z.

    Parameters
    ----------
    size : MotionVAESettings
        Of the transformer.
    """

    def __init__(self, size: MotionVAESettings) -> None:
        super().__init__()
        self.layers = nn.ModuleList(TransformerLayer(size, size.latent) for _ in range(size.layers))
        self.norm = nn.LayerNorm(size.width)
        times = sinusoids(torch.arange(size.frames), size.width)
        self.register_buffer("times", times, persistent=False)

    def forward(self, latents: torch.Tensor) -> torch.Tensor:
        """Return the vectors of frames: ``(B, Z) → (B, T, width)``."""
        # The first layer's attention is the same for every z, and goes through once.
        tokens = self.times[None]
        for layer in self.layers:
            tokens = layer(tokens, latents)
        return self.norm(tokens)


class MotionVAENetwork(nn.Module):
    """q(z | 2D joints) and the motion at z.

    Parameters
    ----------
    settings : MotionVAESettings
        Its size.
    n_joints : int
        J.
    n_bones : int
        Bones whose turns are decoded.
    seed : int
        Of the first weights.
    """

    def __init__(
        self, settings: MotionVAESettings, n_joints: int, n_bones: int, seed: int = 0
    ) -> None:
        super().__init__()
        self.settings, self.n_joints, self.n_bones = settings, n_joints, n_bones
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seeds.integer(seed, "weights"))
            kind = FrameEncoder if settings.spatial else FrameMap
            self.frame_encoder = kind(settings, n_joints)
            self.time_encoder = TimeEncoder(settings)
            self.time_decoder = TimeDecoder(settings)
            if settings.spatial:
                self.bone_decoder: nn.Module = BoneDecoder(settings, n_bones)
            else:
                all_bones = Readout(settings.width, 3 * n_bones)
                self.bone_decoder = nn.Sequential(all_bones, nn.Unflatten(-1, (n_bones, 3)))

    def encode(
        self,
        keypoints: torch.Tensor,
        confidence: torch.Tensor,
        rest: torch.Tensor,
        features: ImageFeatures | None = None,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return mean and logarithmic variance of q(z), (B, Z) each.

        Parameters
        ----------
        keypoints : Tensor, (B, T, J, 2)
            Metres at the subject's distance, centred on the root; not read where not seen.
        confidence : Tensor, (B, T, J)
            Of each joint; 0 where it is not seen.
        rest : Tensor, (J, 3)
            Joints of the rest pose relative to the root, metres: offsets summed from it on.
        features : tuple of Tensor, optional
            Image features of frames, (B, T, F), and at joints, (B, T, J, F), if the settings say
            so.

        Raises
        ------
        ValueError
            If a shape does not fit, or features are missing or not expected.
        """
        check_shape("keypoints", keypoints, ("B", self.settings.frames, self.n_joints, 2))
        with mixed_precision(self, keypoints.device):
            return self.time_encoder(self.frame_encoder(keypoints, confidence, rest, features))

    def decode(self, latents: torch.Tensor) -> torch.Tensor:
        """Return the turns of bones at z: ``(B, Z) → (B, T, bones, 3)``, rotation vectors."""
        check_shape("latents", latents, ("B", self.settings.latent))
        with mixed_precision(self, latents.device):
            return self.bone_decoder(self.time_decoder(latents))
