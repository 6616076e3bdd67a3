"""Where the truth stands among draws: one number in [0, 1] per quantity, uniform if all is right.

Talts et al. (2018), "Validating Bayesian inference algorithms with simulation-based calibration".
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from probmotion import seeds
from probmotion.calibration.quantities import log_densities, quantities
from probmotion.metrics.credible_sets import DISTANCE
from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.problem import Problem

__all__ = ["Rank", "independent_draws", "rank", "ranks_of_truth"]

_FEWEST = 4


class Rank(NamedTuple):
    """Where the truth stands.

    Attributes
    ----------
    value : float
        In [0, 1]: the share of draws below, spread over its step.
    draws : int
        Among how many draws.
    """

    value: float
    draws: int


def rank(truth: float, draws: np.ndarray, rng: np.random.Generator) -> float:
    """Return (r + U) / (L + 1), r the rank of the truth among L draws, ties broken at random.

    It is uniform on [0, 1] whatever L is, if truth and draws are exchangeable; so that runs of
    different lengths may be put together.

    Parameters
    ----------
    truth : float
        The quantity, of the truth.
    draws : ndarray, (L,)
        The same, of draws that are independent.
    rng : numpy.random.Generator
        For ties, and for U.
    """
    below, equal = int((draws < truth).sum()), int((draws == truth).sum())
    return float((below + (equal + 1) * rng.random()) / (len(draws) + 1))


def independent_draws(values: np.ndarray, draws: MotionDraws) -> np.ndarray:
    """Return so many of a chain's values, evenly apart, as are about independent.

    As many as the quantity's own effective sample size (bulk, Vehtari et al. 2021; an ensemble's
    is draws / autocorrelation time), all if the draws are independent anyway; at least one. What
    never moves, is not finite everywhere, has chains of fewer than 4 draws, or is of an ensemble
    whose autocorrelation time is not known (NaN) is one draw.

    Parameters
    ----------
    values : ndarray, (chain, draw)
        The quantity of every draw.
    draws : MotionDraws
        The run.
    """
    flat = values.reshape(-1)
    if draws.independent:
        return flat
    if "autocorrelation_time" in draws.dataset:
        size = len(flat) / float(np.max(draws.dataset["autocorrelation_time"].values))
    elif not np.isfinite(flat).all() or np.ptp(flat) == 0 or values.shape[1] < _FEWEST:
        size = 1.0
    else:
        from arviz_stats.base import array_stats

        size = float(array_stats.ess(values, method="bulk", chain_axis=0, draw_axis=1))
    kept = min(len(flat), int(size)) if math.isfinite(size) and size >= 1 else 1
    # The middles of equal stretches: never only where chains begin.
    return flat[((np.arange(kept) + 0.5) * len(flat) / kept).astype(int)]


def ranks_of_truth(
    problem: Problem,
    simulation: Problem,
    draws: MotionDraws,
    elsewhere: Problem,
    seed: int,
) -> dict[str, Rank]:
    """Return the truth's rank by each quantity.

    Parameters
    ----------
    problem : Problem
        What was simulated; it decides the quantities.
    simulation : Problem
        One simulation of it, with a truth.
    draws : MotionDraws
        A run on the simulation.
    elsewhere : Problem
        Another simulation. Its truth has nothing to do with this one's evidence: the quantity
        ``distance`` is the root mean square distance of joints from it, metres.
    seed : int
        Seed of ties.

    Raises
    ------
    ValueError
        If a simulation has no truth, or a quantity is NaN.
    """
    if simulation.truth is None or elsewhere.truth is None:
        raise ValueError(f"{problem.name} simulates no truth, expected one to be ranked")
    positions = np.concatenate([simulation.truth[None], draws.flat()])
    found = {one.name: one.evaluate(positions) for one in quantities(problem.posterior)}
    found |= log_densities(simulation, positions)
    found[DISTANCE] = np.sqrt(((positions - elsewhere.truth) ** 2).sum(axis=-1).mean(axis=(1, 2)))
    shape = (draws.dataset.sizes["chain"], draws.dataset.sizes["draw"])
    ranks = {}
    for name, values in found.items():
        if unknown := int(np.isnan(values).sum()):
            raise ValueError(
                f"{name} is NaN for {unknown} of the truth and the draws, expected numbers, which "
                "have ranks"
            )
        kept = independent_draws(values[1:].reshape(shape), draws)
        rng = seeds.generator(seed, "ties", name)
        ranks[name] = Rank(rank(float(values[0]), kept, rng), len(kept))
    return ranks
