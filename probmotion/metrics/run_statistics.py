"""Statistics of a run against reference draws, from which a verdict is computed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property, lru_cache
from hashlib import blake2b
from typing import Any

import numpy as np

from probmotion import seeds
from probmotion.interaction.geometry.coordinates import align_motions
from probmotion.metrics import distribution
from probmotion.metrics.chains import rhat_of_independent
from probmotion.metrics.two_sample import (
    accuracy_sd,
    classifier_two_sample,
    principal_components,
)
from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.problem import Problem
from probmotion.posteriors.protocols import HasManifold, HasStyles

__all__ = [
    "MIN_CLASSIFIED",
    "N_SETS",
    "DrawStatistics",
    "Features",
    "draw_statistics",
    "reference_draws",
]

MIN_CLASSIFIED = 100
"""Minimum number of draws for the classifier."""
N_SETS = 8
"""Number of sets of reference draws for the distance."""

_N_REFERENCES = 4000
_DIRECTION_FRACTION = 0.75  # of the reference draws
_N_LEADING = 8
_N_PROJECTIONS = 128
_MAX_CLASSIFIED = 400


@dataclass(frozen=True, eq=False)
class Features:
    """Features of draws of a problem, each computed once.

    Parameters
    ----------
    problem : Problem
        Problem that was sampled.
    positions : ndarray, (n, L, J, 3)
        The draws, metres.
    """

    problem: Problem
    positions: np.ndarray

    @cached_property
    def flat(self) -> np.ndarray:
        """Motions flattened, (n, L J 3), and aligned if the problem requires it."""
        motions = self.positions
        if self.problem.aligned_to is not None:
            motions = align_motions(motions, self.problem.aligned_to)
        return motions.reshape(len(motions), -1)

    @cached_property
    def off_manifold(self) -> np.ndarray | None:
        """Variance off the prior's manifold, (n,), if there is one."""
        prior = self.problem.posterior.prior
        if not isinstance(prior, HasManifold):
            return None
        return np.asarray(prior.off_manifold(self.positions))

    @cached_property
    def proportions(self) -> np.ndarray | None:
        """Probability of each style, (n, K), if there are any."""
        prior = self.problem.posterior.prior
        if not isinstance(prior, HasStyles):
            return None
        return np.asarray(prior.style_responsibilities(self.positions))


def reference_draws(problem: Problem, seed: int, at_least: int = 0) -> Features:
    """Return 4000 reference draws, or ``at_least`` if that is more; fewer if fewer are stored."""
    n, most = max(_N_REFERENCES, at_least), problem.max_references
    return _drawn(problem, seed, n if most is None else min(n, most))


@lru_cache(maxsize=2)
def _drawn(problem: Problem, seed: int, n: int) -> Features:
    return Features(problem, problem.reference(seed, n))


@dataclass(frozen=True)
class DrawStatistics:
    """Statistics of one run against reference draws; JSON values, so that runs can be pooled.

    Parameters
    ----------
    digest : str
        Checksum of the draws: equal runs count once.
    n, m : float
        Effective number of draws; number of reference draws.
    mean : list of float, (k,)
        Error of the mean in the leading principal directions of the reference, posterior sd.
    spread : list of list of float, (k, k)
        Covariance of draws in these directions, plus n/m times that of the reference.
    ratios : dict
        Logarithm of each ratio, and n times the variance of the logarithm.
    modes : dict
        Proportion of each style among the draws and among the reference draws.
    modes_spread : list of list of float
        n times the covariance of the difference of proportions.
    classifier : list of float
        Accuracy of the classifier two-sample test and its standard deviation; may be empty.
    distance : list of float
        ``swd_ratio`` and its z-score among reference sets; may be empty.
    rhat : float or None
        R-hat of chains; None for independent draws.
    rhat_by_chance : float
        95 % quantile of R-hat for converged chains; 0 for independent draws.
    """

    digest: str
    n: float
    m: float
    mean: list[float]
    spread: list[list[float]]
    ratios: dict[str, list[float]]
    modes: dict[str, list[float]]
    modes_spread: list[list[float]]
    classifier: list[float]
    distance: list[float]
    rhat: float | None
    rhat_by_chance: float

    def to_json(self) -> dict[str, Any]:
        """Return the fields as JSON values, the arguments of :class:`DrawStatistics`."""
        return asdict(self)


def draw_statistics(
    problem: Problem, draws: MotionDraws, seed: int, metrics: Mapping[str, float]
) -> DrawStatistics:
    """Return the statistics of a run that a verdict needs.

    Parameters
    ----------
    problem : Problem
        Problem that was sampled, with reference draws.
    draws : MotionDraws
        The run, at least two draws.
    seed : int
        Seed of reference draws, shared by all samplers.
    metrics : mapping of str to float
        Metrics of the draws with the same seed, at least
        :func:`~probmotion.metrics.chains.chain_diagnostics`; ``c2st`` saves its computation.
    """
    reference = _reference(problem, seed)
    exact = reference.draws
    own = Features(problem, draws.flat())
    flat = own.flat
    total = len(flat)
    n = min(total, metrics.get("ess_bulk", total))
    m = len(exact.flat)
    leading = (flat @ reference.directions.T - reference.mean) / reference.sd
    spread = np.atleast_2d(np.cov(leading.T)) + n / m * reference.correlation
    ratios = {}
    for name, values in _positive(own, leading).items():
        against = reference.positive[name]
        # Equal draws have no variance, or that of rounding.
        values = np.maximum(values, np.finfo(float).eps ** 2 * against.mean())
        ratios[name] = [
            math.log(values.mean() / against.mean()),
            _relative_variance(values) + n / len(against) * _relative_variance(against),
        ]
    modes, modes_spread = {}, []
    if own.proportions is not None and exact.proportions is not None:
        prior = problem.posterior.prior
        assert isinstance(prior, HasStyles)
        means = own.proportions.mean(axis=0), exact.proportions.mean(axis=0)
        named = zip(prior.styles, *means, strict=True)
        modes = {str(name): [float(a), float(b)] for name, a, b in named}
        covariance = np.cov(own.proportions.T) + n / m * np.cov(exact.proportions.T)
        modes_spread = np.atleast_2d(covariance).tolist()
    size = min(int(n), m, _MAX_CLASSIFIED)
    rows = np.arange(size) * total // size
    classifier = []
    if size >= MIN_CLASSIFIED:
        accuracy = metrics.get("c2st") if size == total else None
        if accuracy is None:
            accuracy = classifier_two_sample(flat[rows], exact.flat[:size], seed)
        classifier = [accuracy, accuracy_sd(size)]
    rhat, sizes = metrics.get("rhat"), draws.dataset.sizes
    return DrawStatistics(
        digest=blake2b(np.ascontiguousarray(own.positions).tobytes(), digest_size=8).hexdigest(),
        n=float(n),
        m=float(m),
        mean=leading.mean(axis=0).tolist(),
        spread=spread.tolist(),
        ratios=ratios,
        modes=modes,
        modes_spread=modes_spread,
        classifier=classifier,
        distance=_distance(problem, flat[rows], seed),
        rhat=rhat,
        rhat_by_chance=0.0 if rhat is None else rhat_of_independent(sizes["chain"], sizes["draw"]),
    )


@dataclass(frozen=True, eq=False)
class _Reference:
    """Reference draws in their principal directions.

    Variance along the directions comes from held-out draws, since that of the draws from which
    directions are estimated is too large.
    """

    draws: Features
    directions: np.ndarray
    mean: np.ndarray
    sd: np.ndarray
    correlation: np.ndarray
    positive: dict[str, np.ndarray]


@lru_cache(maxsize=4)
def _reference(problem: Problem, seed: int) -> _Reference:
    draws = reference_draws(problem, seed)
    flat = draws.flat
    chosen, held_out = np.split(flat, [int(_DIRECTION_FRACTION * len(flat))])
    _, directions = principal_components(chosen, min(_N_LEADING, *chosen.shape))
    projected = held_out @ directions.T
    mean, sd = projected.mean(axis=0), projected.std(axis=0, ddof=1)
    return _Reference(
        draws=draws,
        directions=directions,
        mean=(flat @ directions.T).mean(axis=0),
        sd=sd,
        correlation=np.atleast_2d(np.corrcoef(projected.T)),
        positive=_positive(draws, (projected - mean) / sd),
    )


def _positive(features: Features, leading: np.ndarray) -> dict[str, np.ndarray]:
    """Return positive values per draw, (n,), whose means are compared as ratios."""
    apart = (leading - leading.mean(axis=0)) ** 2
    level = apart.mean(axis=0)
    # The mean is the geometric mean of the variances; deviations are those of their logarithm.
    geometric = math.exp(np.log(level).mean())
    flat = features.flat
    values = {
        "variance": _unbiased(((flat - flat.mean(axis=0)) ** 2).sum(axis=1)),
        "leading variance": _unbiased(geometric * (apart / level).mean(axis=1)),
    }
    if features.off_manifold is not None:
        values["off-manifold"] = features.off_manifold
    return values


def _unbiased(squares: np.ndarray) -> np.ndarray:
    """Return squared deviations from the mean of n draws, times n/(n − 1)."""
    return squares * len(squares) / (len(squares) - 1)


def _relative_variance(values: np.ndarray) -> float:
    return float(values.var(ddof=1) / values.mean() ** 2)


def _distance(problem: Problem, flat: np.ndarray, seed: int) -> list[float]:
    """Return ``swd_ratio`` and its z-score; empty if there are too few reference draws."""
    exact = _distances_of_sets(problem, seed, len(flat))
    if exact is None:
        return []
    sets, directions, own = exact
    distance = _distances(np.sort(flat @ directions.T, axis=0), sets).mean()
    deviation = own.std(ddof=1) * math.sqrt(1 + 1 / len(own))
    return [float(distance / own.mean()), float((distance - own.mean()) / deviation)]


@lru_cache(maxsize=4)
def _distances_of_sets(
    problem: Problem, seed: int, size: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return sorted projections of reference sets, directions, and mean distances of each set."""
    flat = reference_draws(problem, seed).flat
    if size < 2 or len(flat) < N_SETS * size:
        return None
    rng = seeds.generator(seed, "verdict directions")
    directions = distribution.random_directions(rng, _N_PROJECTIONS, flat.shape[1])
    projected = (flat[: N_SETS * size] @ directions.T).reshape(N_SETS, size, -1)
    sets = np.sort(projected, axis=1)
    own = np.array([_distances(one, sets).sum() for one in sets]) / (N_SETS - 1)
    return sets, directions, own


def _distances(one: np.ndarray, sets: np.ndarray) -> np.ndarray:
    """Return sliced Wasserstein distances of sorted projections: ``(n, P), (S, n, P) → (S,)``."""
    return np.asarray(np.sqrt(((sets - one) ** 2).mean(axis=(1, 2))))
