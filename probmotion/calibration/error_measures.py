"""How wrong a set of draws is, as signed numbers whose differences add up.

Each measure is one number of one set of draws, so that along a chain of samplers the differences
from one to the next add up to that from the first to the last, whatever the measure.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from probmotion import seeds
from probmotion.metrics.distribution import random_directions, sliced_wasserstein
from probmotion.metrics.structure import HasManifold
from probmotion.posteriors.problem import Problem

__all__ = ["MEASURES", "BiasMeasures", "require_exact"]

MEASURES: Mapping[str, str] = {
    "spread": "log total variance",
    "small": "log variance, small directions",
    "off": "log variance off the manifold",
    "mean": "squared error of the mean / total variance",
    "distance": "squared sliced distance / mean variance",
}
"""What is measured, in words."""

_SETS, _DIRECTIONS, _POOL = 8, 256, 4000
_LARGE = 0.95


class BiasMeasures:
    """What is measured of draws from a problem that is known exactly.

    - ``spread``: log of the trace of the covariance over the exact one; negative is over-confident
    - ``small``: mean over small principal directions of log(variance / exact variance): those of
      the exact covariance beyond the ones that hold 95 % of it
    - ``off``: log of the mean variance off the prior's manifold over exact draws', for a prior
      that knows one
    - ``mean``: squared distance of the mean from the exact one over the trace, less what chance
      alone makes of it: 0 in expectation for exact draws
    - ``distance``: squared sliced 2-Wasserstein distance to as many exact draws, over the mean
      variance of a projection. It has a floor, what exact draws have.

    Logarithms, because the steps of a sampler multiply variances; squares, because they add up
    where errors are of unlike kinds.

    Parameters
    ----------
    problem : Problem
        One with an exact posterior.

    Raises
    ------
    ValueError
        If it has none.
    """

    def __init__(self, problem: Problem) -> None:
        require_exact(problem)
        self.problem = problem
        # Of every budget of the problem alike: what is measured must not differ with its seeds.
        pool = problem.reference(seeds.integer(0, "bias measures"), _POOL)
        flat = pool.reshape(_POOL, -1)
        variances, axes = np.linalg.eigh(np.cov(flat, rowvar=False))
        self.total = float(variances.sum())
        held = np.cumsum(variances[::-1])[::-1]
        # From the largest down: a direction is small if the larger ones hold enough without it.
        self.small = axes[:, held - variances >= _LARGE * self.total]
        self.small_variances = np.var(flat @ self.small, axis=0, ddof=1)
        prior = problem.posterior.prior
        self.manifold = prior if isinstance(prior, HasManifold) else None
        self.off = None if self.manifold is None else float(self.manifold.off_manifold(pool).mean())

    def of(self, positions: np.ndarray, seed: int) -> dict[str, float]:
        """Return every measure of draws.

        Parameters
        ----------
        positions : ndarray, (n, L, J, 3)
            Metres.
        seed : int
            Of the exact draws and directions; the same for all samplers that are compared.
        """
        n = len(positions)
        flat = positions.reshape(n, -1)
        exact = self.problem.reference(seeds.integer(seed, "exact sets"), _SETS * n)
        exact = exact.reshape(_SETS * n, -1)
        spread = float(flat.var(axis=0, ddof=1).sum())
        chance = spread / n + float(exact.var(axis=0, ddof=1).sum()) / len(exact)
        apart = float(((flat.mean(axis=0) - exact.mean(axis=0)) ** 2).sum())
        found = {"spread": float(np.log(spread / self.total))}
        if self.small.shape[1]:
            ratios = np.var(flat @ self.small, axis=0, ddof=1) / self.small_variances
            found["small"] = float(np.log(ratios).mean())
        if self.manifold is not None and self.off is not None:
            off = float(self.manifold.off_manifold(positions).mean())
            found["off"] = float(np.log(off / self.off))
        found["mean"] = (apart - chance) / self.total
        directions = random_directions(
            seeds.generator(seed, "directions"), _DIRECTIONS, flat.shape[1]
        )
        squares = [
            float(sliced_wasserstein(flat, some, directions)) ** 2
            for some in np.split(exact, _SETS)
        ]
        found["distance"] = float(np.mean(squares)) * flat.shape[1] / self.total
        return found


def require_exact(problem: Problem) -> None:
    """Raise ``ValueError`` if a problem has no exact posterior."""
    if problem.exact is None:
        raise ValueError(
            f"problem is {problem.name!r}, which nobody knows exactly, expected one with an exact "
            "posterior: what is measured is how far samplers are from it"
        )
