"""Low-dimensional subspace of a latent prior.

Random-walk samplers mix in this subspace, which is spanned by the k directions along which the
decoded motion varies most.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np

from probmotion import seeds
from probmotion.arrays import Array, constant
from probmotion.extras import torch
from probmotion.models.latent.code_mixture import CodePrior
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.protocols import ChecksObservations, Likelihood
from probmotion.validation import check_count, check_shape

__all__ = ["ReducedLatent"]

_ROWS = 64  # Number of draws per batch.


class ReducedLatent(CodePrior):
    """Prior over θ = Uᵀ z, with latent code z = z̄ + U (θ − Uᵀ z̄).

    z̄ is the mean of the prior's codes. U (Z, k) contains the leading eigenvectors of E[JᵀJ], with
    J = ∂X/∂z the Jacobian of the motion X at prior draws. E[JᵀJ] is estimated by E[(Jᵀv)(Jᵀv)ᵀ]
    with v ~ N(0, I), one product per draw.

    Parameters
    ----------
    prior : MotionVAE
        Prior over codes with a ``motion`` method differentiable by torch.
    k : int
        Number of directions, at most the prior's ``dim``.
    seed : int
        Seed of the draws for this estimate.

    Raises
    ------
    ValueError
        If k is out of range.
    """

    def __init__(self, prior: Any, k: int, seed: int = 0) -> None:
        check_count("k", k)
        if k > prior.dim:
            raise ValueError(f"k must be at most the prior's {prior.dim} dimensions, got {k}")
        self.prior = prior
        self.seed = seed
        self.skeleton: Skeleton = prior.skeleton
        self.frames: int = prior.frames
        self.fps: float = prior.fps
        # Remedies for protocols that the prior lacks, shown if a sampler is not applicable.
        self.stand_ins: Mapping[str, str] = getattr(prior, "stand_ins", {})
        values, vectors = np.linalg.eigh(_mean_square(prior, seeds.generator(seed, "directions")))
        leading = np.argsort(values)[::-1][:k]
        # Fix the sign of each eigenvector: its largest entry is positive.
        vectors = vectors[:, leading]
        largest = np.abs(vectors).argmax(axis=0)
        self.directions = vectors * np.sign(vectors[largest, np.arange(k)])
        self.codes = prior.codes.along(self.directions)
        mean = prior.codes.weights @ prior.codes.means
        self._rest = mean - self.directions @ (mean @ self.directions)

    @cached_property
    def explained(self) -> float:
        """Fraction of tr E[JᵀJ] along the directions, estimated from independent draws."""
        mean_square = _mean_square(self.prior, seeds.generator(self.seed, "kept"))
        along = np.einsum("zk,zy,yk->", self.directions, mean_square, self.directions)
        return float(along / np.trace(mean_square))

    def check_observations(self, likelihood: Likelihood) -> None:
        """Raise ``ValueError`` if the prior does not support the observations."""
        if isinstance(self.prior, ChecksObservations):
            self.prior.check_observations(likelihood)

    def latent(self, theta: Array) -> Array:
        """Return z, ``(…, k) → (…, Z)``."""
        check_shape("theta", theta, ("…", self.dim))
        return constant(self._rest, theta) + theta @ constant(self.directions.T, theta)

    def motion(self, theta: Array) -> Array:
        """Return the motion at z, ``(…, k) → (…, L, J, 3)``, metres."""
        return self.prior.motion(self.latent(theta))


def _mean_square(prior: Any, rng: np.random.Generator) -> np.ndarray:
    """Return an estimate of E[JᵀJ], (Z, Z), from eight draws per dimension, at least 512."""
    n = max(512, 8 * prior.dim)
    total = np.zeros((prior.dim, prior.dim))
    for start in range(0, n, _ROWS):
        rows = min(_ROWS, n - start)
        z = torch.as_tensor(prior.initial(rng, rows), dtype=torch.float32)
        z.requires_grad_(True)
        motion = prior.motion(z)
        v = torch.as_tensor(rng.standard_normal(tuple(motion.shape)), dtype=motion.dtype)
        (product,) = torch.autograd.grad(motion, z, v)
        products = product.double().numpy()
        total += products.T @ products
    return total / n
