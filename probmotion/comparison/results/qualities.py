"""What says most of a sampler, which numbers are the best, and which cannot be told from them."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from probmotion.metrics.intervals import best_and_tied

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["QUALITIES", "best_of", "first_quality"]

QUALITIES: Mapping[str, str] = {
    "swd_ratio": "sliced Wasserstein distance to reference draws (1: as far as others of them)",
    "coverage_interaction": "mean distance of a held-out pose to its nearest draw (D_IC, m)",
    "fid": "Fréchet distance to held-out real views (FID)",
    "g_mpjpe_mm": "mean distance of a joint from the truth (G-MPJPE, mm)",
}
"""Measures by what they are, in a sentence: the first that was measured says most."""

_RATIO: Mapping[str, Any] = {"target": 1.0, "ratio": True}
_LESS: Mapping[str, Any] = {"target": None}
_MORE: Mapping[str, Any] = {"target": None, "lower_is_better": False}

_RIGHT: Mapping[str, Mapping[str, Any]] = {
    "swd_ratio": _RATIO,
    "variance_ratio": _RATIO,
    "off_manifold_ratio": _RATIO,
    "acceleration_ratio": _RATIO,
    "diversity_ratio": _RATIO,
    "log_density_gap": {"target": 0.0},
    "c2st": {"target": 0.5},
    "mean_error_sd": _LESS,
    "mode_proportions_tv": _LESS,
    "mmd": {"target": 0.0},
    "ksd": {"target": 0.0},
    "acceleration_error": _LESS,
    "velocity_error": _LESS,
    "pck": _MORE,
    "precision": _MORE,
    "recall": _MORE,
    "view_precision": _MORE,
    "view_recall": _MORE,
    "view_recall_side": _MORE,
    "view_recall_learnt": _MORE,
}
_LESS_BEGIN = ("coverage_", "fid")
_LESS_END = ("_mm", "_cm2")
# Of how many sets of draws a value is a share, and so moves by steps.
_SHARES = {"precision": 1, "recall": 1, "mode_proportions_tv": 1, "c2st": 2}
_NEAR_THE_TRUTH = ("acceleration_error", "velocity_error", "pck")


def first_quality(table: pd.DataFrame) -> str | None:
    """Return the first of :data:`QUALITIES` that a table has, above zero; None where none is."""
    values = table["value"].to_numpy(float)
    measured = set(table["metric"][np.isfinite(values) & (values > 0)])
    return next((name for name in QUALITIES if name in measured), None)


def best_of(
    metric: str,
    values: Mapping[str, pd.Series],
    seeds: Iterable[int],
    beside: Collection[str] = (),
    draws: int | None = None,
) -> tuple[str | None, set[str]]:
    """Return the best sampler and all that are not distinguishable from it, itself among them.

    Nobody is where fewer than two samplers have a number, none has one at two seeds, without which
    nothing can be told apart, or no value of the metric is right, as of costs, of what describes a
    run, and of how near draws are to the truth where references show how far right ones are: draws
    that vary too little are nearer.

    Parameters
    ----------
    metric : str
        As in the table's frame.
    values : mapping of Series
        By sampler, its values by seed.
    seeds : iterable of int
        Those that were asked for.
    beside : collection of str
        What else was measured on the problem.
    draws : int, optional
        That each value is of.
    """
    rule = _RIGHT.get(metric)
    if rule is None and (metric.startswith(_LESS_BEGIN) or metric.endswith(_LESS_END)):
        rule = _LESS
    if rule is None or ("swd_ratio" in beside and _is_nearness(metric)):
        return None, set()
    rows = {name: row.reindex(list(seeds)).to_numpy(float) for name, row in values.items()}
    # A ratio of 0 is infinitely wrong, and an infinite value as well.
    errors = {
        name: row
        for name, row in rows.items()
        if np.isfinite(row).any()
        and not np.isinf(row).any()
        and not (rule.get("ratio") and (row <= 0).any())
    }
    if len(errors) < 2 or max(np.isfinite(row).sum() for row in errors.values()) < 2:
        return None, set()
    step = 1 / (_SHARES[metric] * draws) if draws and metric in _SHARES else 0.0
    return best_and_tied(errors, **rule, step=step)


def _is_nearness(metric: str) -> bool:
    """Whether a metric is how near single draws are to the truth, as that of their mean is not."""
    return metric in _NEAR_THE_TRUTH or (metric.endswith("_mm") and "_mean_" not in metric)
