"""The terms of the denoising posterior's bound (Motion-DVAE supplement, C), misprints put right.

Noise is y − x ~ N(0, s² v̄) with v̄ ~ IG(λ/2, λ/2): Student-t with λ degrees of freedom and scale s,
metres. Every term is a number to be added up by whoever knows which entries were observed.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

__all__ = ["expected_log_normal", "gaussian_kl", "inverse_gamma_kl", "log_normal"]

_HALF_LOG_TWO_PI = 0.5 * math.log(2 * math.pi)


def gaussian_kl(
    mean: Tensor, log_scale: Tensor, prior_mean: Tensor, prior_log_scale: Tensor
) -> Tensor:
    """Return KL(q ‖ p) of Gaussians with independent coordinates, 0 or more: ``(…, D) → (…)``.

    Parameters
    ----------
    mean, log_scale : Tensor, (…, D)
        Of q: its mean and the logarithm of its standard deviation.
    prior_mean, prior_log_scale : Tensor, (…, D)
        Of p.
    """
    ratio = log_scale - prior_log_scale
    offset = (mean - prior_mean) * torch.exp(-prior_log_scale)
    # expm1, because σ²/σ₀² − 1 and log σ²/σ₀² all but cancel where the two are alike.
    return 0.5 * (torch.expm1(2 * ratio) - 2 * ratio + offset**2).sum(dim=-1)


def inverse_gamma_kl(
    alpha: Tensor, beta: Tensor, prior_alpha: Tensor | float, prior_beta: Tensor | float
) -> Tensor:
    """Return KL(IG(α, β) ‖ IG(α₀, β₀)) entry by entry, 0 or more.

    (α − α₀) ψ(α) − log Γ(α) + log Γ(α₀) + α₀ (log β − log β₀) + α (β₀ − β)/β; with
    α₀ = β₀ = λ/2 the last term of the bound.

    Parameters
    ----------
    alpha, beta : Tensor
        Shape and scale of q, above 0: density ∝ v^(−α−1) exp(−β/v).
    prior_alpha, prior_beta : Tensor or float
        Those of the prior, above 0.

    Returns
    -------
    Tensor
        The broadcast shape, dtype of ``alpha``.
    """
    # With λ of a million log Γ is of the order of 10⁶: in single precision nothing would be left.
    a, b = alpha.double(), beta.double()
    a0, b0 = (
        torch.as_tensor(value, dtype=torch.float64, device=alpha.device)
        for value in (prior_alpha, prior_beta)
    )
    shapes = (a - a0) * torch.digamma(a) - torch.lgamma(a) + torch.lgamma(a0)
    scales = a0 * (torch.log(b) - torch.log(b0)) + a * (b0 - b) / b
    return (shapes + scales).to(alpha.dtype)


def expected_log_normal(
    residual: Tensor, alpha: Tensor, beta: Tensor, scale: Tensor | float
) -> Tensor:
    """Return E[log N(residual; 0, s² v̄)] over v̄ ~ IG(α, β), entry by entry.

    −½ (log 2π + log s² + log β − ψ(α) + (α/β) residual²/s²), as E[1/v̄] = α/β and
    E[log v̄] = log β − ψ(α). The supplement leaves out E[log v]: its bound would rise for ever
    with v.

    Parameters
    ----------
    residual : Tensor
        y − x, metres.
    alpha, beta : Tensor
        Of v̄, above 0.
    scale : Tensor or float
        s, metres, above 0.
    """
    log_variance = torch.log(beta) - torch.digamma(alpha)
    square = (residual / scale) ** 2
    return -0.5 * (log_variance + alpha / beta * square) - _log_scale(scale) - _HALF_LOG_TWO_PI


def log_normal(residual: Tensor, scale: Tensor | float) -> Tensor:
    """Return log N(residual; 0, s²), entry by entry.

    Parameters
    ----------
    residual : Tensor
        y − x, metres.
    scale : Tensor or float
        s, metres, above 0.
    """
    return -0.5 * (residual / scale) ** 2 - _log_scale(scale) - _HALF_LOG_TWO_PI


def _log_scale(scale: Tensor | float) -> Tensor | float:
    return torch.log(scale) if isinstance(scale, Tensor) else math.log(scale)
