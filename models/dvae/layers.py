"""Layers shared by the Motion-DVAE networks."""

from __future__ import annotations

from typing import NamedTuple

from probmotion.extras import nn, torch

__all__ = ["State", "mean_and_log_scale", "n_encoder_inputs", "perceptron", "trust_weight"]

_LOG_SCALE_BOUND = 6.0  # Maximum absolute log scale.
_HALF_WEIGHT_NOISE = 0.05  # Noise of a joint with weight ½, metres.


class State(NamedTuple):
    """LSTM state, (B, H) each, and the current standardised mean μ_x, (B, D)."""

    hidden: torch.Tensor
    cell: torch.Tensor
    motion: torch.Tensor


def perceptron(inputs: int, outputs: int, width: int, groups: int) -> nn.Sequential:
    """Return a perceptron with two group-normalised ReLU layers (A.1)."""
    return nn.Sequential(
        nn.Linear(inputs, width),
        nn.GroupNorm(groups, width),
        nn.ReLU(),
        nn.Linear(width, width),
        nn.GroupNorm(groups, width),
        nn.ReLU(),
        nn.Linear(width, outputs),
    )


def mean_and_log_scale(numbers: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Split network outputs into a mean and a bounded log scale."""
    mean, raw = numbers.chunk(2, dim=-1)
    # The smooth bound prevents overflow and underflow early in training.
    return mean, _LOG_SCALE_BOUND * torch.tanh(raw / _LOG_SCALE_BOUND)


def n_encoder_inputs(joints: int) -> int:
    """Return the number of encoder inputs per frame for J joints."""
    return 4 * joints + 1


def trust_weight(noise: torch.Tensor) -> torch.Tensor:
    """Return the weight of a joint with noise in metres: 1 at 0, ½ at 5 cm, 0 at infinity."""
    return 1 / (1 + (noise / _HALF_WEIGHT_NOISE) ** 2)
