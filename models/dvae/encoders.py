"""Inference networks of the Motion-DVAE: latents z_t given joints y and the first state x₀."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from probmotion.extras import nn, torch
from probmotion.models.dvae.latent_rollouts import Inference
from probmotion.models.dvae.layers import State, mean_and_log_scale, n_encoder_inputs, perceptron
from probmotion.models.dvae.settings import DVAESettings

__all__ = ["EncoderInputs", "JointEncoder", "TrackingEncoder"]

_STEP = 0.05
"""Unit of joint displacements between frames, metres."""


class EncoderInputs(NamedTuple):
    """Encoder inputs of B windows in their canonical frames.

    ``observed`` (B, L, M): features from :meth:`DVAEModel.observed`; ``joints`` (B, L, J, 3): y,
    metres, ignored where occluded; ``trust`` (B, L, J): weights, 0 where occluded; ``pose``: M_β,
    which maps standardised states (B, D) to joints (B, J, 3), metres.
    """

    observed: torch.Tensor
    joints: torch.Tensor
    trust: torch.Tensor
    pose: Callable[[torch.Tensor], torch.Tensor]


class JointEncoder(nn.Module):
    """Encoder q(z_t | z_{1:t−1}, y_{t:T}, x₀) of the paper, with joints as inputs (A.2).

    The inputs of the published encoder are states x_t. Joint positions allow noise and occlusion,
    so an encoder trained on clean motion can be fine-tuned on noisy joints.
    """

    def __init__(self, size: DVAESettings, dim: int, joints: int) -> None:
        super().__init__()
        width, groups = size.hidden, size.groups
        self.starts = perceptron(dim, 2 * width, width, groups)
        self.recurrent = nn.LSTMCell(size.latent, width)
        self.reader = nn.LSTM(n_encoder_inputs(joints), width, batch_first=True)
        self.latents = perceptron(2 * width, 2 * size.latent, width, groups)

    def conditioned(self, inputs: EncoderInputs) -> Inference:
        """Return the inference model conditioned on observations."""
        return _JointPosterior(self, _read_backwards(self.reader, inputs))


@dataclass(frozen=True)
class _JointPosterior:
    """A :class:`JointEncoder` conditioned on observations."""

    encoder: JointEncoder
    read: torch.Tensor

    def start(self, initial: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the initial recurrent state e_ini(x₀)."""
        hidden, cell = self.encoder.starts(initial).chunk(2, dim=-1)
        return torch.tanh(hidden), cell

    def posterior(
        self, state: tuple[torch.Tensor, torch.Tensor], frame: int, generative_state: State
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return mean and log scale of q(z_t | …) given the recurrent state and y_{t:T}."""
        inputs = torch.cat([state[0], self.read[:, frame - 1]], dim=-1)
        return mean_and_log_scale(self.encoder.latents(inputs))

    def step(
        self, state: tuple[torch.Tensor, torch.Tensor], latent: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the recurrent state h^lat_t."""
        return self.encoder.recurrent(latent, state)


class TrackingEncoder(nn.Module):
    """Encoder q(z_t | z_{1:t−1}, y_{t:T}, x₀) with the current tracking error as an input.

    The state and pose of the generative model summarise z_{1:t−1} and x₀, so no second recurrent
    network is needed. As in a Kalman filter, the tracking error is the innovation: observed joints
    at t minus the pose at t − 1.
    """

    def __init__(self, size: DVAESettings, dim: int, joints: int) -> None:
        super().__init__()
        width, groups = size.hidden, size.groups
        self.reader = nn.LSTM(n_encoder_inputs(joints), width, batch_first=True)
        n_inputs = 2 * width + dim + 4 * joints
        self.latents = perceptron(n_inputs, 2 * size.latent, width, groups)

    def conditioned(self, inputs: EncoderInputs) -> Inference:
        """Return the inference model conditioned on observations."""
        return _TrackingPosterior(self, inputs, _read_backwards(self.reader, inputs))


@dataclass(frozen=True)
class _TrackingPosterior:
    """A :class:`TrackingEncoder` conditioned on observations."""

    encoder: TrackingEncoder
    inputs: EncoderInputs
    read: torch.Tensor

    def start(self, initial: torch.Tensor) -> None:
        """Return None: the encoder has no recurrent state."""

    def posterior(
        self, state: None, frame: int, generative_state: State
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return mean and log scale of q(z_t | …)."""
        previous, trust = generative_state, self.inputs.trust[:, frame]
        innovation = (self.inputs.joints[:, frame] - self.inputs.pose(previous.motion)) / _STEP
        innovation = torch.where(trust[..., None] > 0, innovation, 0.0).flatten(-2)
        parts = [previous.hidden, self.read[:, frame - 1], previous.motion, innovation, trust]
        return mean_and_log_scale(self.encoder.latents(torch.cat(parts, dim=-1)))

    def step(self, state: None, latent: torch.Tensor) -> None:
        """Return None: the encoder has no recurrent state."""


def _read_backwards(reader: nn.LSTM, inputs: EncoderInputs) -> torch.Tensor:
    """Return features (B, T, H) of a backward LSTM; those at t summarise frames t to T."""
    features, _ = reader(inputs.observed[:, 1:].flip(1))
    return features.flip(1)
