"""Terms of the denoising evidence lower bound (Motion-DVAE supplement, C), with corrections.

The noise of observed coordinates is N(0, s² v̄) with v̄ ~ IG(λ/2, λ/2): Student-t with λ degrees of
freedom and scale s in metres. Except for ``gaussian_kl``, terms are elementwise, to be summed.
"""

from __future__ import annotations

import math

from probmotion.extras import torch

__all__ = ["expected_log_normal", "gaussian_kl", "inverse_gamma_kl", "log_normal"]

_HALF_LOG_TWO_PI = 0.5 * math.log(2 * math.pi)


def gaussian_kl(
    mean: torch.Tensor,
    log_scale: torch.Tensor,
    prior_mean: torch.Tensor,
    prior_log_scale: torch.Tensor,
) -> torch.Tensor:
    """Return KL(q ‖ p) of diagonal Gaussians, ``(…, D) → (…)``.

    Arguments are the means and log standard deviations of q, then of p.
    """
    ratio = log_scale - prior_log_scale
    offset = (mean - prior_mean) * torch.exp(-prior_log_scale)
    # expm1 avoids cancellation between σ²/σ₀² − 1 and log σ²/σ₀² for similar scales.
    return 0.5 * (torch.expm1(2 * ratio) - 2 * ratio + offset**2).sum(dim=-1)


def inverse_gamma_kl(
    alpha: torch.Tensor,
    beta: torch.Tensor,
    prior_alpha: torch.Tensor | float,
    prior_beta: torch.Tensor | float,
) -> torch.Tensor:
    """Return KL(IG(α, β) ‖ IG(α₀, β₀)) elementwise, with density ∝ v^(−α−1) exp(−β/v).

    The result is (α − α₀) ψ(α) − log Γ(α) + log Γ(α₀) + α₀ (log β − log β₀) + α (β₀ − β)/β. In
    the bound, α₀ = β₀ = λ/2. Computed in double precision, returned in the dtype of ``alpha``.
    """
    # log Γ exceeds 10⁶ for λ = 10⁶, so single precision would be too coarse.
    a, b = alpha.double(), beta.double()
    a0, b0 = (
        torch.as_tensor(value, dtype=torch.float64, device=alpha.device)
        for value in (prior_alpha, prior_beta)
    )
    shapes = (a - a0) * torch.digamma(a) - torch.lgamma(a) + torch.lgamma(a0)
    scales = a0 * (torch.log(b) - torch.log(b0)) + a * (b0 - b) / b
    return (shapes + scales).to(alpha.dtype)


def expected_log_normal(
    residual: torch.Tensor, alpha: torch.Tensor, beta: torch.Tensor, scale: torch.Tensor | float
) -> torch.Tensor:
    """Return E[log N(residual; 0, s² v̄)] over v̄ ~ IG(α, β), elementwise.

    The result is −½ (log 2π + log s² + log β − ψ(α) + (α/β) residual²/s²), as E[1/v̄] = α/β and
    E[log v̄] = log β − ψ(α). The supplement omits E[log v̄]; its objective is therefore unbounded.
    ``residual`` and ``scale`` (s) are in metres.
    """
    log_variance = torch.log(beta) - torch.digamma(alpha)
    square = (residual / scale) ** 2
    return -0.5 * (log_variance + alpha / beta * square) - _log_scale(scale) - _HALF_LOG_TWO_PI


def log_normal(residual: torch.Tensor, scale: torch.Tensor | float) -> torch.Tensor:
    """Return log N(residual; 0, s²), elementwise; ``residual`` and ``scale`` (s) in metres."""
    return -0.5 * (residual / scale) ** 2 - _log_scale(scale) - _HALF_LOG_TWO_PI


def _log_scale(scale: torch.Tensor | float) -> torch.Tensor | float:
    return torch.log(scale) if isinstance(scale, torch.Tensor) else math.log(scale)
