"""`ExactSampler`: independent draws from a posterior that is known exactly."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from probmotion import seeds
from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import (
    ExactPosterior,
    HasExactPosterior,
    NotConjugate,
    Samplable,
)
from probmotion.posteriors.sampling import (
    Interrupted,
    UnsupportedPosterior,
    progress_bar,
    require,
    suited,
)
from probmotion.validation import check_count

__all__ = ["ExactSampler"]


@dataclass(frozen=True)
class ExactSampler:
    """Independent draws from the posterior that the prior knows in closed form.

    Without evidence the posterior is the prior, and any that can be drawn from will do.

    Draw i of chain k comes from its own random numbers, so that it is the same however many draws
    and chains there are.
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
            If the posterior has no closed form, and is not the prior.
        Interrupted
            On Ctrl-C; it carries the draws that were finished.
        """
        exact = self._source(posterior)
        check_count("draws", draws)
        check_count("chains", chains)
        if initial is not None:
            raise ValueError(
                f"initial is {type(initial).__name__}, expected None: exact draws start nowhere"
            )
        start = time.perf_counter()
        finished: list[np.ndarray] = []

        def result() -> MotionDraws:
            return MotionDraws.of(
                posterior,
                self,
                np.stack(finished, axis=1),
                seed=seed,
                seconds=time.perf_counter() - start,
                independent=True,
            )

        try:
            with progress_bar(draws, self.name, progress) as bar:
                for draw in range(draws):
                    streams = [seeds.generator(seed, "draw", k, draw) for k in range(chains)]
                    finished.append(np.concatenate([exact.sample(rng, 1) for rng in streams]))
                    bar.update(1)
        except KeyboardInterrupt as stop:
            if not finished:
                raise
            raise Interrupted(result()) from stop
        return result()

    @staticmethod
    def draws_from(posterior: MotionPosterior) -> bool:
        """Return whether it can."""
        if posterior.reshaped:
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
        if posterior.reshaped:
            raise UnsupportedPosterior(
                self.name,
                "draws from prior and evidence, and the posterior's density is cut",
                word="truncated",
                others=suited(posterior),
            )
        if not isinstance(prior, HasExactPosterior):
            if posterior.likelihood is None and isinstance(prior, Samplable):
                return prior
            raise UnsupportedPosterior(
                self.name,
                "needs a prior with HasExactPosterior where there is evidence, which "
                f"{type(prior).__name__} is not",
                word="HasExactPosterior",
                others=suited(posterior),
            )
        try:
            return prior.exact_posterior(posterior.likelihood)
        except NotConjugate as error:
            raise UnsupportedPosterior(
                self.name,
                f"needs a posterior in closed form, but {error}",
                word="not-conjugate",
                others=suited(posterior),
            ) from error
