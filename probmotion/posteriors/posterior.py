"""Posterior over motions, the target of every sampler."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from probmotion import seeds
from probmotion.arrays import Array, to_numpy
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.protocols import (
    ChecksObservations,
    ComparesViews,
    HasConditional,
    HasCoordinateSpeeds,
    HasLogDensity,
    HasMotionDensity,
    Likelihood,
    Marginalises,
    MotionPrior,
)
from probmotion.seeds import RandomNumbers
from probmotion.validation import check_shape

__all__ = ["MotionPosterior"]


@dataclass(frozen=True, eq=False)
class MotionPosterior:
    """Posterior p(X | y) ∝ p(X) p(y | X), or the prior if there is no likelihood.

    Parameters
    ----------
    prior : MotionPrior
        Distribution of motions.
    likelihood : Likelihood, optional
        Model of the observations.

    Raises
    ------
    ValueError
        If the likelihood's joints, number of frames or frame rate differ from the prior's, or the
        prior rejects the observations.
    """

    prior: MotionPrior
    likelihood: Likelihood | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.prior, MotionPrior):
            raise ValueError(
                "prior must have skeleton, frames, fps, dim and motion(theta), got "
                f"{type(self.prior).__name__}"
            )
        if self.likelihood is None:
            return
        if not isinstance(self.likelihood, Likelihood):
            raise ValueError(
                "likelihood must have log_density(positions) and simulate(rng, positions), got "
                f"{type(self.likelihood).__name__}"
            )
        for name, expected in (("frames", self.frames), ("n_joints", self.skeleton.n_joints)):
            got = getattr(self.likelihood, name, expected)
            if got != expected:
                raise ValueError(f"likelihood must have the prior's {name}, {expected}, got {got}")
        seen = getattr(self.likelihood, "skeleton", None)
        if seen is not None and seen.canonical_names != self.skeleton.canonical_names:
            raise ValueError(
                f"likelihood must have the prior's joints, {', '.join(self.skeleton.joint_names)}, "
                f"got {', '.join(seen.joint_names)}; retarget one to the other"
            )
        if isinstance(self.prior, ChecksObservations):
            self.prior.check_observations(self.likelihood)
        fps = getattr(self.likelihood, "fps", None)
        if fps is not None and abs(fps - self.fps) > 1e-6 * self.fps:
            raise ValueError(
                f"likelihood must have the prior's frame rate, {self.fps:g}, got {fps:g}; resample "
                "one to the other"
            )

    @property
    def skeleton(self) -> Skeleton:
        """The prior's skeleton."""
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
        """Dimension of θ."""
        return self.prior.dim

    @property
    def differentiable(self) -> bool:
        """Whether prior and likelihood are differentiable."""
        parts = (self.prior, self.likelihood)
        return all(getattr(part, "differentiable", True) for part in parts)

    @property
    def truncated(self) -> bool:
        """Whether the density is truncated (:class:`TruncatedPosterior`)."""
        return False

    def conditioned(self) -> MotionPosterior:
        """Return this posterior as a prior without likelihood, with exact denoisers.

        Raises
        ------
        ValueError
            If there are observations, but the prior has no ``given``, or the density is truncated.
        NotConjugate
            If the observations are not linear in the positions with Gaussian noise.
        """
        if self.truncated:
            raise ValueError("a truncated posterior has no exact denoisers; use limit=inf")
        if self.likelihood is None:
            return self
        if not isinstance(self.prior, HasConditional):
            raise ValueError(
                "prior must have given(likelihood) for exact denoisers of the posterior, got "
                f"{type(self.prior).__name__}"
            )
        return MotionPosterior(self.prior.given(self.likelihood))

    def log_density(self, theta: Array) -> Array:
        """Return log p(θ) + log p(y | θ), unnormalised: ``(…, dim) → (…)``.

        Accepts the array types of prior and likelihood (NumPy, torch, JAX). With NumPy, the
        likelihood is only evaluated where the prior's density is positive.
        """
        check_shape("theta", theta, ("…", self.dim))
        log_prior, motion = self._log_prior(theta)
        if not isinstance(log_prior, np.ndarray | np.floating):
            # Boolean masks fail under automatic differentiation and compilation.
            return log_prior if self.likelihood is None else log_prior + self.log_likelihood(theta)
        likelihood = self.likelihood
        if likelihood is None:
            return self._shaped(np.asarray(log_prior), self._log_measure(theta))

        def evaluate(mask: np.ndarray) -> tuple[Array, np.ndarray]:
            if motion is None:
                log_likelihood = self.log_likelihood(theta[mask])
            else:
                log_likelihood = likelihood.log_density(motion[mask])
            return log_likelihood, np.empty((mask.sum(), 0), dtype=int)

        return self._with_observations(theta, np.asarray(log_prior), evaluate)[0]

    def evaluate(
        self, theta: np.ndarray, generators: Sequence[np.random.Generator] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the log density and the closest annotations.

        Parameters
        ----------
        theta : ndarray, (n, dim)
            Coordinates.
        generators : sequence of numpy.random.Generator, optional
            One generator per point, from which views are drawn. The density is then an unbiased
            estimate, which must not be truncated.

        Returns
        -------
        log_density : ndarray, (n,)
        closest : ndarray of int, (n, m)
            Closest annotations, for :meth:`speeds`; 0 where the likelihood is not evaluated.
        """
        likelihood = self.likelihood
        if not isinstance(likelihood, ComparesViews):
            raise ValueError(
                f"likelihood must compare views with annotations, got {type(likelihood).__name__}"
            )
        if generators is not None and self.truncated:
            raise ValueError(
                "limit must be infinite with randomly drawn views, since truncating an unbiased "
                "estimate biases it"
            )
        log_prior, motion = self._log_prior(theta)

        def compare(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            selected = None if generators is None else [generators[i] for i in np.flatnonzero(mask)]
            positions = self.prior.motion(theta[mask]) if motion is None else motion[mask]
            return likelihood.evaluate(to_numpy(positions), selected)

        return self._with_observations(theta, to_numpy(log_prior), compare)

    def draw_statistics(self, theta: np.ndarray, log_density: np.ndarray) -> dict[str, np.ndarray]:
        """Return additional statistics of draws by name, given θ (…, dim) and log density (…)."""
        return {}

    def speeds(self, closest: np.ndarray) -> np.ndarray:
        """Return each coordinate's mean squared step in the closest annotations D' (eq. 12).

        ``(n, m) → (n, dim)``; ``closest`` comes from :meth:`evaluate`.
        """
        if not isinstance(self.likelihood, ComparesViews) or not isinstance(
            self.prior, HasCoordinateSpeeds
        ):
            raise ValueError(
                "prior and likelihood must be HasCoordinateSpeeds and ComparesViews, got "
                f"{type(self.prior).__name__} and {type(self.likelihood).__name__}"
            )
        return self.prior.coordinate_speeds(self.likelihood.joint_speeds(closest))

    def _log_prior(self, theta: Array) -> tuple[Array, Array | None]:
        """Return log p(θ) and, if the prior computes it from the motion, that motion."""
        if isinstance(self.prior, HasMotionDensity):
            return self.prior.density_and_motion(theta)
        if not isinstance(self.prior, HasLogDensity):
            raise ValueError(f"prior must have a log density, got {type(self.prior).__name__}")
        return self.prior.log_density(theta), None

    def _with_observations(
        self,
        theta: np.ndarray,
        log_prior: np.ndarray,
        evaluate: Callable[[np.ndarray], tuple[Array, np.ndarray]],
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the log density and the closest annotations of all points.

        ``evaluate`` maps a mask of points to their log likelihood and closest annotations.
        """
        log_measure = self._log_measure(theta)
        mask = self._needs_likelihood(log_prior, log_measure)
        log_likelihood, masked = evaluate(mask)
        log_density = np.full(log_prior.shape, -np.inf)
        log_density[mask] = log_prior[mask] + np.asarray(log_likelihood)
        closest = np.zeros((*log_prior.shape, *masked.shape[1:]), masked.dtype)
        closest[mask] = masked
        return self._shaped(log_density, log_measure), closest

    # Methods overridden by TruncatedPosterior.

    def _log_measure(self, theta: np.ndarray) -> np.ndarray:
        """Return the log density of the base measure, 0 unless the subclass uses the prior's."""
        return np.zeros(theta.shape[:-1])

    def _needs_likelihood(self, log_prior: np.ndarray, log_measure: np.ndarray) -> np.ndarray:
        """Return the mask of points where the likelihood affects the density."""
        return log_prior > -np.inf

    def _shaped(self, log_density: np.ndarray, log_measure: np.ndarray) -> np.ndarray:
        """Return the log density, truncated in the subclass."""
        return log_density

    def log_likelihood(self, theta: Array) -> Array:
        """Return log p(y | θ): ``(…, dim) → (…)``."""
        check_shape("theta", theta, ("…", self.dim))
        if self.likelihood is None:
            raise ValueError("posterior must have a likelihood, got None")
        if isinstance(self.prior, Marginalises):
            return self.prior.log_likelihood(theta, self.likelihood)
        return self.likelihood.log_density(self.prior.motion(theta))

    def motion(self, theta: Array) -> Array:
        """Return the positions at θ: ``(…, dim) → (…, L, J, 3)``, metres.

        Use :meth:`complete` for a prior that marginalises variables.
        """
        check_shape("theta", theta, ("…", self.dim))
        return self.prior.motion(theta)

    def complete(self, theta: Array, rng: RandomNumbers | None = None) -> np.ndarray:
        """Return one motion per θ: ``(…, dim) → (…, L, J, 3)``, metres.

        Variables that the prior marginalises are drawn given θ and the observations, from ``rng``
        or, by default, a generator of seed 0. ``rng`` is unused without such variables.
        """
        check_shape("theta", theta, ("…", self.dim))
        if not isinstance(self.prior, Marginalises):
            return to_numpy(self.prior.motion(theta))
        rng = seeds.generator(0, "complete") if rng is None else rng
        flat = to_numpy(theta).reshape(-1, self.dim)
        motions = self.prior.complete(rng, flat, self.likelihood)
        return motions.reshape(*theta.shape[:-1], *motions.shape[1:])

    def initial(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Return n starting points drawn from the prior, (n, dim)."""
        if not isinstance(self.prior, HasLogDensity):
            raise ValueError(f"prior must have a log density, got {type(self.prior).__name__}")
        return self.prior.initial(rng, n)
