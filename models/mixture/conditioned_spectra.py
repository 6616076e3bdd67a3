"""Spectral mixture conditioned on a likelihood, with exact denoisers.

A noisy view x_t = √ᾱ P X + √(1−ᾱ) ε adds ᾱ/(1−ᾱ) PᵀP to Λ and √ᾱ/(1−ᾱ) Pᵀ x_t to η, in
exp(−½ xᵀΛx + ηᵀx) at each frame and joint: E[X₀ | x_t, y] is another posterior mean.
"""

from __future__ import annotations

import math

import numpy as np

from probmotion.arrays import Array
from probmotion.geometry.cameras import Cameras
from probmotion.models.mixture.spectral_posterior import SpectralPosterior, condition
from probmotion.posteriors.protocols import Likelihood, MotionPrior, NotConjugate, OrthographicOnly
from probmotion.validation import check_shape

__all__ = ["ConditionedSpectra"]


class ConditionedSpectra:
    """Posterior p(X | y) as a prior, with exact E[X₀ | X_t, y] and E[x₀ | x_t, y] for every view.

    θ is that of the prior.

    Parameters
    ----------
    prior : MotionPrior
        Prior p(X).
    posterior : SpectralPosterior
        Posterior p(X | y).
    scale : float
        Metres per normalised unit.
    """

    def __init__(self, prior: MotionPrior, posterior: SpectralPosterior, scale: float) -> None:
        self.prior = prior
        self.skeleton = prior.skeleton
        self.frames = prior.frames
        self.fps = prior.fps
        self.scale = scale
        self.dim = prior.dim
        self._posterior = posterior

    def motion(self, theta: Array) -> Array:
        """Return the positions at θ: ``(…, dim) → (…, L, J, 3)``, metres."""
        return self.prior.motion(theta)

    def sample(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Return n independent motions, (n, L, J, 3), metres."""
        return self._posterior.sample(rng, n)

    def exact_posterior(self, likelihood: Likelihood | None) -> SpectralPosterior:
        """Return p(X | y); raise ``NotConjugate`` if a second likelihood is given."""
        if likelihood is not None:
            raise NotConjugate(
                "likelihood must be None for a prior that is already conditioned, got "
                f"{type(likelihood).__name__}; condition the prior on all observations at once"
            )
        return self._posterior

    def denoise_motion(self, x_t: np.ndarray, alpha_bar: float) -> np.ndarray:
        """Return E[X₀ | X_t, y]: ``(B, L, J, 3) → (B, L, J, 3)``, normalised units."""
        check_shape("x_t", x_t, ("B", self.frames, self.skeleton.n_joints, 3))
        return self._mean(x_t, alpha_bar, np.eye(3))

    def denoise(self, x_t: np.ndarray, alpha_bar: float, cameras: Cameras) -> np.ndarray:
        """Return E[x₀ | x_t, y] for each orthographic view, (B, V, L, J, 2), normalised units."""
        if not cameras.orthographic:
            raise OrthographicOnly("cameras must be orthographic, got perspective")
        check_shape("x_t", x_t, ("B", cameras.n_views, self.frames, self.skeleton.n_joints, 2))
        views = [
            self._mean(x_t[:, view], alpha_bar, axes) @ axes.T
            for view, axes in enumerate(cameras.image_axes)
        ]
        return np.stack(views, axis=1)

    def _mean(self, x_t: np.ndarray, alpha_bar: float, axes: np.ndarray) -> np.ndarray:
        """Return E[X₀ | P X₀ √ᾱ + noise = x_t, y]: ``(B, L, J, M) → (B, L, J, 3)``."""
        if not 0 < alpha_bar < 1:
            raise ValueError(f"alpha_bar must be between 0 and 1 (exclusive), got {alpha_bar!r}")
        precision = alpha_bar / ((1 - alpha_bar) * self.scale**2)
        information = self._posterior.information + precision * axes.T @ axes
        shift = self._posterior.shift + precision * self.scale / math.sqrt(alpha_bar) * (x_t @ axes)
        return condition(self._posterior.components, information, shift)[1] / self.scale
