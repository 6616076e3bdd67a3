"""Gaussian-mixture prior conditioned on a likelihood, with exact denoisers.

At each joint and frame a linear Gaussian likelihood of X is exp(−½ xᵀΛx + ηᵀx). The likelihood of a
noisy view x_t = √ᾱ P X + √(1−ᾱ) ε, with projection P, has the same form: it adds ᾱ/(1−ᾱ) PᵀP to Λ
and √ᾱ/(1−ᾱ) Pᵀ x_t to η. Hence E[X₀ | x_t, y] is the posterior mean of a mixture
(:mod:`~probmotion.models.mixture.posterior`). Λ is the same for all draws at a noise level, so
everything that depends on it is computed once per batch.
"""

from __future__ import annotations

import math

import numpy as np

from probmotion.arrays import Array
from probmotion.geometry.cameras import Cameras
from probmotion.models.mixture.posterior import MixturePosterior
from probmotion.posteriors.protocols import Likelihood, MotionPrior, NotConjugate, OrthographicOnly
from probmotion.validation import check_shape

__all__ = ["ConditionedMixture"]


class ConditionedMixture:
    """Posterior p(X | y) as a prior, with exact E[X₀ | X_t, y] and E[x₀ | x_t, y] for every view.

    θ contains all positions.

    Parameters
    ----------
    prior : MotionPrior
        Prior p(X).
    posterior : MixturePosterior
        Posterior p(X | y).
    scale : float
        Metres per normalised unit.
    """

    def __init__(self, prior: MotionPrior, posterior: MixturePosterior, scale: float) -> None:
        self.skeleton = prior.skeleton
        self.frames = prior.frames
        self.fps = prior.fps
        self.scale = scale
        self.dim = math.prod(posterior.shape)
        self._posterior = posterior

    def motion(self, theta: Array) -> Array:
        """Return the positions at θ: ``(…, dim) → (…, L, J, 3)``, metres."""
        return theta.reshape(*theta.shape[:-1], *self._posterior.shape)

    def sample(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Return n independent motions, (n, L, J, 3), metres."""
        return self._posterior.sample(rng, n)

    def exact_posterior(self, likelihood: Likelihood | None) -> MixturePosterior:
        """Return p(X | y); raise ``NotConjugate`` if a second likelihood is given."""
        if likelihood is not None:
            raise NotConjugate(
                "likelihood must be None for a prior that is already conditioned, got "
                f"{type(likelihood).__name__}; condition the prior on all observations at once"
            )
        return self._posterior

    def denoise_motion(self, x_t: np.ndarray, alpha_bar: float) -> np.ndarray:
        """Return E[X₀ | X_t, y]: ``(B, L, J, 3) → (B, L, J, 3)``, normalised units."""
        check_shape("x_t", x_t, ("B", *self._posterior.shape))
        seen = x_t.reshape(len(x_t), -1, 3)
        return self._mean(seen, alpha_bar, np.eye(3)).reshape(x_t.shape)

    def denoise(self, x_t: np.ndarray, alpha_bar: float, cameras: Cameras) -> np.ndarray:
        """Return E[x₀ | x_t, y] for each orthographic view, (B, V, L, J, 2), normalised units."""
        if not cameras.orthographic:
            raise OrthographicOnly("cameras must be orthographic, got perspective")
        check_shape("x_t", x_t, ("B", cameras.n_views, *self._posterior.shape[:2], 2))
        out = np.empty_like(x_t)
        for view, axes in enumerate(cameras.image_axes):
            seen = x_t[:, view].reshape(len(x_t), -1, 2)
            out[:, view] = (self._mean(seen, alpha_bar, axes) @ axes.T).reshape(out[:, view].shape)
        return out

    def _mean(self, seen: np.ndarray, alpha_bar: float, axes: np.ndarray) -> np.ndarray:
        """Return E[X₀ | P X_t, y], ``(B, F, M) → (B, F, 3)``, F = L·J; P is ``axes``, (M, 3)."""
        posterior, scale, variance = self._posterior, self.scale, self._posterior.noise**2
        if not 0 < alpha_bar < 1:
            raise ValueError(f"alpha_bar must be between 0 and 1 (exclusive), got {alpha_bar!r}")
        precision = alpha_bar / ((1 - alpha_bar) * scale**2)
        information = posterior.information + precision * axes.T @ axes
        shrink = np.linalg.inv(np.eye(3) + variance * information)
        fields, turns = posterior.fields, posterior.turns
        K, width, _, F, _ = fields.shape
        flat = fields.reshape(K, width * 3, F * 3)
        weighted = np.einsum("fij,knefj->knefi", shrink @ information, fields, optimize=True)
        gram = (flat @ weighted.reshape(flat.shape).swapaxes(1, 2)).reshape(K, width, 3, width, 3)
        gram = np.einsum("kicjd,ac,ad->kaij", gram, turns, turns, optimize=True)
        # The arrays below have one row per draw.
        shift = posterior.shift + math.sqrt(alpha_bar) / ((1 - alpha_bar) * scale) * (seen @ axes)
        shrunk_shift = np.einsum("fij,bfj->bfi", shrink, shift)
        products = shrunk_shift.reshape(len(seen), F * 3) @ flat.reshape(K * width * 3, F * 3).T
        linear = products.reshape(len(seen), K, width, 3) @ turns.T
        return self._recombine(linear.swapaxes(2, 3), gram, shrink, shift)

    def _recombine(
        self, linear: np.ndarray, gram: np.ndarray, shrink: np.ndarray, shift: np.ndarray
    ) -> np.ndarray:
        """Return S (E[m + W z] + δ² η), the mean over components and latents, (B, F, 3).

        S is ``shrink``, η ``shift``. ``linear`` is (B, K, A, 1 + r), ``gram`` (K, A, 1 + r, 1 + r).
        """
        posterior = self._posterior
        latent_precision = np.eye(gram.shape[-1] - 1) + gram[..., 1:, 1:]
        slope = linear[..., 1:] - gram[..., 0, 1:]
        latent = (np.linalg.inv(latent_precision) @ slope[..., None])[..., 0]
        logits = np.log(posterior.weights)[:, None] - 0.5 * gram[..., 0, 0]
        logits = logits - 0.5 * np.linalg.slogdet(latent_precision)[1]
        logits = logits + linear[..., 0] + 0.5 * (slope * latent).sum(axis=-1)
        weights = np.exp(logits - logits.max(axis=(1, 2), keepdims=True))
        weights /= weights.sum(axis=(1, 2), keepdims=True)
        extended = np.concatenate([np.ones((*latent.shape[:-1], 1)), latent], axis=-1)
        base = (extended * weights[..., None]).swapaxes(2, 3) @ posterior.turns
        fields = posterior.fields
        clean = base.reshape(len(base), -1) @ fields.reshape(-1, fields[0, 0, 0].size)
        clean = clean.reshape(shift.shape) + posterior.noise**2 * shift
        return np.einsum("fij,bfj->bfi", shrink, clean) / self.scale
