"""Sampler that wraps a user-supplied function of the log density."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from probmotion import seeds
from probmotion.arrays import Array, to_numpy
from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import HasLogDensity
from probmotion.posteriors.sampling import require
from probmotion.samplers.densities import motions
from probmotion.validation import check_count, check_finite, check_shape

__all__ = ["FunctionSampler", "SamplingFunction", "TargetDensity"]

_MIN_CANDIDATES, _BATCH_SIZE = 1000, 256


class TargetDensity:
    """Log density of a posterior, as passed to a :class:`FunctionSampler`.

    Call it with θ, ``(…, dim) → (…)``, in NumPy, torch or JAX. ``evaluations`` counts points
    evaluated in NumPy.
    """

    def __init__(self, posterior: MotionPosterior) -> None:
        self._posterior = posterior
        self.evaluations = 0

    def __call__(self, theta: Array) -> Array:
        """Return log p(θ) + log p(y | θ), unnormalised: ``(…, dim) → (…)``."""
        if isinstance(theta, np.ndarray):
            self.evaluations += theta[..., 0].size
        return self._posterior.log_density(theta)

    def initial(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Return n starting points, (n, dim): prior draws resampled by their likelihood."""
        if self._posterior.likelihood is None:
            return self._posterior.initial(rng, n)
        drawn = self._posterior.initial(rng, max(_MIN_CANDIDATES, 10 * n))
        log_likelihood = np.concatenate(
            [
                to_numpy(self._posterior.log_likelihood(drawn[start : start + _BATCH_SIZE]))
                for start in range(0, len(drawn), _BATCH_SIZE)
            ]
        )
        # Gumbel top-n: n choices without replacement, with probability ∝ likelihood.
        keys = log_likelihood + rng.gumbel(size=len(drawn))
        return drawn[np.argsort(-keys, kind="stable")[:n]]


SamplingFunction = Callable[[TargetDensity, int, np.random.Generator, int], Any]
"""(log_density, dim, rng, draws) → θ, (draws, dim): one chain."""


@dataclass(frozen=True)
class FunctionSampler:
    """A sampler that is a function ``(log_density, dim, rng, draws) → θ``.

    Parameters
    ----------
    function : callable
        Returns θ, (draws, dim), of one chain, given the log density (:class:`TargetDensity`), the
        length of θ, a NumPy generator and the number of draws.
    name : str
        Name in tables; by default that of the function.
    independent : bool
        Whether draws are independent by construction, so that R-hat does not apply.
    """

    requires: ClassVar[tuple[type, ...]] = (HasLogDensity,)

    function: SamplingFunction
    name: str = ""
    independent: bool = False

    def __post_init__(self) -> None:
        if not callable(self.function):
            raise ValueError(f"function must be callable, got {type(self.function).__name__}")
        if not self.name:
            object.__setattr__(self, "name", getattr(self.function, "__name__", "function"))

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
        """Return the draws of ``chains`` calls of the function, each with its own generator.

        Raises
        ------
        ValueError
            If the function returns an array of another shape or values that are not finite.
        """
        check_count("draws", draws)
        check_count("chains", chains)
        require(self, posterior)
        if initial is not None:
            raise ValueError(f"initial must be None, got {type(initial).__name__}")
        start = time.perf_counter()
        density = TargetDensity(posterior)
        theta = np.empty((chains, draws, posterior.dim))
        for chain in range(chains):
            rng = seeds.generator(seed, "function", chain)
            returned = to_numpy(self.function(density, posterior.dim, rng, draws))
            check_shape(f"theta of {self.name}", returned, (draws, posterior.dim))
            check_finite(f"theta of {self.name}", returned)
            theta[chain] = returned
        seconds = time.perf_counter() - start
        counts = {"density": density.evaluations} if density.evaluations else {}
        return MotionDraws.of(
            posterior,
            self,
            motions(posterior, theta, seed, first=0),
            seed=seed,
            seconds=seconds,
            theta=theta,
            log_density=to_numpy(posterior.log_density(theta)),
            counts=counts,
            independent=self.independent,
        )
