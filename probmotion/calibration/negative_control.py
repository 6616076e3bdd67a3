"""`Overconfident`: a sampler that is known to be wrong, which a test of calibration must find."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.sampling import Interrupted, Sampler
from probmotion.validation import check_positive

__all__ = ["Overconfident"]

_CHANGED = ("positions", "theta", "log_density")


@dataclass(frozen=True)
class Overconfident:
    """Draws of another sampler, pulled towards their mean: a posterior that is too narrow.

    Parameters
    ----------
    sampler : Sampler
        What draws; it decides which posteriors can be drawn from.
    factor : float
        What is left of a draw's distance from the mean of all, between 0 and 1.

    Raises
    ------
    ValueError
        If ``factor`` is not between 0 and 1.
    """

    name: ClassVar[str] = "overconfident"
    requires: ClassVar[tuple[type, ...]] = ()

    sampler: Sampler
    factor: float = 0.5

    def __post_init__(self) -> None:
        check_positive("factor", self.factor)
        if self.factor >= 1:
            raise ValueError(f"factor must be a number between 0 and 1, got {self.factor!r}")

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
        """Return ``chains`` × ``draws`` draws that lie too close together.

        Raises
        ------
        UnsupportedPosterior
            If the other sampler cannot draw from the posterior.
        Interrupted
            On Ctrl-C, if the other sampler hands over what it had finished.
        """
        try:
            right = self.sampler.sample(
                posterior, draws=draws, chains=chains, seed=seed, initial=initial, progress=progress
            )
        except Interrupted as stop:
            raise Interrupted(self._pulled(posterior, stop.draws, seed)) from stop
        return self._pulled(posterior, right, seed)

    def _pulled(self, posterior: MotionPosterior, right: MotionDraws, seed: int) -> MotionDraws:
        positions = right.positions.values
        mean = positions.mean(axis=(0, 1))
        return MotionDraws.of(
            posterior,
            self,
            mean + self.factor * (positions - mean),
            seed=seed,
            seconds=right.seconds,
            statistics={
                str(name): values.values
                for name, values in right.dataset.data_vars.items()
                if values.dims[:1] == ("chain",) and name not in _CHANGED
            },
            counts=right.counts,
            independent=right.independent,
        )
