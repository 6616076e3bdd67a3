"""Walking a dynamical latent-variable model forward in time, with its inference model beside it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import torch

from probmotion.models.dvae.variational_terms import gaussian_kl

__all__ = ["Generative", "Inference", "Rollout", "rollout"]


class Generative(Protocol):
    """p(z_t | z_{1:t−1}, x₀), through a state that is carried from frame to frame."""

    def start(self, initial: torch.Tensor) -> Any:
        """Return the state at frame 0 of x₀: ``(B, D)``."""

    def priors(self, states: list[Any]) -> tuple[torch.Tensor, torch.Tensor]:
        """Return mean and log scale of the z that follows each state, (B, T, Z) each."""

    def step(self, state: Any, latent: torch.Tensor) -> Any:
        """Return the state after z_t, (B, Z)."""


class Inference(Protocol):
    """q(z_t | z_{1:t−1}, y_{t:T}, x₀), likewise."""

    def start(self, initial: torch.Tensor) -> Any:
        """Return the state at frame 0."""

    def posterior(self, state: Any, frame: int, moved: Any) -> tuple[torch.Tensor, torch.Tensor]:
        """Return mean and log scale of z at a frame, counted from 1.

        ``moved`` is the generative state of the frame before.
        """

    def step(self, state: Any, latent: torch.Tensor) -> Any:
        """Return the state after z_t."""


@dataclass(frozen=True)
class Rollout:
    """What happened on the way.

    Parameters
    ----------
    states : list
        The generative states of frames 1 to T.
    latents : Tensor, (B, T, Z)
        z.
    innovations : Tensor, (B, T, Z)
        (z − μ_z)/σ_z of the generative model: standard normal numbers that make z.
    kl : Tensor, (B,)
        Σ_t KL(q(z_t | …) ‖ p(z_t | …)) along the way; 0 where z was drawn from p itself.
    """

    states: list[Any]
    latents: torch.Tensor
    innovations: torch.Tensor
    kl: torch.Tensor


def rollout(
    generative: Generative,
    initial: torch.Tensor,
    noise: torch.Tensor,
    inference: Inference | None = None,
) -> Rollout:
    """Draw z_{1:T} from q, or from p where there is no inference model.

    Parameters
    ----------
    generative : Generative
        p.
    initial : Tensor, (B, D)
        x₀.
    noise : Tensor, (B, T, Z)
        Standard normal numbers: of q's draws, or p's own innovations. 0 takes every mean.
    inference : Inference, optional
        q.
    """
    states = [generative.start(initial)]
    latents = []
    if inference is None:
        for frame in range(noise.shape[1]):
            mean, log_scale = generative.priors(states[-1:])
            latents.append(mean[:, 0] + torch.exp(log_scale[:, 0]) * noise[:, frame])
            states.append(generative.step(states[-1], latents[-1]))
        return Rollout(states[1:], torch.stack(latents, 1), noise, noise.new_zeros(len(noise)))
    beside, found = inference.start(initial), []
    for frame in range(1, noise.shape[1] + 1):
        found.append(inference.posterior(beside, frame, states[-1]))
        mean, log_scale = found[-1]
        latents.append(mean + torch.exp(log_scale) * noise[:, frame - 1])
        states.append(generative.step(states[-1], latents[-1]))
        beside = inference.step(beside, latents[-1])
    # What p says of every z is asked at once: nothing on the way depends on it.
    prior_mean, prior_log_scale = generative.priors(states[:-1])
    q_mean, q_log_scale = (torch.stack(part, 1) for part in zip(*found, strict=True))
    kl = gaussian_kl(q_mean, q_log_scale, prior_mean, prior_log_scale).sum(-1)
    drawn = torch.stack(latents, 1)
    innovations = (drawn - prior_mean) * torch.exp(-prior_log_scale)
    return Rollout(states[1:], drawn, innovations, kl)
