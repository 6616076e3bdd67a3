"""Exact sampling from posteriors with a closed form."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import (
    ExactPosterior,
    HasExactPosterior,
    NotConjugate,
    Samplable,
)
from probmotion.posteriors.sampling import UnsupportedPosterior, suited
from probmotion.samplers.independent import Batches, IndependentSampler
from probmotion.seeds import NormalStreams

__all__ = ["ExactSampler"]


@dataclass(frozen=True)
class ExactSampler(IndependentSampler):
    """Exact sampler of closed-form posteriors, or of the prior without observations."""

    name: ClassVar[str] = "exact"
    requires: ClassVar[tuple[Any, ...]] = (HasExactPosterior | Samplable,)

    @staticmethod
    def draws_from(posterior: MotionPosterior) -> bool:
        """Return whether the posterior can be sampled exactly."""
        return _closed_form(posterior)[0] is not None

    def _batches(self, posterior: MotionPosterior, seed: int, progress: bool) -> Batches:
        exact, reason, word = _closed_form(posterior)
        if exact is None:
            raise UnsupportedPosterior(self.name, reason, word=word, others=suited(posterior))

        def draw(streams: NormalStreams, tick: Callable[[], Any]) -> np.ndarray:
            tick()
            return exact.sample(streams.generators[0], 1)

        return Batches(draw, size=1)


def _closed_form(posterior: MotionPosterior) -> tuple[ExactPosterior | Samplable | None, str, str]:
    """Return the closed-form posterior, or ``None`` with the reason and a failure code."""
    prior = posterior.prior
    if posterior.truncated:
        return None, "cannot draw from a posterior with a truncated density", "truncated"
    if isinstance(prior, HasExactPosterior):
        try:
            return prior.exact_posterior(posterior.likelihood), "", ""
        except NotConjugate as error:
            return None, f"requires a posterior in closed form, but {error}", "not-conjugate"
    if posterior.likelihood is None and isinstance(prior, Samplable):
        return prior, "", ""
    reason = "requires a prior that implements HasExactPosterior for observations, got"
    return None, f"{reason} {type(prior).__name__}", "HasExactPosterior"
