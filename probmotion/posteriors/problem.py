"""`Problem`: a posterior, its truth where there is one, and its reference draws."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol

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

__all__ = ["Problem", "ScoresGeneration", "simulated"]


class ScoresGeneration(Protocol):
    """Real 2D motion that draws are scored against.

    See :class:`~probmotion.metrics.generation.GenerationReference`.
    """

    @property
    def held_out_features(self) -> np.ndarray:
        """Features of held-out real motions, (M, D)."""

    @property
    def learnt_features(self) -> np.ndarray | None:
        """Features of the clips that were learnt from, (M, D)."""

    @property
    def held_out_views(self) -> np.ndarray | None:
        """Held-out 2D motions, (M', L', J, 2), metres."""

    def of_learnt(self) -> ScoresGeneration:
        """Return the reference whose real motions are those that were learnt from."""

    def score_motions(
        self, positions: np.ndarray, *, seed: int, samples: int = 1000, angles: Any = "all"
    ) -> dict[str, tuple[float, float]]:
        """Return mean and deviation of each score of 3D motions, (N, L, J, 3) metres."""

    def chamfer(self, positions: np.ndarray, *, seed: int) -> Any:
        """Return the Motion Chamfer Distance of 3D motions, (N, L, J, 3) metres."""


@dataclass(frozen=True, eq=False)
class Problem:
    """What samplers are compared on.

    Parameters
    ----------
    name : str
        What tables call it.
    description : str
        One sentence.
    posterior : MotionPosterior
        What is drawn from.
    truth : ndarray, (L, J, 3), optional
        The motion that the evidence is of, metres.
    held_out : ndarray, (G, L, J, 3), optional
        Real motions of the kind, metres, that draws are to cover; nobody has learnt from them.
    generation : ScoresGeneration, optional
        Real 2D motion of the kind that draws, filmed, are to be like.
    kept : StoredReference, optional
        Draws of a long run, where nothing is exact.
    aligned_to : ndarray, (L, J, 3), optional
        Motion to which draws and reference draws are aligned, each moved and turned as a whole,
        before they are compared: for a posterior to which it is all the same where motions stand.
    simulate : callable, optional
        ``simulate(k)`` is the same problem with another truth, drawn from the prior, and evidence
        of it, both addressed by the seed k; see :func:`simulated`.

    Raises
    ------
    ValueError
        If the truth, ``aligned_to`` or a motion that was held out has another shape than the
        posterior's motions, or is not finite, or what is kept was drawn from another posterior.
    """

    name: str
    description: str
    posterior: MotionPosterior
    truth: np.ndarray | None = None
    held_out: np.ndarray | None = None
    generation: ScoresGeneration | None = None
    kept: StoredReference | None = None
    aligned_to: np.ndarray | None = None
    simulate: Callable[[int], Problem] | None = None

    def __post_init__(self) -> None:
        shape = (self.posterior.frames, self.posterior.skeleton.n_joints, 3)
        for name in ("truth", "aligned_to"):
            motion = getattr(self, name)
            if motion is not None:
                check_shape(name, motion, shape)
                check_finite(name, motion)
        if self.held_out is not None:
            check_shape("held_out", self.held_out, ("G", *shape))
            check_finite("held_out", self.held_out)
        if self.kept is not None:
            self.kept.check(self.name, self.posterior)

    @property
    def exact(self) -> ExactPosterior | None:
        """The posterior in closed form, where it has one."""
        prior = self.posterior.prior
        if self.posterior.reshaped or not isinstance(prior, HasExactPosterior):
            return None
        try:
            return prior.exact_posterior(self.posterior.likelihood)
        except NotConjugate:
            return None

    @property
    def known(self) -> ExactPosterior | Samplable | None:
        """What independent draws come from: the closed form; without evidence, the prior."""
        posterior, exact = self.posterior, self.exact
        if exact is not None or posterior.reshaped or posterior.likelihood is not None:
            return exact
        return posterior.prior if isinstance(posterior.prior, Samplable) else None

    @property
    def has_reference(self) -> bool:
        """Whether reference draws can be had, exact or kept."""
        return self.kept is not None or self.known is not None

    @property
    def most_reference(self) -> int | None:
        """The most reference draws there are; None where any number can be had."""
        return None if self.kept is None or self.known is not None else self.kept.n

    def reference(self, seed: int, n: int) -> np.ndarray:
        """Return n independent reference draws, (n, L, J, 3), metres.

        Exact ones where the posterior has a closed form or is a prior that can be drawn from; else
        kept ones, chosen without replacement.

        Raises
        ------
        ValueError
            If there are none, or fewer than n are kept.
        """
        check_count("n", n)
        known = self.known
        if known is not None:
            drawn = known.sample(seeds.generator(seed, "reference"), n)
            shape = (self.posterior.frames, self.posterior.skeleton.n_joints, 3)
            check_shape(f"sample(rng, {n}) of {type(known).__name__}", drawn, (n, *shape))
            check_finite(f"sample(rng, {n}) of {type(known).__name__}", drawn)
            return drawn
        if self.kept is not None:
            return self.kept.choose(seeds.generator(seed, "reference"), n)
        raise ValueError(
            f"problem {self.name} has no reference: {type(self.posterior.prior).__name__} has no "
            f"exact posterior{self._why_not()}, and no long run is kept (probmotion reference)"
        )

    def log_density_of(self, positions: np.ndarray) -> np.ndarray | None:
        """Return log p(X | y) up to a constant: ``(n, L, J, 3) → (n,)``; None if no one knows it.

        Normalised where the posterior is exact.
        """
        if self.exact is not None:
            return to_numpy(self.exact.log_density(positions))
        if not isinstance(self.posterior.prior, HasPositionDensity):
            return None
        return log_density_at(self.posterior, positions)

    def _why_not(self) -> str:
        return " here" if isinstance(self.posterior.prior, HasExactPosterior) else ""


def simulated(problem: Problem) -> Problem:
    """Return the problem with ``simulate``: truths drawn from its prior, evidence of them.

    The prior must be :class:`~probmotion.posteriors.protocols.Samplable`; where there is no
    evidence, only the truth is drawn.
    """
    return replace(problem, simulate=partial(_another, problem))


def _another(problem: Problem, k: int) -> Problem:
    prior, likelihood = problem.posterior.prior, problem.posterior.likelihood
    assert isinstance(prior, Samplable)
    truth = to_numpy(prior.sample(seeds.generator(k, "simulated truth"), 1))[0]
    if likelihood is not None:
        likelihood = likelihood.simulate(seeds.generator(k, "simulated evidence"), truth)
    again = replace(
        problem, posterior=MotionPosterior(prior, likelihood), truth=truth, kept=None, simulate=None
    )
    return simulated(again)
