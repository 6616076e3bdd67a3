"""`Problem`: a posterior, its truth where there is one, and its reference draws."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probmotion import seeds
from probmotion.checks import check_count, check_finite, check_shape
from probmotion.metrics.generation import GenerationReference
from probmotion.posterior import MotionPosterior
from probmotion.priors import HasExactPosterior, NotConjugate

__all__ = ["Problem"]


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
    generation : GenerationReference, optional
        Real 2D motion of the kind that draws, filmed, are to be like.

    Raises
    ------
    ValueError
        If the truth or a motion that was held out has another shape than the posterior's
        motions, or is not finite.
    """

    name: str
    description: str
    posterior: MotionPosterior
    truth: np.ndarray | None = None
    held_out: np.ndarray | None = None
    generation: GenerationReference | None = None

    def __post_init__(self) -> None:
        shape = (self.posterior.frames, self.posterior.skeleton.n_joints, 3)
        if self.truth is not None:
            check_shape("truth", self.truth, shape)
            check_finite("truth", self.truth)
        if self.held_out is not None:
            check_shape("held_out", self.held_out, ("G", *shape))
            check_finite("held_out", self.held_out)

    @property
    def has_reference(self) -> bool:
        """Whether exact reference draws can be had."""
        prior = self.posterior.prior
        if not isinstance(prior, HasExactPosterior):
            return False
        try:
            prior.exact_posterior(self.posterior.likelihood)
        except NotConjugate:
            return False
        return True

    def reference(self, seed: int, n: int) -> np.ndarray:
        """Return n independent draws from the exact posterior, (n, L, J, 3), metres.

        Raises
        ------
        ValueError
            If the posterior has no closed form.
        """
        check_count("n", n)
        prior = self.posterior.prior
        if not isinstance(prior, HasExactPosterior):
            raise ValueError(
                f"problem {self.name} has no reference: {type(prior).__name__} has no exact "
                "posterior"
            )
        exact = prior.exact_posterior(self.posterior.likelihood)
        return exact.sample(seeds.generator(seed, "reference"), n)
