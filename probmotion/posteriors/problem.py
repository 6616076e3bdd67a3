"""Test problems: posteriors with true motions and reference draws."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from probmotion import seeds
from probmotion.arrays import to_numpy
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import (
    ExactPosterior,
    HasExactPosterior,
    NotConjugate,
    Samplable,
)
from probmotion.posteriors.reference import HasPositionDensity, StoredReference, log_density_at
from probmotion.validation import check_count, check_finite, check_shape

__all__ = ["Problem", "problem_of", "simulated"]


@dataclass(frozen=True, eq=False)
class Problem:
    """Test problem for the comparison of samplers.

    Parameters
    ----------
    name : str
        Name of the problem in tables.
    description : str
        Description of the problem in one sentence.
    posterior : MotionPosterior
        Target of the samplers.
    truth : ndarray, (L, J, 3), optional
        True motion that generated the observations, metres.
    held_out : ndarray, (G, L, J, 3), optional
        Held-out real motions that draws should cover, metres.
    generation : GenerationReference, optional
        Real 2D motion that projected draws should resemble.
    stored : StoredReference, optional
        Draws of a long run, for a posterior without exact draws.
    aligned_to : ndarray, (L, J, 3), optional
        Motion to which draws and reference draws are rigidly aligned before comparison, for
        posteriors invariant to translation and rotation.
    simulate : callable, optional
        ``simulate(k)`` returns the problem with a truth drawn from the prior and simulated
        observations, both seeded by k; see :func:`simulated`.

    Raises
    ------
    ValueError
        If an array has the wrong shape or is not finite, or ``stored`` belongs to another
        posterior.
    """

    name: str
    description: str
    posterior: MotionPosterior
    truth: np.ndarray | None = None
    held_out: np.ndarray | None = None
    generation: Any = None
    stored: StoredReference | None = None
    aligned_to: np.ndarray | None = None
    simulate: Callable[[int], Problem] | None = None

    def __post_init__(self) -> None:
        for name, batch in (("truth", ()), ("aligned_to", ()), ("held_out", ("G",))):
            motion = getattr(self, name)
            if motion is not None:
                check_shape(name, motion, (*batch, *self._shape))
                check_finite(name, motion)
        if self.stored is not None:
            self.stored.check(self.name, self.posterior)

    @property
    def _shape(self) -> tuple[int, int, int]:
        return self.posterior.frames, self.posterior.skeleton.n_joints, 3

    @property
    def exact(self) -> ExactPosterior | None:
        """Closed-form posterior; ``None`` if unavailable."""
        prior = self.posterior.prior
        if self.posterior.truncated or not isinstance(prior, HasExactPosterior):
            return None
        try:
            return prior.exact_posterior(self.posterior.likelihood)
        except NotConjugate:
            return None

    @property
    def exact_source(self) -> ExactPosterior | Samplable | None:
        """Source of independent draws: the closed form, or the prior without observations."""
        posterior, exact = self.posterior, self.exact
        if exact is not None or posterior.truncated or posterior.likelihood is not None:
            return exact
        return posterior.prior if isinstance(posterior.prior, Samplable) else None

    @property
    def has_reference(self) -> bool:
        """Whether exact or stored reference draws are available."""
        return self.stored is not None or self.exact_source is not None

    @property
    def max_references(self) -> int | None:
        """Largest number of reference draws; ``None`` if unlimited."""
        return None if self.stored is None or self.exact_source is not None else self.stored.n

    def reference(self, seed: int, n: int) -> np.ndarray:
        """Return n independent reference draws, (n, L, J, 3), metres.

        The draws are exact if possible, else stored draws chosen without replacement. Raises
        ``ValueError`` if fewer than n draws are available.
        """
        check_count("n", n)
        source, rng = self.exact_source, seeds.generator(seed, "reference")
        if source is not None:
            draws = source.sample(rng, n)
            name = f"sample(rng, {n}) of {type(source).__name__}"
            check_shape(name, draws, (n, *self._shape))
            check_finite(name, draws)
            return draws
        if self.stored is not None:
            return self.stored.choose(rng, n)
        raise ValueError(
            f"problem {self.name} must have reference draws, got neither an exact posterior nor "
            "stored draws; create them with probmotion reference"
        )

    def log_density_of(self, positions: np.ndarray) -> np.ndarray | None:
        """Return log p(X | y), (n, L, J, 3) → (n,): normalised if exact, ``None`` if unknown."""
        if self.exact is not None:
            return to_numpy(self.exact.log_density(positions))
        known = isinstance(self.posterior.prior, HasPositionDensity)
        return log_density_at(self.posterior, positions) if known else None


def simulated(problem: Problem) -> Problem:
    """Return the problem with a ``simulate`` function that draws truths from its prior.

    The prior must be :class:`~probmotion.posteriors.protocols.Samplable`.
    """
    return replace(problem, simulate=partial(_another, problem))


def problem_of(name: str, posterior: MotionPosterior) -> Problem:
    """Return the problem of a user-supplied posterior, simulated if its prior can be sampled."""
    problem = Problem(name, "a user-supplied posterior", posterior)
    can_simulate = isinstance(posterior.prior, Samplable) and not posterior.truncated
    return simulated(problem) if can_simulate else problem


def _another(problem: Problem, k: int) -> Problem:
    prior, likelihood = problem.posterior.prior, problem.posterior.likelihood
    assert isinstance(prior, Samplable)
    truth = to_numpy(prior.sample(seeds.generator(k, "simulated truth"), 1))[0]
    if likelihood is not None:
        likelihood = likelihood.simulate(seeds.generator(k, "simulated evidence"), truth)
    posterior = MotionPosterior(prior, likelihood)
    return simulated(replace(problem, posterior=posterior, truth=truth, stored=None))
