"""Which numbers of a table are the best, and which cannot be told from the best."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from probmotion.metrics.intervals import best_and_tied

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["best_of"]

_RATIO: Mapping[str, Any] = {"target": 1.0, "ratio": True}
_LESS: Mapping[str, Any] = {"target": None}
_MORE: Mapping[str, Any] = {"target": None, "lower_is_better": False}

_RIGHT: Mapping[str, Mapping[str, Any]] = {
    "swd": _RATIO,
    "tr": _RATIO,
    "off": _RATIO,
    "acceleration_ratio": _RATIO,
    "diversity_ratio": _RATIO,
    "log_density_gap": {"target": 0.0},
    "c2st": {"target": 0.5},
    "mean_error": _LESS,
    "share_error": _LESS,
    "mmd": {"target": 0.0},
    "ksd": {"target": 0.0},
    "precision": _MORE,
    "recall": _MORE,
    "view_precision": _MORE,
    "view_recall": _MORE,
    "view_recall_side": _MORE,
    "view_recall_learnt": _MORE,
}
_LESS_BEGIN = ("coverage_", "fid")
_LESS_END = ("_mm",)


def best_of(
    metric: str, values: Mapping[str, pd.Series], seeds: int
) -> tuple[str | None, set[str]]:
    """Return the best sampler and all that are not distinguishable from it, itself among them.

    Nobody is where fewer than two samplers have a number, or no value of the metric is right, as of
    costs and of what describes a run.

    Parameters
    ----------
    metric : str
        As in the table's frame.
    values : mapping of Series
        By sampler, its values by seed.
    seeds : int
        Seeds that were asked for.
    """
    rule = _RIGHT.get(metric)
    if rule is None and (metric.startswith(_LESS_BEGIN) or metric.endswith(_LESS_END)):
        rule = _LESS
    if rule is None:
        return None, set()
    rows = {name: row.reindex(range(seeds)).to_numpy(float) for name, row in values.items()}
    # A ratio of 0 is infinitely wrong, and an infinite value as well.
    errors = {
        name: row
        for name, row in rows.items()
        if np.isfinite(row).any()
        and not np.isinf(row).any()
        and not (rule.get("ratio") and (row <= 0).any())
    }
    if len(errors) < 2:
        return None, set()
    return best_and_tied(errors, **rule)
