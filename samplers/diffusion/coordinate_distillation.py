"""Score distillation in the coordinates of a prior, with or without observations.

For noise ε, θ_t = √ᾱ θ + √(1−ᾱ) ε and ε_φ = (θ_t − √ᾱ E[θ | θ_t])/√(1−ᾱ), an iteration descends

    w(t) (ε_φ − ε) − g(t) ∇ log p(y | θ),    g(t) = w(t) √(ᾱ(1−ᾱ)).

By Tweedie's formula E_ε[ε_φ − ε] = −√(1−ᾱ) E_ε[∇ log p_t(θ_t)], which for the prior N(0, I) is
√(ᾱ(1−ᾱ)) θ = −√(ᾱ(1−ᾱ)) ∇ log p(θ). Prior and likelihood then have equal weights at every level,
so the iterates converge to a mode of the posterior; w(t) is a positive weight of level t.
"""

from __future__ import annotations

import math

import numpy as np

from probmotion.arrays import to_numpy
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import DenoisesCoordinates, NotConjugate
from probmotion.posteriors.sampling import UnsupportedPosterior, suited
from probmotion.samplers.densities import not_conjugate
from probmotion.validation import check_finite

__all__ = ["coordinate_distillation_gradient", "no_gradient", "posterior_gradient"]


def posterior_gradient(
    posterior: MotionPosterior, theta: np.ndarray, noise: np.ndarray, alpha_bar: float
) -> np.ndarray:
    """Return ε_φ − ε − √(ᾱ(1−ᾱ)) ∇ log p(y | θ); all arrays are (n, dim).

    Raises :class:`UnsupportedPosterior` if torch cannot differentiate the log likelihood, and
    ``ValueError`` if its gradient is not finite.
    """
    assert isinstance(posterior.prior, DenoisesCoordinates)
    gradient = coordinate_distillation_gradient(posterior.prior, theta, noise, alpha_bar)
    if posterior.likelihood is not None:
        gradient -= math.sqrt(alpha_bar * (1 - alpha_bar)) * _likelihood_gradient(posterior, theta)
    return gradient


def coordinate_distillation_gradient(
    prior: DenoisesCoordinates, theta: np.ndarray, noise: np.ndarray, alpha_bar: float
) -> np.ndarray:
    """Return ε_φ(θ_t) − ε, (…, dim), for θ_t = √ᾱ θ + √(1−ᾱ) ε = √ᾱ E[θ | θ_t] + √(1−ᾱ) ε_φ."""
    signal, noise_scale = math.sqrt(alpha_bar), math.sqrt(1 - alpha_bar)
    noisy = signal * theta + noise_scale * noise
    clean = to_numpy(prior.denoise_coordinates(noisy, alpha_bar))
    return (noisy - signal * clean) / noise_scale - noise


def _likelihood_gradient(posterior: MotionPosterior, theta: np.ndarray) -> np.ndarray:
    """Return ∇ log p(y | θ), ``(n, dim) → (n, dim)``."""
    from probmotion.extras import torch

    # Copy θ because Adam updates it in place.
    point = torch.tensor(theta, requires_grad=True)
    try:
        value = posterior.log_likelihood(point)
    except NotConjugate as error:
        raise not_conjugate("sds", error) from error
    except (TypeError, RuntimeError) as error:
        # Raised by NumPy or torch if the prior or likelihood converts tensors to arrays.
        reason = f"but got {type(error).__name__}: {str(error).splitlines()[0]}"
        raise no_gradient(posterior, reason) from error
    if not getattr(value, "requires_grad", False):
        raise no_gradient(posterior, f"but {type(posterior.prior).__name__} returns none")
    (gradient,) = torch.autograd.grad(value.sum(), point)
    check_finite("gradient of the log likelihood", gradient)
    return to_numpy(gradient)


def no_gradient(posterior: MotionPosterior, reason: str) -> UnsupportedPosterior:
    """Return the error for a log likelihood without a gradient."""
    return UnsupportedPosterior(
        "sds",
        f"needs a log likelihood that torch can differentiate, {reason}",
        word="gradient",
        others=[name for name in suited(posterior) if name != "sds"],
    )
