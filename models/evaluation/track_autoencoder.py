"""Variational autoencoder of 2D motions.

The architecture, with the latent of ACTOR (Petrovich et al. 2021), follows the released MAS code.
"""

from __future__ import annotations

from dataclasses import dataclass

from probmotion.extras import nn, torch
from probmotion.models.diffusion.motion_transformer import sinusoids
from probmotion.models.diffusion.settings import TransformerSettings
from probmotion.validation import check_count, check_positive

__all__ = ["EvaluatorSettings", "TrackAutoencoder", "TrackEncoder"]


@dataclass(frozen=True)
class EvaluatorSettings(TransformerSettings):
    """Size of the autoencoder and weight of its KL divergence.

    Parameters
    ----------
    frames, layers, width, heads, feedforward : int
        Size of each of the two transformers.
    latent : int
        Dimension of the latent, the features.
    kl_weight : float
        Weight of the KL divergence of the latent from N(0, I), summed over dimensions, relative to
        the mean squared error in standardised units.
    """

    width: int = 256
    latent: int = 256
    kl_weight: float = 1e-5

    def __post_init__(self) -> None:
        super().__post_init__()
        check_count("latent", self.latent)
        check_positive("kl_weight", self.kl_weight)

    @classmethod
    def tiny(cls, frames: int = 20) -> EvaluatorSettings:
        """Return settings of a network for tests that trains in seconds."""
        return cls(frames, layers=2, width=32, heads=2, feedforward=64, latent=8)

    @classmethod
    def small(cls, frames: int = 40) -> EvaluatorSettings:
        """Return the shipped size, which trains in minutes on two cores."""
        return cls(frames, layers=4, width=96, heads=4, feedforward=256, latent=64)

    @classmethod
    def reference_code(cls, frames: int = 180) -> EvaluatorSettings:
        """Return the size in the MAS authors' released code."""
        return cls(frames)

    def transformer(self) -> nn.TransformerEncoder:
        """Return a transformer over frames."""
        layer = nn.TransformerEncoderLayer(
            self.width, self.heads, self.feedforward, 0.0, activation="gelu", batch_first=True
        )
        return nn.TransformerEncoder(layer, self.layers, enable_nested_tensor=False)


class TrackEncoder(nn.Module):
    """Encoder of a standardised motion into the mean and log variance of its latent.

    Two learnt tokens precede the frames; their outputs are mapped linearly to the mean and log
    variance (ACTOR).
    """

    def __init__(self, size: EvaluatorSettings, n_joints: int) -> None:
        super().__init__()
        self.enter = nn.Linear(2 * n_joints, size.width)
        self.asked = nn.Parameter(torch.randn(2, size.width))
        self.transformer = size.transformer()
        self.mean = nn.Linear(size.width, size.latent)
        self.log_variance = nn.Linear(size.width, size.latent)
        positions = sinusoids(torch.arange(size.frames), size.width)
        self.register_buffer("positions", positions, persistent=False)

    def forward(
        self, motions: torch.Tensor, valid: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return mean and log variance: ``(N, L, 2J), (N, L) → (N, latent), (N, latent)``."""
        frames = self.enter(motions) + self.positions[: motions.shape[1]]
        learnt = self.asked.to(frames.dtype).expand(len(frames), -1, -1)
        padding = torch.cat([torch.zeros_like(valid[:, :2]), ~valid], dim=1)
        tokens = torch.cat([learnt, frames], dim=1)
        encoded = self.transformer(tokens, src_key_padding_mask=padding)
        return self.mean(encoded[:, 0]), self.log_variance(encoded[:, 1])


class TrackDecoder(nn.Module):
    """Decoder of a latent into a standardised motion.

    The input token of every frame is the embedded latent plus a positional embedding.
    """

    def __init__(self, size: EvaluatorSettings, n_joints: int) -> None:
        super().__init__()
        self.enter = nn.Linear(size.latent, size.width)
        self.transformer = size.transformer()
        self.leave = nn.Linear(size.width, 2 * n_joints)
        positions = sinusoids(torch.arange(size.frames), size.width)
        self.register_buffer("positions", positions, persistent=False)

    def forward(self, latents: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
        """Return motions: ``(N, latent), (N, L) → (N, L, 2J)``."""
        tokens = self.enter(latents)[:, None] + self.positions[: valid.shape[1]]
        return self.leave(self.transformer(tokens, src_key_padding_mask=~valid))


class TrackAutoencoder(nn.Module):
    """Variational autoencoder: encoder and decoder of standardised motions."""

    def __init__(self, size: EvaluatorSettings, n_joints: int) -> None:
        super().__init__()
        self.encoder = TrackEncoder(size, n_joints)
        self.decoder = TrackDecoder(size, n_joints)

    def forward(
        self, motions: torch.Tensor, valid: torch.Tensor, noise: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return reconstructions (N, L, 2J) and divergences of latents from N(0, I), (N,).

        ``noise`` is standard normal, (N, latent) (Kingma and Welling 2014, section 2.4).
        """
        mean, log_variance = (part.float() for part in self.encoder(motions, valid))
        latents = mean + torch.exp(0.5 * log_variance) * noise
        return self.decoder(latents, valid), divergence_from_normal(mean, log_variance)


def divergence_from_normal(mean: torch.Tensor, log_variance: torch.Tensor) -> torch.Tensor:
    """Return KL(N(mean, variance) ‖ N(0, I)), nats: ``(N, D), (N, D) → (N,)``."""
    return 0.5 * (mean**2 + log_variance.exp() - 1 - log_variance).sum(dim=-1)
