"""What the networks of a Motion-DVAE are made of."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import nn

__all__ = ["State", "mean_and_log_scale", "numbers_read", "perceptron", "trust_in"]

_WIDEST = 6.0
_HALF_TRUSTED = 0.05


class State(NamedTuple):
    """The LSTM's two parts, (B, H) each, and μ_x so far, (B, D), standardised."""

    hidden: torch.Tensor
    cell: torch.Tensor
    motion: torch.Tensor


def perceptron(inputs: int, outputs: int, width: int, groups: int) -> nn.Sequential:
    """Return a network of two hidden layers with group normalisation and ReLU (A.1)."""
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
    mean, raw = numbers.chunk(2, dim=-1)
    # Bounded smoothly, so that no scale over- or underflows before the network has learnt.
    return mean, _WIDEST * torch.tanh(raw / _WIDEST)


def numbers_read(joints: int) -> int:
    """Return how many numbers inference reads of a frame of J joints."""
    return 4 * joints + 1


def trust_in(noise: torch.Tensor) -> torch.Tensor:
    """Return how far a joint is trusted by its noise, metres: 1 without any, ½ at 5 cm, to 0."""
    return 1 / (1 + (noise / _HALF_TRUSTED) ** 2)
