"""Kernel Stein discrepancy: goodness of fit of draws to an unnormalised density.

The discrepancy requires only the gradient of the log density. It is local: it does not detect wrong
weights of well-separated modes.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from probmotion.arrays import to_numpy
from probmotion.metrics.two_sample import median_distance, squared_distances
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import HasLogDensity, NotConjugate
from probmotion.validation import check_finite, check_positive, check_shape

__all__ = ["NoGradient", "kernel_stein_discrepancy", "score_of"]

_BATCH = 256  # draws per gradient evaluation


class NoGradient(ValueError):  # noqa: N818 (a condition, not a fault)
    """Error for a posterior without a differentiable log density in θ; states the reason."""


def kernel_stein_discrepancy(
    theta: np.ndarray, score: np.ndarray, *, length_scale: float | None = None
) -> float:
    """Return the squared kernel Stein discrepancy of draws from a density, unbiased; 0 is ideal.

    It is the mean, over pairs θ ≠ θ' of draws, of (Liu et al. 2016, eqs. 9 and 14)

        h(θ, θ') = s·s' k + s·∇'k + s'·∇k + tr ∇∇'k,    s = ∇ log p(θ), s' = ∇ log p(θ'),

    with the inverse multiquadric kernel k = (1 + ‖θ − θ'‖²/ℓ²)^(−1/2). A Gaussian kernel would not
    detect divergent draws in three dimensions or more (Gorham and Mackey 2017, theorems 6 and 8).
    The computation uses θ/ℓ, so the result does not depend on the unit of θ.

    This U-statistic has mean 0 for exact draws and may be negative. The V-statistic, which includes
    θ = θ', would have mean E h(θ, θ)/n, which grows with the dimension.

    Parameters
    ----------
    theta : ndarray, (n, d)
        Draws, n ≥ 2.
    score : ndarray, (n, d)
        Gradients ∇ log p at the draws (:func:`score_of`).
    length_scale : float, optional
        Length scale ℓ, in units of θ; by default the median distance between draws.
    """
    check_shape("score", score, np.shape(theta))
    check_finite("score", score)
    median = median_distance(theta)
    if length_scale is None:
        length_scale = median
    check_positive("length_scale", length_scale)
    n, dim = theta.shape
    point, slope = (theta - theta.mean(axis=0)) / length_scale, score * length_scale
    squared = squared_distances(point)
    kernel = (1 + squared) ** -0.5
    # With u = θ − θ' and f(‖u‖²) = k: ∇k = 2f'u, ∇'k = −2f'u, tr ∇∇'k = −2d f' − 4f''‖u‖².
    first, second = -0.5 * kernel**3, 0.75 * kernel**5
    products = slope @ point.T
    projection = np.diag(products)[:, None] - products
    pairs = (slope @ slope.T) * kernel - 2 * first * (projection + projection.T)
    pairs -= 2 * dim * first + 4 * second * squared
    return float((pairs.sum() - np.trace(pairs)) / (n * (n - 1)))


def score_of(posterior: MotionPosterior, theta: np.ndarray) -> np.ndarray:
    """Return ∇ log p(θ | y) by automatic differentiation with torch, or JAX if torch fails.

    ``(n, dim) → (n, dim)``, float64.

    Raises
    ------
    NoGradient
        If the posterior has no log density in θ, or neither library can differentiate it.
    ValueError
        If the gradient is not finite.
    """
    check_shape("theta", theta, ("n", posterior.dim))
    check_finite("theta", theta)
    if not isinstance(posterior.prior, HasLogDensity):
        raise NoGradient(f"posterior must have a log density, got {_kind(posterior.prior)}")
    for part in (posterior.prior, posterior.likelihood):
        if not getattr(part, "differentiable", True):
            raise NoGradient(f"posterior must be differentiable, but {_kind(part)} has no gradient")
    score = _score(posterior, np.asarray(theta, np.float64))
    check_finite("score", score)
    return score


def _score(posterior: MotionPosterior, theta: np.ndarray) -> np.ndarray:
    """Return the gradient, computed by the first library that can differentiate the density."""
    reasons = []
    for name, gradient in (("torch", _torch_gradient), ("JAX", _jax_gradient)):
        try:
            starts = range(0, len(theta), _BATCH)
            parts = [gradient(posterior, theta[start : start + _BATCH]) for start in starts]
            return np.concatenate(parts)
        except NotConjugate as error:
            raise NoGradient(f"posterior must be differentiable: {error}") from error
        except Exception as cause:
            # Densities may raise any exception for unsupported arrays.
            is_missing = isinstance(cause, ModuleNotFoundError)
            reasons.append(str(cause) if is_missing else f"{name} raised {type(cause).__name__}")
    raise NoGradient(
        f"posterior must be differentiable, got {_kind(posterior.prior)} with "
        f"{_kind(posterior.likelihood)}: {' and '.join(reasons)}"
    )


def _torch_gradient(posterior: MotionPosterior, theta: np.ndarray) -> np.ndarray:
    from probmotion.extras import torch

    point = torch.tensor(theta, requires_grad=True)
    # Rows are independent: the gradient of their sum contains each row's gradient.
    (gradient,) = torch.autograd.grad(posterior.log_density(point).sum(), point)
    return to_numpy(gradient)


def _jax_gradient(posterior: MotionPosterior, theta: np.ndarray) -> np.ndarray:
    from probmotion.extras import jax

    def total(point: Any) -> Any:
        return posterior.log_density(point).sum()

    with jax.enable_x64(True):
        return to_numpy(jax.grad(total)(jax.numpy.asarray(theta)))


def _kind(part: object) -> str:
    return "no likelihood" if part is None else type(part).__name__
