"""Networks of the motion VAE, from 2D joints to one latent code and on to bone rotations.

Source: Ponymation, section 3.3 and table 5. Transformers over the joints of a frame, E_s, and over
frames, E_t, encode q(z); transformers with timestamp queries, D_t, and bone queries, D_s, decode z.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from probmotion import seeds
from probmotion.extras import nn, torch
from probmotion.models.bodies.articulated_body import ArticulatedBody
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
from probmotion.models.vae.pose_network import PoseNetwork
from probmotion.models.vae.settings import MotionVAESettings
from probmotion.validation import check_shape

__all__ = [
    "KIND",
    "FrameMap",
    "MotionVAEModel",
    "MotionVAENetwork",
    "TimeDecoder",
    "TimeEncoder",
    "description_of",
]

KIND = "motion-vae"  # kind of the checkpoints

_TOKEN_SCALE = 0.02  # standard deviation of the initial tokens μ and σ
_INITIAL_LOG_VARIANCE = -4.0
_LOG_VARIANCE_BOUND = 10.0  # largest absolute log variance


class FrameMap(nn.Module):
    """Linear map from frame descriptors to frame vectors, which replaces E_s in the ablation.

    As published (table 7), it uses image features of frames, not of joints; occluded joints are 0.
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
        """Return frame vectors, (B, T, width); see :meth:`MotionVAENetwork.encode`."""
        check_frames(keypoints, confidence, rest, features, self.n_joints, self.features)
        visible = torch.where(confidence[..., None] > 0, keypoints, 0.0) / body_size(rest)
        rest_pose = (rest / body_size(rest)).flatten().expand(*confidence.shape[:2], -1)
        parts = [visible.flatten(2), confidence, rest_pose]
        if features is not None:
            parts.append(features[0])
        return self.enter(torch.cat(parts, dim=-1))


class TimeEncoder(nn.Module):
    """Temporal encoder E_t: encodes frame vectors into mean and log variance of z.

    Two learnt tokens, μ and σ, precede the frames; position encodings are sinusoidal.
    """

    def __init__(self, size: MotionVAESettings) -> None:
        super().__init__()
        # Large initial tokens would dominate the attended frames in the residual stream.
        self.asked = nn.Parameter(_TOKEN_SCALE * torch.randn(2, size.width))
        self.layers = nn.ModuleList(TransformerLayer(size) for _ in range(size.layers))
        self.norm = nn.LayerNorm(size.width)
        self.mean = Readout(size.width, size.latent, quiet=False)
        self.log_variance = Readout(size.width, size.latent)
        # Start with small variances: with unit noise the decoder ignores z for thousands of steps.
        nn.init.constant_(self.log_variance.bias, _INITIAL_LOG_VARIANCE)
        positions = sinusoids(torch.arange(size.frames + 2), size.width)
        self.register_buffer("positions", positions, persistent=False)

    def forward(self, frames: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return mean and log variance: ``(B, T, width) → (B, Z), (B, Z)``.

        The log variance is bounded by 10 tanh(·/10), so that its exponentials stay finite.
        """
        return self.read(self.attended(frames))

    def attended(self, frames: torch.Tensor) -> torch.Tensor:
        """Return the tokens μ and σ after all layers: ``(B, T, width) → (B, 2, width)``."""
        queries = self.asked.to(frames.dtype).expand(len(frames), -1, -1)
        tokens = torch.cat([queries, frames], dim=1) + self.positions
        for layer in self.layers[:-1]:
            tokens = layer(tokens)
        return self.norm(self.layers[-1](tokens, first=2))

    def read(self, tokens: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return mean and log variance of z given both tokens."""
        bound = _LOG_VARIANCE_BOUND
        log_variance = bound * torch.tanh(self.log_variance(tokens[:, 1]) / bound)
        return self.mean(tokens[:, 0]), log_variance


class TimeDecoder(nn.Module):
    """Temporal decoder D_t: decodes z into frame vectors, with one query per timestamp."""

    def __init__(self, size: MotionVAESettings) -> None:
        super().__init__()
        self.layers = nn.ModuleList(TransformerLayer(size, size.latent) for _ in range(size.layers))
        self.norm = nn.LayerNorm(size.width)
        times = sinusoids(torch.arange(size.frames), size.width)
        self.register_buffer("times", times, persistent=False)

    def forward(self, latents: torch.Tensor) -> torch.Tensor:
        """Return frame vectors: ``(B, Z) → (B, T, width)``."""
        # The first layer's self-attention is the same for every z and is computed once.
        tokens = self.times[None]
        for layer in self.layers:
            tokens = layer(tokens, latents)
        return self.norm(tokens)


class MotionVAENetwork(nn.Module):
    """Motion VAE network: encoder q(z | 2D joints) and decoder to bone rotations."""

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
        """Return mean and log variance of q(z), (B, Z) each.

        ``keypoints`` (B, T, J, 2): relative to the root, metres at the subject's distance, ignored
        where occluded; ``confidence`` (B, T, J): 0 where occluded; ``rest`` (J, 3): rest positions
        relative to the root, metres; ``features``: image features of frames, (B, T, F), and at
        joints, (B, T, J, F), required if and only if ``image_features`` is set.
        """
        check_shape("keypoints", keypoints, ("B", self.settings.frames, self.n_joints, 2))
        with mixed_precision(self, keypoints.device):
            return self.time_encoder(self.frame_encoder(keypoints, confidence, rest, features))

    def decode(self, latents: torch.Tensor) -> torch.Tensor:
        """Return bone rotation vectors at z: ``(B, Z) → (B, T, bones, 3)``."""
        check_shape("latents", latents, ("B", self.settings.latent))
        with mixed_precision(self, latents.device):
            return self.bone_decoder(self.time_decoder(latents))


class MotionVAEModel(nn.Module):
    """Module with the motion VAE network and the pose network as parts."""

    def __init__(self, vae: MotionVAENetwork, pose: PoseNetwork) -> None:
        super().__init__()
        self.vae = vae
        self.pose = pose

    @classmethod
    def of(cls, settings: MotionVAESettings, body: ArticulatedBody) -> MotionVAEModel:
        """Return randomly initialised networks for a body."""
        joints, bones = body.skeleton.n_joints, len(body.bones)
        return cls(
            MotionVAENetwork(settings, joints, bones),
            PoseNetwork(settings, joints, bones, body.n_groups),
        )


def description_of(size: MotionVAESettings, body: ArticulatedBody, fps: float) -> dict[str, Any]:
    """Return the checkpoint settings of a motion VAE, JSON-compatible."""
    return {
        "size": asdict(size),
        "joint_names": list(body.skeleton.joint_names),
        "parents": list(body.skeleton.parents),
        "rest": body.rest.tolist(),
        "fps": fps,
    }
