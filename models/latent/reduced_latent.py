"""`ReducedLatent`: the few directions of a latent code along which the motion changes most.

Walkers that propose blindly lose their way in hundreds of dimensions; along these directions a
prior of k dimensions keeps most of what its decoder can do.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np
import torch

from probmotion import seeds
from probmotion.arrays import Array, constant
from probmotion.models.latent.standard_normal import StandardNormalPrior
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.protocols import ChecksObservations, Likelihood
from probmotion.validation import check_count, check_shape

__all__ = ["ReducedLatent"]

_ROWS = 64


class ReducedLatent(StandardNormalPrior):
    """A prior whose z = U θ, θ ~ N(0, I_k), and 0 along all other directions.

    U (Z, k) holds the leading eigenvectors of E[JᵀJ], J = ∂X/∂z the decoder's Jacobian at draws of
    the prior. It is estimated by E[(Jᵀv)(Jᵀv)ᵀ] with v ~ N(0, I), one pull-back per draw of z, so
    that no Jacobian is ever held.

    Parameters
    ----------
    prior : MotionVAE
        Any prior with θ ~ N(0, I) whose motion torch differentiates.
    k : int
        Number of directions, at most the prior's ``dim``.
    seed : int
        Of the draws.

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
        values, vectors = np.linalg.eigh(_mean_square(prior, seeds.generator(seed, "directions")))
        leading = np.argsort(values)[::-1][:k]
        # Eigenvectors have no sign: the largest entry is positive.
        chosen = vectors[:, leading]
        largest = np.abs(chosen).argmax(axis=0)
        self.directions = chosen * np.sign(chosen[largest, np.arange(k)])

    @property
    def stand_ins(self) -> Mapping[str, str]:
        """How to get what the prior lacks, as samplers say when they refuse."""
        return getattr(self.prior, "stand_ins", {})

    @cached_property
    def kept(self) -> float:
        """Share of the motion's mean squared change, tr E[JᵀJ], that is along the directions.

        What is lost is one less this share. It is estimated when it is asked for.
        """
        # On draws of their own: the directions suit those that chose them better than any others.
        other = _mean_square(self.prior, seeds.generator(self.seed, "kept"))
        along = np.einsum("zk,zy,yk->", self.directions, other, self.directions)
        return float(along / np.trace(other))

    @property
    def skeleton(self) -> Skeleton:
        """The J joints."""
        return self.prior.skeleton

    @property
    def frames(self) -> int:
        """Number of frames L."""
        return self.prior.frames

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self.prior.fps

    @property
    def dim(self) -> int:
        """Length k of θ."""
        return self.directions.shape[1]

    def check_observations(self, likelihood: Likelihood) -> None:
        """Raise ``ValueError`` if the prior does."""
        if isinstance(self.prior, ChecksObservations):
            self.prior.check_observations(likelihood)

    def latent(self, theta: Array) -> Array:
        """Return z = U θ, ``(…, k) → (…, Z)``."""
        check_shape("theta", theta, ("…", self.dim))
        return theta @ constant(self.directions.T, theta)

    def motion(self, theta: Array) -> Array:
        """Return the prior's motion at U θ, ``(…, k) → (…, L, J, 3)``, metres."""
        return self.prior.motion(self.latent(theta))


def _mean_square(prior: Any, rng: np.random.Generator) -> np.ndarray:
    """Return an estimate of E[JᵀJ], (Z, Z), from eight draws per dimension and 512 at least."""
    n = max(512, 8 * prior.dim)
    total = np.zeros((prior.dim, prior.dim))
    for begun in range(0, n, _ROWS):
        rows = min(_ROWS, n - begun)
        z = torch.as_tensor(rng.standard_normal((rows, prior.dim)), dtype=torch.float32)
        z.requires_grad_(True)
        motion = prior.motion(z)
        across = torch.as_tensor(rng.standard_normal(tuple(motion.shape)), dtype=motion.dtype)
        (pulled,) = torch.autograd.grad(motion, z, across)
        found = pulled.double().numpy()
        total += found.T @ found
    return total / n
