"""Ranks of the truth among draws, uniform on [0, 1] for a calibrated sampler.

Talts et al. (2018), "Validating Bayesian inference algorithms with simulation-based calibration".
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from probmotion import seeds
from probmotion.calibration.quantities import log_densities, quantities
from probmotion.metrics.uniformity import DISTANCE
from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.problem import Problem

__all__ = ["Rank", "independent_draws", "rank", "ranks_of_truth"]

_MIN_DRAWS = 4  # minimum draws per chain for an effective sample size


class Rank(NamedTuple):
    """Randomised rank of the truth in [0, 1], and the number of draws compared with it."""

    value: float
    draws: int


def rank(truth: float, draws: np.ndarray, rng: np.random.Generator) -> float:
    """Return the rank (r + U) / (L + 1): r of L draws are below the truth, U is uniform on [0, 1].

    ``truth`` and ``draws`` (L,) are values of one quantity; draws must be independent. Ties are
    broken at random. If truth and draws are exchangeable, the rank is uniform on [0, 1] for every
    L, so runs of different lengths can be pooled.
    """
    below, equal = int((draws < truth).sum()), int((draws == truth).sum())
    return float((below + (equal + 1) * rng.random()) / (len(draws) + 1))


def independent_draws(values: np.ndarray, draws: MotionDraws) -> np.ndarray:
    """Return values (chain, draw) of a run, evenly thinned to n nearly independent ones, (n,).

    n is the effective sample size of the quantity (bulk, Vehtari et al. 2021; draws /
    autocorrelation time for an ensemble), or the number of draws if these are independent. It is 1
    if values are constant or not finite, a chain has fewer than 4 draws, or the time is NaN.
    """
    flat = values.reshape(-1)
    if draws.independent:
        return flat
    if "autocorrelation_time" in draws.dataset:
        size = len(flat) / float(np.max(draws.dataset["autocorrelation_time"].values))
    elif not np.isfinite(flat).all() or np.ptp(flat) == 0 or values.shape[1] < _MIN_DRAWS:
        size = 1.0
    else:
        from arviz_stats.base import array_stats

        size = float(array_stats.ess(values, method="bulk", chain_axis=0, draw_axis=1))
    n = min(len(flat), int(size)) if math.isfinite(size) and size >= 1 else 1
    # Select the midpoints of equal segments, to avoid the starts of chains.
    return flat[((np.arange(n) + 0.5) * len(flat) / n).astype(int)]


def ranks_of_truth(
    problem: Problem,
    simulation: Problem,
    draws: MotionDraws,
    other: Problem,
    seed: int,
) -> dict[str, Rank]:
    """Return the rank of a simulation's truth in each quantity of ``problem``.

    The quantity ``distance`` is the root mean square distance of joints from the truth of another
    simulation, ``other``, in metres. ``seed`` determines how ties are broken.
    """
    if simulation.truth is None or other.truth is None:
        raise ValueError(f"simulations of {problem.name} must have a truth, got none")
    positions = np.concatenate([simulation.truth[None], draws.flat()])
    values_of = {item.name: item.evaluate(positions) for item in quantities(problem.posterior)}
    values_of |= log_densities(simulation, positions)
    square = ((positions - other.truth) ** 2).sum(axis=-1)
    values_of[DISTANCE] = np.sqrt(square.mean(axis=(1, 2)))
    shape = (draws.dataset.sizes["chain"], draws.dataset.sizes["draw"])
    ranks = {}
    for name, values in values_of.items():
        if unknown := int(np.isnan(values).sum()):
            raise ValueError(
                f"{name} must not be NaN, got {unknown} NaN values for the truth and the draws"
            )
        thinned = independent_draws(values[1:].reshape(shape), draws)
        rng = seeds.generator(seed, "ties", name)
        ranks[name] = Rank(rank(float(values[0]), thinned, rng), len(thinned))
    return ranks
