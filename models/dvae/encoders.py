"""The inference models of a Motion-DVAE, q(z_t | z_{1:t−1}, y_{t:T}, x₀)."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import nn

from probmotion.models.dvae.latent_rollouts import Inference
from probmotion.models.dvae.layers import State, mean_and_log_scale, numbers_read, perceptron
from probmotion.models.dvae.settings import DVAESettings

__all__ = ["Evidence", "JointEncoder", "TrackingEncoder"]

_STEP = 0.05
"""What a joint's way from frame to frame is measured in, metres."""


class Evidence(NamedTuple):
    """What inference reads of B windows, in their canonical frames.

    Parameters
    ----------
    observed : Tensor, (B, L, M)
        :meth:`~probmotion.models.dvae.network.DVAEModel.observed`.
    joints : Tensor, (B, L, J, 3)
        y, metres; not read where hidden.
    trust : Tensor, (B, L, J)
        0 where hidden.
    pose : callable
        M_β: standardised states of a frame (B, D) to joints (B, J, 3), metres.
    """

    observed: torch.Tensor
    joints: torch.Tensor
    trust: torch.Tensor
    pose: Callable[[torch.Tensor], torch.Tensor]


class JointEncoder(nn.Module):
    """q(z_t | z_{1:t−1}, y_{t:T}, x₀) as published, but for what it reads (A.2).

    The published encoder reads states x_t. Joints' positions say the same, and what is noisy or
    hidden can be said of them too, so that what learnt on clean motion can go on with noisy joints.

    Parameters
    ----------
    size : DVAESettings
        Its size.
    dim : int
        Numbers of a state.
    joints : int
        J.
    """

    def __init__(self, size: DVAESettings, dim: int, joints: int) -> None:
        super().__init__()
        width, groups = size.hidden, size.groups
        self.starts = perceptron(dim, 2 * width, width, groups)
        self.recurrent = nn.LSTMCell(size.latent, width)
        self.reader = nn.LSTM(numbers_read(joints), width, batch_first=True)
        self.latents = perceptron(2 * width, 2 * size.latent, width, groups)

    def reading(self, evidence: Evidence) -> Inference:
        """Return the inference model of some evidence."""
        return _Reading(self, _read_backwards(self.reader, evidence))


class _Reading:
    """A :class:`JointEncoder` that has read its evidence."""

    def __init__(self, encoder: JointEncoder, read: torch.Tensor) -> None:
        self.encoder = encoder
        self.read = read

    def start(self, initial: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return e_ini(x₀)."""
        hidden, cell = self.encoder.starts(initial).chunk(2, dim=-1)
        return torch.tanh(hidden), cell

    def posterior(
        self, state: tuple[torch.Tensor, torch.Tensor], frame: int, moved: State
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return mean and log scale of q(z_t | …) from [h^lat_{t−1}, h^data_t]."""
        both = torch.cat([state[0], self.read[:, frame - 1]], dim=-1)
        return mean_and_log_scale(self.encoder.latents(both))

    def step(
        self, state: tuple[torch.Tensor, torch.Tensor], latent: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return h^lat_t."""
        return self.encoder.recurrent(latent, state)


class TrackingEncoder(nn.Module):
    """q(z_t | z_{1:t−1}, y_{t:T}, x₀) that sees how far the motion so far is from the evidence.

    z_{1:t−1} and x₀ enter through what the generative model has made of them, its state and its
    pose, so that no second recurrent network walks beside it; and the difference between the joints
    observed at t and the pose at t − 1 is read as such, as in a Kalman filter.

    Parameters
    ----------
    size, dim, joints
        As of :class:`JointEncoder`.
    """

    def __init__(self, size: DVAESettings, dim: int, joints: int) -> None:
        super().__init__()
        width, groups = size.hidden, size.groups
        self.reader = nn.LSTM(numbers_read(joints), width, batch_first=True)
        read = 2 * width + dim + 4 * joints
        self.latents = perceptron(read, 2 * size.latent, width, groups)

    def reading(self, evidence: Evidence) -> Inference:
        """Return the inference model of some evidence."""
        return _Tracking(self, evidence, _read_backwards(self.reader, evidence))


class _Tracking:
    """A :class:`TrackingEncoder` that has read its evidence."""

    def __init__(self, encoder: TrackingEncoder, evidence: Evidence, read: torch.Tensor) -> None:
        self.encoder = encoder
        self.evidence = evidence
        self.read = read

    def start(self, initial: torch.Tensor) -> None:
        """Begin with nothing of its own."""

    def posterior(self, state: None, frame: int, moved: State) -> tuple[torch.Tensor, torch.Tensor]:
        """Return mean and log scale of q(z_t | …)."""
        trust = self.evidence.trust[:, frame]
        apart = (self.evidence.joints[:, frame] - self.evidence.pose(moved.motion)) / _STEP
        apart = torch.where(trust[..., None] > 0, apart, torch.zeros_like(apart))
        seen = [moved.hidden, self.read[:, frame - 1], moved.motion, apart.flatten(-2), trust]
        return mean_and_log_scale(self.encoder.latents(torch.cat(seen, dim=-1)))

    def step(self, state: None, latent: torch.Tensor) -> None:
        """Keep nothing."""


def _read_backwards(reader: nn.LSTM, evidence: Evidence) -> torch.Tensor:
    """Return (B, T, H): what stands at frame t has read the frames from T down to t."""
    read, _ = reader(evidence.observed[:, 1:].flip(1))
    return read.flip(1)
