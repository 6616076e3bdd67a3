"""Transformer of the motion diffusion model (MDM, Tevet et al. 2023; used in 2D by MAS).

The transformer is an encoder over frames, with linear maps from and to the 2J coordinates of a
frame, one additional token for the noise level, and sinusoidal position embeddings.
"""

from __future__ import annotations

import math

from probmotion.extras import nn, torch

__all__ = ["MotionTransformer", "sinusoids"]


class MotionTransformer(nn.Module):
    """Network that maps a noisy motion and its noise level to the clean motion, all standardised.

    ``features`` is 2J, the number of coordinates per frame; ``frames`` is the maximum length L.
    """

    def __init__(
        self,
        features: int,
        frames: int,
        *,
        layers: int,
        width: int,
        heads: int,
        feedforward: int,
        dropout: float,
    ) -> None:
        super().__init__()
        self.width = width
        self.enter = nn.Linear(features, width)
        self.leave = nn.Linear(width, features)
        self.level = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
        self.dropout = nn.Dropout(dropout)
        layer = nn.TransformerEncoderLayer(
            width, heads, feedforward, dropout, activation="gelu", batch_first=True
        )
        self.encoder = nn.TransformerEncoder(layer, layers, enable_nested_tensor=False)
        positions = sinusoids(torch.arange(frames + 1), width)
        self.register_buffer("positions", positions, persistent=False)

    def forward(
        self, motions: torch.Tensor, levels: torch.Tensor, valid: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Return the clean motions, ``(N, L, 2J), (N,), (N, L) → (N, L, 2J)``.

        Noise levels are 0 to T and may be fractional. Frames that are not ``valid`` are padding.
        """
        first = self.level(sinusoids(levels, self.width))[:, None]
        tokens = torch.cat([first, self.enter(motions)], dim=1)
        tokens = self.dropout(tokens + self.positions[: tokens.shape[1]])
        ignored = None
        if valid is not None:
            ignored = torch.cat([torch.zeros_like(valid[:, :1]), ~valid], dim=1)
        return self.leave(self.encoder(tokens, src_key_padding_mask=ignored)[:, 1:])


def sinusoids(positions: torch.Tensor, width: int) -> torch.Tensor:
    """Return the embedding of positions (Vaswani et al. 2017, section 3.5): ``(N,) → (N, width)``.

    Sines are at even indices, cosines at odd ones.
    """
    rates = torch.exp(
        torch.arange(0, width, 2, device=positions.device) * (-math.log(10_000.0) / width)
    )
    angles = positions.to(torch.float32)[:, None] * rates
    return torch.stack([angles.sin(), angles.cos()], dim=-1).flatten(1)
