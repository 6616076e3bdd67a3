"""Negative control: a deliberately overconfident sampler that calibration must detect."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.sampling import Interrupted, Sampler
from probmotion.validation import check_positive

__all__ = ["Overconfident"]

_CHANGED = ("positions", "theta", "log_density")  # variables that are not copied


@dataclass(frozen=True)
class Overconfident:
    """Sampler that shrinks the draws of another sampler towards their mean.

    Parameters
    ----------
    sampler : Sampler
        Sampler whose draws are shrunk.
    factor : float
        Factor of deviations from the mean, greater than 0 and less than 1.
    """

    name: ClassVar[str] = "overconfident"
    requires: ClassVar[tuple[type, ...]] = ()

    sampler: Sampler
    factor: float = 0.5

    def __post_init__(self) -> None:
        check_positive("factor", self.factor)
        if self.factor >= 1:
            raise ValueError(f"factor must be between 0 and 1, got {self.factor!r}")

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
        """Return ``chains`` × ``draws`` overconfident draws; raise the errors of ``sampler``."""
        try:
            drawn = self.sampler.sample(
                posterior, draws=draws, chains=chains, seed=seed, initial=initial, progress=progress
            )
        except Interrupted as stop:
            raise Interrupted(self._shrunk(posterior, stop.draws, seed)) from stop
        return self._shrunk(posterior, drawn, seed)

    def _shrunk(self, posterior: MotionPosterior, drawn: MotionDraws, seed: int) -> MotionDraws:
        positions = drawn.positions.values
        mean = positions.mean(axis=(0, 1))
        return MotionDraws.of(
            posterior,
            self,
            mean + self.factor * (positions - mean),
            seed=seed,
            seconds=drawn.seconds,
            statistics={
                str(name): values.values
                for name, values in drawn.dataset.data_vars.items()
                if values.dims[:1] == ("chain",) and name not in _CHANGED
            },
            counts=drawn.counts,
            independent=drawn.independent,
        )
