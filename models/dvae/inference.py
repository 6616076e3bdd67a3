"""Inference in a Motion-DVAE from noisy joints: q(x₀, z, v | y) and its bound (B to E).

q = q_ω(x₀ | y) Π_t q_φ(z_t | z_{1:t−1}, y_{t:T}, x₀) q_γ(v_t | z_{1:t}, y_t, x₀), with the prior's
networks as they are. x₀ comes with where the window stands and looks, which noisy joints say only
roughly.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

from probmotion import seeds
from probmotion.models.bodies.body_states import turned_about_vertical
from probmotion.models.dvae.latent_rollouts import Rollout, rollout
from probmotion.models.dvae.layers import numbers_read, perceptron, trust_in
from probmotion.models.dvae.motion_dvae import MotionDVAE
from probmotion.models.dvae.noisy_windows import NoisyWindows, on_ground
from probmotion.models.dvae.variational_terms import (
    expected_log_normal,
    gaussian_kl,
    inverse_gamma_kl,
    log_normal,
)

__all__ = ["Bound", "Denoiser", "DenoisingNetworks", "Inferred"]

_GROUND, _TURN = 0.1, 0.3
_WIDEST = 5.0
# Beyond, the scale mixture is Gaussian to all digits that matter, and its terms lose theirs.
_GAUSSIAN_TAILS = 1e-4


class DenoisingNetworks(nn.Module):
    """What learns from noisy joints: the encoder q_φ, first states q_ω and noise q_γ.

    Parameters
    ----------
    prior : MotionDVAE
        Whose encoder is where q_φ starts.
    seed : int
        Of the other first weights.
    """

    def __init__(self, prior: MotionDVAE, seed: int = 0) -> None:
        super().__init__()
        size, joints = prior.settings, prior.skeleton.n_joints
        read = numbers_read(joints)
        self.encoder = copy.deepcopy(prior.model.encoder).requires_grad_(True)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seeds.integer(seed, "denoiser"))
            self.first_reader = nn.LSTM(read, size.hidden, batch_first=True)
            self.first = perceptron(size.hidden, 2 * (3 + prior.rank), size.hidden, size.groups)
            self.noise = perceptron(size.hidden + read, 6 * joints, size.hidden, size.groups)
        nn.init.zeros_(self.noise[-1].weight)
        nn.init.zeros_(self.noise[-1].bias)

    def first_state(self, observed: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return mean and log scale of q_ω: two of the ground, the heading, r of the pose."""
        read, _ = self.first_reader(observed.flip(1))
        mean, raw = self.first(read[:, -1]).chunk(2, dim=-1)
        return mean, _WIDEST * torch.tanh(raw / _WIDEST) - 1

    def noise_shape(
        self,
        hidden: torch.Tensor,
        observed: torch.Tensor,
        half: torch.Tensor,
        squares: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return α and β of q_γ, (B, L, J, 3) each, in units of noise².

        Given the motion, v is IG(λ/2 + ½, λ/2 + ½ r²/s²) exactly. The network e_b begins there, and
        says by which factors q_γ differs from it.

        Parameters
        ----------
        hidden : Tensor, (B, L, H)
            The generative states of frames 0 to T.
        observed : Tensor, (B, L, M)
            y.
        half : Tensor, (B,)
            λ/2.
        squares : Tensor, (B, L, J, 3)
            r²/s²: squared residuals over those of the noise's scale.
        """
        both = torch.cat([hidden, observed], dim=-1)
        raw = self.noise(both.flatten(0, 1)).unflatten(0, both.shape[:2])
        alpha, beta = (torch.exp(torch.tanh(part)) for part in raw.chunk(2, dim=-1))
        begin = half[:, None, None, None]
        return (
            (begin + 0.5) * alpha.unflatten(-1, (-1, 3)),
            (begin + 0.5 * squares) * beta.unflatten(-1, (-1, 3)),
        )


@dataclass(frozen=True)
class Bound:
    """The parts of the evidence lower bound of each window, (B,) each; see :attr:`total`.

    Parameters
    ----------
    data : Tensor
        E_q[log N(y; M_β(μ_x), v)].
    latents : Tensor
        KL(q_φ ‖ p_θ) of z.
    noise : Tensor
        KL(q_γ ‖ p) of v.
    first : Tensor
        KL(q_ω ‖ p) of x₀ and the placement, or 0 where it is left out (C.2.2).
    """

    data: torch.Tensor
    latents: torch.Tensor
    noise: torch.Tensor
    first: torch.Tensor

    def total(self, latent_weight: float = 1.0) -> torch.Tensor:
        """Return the bound, or one in which the motion prior weighs less."""
        return self.data - latent_weight * self.latents - self.noise - self.first


@dataclass(frozen=True)
class Inferred:
    """One draw from q per window.

    Parameters
    ----------
    positions : Tensor, (B, L, J, 3)
        M_β(μ_x) in the world, metres.
    rolled : Rollout
        z and its innovations.
    first : Tensor, (B, r)
        Coordinates of the first pose.
    heading : Tensor, (B,)
        Radians.
    ground : Tensor, (B, 2)
        Metres.
    observed : Tensor, (B, L, M)
        What the networks read, in the drawn frame.
    hidden : Tensor, (B, L, H)
        The generative states.
    first_kl : Tensor, (B,)
        KL of x₀ and placement against the prior's.
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
    """A Motion-DVAE with inference networks: draws, bounds and predictions of windows.

    Parameters
    ----------
    prior : MotionDVAE
        Frozen.
    networks : DenoisingNetworks
        What learns.
    """

    def __init__(self, prior: MotionDVAE, networks: DenoisingNetworks) -> None:
        self.prior = prior
        self.networks = networks

    def noise_numbers(self, length: int) -> tuple[int, tuple[int, int]]:
        """Return how many standard normal numbers a window's draw takes: of x₀, and (T, Z)."""
        return 3 + self.prior.rank, (length - 1, self.prior.settings.latent)

    def infer(
        self, windows: NoisyWindows, first_noise: torch.Tensor, noise: torch.Tensor
    ) -> Inferred:
        """Return draws from q, one per window.

        Parameters
        ----------
        windows : NoisyWindows
            y.
        first_noise : Tensor, (B, 3 + r)
            Standard normal; 0 takes the mean.
        noise : Tensor, (B, T, Z)
            Standard normal; 0 takes the means.
        """
        model = self.prior.model
        trust = torch.where(windows.seen, trust_in(windows.noise), 0.0)
        roughly = windows.in_frame(windows.heading, windows.ground)
        mean, log_scale = self.networks.first_state(model.observed(roughly, trust, windows.tails))
        drawn = mean + torch.exp(log_scale) * first_noise
        heading = windows.heading + _TURN * drawn[:, 2]
        moved = on_ground(_GROUND * drawn[:, :2])[:, None, None, :]
        ground = windows.ground + turned_about_vertical(moved, windows.heading)[:, 0, 0, [0, 2]]
        # What follows is seen from the frame that was drawn.
        joints = windows.in_frame(heading, ground)
        evidence = model.evidence(joints, trust, windows.tails, self.prior.states, windows.bodies)
        start = model.first_states(drawn[:, 3:])
        rolled = rollout(
            model.generative,
            model.standardised(start),
            noise,
            self.networks.encoder.reading(evidence),
        )
        states = torch.cat([start[:, None], model.decoded(rolled)], dim=1)
        canonical = self.prior.states.positions(states, windows.bodies)
        positions = turned_about_vertical(canonical, heading) + on_ground(ground)[:, None, None, :]
        begun = model.generative.start(model.standardised(start)).hidden
        hidden = torch.stack([begun, *(state.hidden for state in rolled.states)], dim=1)
        kl = self._first_kl(windows, mean, log_scale)
        return Inferred(
            positions, rolled, drawn[:, 3:], heading, ground, evidence.observed, hidden, kl
        )

    def bound(self, windows: NoisyWindows, inferred: Inferred, *, first: bool) -> Bound:
        """Return the bound's parts at one draw of q.

        ``first`` counts the entropy of q_ω and the prior of x₀; the paper leaves them out.
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
            apart = inverse_gamma_kl(alpha, beta, prior, prior)
            data = torch.where(heavy, torch.where(seen, expected, 0.0).sum((1, 2, 3)), data)
            kl = torch.where(heavy, torch.where(seen, apart, 0.0).sum((1, 2, 3)), kl)
        start = inferred.first_kl if first else torch.zeros_like(data)
        return Bound(data, inferred.rolled.kl, kl, start)

    def drawn_variance(
        self, windows: NoisyWindows, inferred: Inferred, rng: np.random.Generator
    ) -> torch.Tensor:
        """Return draws of v from q_γ, (B, L, J, 3), metres²; the noise's own where Gaussian."""
        square = (windows.noise**2)[..., None].expand_as(inferred.positions)
        heavy = windows.tails > _GAUSSIAN_TAILS
        if not bool(heavy.any()):
            return square
        alpha, beta = self._noise_shape(windows, inferred, heavy)
        # 1/v is a Gamma number over β.
        gamma = torch.as_tensor(rng.standard_gamma(alpha.numpy()), dtype=square.dtype)
        return torch.where(heavy[:, None, None, None], square * beta / gamma, square)

    def _noise_shape(
        self, windows: NoisyWindows, inferred: Inferred, heavy: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        half = _half_freedom(windows, heavy)
        residual = (windows.joints - inferred.positions) / windows.noise[..., None]
        squares = torch.where(windows.seen[..., None], residual**2, 0.0)
        return self.networks.noise_shape(inferred.hidden, inferred.observed, half, squares)

    def _first_kl(
        self, windows: NoisyWindows, mean: torch.Tensor, log_scale: torch.Tensor
    ) -> torch.Tensor:
        """Return KL of q_ω against N(0, I) poses, N(0, spread²) places and uniform headings."""
        spread = self.prior.spread / _GROUND
        at_origin = -on_ground(windows.ground)[:, None, None, :]
        origin = turned_about_vertical(at_origin, -windows.heading)[:, 0, 0, [0, 2]] / _GROUND
        place = gaussian_kl(
            mean[:, :2],
            log_scale[:, :2],
            origin,
            torch.full_like(origin, math.log(spread)),
        )
        zero = torch.zeros_like(mean[:, 3:])
        pose = gaussian_kl(mean[:, 3:], log_scale[:, 3:], zero, zero)
        entropy = 0.5 * math.log(2 * math.pi * math.e) + log_scale[:, 2] + math.log(_TURN)
        # On the circle no distribution has more entropy than the uniform one.
        return place + pose + torch.relu(math.log(2 * math.pi) - entropy)


def _half_freedom(windows: NoisyWindows, heavy: torch.Tensor) -> torch.Tensor:
    """Return λ/2 of the windows whose noise is Student-t; 1 in the others, which do not use it."""
    return torch.where(heavy, 0.5 / windows.tails.clamp(min=_GAUSSIAN_TAILS), 1.0)
