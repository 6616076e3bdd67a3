"""A posterior as a prior of its own, with exact denoisers: what guidance tries to be."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from probmotion.models.mixture.conditioned_mixture import ConditionedMixture
from probmotion.models.mixture.gaussian_mixture import GaussianMixtureMotion
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import Likelihood, MotionPrior

__all__ = ["Conditions", "conditioned"]


@runtime_checkable
class Conditions(Protocol):
    """A prior that can be had given evidence, with the denoisers that it then has."""

    def given(self, likelihood: Likelihood) -> MotionPrior:
        """Return the prior of motions given the evidence."""


def conditioned(posterior: MotionPosterior) -> MotionPosterior:
    """Return the same distribution with the evidence inside the prior; itself without evidence.

    The denoisers of the prior that is returned are given the evidence.

    Raises
    ------
    ValueError
        If there is evidence, and the prior is neither a Gaussian mixture nor has ``given``.
    NotConjugate
        If a Gaussian mixture's evidence is not linear in the positions with Gaussian noise.
    """
    prior, likelihood = posterior.prior, posterior.likelihood
    if likelihood is None:
        return posterior
    if isinstance(prior, Conditions):
        return MotionPosterior(prior.given(likelihood))
    if isinstance(prior, GaussianMixtureMotion):
        return MotionPosterior(ConditionedMixture(prior, likelihood))
    raise ValueError(
        f"posterior has the prior {type(prior).__name__}, whose denoisers given evidence nobody "
        "knows, expected GaussianMixtureMotion or one with given(likelihood)"
    )
