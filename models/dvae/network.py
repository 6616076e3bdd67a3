"""Networks of the Motion-DVAE and their standardisation (A.1)."""

from __future__ import annotations

import math

from probmotion import seeds
from probmotion.extras import nn, torch
from probmotion.models.bodies.body_states import BodyStates
from probmotion.models.dvae.encoders import EncoderInputs, JointEncoder, TrackingEncoder
from probmotion.models.dvae.latent_rollouts import Rollout
from probmotion.models.dvae.layers import State, mean_and_log_scale, perceptron
from probmotion.models.dvae.settings import DVAESettings

__all__ = ["PARTS", "DVAEModel", "DVAENetwork"]

PARTS = 4
"""Number of decoder scales: root translation, root rotation, joint rotations, joints."""


class DVAENetwork(nn.Module):
    """Generative network p(x_{1:T}, z_{1:T} | x₀) over standardised states of dimension ``dim``.

    ``parts`` is the number of decoder scales, including the one for joint positions.
    """

    def __init__(self, size: DVAESettings, dim: int, parts: int) -> None:
        super().__init__()
        width, groups = size.hidden, size.groups
        self.starts = perceptron(dim, 2 * width, width, groups)
        self.recurrent = nn.LSTMCell(size.latent, width)
        self.decoder = perceptron(width, dim, width, groups)
        self.latent_prior = perceptron(width, 2 * size.latent, width, groups)
        self.cumulative = size.decoder == "cumulative"
        if self.cumulative:
            self.straight = nn.Linear(size.latent, dim, bias=False)
            # Small initial increments, as consecutive frames barely differ.
            with torch.no_grad():
                self.decoder[-1].weight.mul_(0.1)
                self.decoder[-1].bias.zero_()
        self.log_scales = nn.Parameter(torch.full((parts,), math.log(0.1)))

    def start(self, initial: torch.Tensor) -> State:
        """Return the initial state h₀ = d_ini(x₀) from standardised x₀, (B, D)."""
        hidden, cell = self.starts(initial).chunk(2, dim=-1)
        return State(torch.tanh(hidden), cell, initial)

    def priors(self, states: list[State]) -> tuple[torch.Tensor, torch.Tensor]:
        """Return mean and log scale of p(z_t | z_{1:t−1}, x₀) from each h_{t−1}, (B, T, Z)."""
        return mean_and_log_scale(_over_frames(self.latent_prior, states))

    def step(self, state: State, latent: torch.Tensor) -> State:
        """Return h_t = LSTM(h_{t−1}, z_t)."""
        hidden, cell = self.recurrent(latent, (state.hidden, state.cell))
        # The direct decoder decodes all frames at once, in `decode`.
        if not self.cumulative:
            return State(hidden, cell, state.motion)
        mean = state.motion + self.decoder(hidden) + self.straight(latent)
        return State(hidden, cell, mean)

    def decode(self, states: list[State]) -> torch.Tensor:
        """Return μ_x of all frames, ``T × (B, H) → (B, T, D)``, standardised."""
        if self.cumulative:
            return torch.stack([state.motion for state in states], dim=1)
        return _over_frames(self.decoder, states)


class DVAEModel(nn.Module):
    """Model with generative network, encoder, standardisation and distribution p(x₀).

    ``dim`` D is the dimension of a state x, ``rank`` r the number of principal directions of x₀.
    """

    state_mean: torch.Tensor
    state_deviation: torch.Tensor
    joint_mean: torch.Tensor
    joint_deviation: torch.Tensor
    initial_mean: torch.Tensor
    initial_factor: torch.Tensor

    def __init__(self, size: DVAESettings, dim: int, joints: int, rank: int, seed: int = 0) -> None:
        super().__init__()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seeds.integer(seed, "weights"))
            self.generative = DVAENetwork(size, dim, PARTS)
            kind = TrackingEncoder if size.decoder == "cumulative" else JointEncoder
            self.encoder = kind(size, dim, joints)
        for name, shape in (
            ("state_mean", (dim,)),
            ("state_deviation", (dim,)),
            ("joint_mean", (joints, 3)),
            ("joint_deviation", (joints, 3)),
            ("initial_mean", (dim,)),
            ("initial_factor", (dim, rank)),
        ):
            self.register_buffer(name, torch.zeros(shape))

    def standardised(self, states: torch.Tensor) -> torch.Tensor:
        """Return standardised states, ``(…, D) → (…, D)``."""
        return (states - self.state_mean) / self.state_deviation

    def decoded(self, rolled: Rollout) -> torch.Tensor:
        """Return μ_x of frames 1 to T, (B, T, D), in state units."""
        return self.state_mean + self.state_deviation * self.generative.decode(rolled.states)

    def first_states(self, coordinates: torch.Tensor) -> torch.Tensor:
        """Return x₀ from its coordinates, ``(…, r) → (…, D)``; N(0, I) maps to p(x₀)."""
        return self.initial_mean + coordinates @ self.initial_factor.T

    def observed(
        self, joints: torch.Tensor, trust: torch.Tensor, tails: torch.Tensor
    ) -> torch.Tensor:
        """Return encoder features of frames, (…, L, 4 J + 1).

        ``joints`` (…, L, J, 3): canonical, metres, ignored where occluded; ``trust`` (…, L, J):
        weights from :func:`trust_weight`, 0 where occluded; ``tails`` (…): reciprocal degrees of
        freedom, 0 for Gaussian noise.
        """
        visible = (joints - self.joint_mean) / self.joint_deviation
        visible = torch.where(trust[..., None] > 0, visible, 0.0)
        tail = tails[..., None, None].expand(*trust.shape[:-1], 1)
        return torch.cat([visible.flatten(-2), trust, tail], dim=-1)

    def encoder_inputs(
        self,
        joints: torch.Tensor,
        trust: torch.Tensor,
        tails: torch.Tensor,
        states: BodyStates,
        bodies: torch.Tensor,
    ) -> EncoderInputs:
        """Return the encoder inputs of B windows; ``bodies`` (B, J, 3): rest offsets, metres."""

        def pose(motion: torch.Tensor) -> torch.Tensor:
            state = self.state_mean + self.state_deviation * motion
            return states.positions(state[:, None], bodies)[:, 0]

        return EncoderInputs(self.observed(joints, trust, tails), joints, trust, pose)


def _over_frames(network: nn.Module, states: list[State]) -> torch.Tensor:
    hidden = torch.stack([state.hidden for state in states], dim=1)
    return network(hidden.flatten(0, 1)).unflatten(0, hidden.shape[:2])
