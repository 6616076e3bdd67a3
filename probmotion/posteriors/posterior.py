"""`MotionPosterior`: the one object that every sampler draws from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from probmotion.arrays import Array, to_numpy
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.protocols import (
    ChecksObservations,
    ComparesViews,
    HasCoordinateSpeeds,
    HasLogDensity,
    Likelihood,
    Marginalises,
    MotionPrior,
)
from probmotion.seeds import RandomNumbers
from probmotion.validation import check_shape

__all__ = ["MotionPosterior"]


@dataclass(frozen=True, eq=False)
class MotionPosterior:
    """p(X | y) ∝ p(X) p(y | X); with no likelihood it is the prior: generation.

    Parameters
    ----------
    prior : MotionPrior
        What one believes about motion.
    likelihood : Likelihood, optional
        The evidence.

    Raises
    ------
    ValueError
        If the likelihood is of other joints, another number of frames or another frame rate than
        the prior, as far as it knows them, or the prior cannot have made it.
    """

    prior: MotionPrior
    likelihood: Likelihood | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.prior, MotionPrior):
            raise ValueError(
                f"prior is {type(self.prior).__name__}, expected an object with skeleton, frames, "
                "fps, dim and motion(theta)"
            )
        if self.likelihood is None:
            return
        if not isinstance(self.likelihood, Likelihood):
            raise ValueError(
                f"likelihood is {type(self.likelihood).__name__}, expected an object with "
                "log_density(positions) and simulate(rng, positions)"
            )
        for name, want in (("frames", self.frames), ("n_joints", self.skeleton.n_joints)):
            got = getattr(self.likelihood, name, want)
            if got != want:
                raise ValueError(f"likelihood has {name} {got}, expected the prior's {want}")
        seen = getattr(self.likelihood, "skeleton", None)
        if seen is not None and seen.canonical_names != self.skeleton.canonical_names:
            raise ValueError(
                f"likelihood is of the joints {', '.join(seen.joint_names)}, expected the prior's, "
                f"{', '.join(self.skeleton.joint_names)}; retarget one to the other"
            )
        if isinstance(self.prior, ChecksObservations):
            self.prior.check_observations(self.likelihood)
        fps = getattr(self.likelihood, "fps", None)
        if fps is not None and abs(fps - self.fps) > 1e-6 * self.fps:
            raise ValueError(
                f"likelihood is at {fps:g} frames per second, expected the prior's {self.fps:g}; "
                "resample one to the other"
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
        """Length of θ."""
        return self.prior.dim

    @property
    def differentiable(self) -> bool:
        """Whether the log density has a gradient, as far as its parts say."""
        parts = (self.prior, self.likelihood)
        return all(getattr(part, "differentiable", True) for part in parts)

    @property
    def reshaped(self) -> bool:
        """Whether the density is another than that of prior and evidence."""
        return False

    def log_density(self, theta: Array) -> Array:
        """Return log p(θ) + log p(y | θ), the posterior's up to a constant: ``(…, dim) → (…)``.

        NumPy, torch and JAX arrays alike, as far as the prior and likelihood allow. Where the
        prior is 0 the evidence is not asked.
        """
        check_shape("theta", theta, ("…", self.dim))
        if not isinstance(self.prior, HasLogDensity):
            raise ValueError(f"prior {type(self.prior).__name__} has no log density")
        log_prior = self.prior.log_density(theta)
        if not isinstance(log_prior, np.ndarray | np.floating):
            # Under a gradient or a compiler there is no asking where.
            return log_prior if self.likelihood is None else log_prior + self.log_likelihood(theta)
        if self.likelihood is None:
            return self._shaped(np.asarray(log_prior), self._log_measure(theta))

        def evidence(asked: np.ndarray) -> tuple[np.ndarray, ...]:
            return (self.log_likelihood(theta[asked]),)

        return self._with_observations(theta, np.asarray(log_prior), evidence)[0]

    def evaluate(
        self, theta: np.ndarray, generators: Sequence[np.random.Generator] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the log density and the annotations that are closest, of annotated evidence.

        Parameters
        ----------
        theta : ndarray, (n, dim)
            Where.
        generators : sequence of numpy.random.Generator, optional
            One per point, which draws views of its own: the density is then an unbiased estimate.

        Returns
        -------
        log_density : ndarray, (n,)
        closest : ndarray of int, (n, m)
            For :meth:`speeds`; 0 where the density is 0 whatever the evidence says.

        Raises
        ------
        ValueError
            If the evidence is not annotated.
        """
        if not isinstance(self.likelihood, ComparesViews):
            raise ValueError(
                f"likelihood is {type(self.likelihood).__name__}, expected annotated pairs, whose "
                "views are compared"
            )
        likelihood = self.likelihood
        log_prior = to_numpy(self.prior.log_density(theta))

        def evidence(asked: np.ndarray) -> tuple[np.ndarray, ...]:
            own = None if generators is None else [generators[i] for i in np.flatnonzero(asked)]
            return likelihood.evaluate(to_numpy(self.prior.motion(theta[asked])), own)

        log_density, closest = self._with_observations(theta, log_prior, evidence)
        return log_density, closest

    def draw_statistics(self, theta: np.ndarray, log_density: np.ndarray) -> dict[str, np.ndarray]:
        """Return what a run on this posterior should keep of every draw, by name: nothing here.

        ``theta`` (…, dim) and ``log_density`` (…) are the draws; values are arrays of (…).
        """
        return {}

    def speeds(self, closest: np.ndarray) -> np.ndarray:
        """Return each coordinate's mean squared step in the annotations of D' (eq. 12).

        ``(n, m) → (n, dim)``; what :meth:`evaluate` found closest.
        """
        if not isinstance(self.likelihood, ComparesViews) or not isinstance(
            self.prior, HasCoordinateSpeeds
        ):
            raise ValueError(
                f"prior {type(self.prior).__name__} with likelihood "
                f"{type(self.likelihood).__name__} has no speeds, expected annotated pairs"
            )
        return self.prior.coordinate_speeds(self.likelihood.joint_speeds(closest))

    def _with_observations(
        self,
        theta: np.ndarray,
        log_prior: np.ndarray,
        evidence: Callable[[np.ndarray], tuple[np.ndarray, ...]],
    ) -> tuple[np.ndarray, ...]:
        """Return the log density and what else ``evidence`` says, which is asked where it counts.

        ``evidence`` takes a mask of points and returns arrays over them, the log likelihood first.
        """
        log_measure = self._log_measure(theta)
        asked = self._worth_asking(log_prior, log_measure)
        log_likelihood, *others = evidence(asked)
        log_density = np.full(log_prior.shape, -np.inf)
        log_density[asked] = log_prior[asked] + np.asarray(log_likelihood)
        full = [np.zeros((*log_prior.shape, *found.shape[1:]), found.dtype) for found in others]
        for array, found in zip(full, others, strict=True):
            array[asked] = found
        return self._shaped(log_density, log_measure), *full

    # What a posterior that changes the density's shape overrides: TruncatedPosterior.

    def _log_measure(self, theta: np.ndarray) -> np.ndarray:
        """Return the log density of the measure that shapes are relative to."""
        return np.zeros(theta.shape[:-1])

    def _worth_asking(self, log_prior: np.ndarray, log_measure: np.ndarray) -> np.ndarray:
        """Return where the evidence can change the density, a mask."""
        return log_prior > -np.inf

    def _shaped(self, log_density: np.ndarray, log_measure: np.ndarray) -> np.ndarray:
        """Return the density that is drawn from."""
        return log_density

    def log_likelihood(self, theta: Array) -> Array:
        """Return log p(y | θ): ``(…, dim) → (…)``.

        Raises
        ------
        ValueError
            If there is no likelihood.
        """
        check_shape("theta", theta, ("…", self.dim))
        if self.likelihood is None:
            raise ValueError("likelihood must be evidence to have a density, got None")
        if isinstance(self.prior, Marginalises):
            return self.prior.log_likelihood(theta, self.likelihood)
        return self.likelihood.log_density(self.prior.motion(theta))

    def motion(self, theta: Array) -> Array:
        """Return the positions at θ: ``(…, dim) → (…, L, J, 3)``, metres.

        Where the prior integrates variables out, use :meth:`complete`.
        """
        check_shape("theta", theta, ("…", self.dim))
        return self.prior.motion(theta)

    def complete(self, rng: RandomNumbers, theta: np.ndarray) -> np.ndarray:
        """Return one motion per θ, ``(n, dim) → (n, L, J, 3)``.

        Variables that the prior integrates out are drawn given θ and the evidence; where there
        are none, ``rng`` is not used.
        """
        check_shape("theta", theta, ("n", self.dim))
        if isinstance(self.prior, Marginalises):
            return self.prior.complete(rng, theta, self.likelihood)
        return to_numpy(self.prior.motion(theta))

    def initial(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Return n starting points, draws of θ from the prior, (n, dim)."""
        if not isinstance(self.prior, HasLogDensity):
            raise ValueError(f"prior {type(self.prior).__name__} has no log density")
        return self.prior.initial(rng, n)
