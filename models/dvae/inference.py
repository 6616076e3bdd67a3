"""Amortised inference from noisy joints: q(x₀, z, v | y) and its evidence lower bound.

For first state x₀, latents z, noise variances v and joints y, q is q_ω(x₀ | y) Π_t
q_φ(z_t | z_{1:t−1}, y_{t:T}, x₀) q_γ(v_t | z_{1:t}, y_t, x₀) (Motion-DVAE supplement, B to E). The
prior is frozen. q_ω also models position and heading, which y determines only approximately.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass

import numpy as np

from probmotion import seeds
from probmotion.extras import nn, torch
from probmotion.models.bodies.body_states import turned_about_vertical
from probmotion.models.dvae.latent_rollouts import Rollout, rollout
from probmotion.models.dvae.layers import n_encoder_inputs, perceptron, trust_weight
from probmotion.models.dvae.motion_dvae import MotionDVAE
from probmotion.models.dvae.noisy_windows import NoisyWindows, on_ground
from probmotion.models.dvae.variational_terms import (
    expected_log_normal,
    gaussian_kl,
    inverse_gamma_kl,
    log_normal,
)

__all__ = ["Bound", "Denoiser", "DenoisingNetworks", "InferenceDraw"]

# Units of the placement corrections, metres and radians.
_GROUND, _TURN = 0.1, 0.3
_LOG_SCALE_BOUND = 5.0  # Smooth bound on the log scales of q_ω, before an offset of −1.
# Noise with smaller reciprocal degrees of freedom is treated as Gaussian, for numerical accuracy.
_GAUSSIAN_TAILS = 1e-4


class DenoisingNetworks(nn.Module):
    """Inference networks: latent encoder q_φ, initial-state network q_ω and noise network q_γ.

    q_φ is initialised with the encoder of ``prior``, q_ω and q_γ from ``seed``.
    """

    def __init__(self, prior: MotionDVAE, seed: int = 0) -> None:
        super().__init__()
        size, joints = prior.settings, prior.skeleton.n_joints
        n_inputs = n_encoder_inputs(joints)
        self.encoder = copy.deepcopy(prior.model.encoder).requires_grad_(True)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seeds.integer(seed, "denoiser"))
            self.first_reader = nn.LSTM(n_inputs, size.hidden, batch_first=True)
            self.first = perceptron(size.hidden, 2 * (3 + prior.rank), size.hidden, size.groups)
            self.noise = perceptron(size.hidden + n_inputs, 6 * joints, size.hidden, size.groups)
        nn.init.zeros_(self.noise[-1].weight)
        nn.init.zeros_(self.noise[-1].bias)

    def first_state(self, observed: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return mean and log scale of q_ω: ground position (2), heading (1) and pose (r)."""
        read, _ = self.first_reader(observed.flip(1))
        mean, raw = self.first(read[:, -1]).chunk(2, dim=-1)
        return mean, _LOG_SCALE_BOUND * torch.tanh(raw / _LOG_SCALE_BOUND) - 1

    def noise_shape(
        self,
        hidden: torch.Tensor,
        observed: torch.Tensor,
        half: torch.Tensor,
        squares: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return α and β of q_γ = IG(α, β), (B, L, J, 3) each, for v in units of noise².

        Given the motion, v is exactly IG(λ/2 + ½, λ/2 + ½ r²/s²). The network multiplies both
        parameters by factors, initially 1. Arguments: generative states (B, L, H), encoder features
        (B, L, M), ``half`` λ/2 (B,) and squared standardised residuals r²/s² (B, L, J, 3).
        """
        features = torch.cat([hidden, observed], dim=-1)
        raw = self.noise(features.flatten(0, 1)).unflatten(0, features.shape[:2])
        alpha, beta = (torch.exp(torch.tanh(part)) for part in raw.chunk(2, dim=-1))
        base = half[:, None, None, None]
        return (
            (base + 0.5) * alpha.unflatten(-1, (-1, 3)),
            (base + 0.5 * squares) * beta.unflatten(-1, (-1, 3)),
        )


@dataclass(frozen=True)
class Bound:
    """Terms of the evidence lower bound of each window, (B,) each.

    ``data``: E_q[log N(y; M_β(μ_x), v)]; ``latents``: KL(q_φ ‖ p_θ) of z; ``noise``: KL(q_γ ‖ p) of
    v; ``first``: KL(q_ω ‖ p) of x₀ and placement, 0 if omitted (C.2.2).
    """

    data: torch.Tensor
    latents: torch.Tensor
    noise: torch.Tensor
    first: torch.Tensor

    def total(self, latent_weight: float = 1.0) -> torch.Tensor:
        """Return the bound, with a weight on the KL term of z."""
        return self.data - latent_weight * self.latents - self.noise - self.first


@dataclass(frozen=True)
class InferenceDraw:
    """One draw from q per window.

    ``positions`` (B, L, J, 3): decoded joints M_β(μ_x), world, metres; ``rolled``: z, innovations;
    ``first`` (B, r): coordinates of x₀; ``heading`` (B,), radians; ``ground`` (B, 2), metres;
    ``observed`` (B, L, M): encoder features in the drawn frame; ``hidden`` (B, L, H): generative
    states; ``first_kl`` (B,): KL(q_ω ‖ p) of x₀ and placement.
    """

    positions: torch.Tensor
    rolled: Rollout
    first: torch.Tensor
    heading: torch.Tensor
    ground: torch.Tensor
    observed: torch.Tensor
    hidden: torch.Tensor
    first_kl: torch.Tensor


class Denoiser:
    """Inference networks with a frozen Motion-DVAE: draws from q, bounds and noise variances."""

    def __init__(self, prior: MotionDVAE, networks: DenoisingNetworks) -> None:
        self.prior = prior
        self.networks = networks

    def noise_numbers(self, length: int) -> tuple[int, tuple[int, int]]:
        """Return shapes of standard normal draws per window: 3 + r for q_ω and (T, Z) for z."""
        return 3 + self.prior.rank, (length - 1, self.prior.settings.latent)

    def infer(
        self, windows: NoisyWindows, first_noise: torch.Tensor, noise: torch.Tensor
    ) -> InferenceDraw:
        """Return one draw from q per window.

        ``first_noise`` (B, 3 + r) and ``noise`` (B, T, Z) are standard normal; zeros: mean of q.
        """
        model = self.prior.model
        trust = torch.where(windows.seen, trust_weight(windows.noise), 0.0)
        placed = windows.in_frame(windows.heading, windows.ground)
        mean, log_scale = self.networks.first_state(model.observed(placed, trust, windows.tails))
        drawn = mean + torch.exp(log_scale) * first_noise
        heading = windows.heading + _TURN * drawn[:, 2]
        offset = on_ground(_GROUND * drawn[:, :2])[:, None, None, :]
        ground = windows.ground + turned_about_vertical(offset, windows.heading)[:, 0, 0, [0, 2]]
        # From here, joints are in the drawn canonical frame.
        joints = windows.in_frame(heading, ground)
        inputs = model.encoder_inputs(
            joints, trust, windows.tails, self.prior.states, windows.bodies
        )
        start = model.first_states(drawn[:, 3:])
        standard, encoder = model.standardised(start), self.networks.encoder.conditioned(inputs)
        rolled = rollout(model.generative, standard, noise, encoder)
        states = torch.cat([start[:, None], model.decoded(rolled)], dim=1)
        canonical = self.prior.states.positions(states, windows.bodies)
        positions = turned_about_vertical(canonical, heading) + on_ground(ground)[:, None, None, :]
        first_hidden = model.generative.start(standard).hidden
        hidden = torch.stack([first_hidden, *(state.hidden for state in rolled.states)], dim=1)
        kl = self._first_kl(windows, mean, log_scale)
        return InferenceDraw(
            positions, rolled, drawn[:, 3:], heading, ground, inputs.observed, hidden, kl
        )

    def bound(self, windows: NoisyWindows, inferred: InferenceDraw, *, first: bool) -> Bound:
        """Return the terms of the bound at one draw of q.

        ``first`` includes KL(q_ω ‖ p(x₀)), which the paper omits.
        """
        residual = windows.joints - inferred.positions
        scale = windows.noise[..., None]
        seen = windows.seen[..., None]
        gaussian = torch.where(seen, log_normal(residual, scale), 0.0).sum((1, 2, 3))
        data, kl = gaussian, torch.zeros_like(gaussian)
        heavy = windows.tails > _GAUSSIAN_TAILS
        if bool(heavy.any()):
            alpha, beta = self._noise_shape(windows, inferred, heavy)
            expected = expected_log_normal(residual, alpha, beta, scale)
            prior = _half_freedom(windows, heavy)[:, None, None, None].expand_as(alpha)
            divergence = inverse_gamma_kl(alpha, beta, prior, prior)
            data = torch.where(heavy, torch.where(seen, expected, 0.0).sum((1, 2, 3)), data)
            kl = torch.where(heavy, torch.where(seen, divergence, 0.0).sum((1, 2, 3)), kl)
        start = inferred.first_kl if first else torch.zeros_like(data)
        return Bound(data, inferred.rolled.kl, kl, start)

    def drawn_variance(
        self, windows: NoisyWindows, inferred: InferenceDraw, rng: np.random.Generator
    ) -> torch.Tensor:
        """Return draws of v from q_γ, (B, L, J, 3), metres²; the known variance if Gaussian."""
        square = (windows.noise**2)[..., None].expand_as(inferred.positions)
        heavy = windows.tails > _GAUSSIAN_TAILS
        if not bool(heavy.any()):
            return square
        alpha, beta = self._noise_shape(windows, inferred, heavy)
        # 1/v ~ Gamma(α)/β.
        gamma = torch.as_tensor(rng.standard_gamma(alpha.numpy()), dtype=square.dtype)
        return torch.where(heavy[:, None, None, None], square * beta / gamma, square)

    def _noise_shape(
        self, windows: NoisyWindows, inferred: InferenceDraw, heavy: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        half = _half_freedom(windows, heavy)
        residual = (windows.joints - inferred.positions) / windows.noise[..., None]
        squares = torch.where(windows.seen[..., None], residual**2, 0.0)
        return self.networks.noise_shape(inferred.hidden, inferred.observed, half, squares)

    def _first_kl(
        self, windows: NoisyWindows, mean: torch.Tensor, log_scale: torch.Tensor
    ) -> torch.Tensor:
        """Return KL(q_ω ‖ p), p: poses N(0, I), positions N(0, spread²) and uniform headings."""
        spread = self.prior.spread / _GROUND
        at_origin = -on_ground(windows.ground)[:, None, None, :]
        origin = turned_about_vertical(at_origin, -windows.heading)[:, 0, 0, [0, 2]] / _GROUND
        log_spread = torch.full_like(origin, math.log(spread))
        position = gaussian_kl(mean[:, :2], log_scale[:, :2], origin, log_spread)
        zero = torch.zeros_like(mean[:, 3:])
        pose = gaussian_kl(mean[:, 3:], log_scale[:, 3:], zero, zero)
        entropy = 0.5 * math.log(2 * math.pi * math.e) + log_scale[:, 2] + math.log(_TURN)
        # The entropy on the circle is at most that of the uniform distribution.
        return position + pose + torch.relu(math.log(2 * math.pi) - entropy)


def _half_freedom(windows: NoisyWindows, heavy: torch.Tensor) -> torch.Tensor:
    """Return λ/2 for windows with Student-t noise and an unused 1 for Gaussian noise."""
    return torch.where(heavy, 0.5 / windows.tails.clamp(min=_GAUSSIAN_TAILS), 1.0)
