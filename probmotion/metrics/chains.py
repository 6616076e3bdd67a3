"""Have the chains mixed, and how many independent draws are theirs worth?"""

from __future__ import annotations

import numpy as np

from probmotion import seeds
from probmotion.posteriors.draws import MotionDraws

__all__ = [
    "chain_diagnostics",
    "principal_coordinates",
    "rhat_of_independent",
    "watched_coordinates",
]

_FEW = 32
_TO_CORRELATE = 10
_PRINCIPAL = 10
_NOTHING = 1e-9


def chain_diagnostics(draws: MotionDraws, values: np.ndarray | None = None) -> dict[str, float]:
    """Return diagnostics of a chain sampler's run; nothing for draws that are independent.

    ``ess_bulk``, ``ess_tail``: the smallest over ``values``, (chain, draw, n), by default
    :func:`watched_coordinates`; ``rhat``: the largest (Vehtari et al. 2021, by ArviZ), NaN of fewer
    than 4 draws a chain. Chains of fewer than 10 have no ESS: they are too short to show that draws
    depend on each other, and stuck chains would have that of independent draws.
    ``acceptance``: the mean; ``divergent``: the number of divergent transitions.

    Walkers of an ensemble move by each other, so that a chain of them has no ESS of its own: a
    run that stores its ``autocorrelation_time`` gets ``ess_bulk`` from that, and none where that
    is NaN, not known. It cannot see that ensembles sit in different modes; their R-hat, each
    ensemble being one chain, can.
    """
    if draws.independent:
        return {}
    from arviz_stats.base import array_stats

    data = draws.dataset
    n_chains, n_draws = data.sizes["chain"], data.sizes["draw"]
    values = watched_coordinates(draws) if values is None else values
    axes = {"chain_axis": 0, "draw_axis": 1}
    found: dict[str, float] = {}
    if "autocorrelation_time" in data:
        slowest = float(np.max(data["autocorrelation_time"].values))
        if not np.isnan(slowest):
            found["ess_bulk"] = n_chains * n_draws / slowest
    elif n_draws >= _TO_CORRELATE:
        found["ess_bulk"] = float(np.min(array_stats.ess(values, method="bulk", **axes)))
        tails = array_stats.ess(values, method="tail", prob=(0.05, 0.95), **axes)
        found["ess_tail"] = float(np.min(tails))
    if n_chains > 1 or "autocorrelation_time" not in data:
        found["rhat"] = float(np.max(array_stats.rhat(values, **axes)))
    if "acceptance" in data:
        found["acceptance"] = float(data["acceptance"].mean())
    if "divergent" in data:
        found["divergent"] = float(data["divergent"].sum())
    return found


def principal_coordinates(values: np.ndarray) -> np.ndarray:
    """Return the leading 10 principal coordinates over all chains, fewer where fewer vary.

    ``(chain, draw, n) → (chain, draw, 1 to 10)``, widest first; the first is always there.
    """
    flat = values.reshape(-1, values.shape[-1])
    left, size, _ = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)
    vary = size[:_PRINCIPAL] >= _NOTHING * size[0]
    vary[1:] &= size[0] > 0
    return (left * size)[:, :_PRINCIPAL][:, vary].reshape(*values.shape[:2], -1)


def rhat_of_independent(chains: int, draws: int, *, level: float = 0.95, seed: int = 0) -> float:
    """Return what the R-hat of a run exceeds with probability ``1 − level`` though it has mixed.

    The quantile of the greatest R-hat of as many coordinates as diagnostics ever look at, of
    independent draws: of short chains it is far from 1. Found from 100 such runs.

    Parameters
    ----------
    chains, draws : int
        Chains, and draws of each: 4 or more.
    level : float
        Between 0 and 1.
    seed : int
        Of the runs.
    """
    from arviz_stats.base import array_stats

    greatest = []
    for run in range(100):
        # One at a time, each with its own stream: all at once would take gigabytes.
        rng = seeds.generator(seed, "rhat", run)
        values = rng.standard_normal((chains, draws, _FEW + 1))
        greatest.append(array_stats.rhat(values, chain_axis=0, draw_axis=1).max())
    return float(np.quantile(greatest, level))


def watched_coordinates(draws: MotionDraws) -> np.ndarray:
    """Return what diagnostics look at, (chain, draw, n).

    θ (the positions where a run stores none), or its 10 leading principal coordinates over all
    chains where there are more than 32: the worst of a thousand is bad for perfect chains too.
    The log density, where stored, is one more.
    """
    data = draws.dataset
    shape = (data.sizes["chain"], data.sizes["draw"])
    values = (data["theta"] if "theta" in data else data["positions"]).values
    values = values.reshape(*shape, -1)
    if values.shape[-1] > _FEW:
        values = principal_coordinates(values)
    if "log_density" in data:
        values = np.concatenate([values, data["log_density"].values[..., None]], axis=-1)
    return values
