"""Signed error measures of draws; their differences between consecutive samplers add up."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from probmotion import seeds
from probmotion.metrics.distribution import random_directions, sliced_wasserstein
from probmotion.posteriors.problem import Problem
from probmotion.posteriors.protocols import HasManifold

__all__ = ["MEASURES", "ErrorMeasures", "require_exact"]

# Descriptions of the measures, by name.
MEASURES: Mapping[str, str] = {
    "spread": "log total variance",
    "small": "log variance, small directions",
    "off": "log variance off the manifold",
    "mean": "squared error of the mean / total variance",
    "distance": "squared sliced distance / mean variance",
}

_SETS, _DIRECTIONS, _POOL = 8, 256, 4000  # exact sets, projections, exact draws in the pool
_LARGE = 0.95  # fraction of the exact variance in the large principal directions


class ErrorMeasures:
    """Error measures of draws from a problem with an exact posterior.

    - ``spread``: log(trace of the covariance / exact trace); negative: overconfident
    - ``small``: mean log(variance / exact variance) over the small principal directions, i.e. all
      but the largest, which account for 95 % of the exact variance
    - ``off``: log(mean variance off the manifold / exact value), if the prior has a manifold
    - ``mean``: (squared error of the mean − its sampling variance) / exact trace
    - ``distance``: squared sliced 2-Wasserstein distance to exact draws, divided by the mean exact
      variance of a projection; positive even for exact draws

    Raises ``ValueError`` if the problem has no exact posterior.
    """

    def __init__(self, problem: Problem) -> None:
        require_exact(problem)
        self.problem = problem
        # Use the same pool for every decomposition of the problem.
        pool = problem.reference(seeds.integer(0, "bias measures"), _POOL)
        flat = pool.reshape(_POOL, -1)
        variances, axes = np.linalg.eigh(np.cov(flat, rowvar=False))
        self.total = float(variances.sum())
        tails = np.cumsum(variances[::-1])[::-1]
        # A direction is small if the larger ones account for 95 % of the variance.
        self.small = axes[:, tails - variances >= _LARGE * self.total]
        self.small_variances = np.var(flat @ self.small, axis=0, ddof=1)
        prior = problem.posterior.prior
        self.manifold = prior if isinstance(prior, HasManifold) else None
        self.off = None if self.manifold is None else float(self.manifold.off_manifold(pool).mean())

    def of(self, positions: np.ndarray, seed: int) -> dict[str, float]:
        """Return every measure of draws, (n, L, J, 3), metres.

        ``seed`` determines the exact draws and projections, which all samplers share.
        """
        n = len(positions)
        flat = positions.reshape(n, -1)
        exact = self.problem.reference(seeds.integer(seed, "exact sets"), _SETS * n)
        exact = exact.reshape(_SETS * n, -1)
        spread = float(flat.var(axis=0, ddof=1).sum())
        expected = spread / n + float(exact.var(axis=0, ddof=1).sum()) / len(exact)
        squared = float(((flat.mean(axis=0) - exact.mean(axis=0)) ** 2).sum())
        values = {"spread": float(np.log(spread / self.total))}
        if self.small.shape[1]:
            ratios = np.var(flat @ self.small, axis=0, ddof=1) / self.small_variances
            values["small"] = float(np.log(ratios).mean())
        if self.manifold is not None and self.off is not None:
            off = float(self.manifold.off_manifold(positions).mean())
            values["off"] = float(np.log(off / self.off))
        values["mean"] = (squared - expected) / self.total
        rng = seeds.generator(seed, "directions")
        directions = random_directions(rng, _DIRECTIONS, flat.shape[1])
        distances = [float(sliced_wasserstein(flat, x, directions)) for x in np.split(exact, _SETS)]
        squares = [distance**2 for distance in distances]
        values["distance"] = float(np.mean(squares)) * flat.shape[1] / self.total
        return values


def require_exact(problem: Problem) -> None:
    """Raise ``ValueError`` if a problem has no exact posterior."""
    if problem.exact is None:
        raise ValueError(f"problem must have an exact posterior, got {problem.name!r}")
