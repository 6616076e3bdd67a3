"""Posterior with a density truncated relative to its value at a seed (eq. 11)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from probmotion.arrays import Array
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.validation import check_finite, check_shape

__all__ = ["TruncatedPosterior", "limit_for_dimension"]

_NEAR = 1.0  # distance to the floor, nats, below which a draw is flagged


@dataclass(frozen=True, eq=False)
class TruncatedPosterior(MotionPosterior):
    """Posterior with density 0 where f < f₀/c, c f₀ where f > c f₀, and f elsewhere (eq. 11).

    f is the density relative to the prior's ``log_measure``, if any, and f₀ = f(seed). The
    likelihood is not evaluated where its upper bound cannot raise f above f₀/c.

    Parameters
    ----------
    prior, likelihood
        As in :class:`~probmotion.MotionPosterior`.
    seed : ndarray, (dim,), optional
        θ at which f₀ is evaluated; 0 by default.
    limit : float
        Truncation ratio c, above 1; infinity disables the truncation.
    """

    seed: np.ndarray | None = None
    limit: float = math.inf
    log_seed: float = field(init=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (isinstance(self.limit, int | float) and self.limit > 1):
            raise ValueError(f"limit must be above 1, got {self.limit!r}")
        theta = np.zeros(self.dim) if self.seed is None else np.asarray(self.seed, np.float64)
        check_shape("seed", theta, (self.dim,))
        check_finite("seed", theta)
        object.__setattr__(self, "log_seed", math.nan)
        untruncated = MotionPosterior(self.prior, self.likelihood)
        log_density = float(untruncated.log_density(theta[None])[0])
        if not math.isfinite(log_density):
            raise ValueError(f"seed must have positive density, got log density {log_density}")
        log_seed = log_density - float(self._log_measure_of_prior(theta[None])[0])
        object.__setattr__(self, "log_seed", log_seed)

    @property
    def truncated(self) -> bool:
        """Whether ``limit`` is finite."""
        return math.isfinite(self.limit)

    @property
    def log_floor(self) -> float:
        """Lower truncation level log f₀/c."""
        return self.log_seed - math.log(self.limit)

    @property
    def log_cap(self) -> float:
        """Upper truncation level log c f₀."""
        return self.log_seed + math.log(self.limit)

    def draw_statistics(self, theta: np.ndarray, log_density: np.ndarray) -> dict[str, np.ndarray]:
        """Return flags (0 or 1) of draws at the cap and of draws within 1 nat of the floor."""
        with np.errstate(invalid="ignore"):
            level = log_density - self._log_measure(theta)
        return {
            "at_cap": (level > self.log_cap - 1e-9).astype(np.int8),
            "near_floor": (level < self.log_floor + _NEAR).astype(np.int8),
        }

    def _log_measure(self, theta: Array) -> np.ndarray:
        # Only bounds depend on it.
        return self._log_measure_of_prior(theta) if self.truncated else super()._log_measure(theta)

    def _log_measure_of_prior(self, theta: Array) -> np.ndarray:
        measure = getattr(self.prior, "log_measure", None)
        return super()._log_measure(theta) if measure is None else measure(theta)

    def _needs_likelihood(self, log_prior: np.ndarray, log_measure: np.ndarray) -> np.ndarray:
        bound = getattr(self.likelihood, "log_bound", math.inf)
        with np.errstate(invalid="ignore"):
            largest = log_prior - log_measure + bound
        return (log_prior > -np.inf) & (largest >= self.log_floor)

    def _shaped(self, log_density: np.ndarray, log_measure: np.ndarray) -> np.ndarray:
        with np.errstate(invalid="ignore"):
            level = log_density - log_measure
        level = np.where(level >= self.log_floor, np.minimum(level, self.log_cap), -np.inf)
        return level + np.where(np.isfinite(level), log_measure, 0.0)


def limit_for_dimension(dim: int) -> float:
    """Return a limit c that includes the typical set of a Gaussian in ``dim`` dimensions.

    On average, log f is dim/2 nats below its mode, with standard deviation √(dim/2); log c is this
    mean difference plus three standard deviations.
    """
    return math.exp(0.5 * dim + 3 * math.sqrt(0.5 * dim))
