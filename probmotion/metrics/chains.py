"""Convergence diagnostics of Markov chains."""

from __future__ import annotations

import math

import numpy as np

from probmotion.posteriors.draws import MotionDraws

__all__ = [
    "chain_diagnostics",
    "monitored_coordinates",
    "principal_coordinates",
    "rhat_of_independent",
]

# In more dimensions, only principal coordinates are monitored.
_MAX_DIMENSIONS = 32
_PRINCIPAL = 10  # number of principal coordinates
# Relative standard deviation below which a coordinate counts as constant.
_RELATIVE_TOLERANCE = 1e-9
# Minimum draws per chain for the effective sample size (ESS): fewer do not show autocorrelation.
_MIN_DRAWS_FOR_ESS = 10


def chain_diagnostics(draws: MotionDraws, values: np.ndarray | None = None) -> dict[str, float]:
    """Return convergence diagnostics of a run; empty for independent draws.

    ``rhat`` is the largest R-hat, ``ess_bulk`` and ``ess_tail`` are the smallest effective sample
    sizes (ESS) over ``values`` (chain, draw, n), by default :func:`monitored_coordinates` (Vehtari
    et al. 2021, ArviZ). With fewer than 4 draws per chain, R-hat is NaN; with fewer than 10, ESS is
    omitted. ``acceptance`` is the mean acceptance rate, ``divergent`` counts divergent transitions.

    The ``ess_bulk`` of an ensemble sampler, whose walkers are coupled, is computed from the stored
    ``autocorrelation_time`` (omitted if NaN). Only R-hat detects ensembles in different modes.
    """
    if draws.independent:
        return {}
    from arviz_stats.base import array_stats

    data = draws.dataset
    n_chains, n_draws = data.sizes["chain"], data.sizes["draw"]
    values = monitored_coordinates(draws) if values is None else values
    axes = {"chain_axis": 0, "draw_axis": 1}
    diagnostics: dict[str, float] = {}
    if "autocorrelation_time" in data:
        slowest = float(np.max(data["autocorrelation_time"].values))
        if not np.isnan(slowest):
            diagnostics["ess_bulk"] = n_chains * n_draws / slowest
    elif n_draws >= _MIN_DRAWS_FOR_ESS:
        diagnostics["ess_bulk"] = float(np.min(array_stats.ess(values, method="bulk", **axes)))
        tails = array_stats.ess(values, method="tail", prob=(0.05, 0.95), **axes)
        diagnostics["ess_tail"] = float(np.min(tails))
    if n_chains > 1 or "autocorrelation_time" not in data:
        # Infinite if no chain moves.
        with np.errstate(divide="ignore"):
            diagnostics["rhat"] = float(np.max(array_stats.rhat(values, **axes)))
    if "acceptance_rate" in data:
        diagnostics["acceptance"] = float(data["acceptance_rate"].mean())
    if "diverging" in data:
        diagnostics["divergent"] = float(data["diverging"].sum())
    return diagnostics


def principal_coordinates(values: np.ndarray) -> np.ndarray:
    """Return the leading principal coordinates of all chains together, at most 10.

    ``(chain, draw, n) → (chain, draw, k)``, in order of decreasing variance. Constant coordinates
    after the first are dropped.
    """
    flat = values.reshape(-1, values.shape[-1])
    left, size, _ = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)
    vary = size[:_PRINCIPAL] >= _RELATIVE_TOLERANCE * size[0]
    vary[1:] &= size[0] > 0
    return (left * size)[:, :_PRINCIPAL][:, vary].reshape(*values.shape[:2], -1)


def rhat_of_independent(chains: int, draws: int, *, level: float = 0.95) -> float:
    """Return the ``level`` quantile of R-hat over converged runs.

    R-hat of a run, of ``chains`` chains with ``draws`` (at least 4) independent draws, is the
    largest over 33 coordinates, the most that are monitored. For short chains, the quantile is well
    above 1.

    R-hat is √((n − 1 + F)/n) with n the length of half a chain, and F the ratio of variances
    between and within half-chains, here F-distributed. Bulk and tail R-hat of a coordinate count
    as independent.
    """
    from scipy import stats

    n, halves = draws // 2, 2 * chains
    ratio = stats.f.ppf(level ** (0.5 / (_MAX_DIMENSIONS + 1)), halves - 1, halves * (n - 1))
    return math.sqrt((n - 1 + float(ratio)) / n)


def monitored_coordinates(draws: MotionDraws) -> np.ndarray:
    """Return the coordinates that diagnostics monitor, (chain, draw, n).

    They are θ, or positions if θ is not stored, and the log density if stored. Above 32 dimensions,
    at most 10 principal coordinates replace θ, as the largest R-hat of many coordinates is high.
    """
    data = draws.dataset
    shape = (data.sizes["chain"], data.sizes["draw"])
    values = (data["theta"] if "theta" in data else data["positions"]).values
    values = values.reshape(*shape, -1)
    if values.shape[-1] > _MAX_DIMENSIONS:
        values = principal_coordinates(values)
    if "log_density" in data:
        values = np.concatenate([values, data["log_density"].values[..., None]], axis=-1)
    return values
