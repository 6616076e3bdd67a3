"""Rollouts of a dynamical latent-variable model and its inference model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from probmotion.extras import torch
from probmotion.models.dvae.variational_terms import gaussian_kl

__all__ = ["Generative", "Inference", "Rollout", "rollout"]


class Generative(Protocol):
    """Generative model p(z_t | z_{1:t−1}, x₀) with a recurrent state.

    ``start`` returns the state at frame 0 given x₀ (B, D); ``priors`` returns mean and log scale
    of the next z for each state, (B, T, Z) each; ``step`` returns the state after z_t.
    """

    def start(self, initial: torch.Tensor) -> Any: ...
    def priors(self, states: list[Any]) -> tuple[torch.Tensor, torch.Tensor]: ...
    def step(self, state: Any, latent: torch.Tensor) -> Any: ...


class Inference(Protocol):
    """Inference model q(z_t | z_{1:t−1}, y_{t:T}, x₀) with a recurrent state.

    ``posterior`` returns mean and log scale of z_t at ``frame`` t ≥ 1; ``generative_state`` is that
    of frame t − 1.
    """

    def start(self, initial: torch.Tensor) -> Any: ...
    def posterior(
        self, state: Any, frame: int, generative_state: Any
    ) -> tuple[torch.Tensor, torch.Tensor]: ...
    def step(self, state: Any, latent: torch.Tensor) -> Any: ...


@dataclass(frozen=True)
class Rollout:
    """Latents and generative states of B windows, returned by :func:`rollout`.

    ``states``: generative states of frames 1 to T; ``latents`` (B, T, Z): z; ``innovations``
    (B, T, Z): (z − μ_z)/σ_z under the generative model; ``kl`` (B,): Σ_t KL(q ‖ p) of z_t, 0
    where z was drawn from p.
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
    """Draw z_{1:T} from q given x₀ (``initial``, (B, D)), or from p without an inference model.

    ``noise`` (B, T, Z) contains standard normal draws; zeros yield the means.
    """
    states = [generative.start(initial)]
    latents = []
    if inference is None:
        for frame in range(noise.shape[1]):
            mean, log_scale = generative.priors(states[-1:])
            latents.append(mean[:, 0] + torch.exp(log_scale[:, 0]) * noise[:, frame])
            states.append(generative.step(states[-1], latents[-1]))
        return Rollout(states[1:], torch.stack(latents, 1), noise, noise.new_zeros(len(noise)))
    q_state, moments = inference.start(initial), []
    for frame in range(1, noise.shape[1] + 1):
        mean, log_scale = inference.posterior(q_state, frame, states[-1])
        moments.append((mean, log_scale))
        latents.append(mean + torch.exp(log_scale) * noise[:, frame - 1])
        states.append(generative.step(states[-1], latents[-1]))
        q_state = inference.step(q_state, latents[-1])
    # The recursion does not need the prior, so evaluate it once for all frames.
    prior_mean, prior_log_scale = generative.priors(states[:-1])
    q_mean, q_log_scale = (torch.stack(part, 1) for part in zip(*moments, strict=True))
    kl = gaussian_kl(q_mean, q_log_scale, prior_mean, prior_log_scale).sum(-1)
    drawn = torch.stack(latents, 1)
    innovations = (drawn - prior_mean) * torch.exp(-prior_log_scale)
    return Rollout(states[1:], drawn, innovations, kl)
