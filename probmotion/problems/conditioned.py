"""Priors conditioned on observations, whose exact denoisers are a reference for guidance."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from probmotion.models.mixture.conditioned_mixture import ConditionedMixture
from probmotion.models.mixture.gaussian_mixture import GaussianMixtureMotion
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import Likelihood, MotionPrior

__all__ = ["Conditionable", "conditioned"]


@runtime_checkable
class Conditionable(Protocol):
    """A prior that can be conditioned on observations."""

    def given(self, likelihood: Likelihood) -> MotionPrior:
        """Return the conditioned prior."""


def conditioned(posterior: MotionPosterior) -> MotionPosterior:
    """Return the posterior as a prior conditioned on the observations, without likelihood.

    Raises ``ValueError`` if there are observations, but the prior is not a Gaussian mixture and
    has no ``given``. Raises ``NotConjugate`` if a mixture's observations are not linear in the
    positions with Gaussian noise.
    """
    prior, likelihood = posterior.prior, posterior.likelihood
    if likelihood is None:
        return posterior
    if isinstance(prior, Conditionable):
        return MotionPosterior(prior.given(likelihood))
    if isinstance(prior, GaussianMixtureMotion):
        return MotionPosterior(ConditionedMixture(prior, likelihood))
    raise ValueError(
        "prior must be GaussianMixtureMotion or have given(likelihood) for exact conditional "
        f"denoisers, got {type(prior).__name__}"
    )
