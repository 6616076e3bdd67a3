"""`TruncatedPosterior`: a density that is cut off far below its seed and level far above it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from probmotion.arrays import Array
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.validation import check_finite, check_shape

__all__ = ["TruncatedPosterior", "limit_for_dimension"]

# A draw this near the floor, nats, clings to it.
_NEAR = 1.0


@dataclass(frozen=True, eq=False)
class TruncatedPosterior(MotionPosterior):
    """f* = 0 where f < f₀/c, c f₀ where f > c f₀, else f; f₀ is the seed's (eq. 11).

    f is relative to the prior's ``log_measure``, where it has one: what is cut is plausibility,
    not the volume that a point stands for. A point whose prior is so low that no evidence can lift
    it above the floor is not compared with the evidence.

    Parameters
    ----------
    prior, likelihood
        As in :class:`~probmotion.MotionPosterior`.
    seed : ndarray, (dim,), optional
        θ of f₀; 0 by default.
    limit : float
        c, above 1; infinity leaves the density as it is.

    Raises
    ------
    ValueError
        If ``limit`` is not above 1, or the seed has density 0.
    """

    seed: np.ndarray | None = None
    limit: float = math.inf
    log_seed: float = field(init=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (isinstance(self.limit, int | float) and self.limit > 1):
            raise ValueError(f"limit must be c above 1, or infinity, got {self.limit!r}")
        theta = np.zeros(self.dim) if self.seed is None else np.asarray(self.seed, np.float64)
        check_shape("seed", theta, (self.dim,))
        check_finite("seed", theta)
        object.__setattr__(self, "log_seed", math.nan)
        whole = MotionPosterior(self.prior, self.likelihood)
        log_density = float(whole.log_density(theta[None])[0])
        if not math.isfinite(log_density):
            raise ValueError(f"seed has log density {log_density}, expected one of density above 0")
        log_seed = log_density - float(self._log_measure(theta[None])[0])
        object.__setattr__(self, "log_seed", log_seed)

    @property
    def reshaped(self) -> bool:
        """Whether the density is cut."""
        return math.isfinite(self.limit)

    @property
    def log_floor(self) -> float:
        """log f₀/c."""
        return self.log_seed - math.log(self.limit)

    @property
    def log_cap(self) -> float:
        """log c f₀."""
        return self.log_seed + math.log(self.limit)

    def evaluate(
        self, theta: np.ndarray, generators: Sequence[np.random.Generator] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the log density and the closest annotations; see the base class.

        Raises
        ------
        ValueError
            With generators where the density is cut: a truncated estimate is not unbiased.
        """
        if generators is not None and math.isfinite(self.limit):
            raise ValueError(
                f"limit is {self.limit:g}, expected infinity where views are drawn anew: the "
                "truncation of an unbiased estimate is biased"
            )
        return super().evaluate(theta, generators)

    def draw_statistics(self, theta: np.ndarray, log_density: np.ndarray) -> dict[str, np.ndarray]:
        """Return which draws are at the cap, and which within 1 nat of the floor, as 1 and 0.

        Parameters
        ----------
        theta : ndarray, (…, dim)
            Draws.
        log_density : ndarray, (…)
            Their log density.
        """
        with np.errstate(invalid="ignore"):
            level = log_density - self._log_measure(theta)
        return {
            "at_cap": (level > self.log_cap - 1e-9).astype(np.int8),
            "near_floor": (level < self.log_floor + _NEAR).astype(np.int8),
        }

    def _log_measure(self, theta: Array) -> np.ndarray:
        measure = getattr(self.prior, "log_measure", None)
        return super()._log_measure(theta) if measure is None else measure(theta)

    def _worth_asking(self, log_prior: np.ndarray, log_measure: np.ndarray) -> np.ndarray:
        bound = getattr(self.likelihood, "log_bound", math.inf)
        with np.errstate(invalid="ignore"):
            most = log_prior - log_measure + bound
        return (log_prior > -np.inf) & (most >= self.log_floor)

    def _shaped(self, log_density: np.ndarray, log_measure: np.ndarray) -> np.ndarray:
        with np.errstate(invalid="ignore"):
            level = log_density - log_measure
        level = np.where(level >= self.log_floor, np.minimum(level, self.log_cap), -np.inf)
        return level + np.where(np.isfinite(level), log_measure, 0.0)


def limit_for_dimension(dim: int) -> float:
    """Return a c that does not cut the typical set off: that of a Gaussian in ``dim`` dimensions.

    There log f lies dim/2 nats below the mode on average, with a standard deviation of √(dim/2);
    c leaves three of them.
    """
    return math.exp(0.5 * dim + 3 * math.sqrt(0.5 * dim))
