"""Independent draws from posteriors in closed form."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import (
    ExactPosterior,
    HasExactPosterior,
    NotConjugate,
    Samplable,
)
from probmotion.posteriors.sampling import UnsupportedPosterior, require, suited
from probmotion.samplers.independent import draw_independently, refuse_initial
from probmotion.seeds import NormalStreams

__all__ = ["ExactSampler"]


@dataclass(frozen=True)
class ExactSampler:
    """Independent draws from a posterior in closed form, or from the prior without observations.

    Each draw has its own random stream and does not depend on the number of draws or chains.
    """

    name: ClassVar[str] = "exact"
    requires: ClassVar[tuple[Any, ...]] = (HasExactPosterior | Samplable,)

    def sample(
        self,
        posterior: MotionPosterior,
        *,
        draws: int = 1000,
        chains: int = 1,
        seed: int = 0,
        initial: MotionDraws | np.ndarray | None = None,
        progress: bool = True,
    ) -> MotionDraws:
        """Return ``chains`` × ``draws`` independent draws.

        Raises
        ------
        UnsupportedPosterior
            If the posterior has no closed form.
        Interrupted
            On Ctrl-C, with the finished draws.
        """
        exact = self._source(posterior)
        refuse_initial(self, initial)

        def draw_batch(streams: NormalStreams, tick: Callable[[], Any]) -> np.ndarray:
            tick()
            return np.concatenate([exact.sample(rng, 1) for rng in streams.generators])

        return draw_independently(
            self,
            posterior,
            draw_batch,
            draws=draws,
            chains=chains,
            seed=seed,
            batch=chains,
            steps=1,
            scale=1.0,
            counts={},
            progress=progress,
        )

    @staticmethod
    def draws_from(posterior: MotionPosterior) -> bool:
        """Return whether the posterior has a closed form."""
        if posterior.truncated:
            return False
        if isinstance(posterior.prior, HasExactPosterior):
            try:
                posterior.prior.exact_posterior(posterior.likelihood)
            except NotConjugate:
                return False
            return True
        return posterior.likelihood is None and isinstance(posterior.prior, Samplable)

    def _source(self, posterior: MotionPosterior) -> ExactPosterior | Samplable:
        require(self, posterior)
        prior = posterior.prior
        if posterior.truncated:
            raise self._unsupported(
                posterior, "truncated", "cannot draw from a posterior with a truncated density"
            )
        if not isinstance(prior, HasExactPosterior):
            if posterior.likelihood is None and isinstance(prior, Samplable):
                return prior
            raise self._unsupported(
                posterior,
                "HasExactPosterior",
                "needs a prior with HasExactPosterior to condition on observations, got "
                f"{type(prior).__name__}",
            )
        try:
            return prior.exact_posterior(posterior.likelihood)
        except NotConjugate as error:
            raise self._unsupported(
                posterior, "not-conjugate", f"needs a posterior in closed form, but {error}"
            ) from error

    def _unsupported(
        self, posterior: MotionPosterior, word: str, reason: str
    ) -> UnsupportedPosterior:
        return UnsupportedPosterior(self.name, reason, word=word, others=suited(posterior))
