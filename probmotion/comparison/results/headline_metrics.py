"""Headline metrics of a problem, and best and statistically tied samplers per metric."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from probmotion.metrics.intervals import best_and_tied

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["HEADLINE_METRICS", "best_of", "headline_metric", "headline_metrics", "seed_values"]

HEADLINE_METRICS: Mapping[str, str] = {
    "swd_ratio": "sliced Wasserstein distance to reference draws (1: that of other references)",
    "coverage_interaction": "mean distance of a held-out pose to its nearest draw (D_IC, m)",
    "fid": "Fréchet distance to held-out real views (FID)",
    "g_mpjpe_mm": "mean distance of a joint from the truth (G-MPJPE, mm)",
}
"""Descriptions by metric, in order of preference."""
_FURTHER_METRICS = ("variance_ratio", "mean_error_sd", "off_manifold_ratio", "c2st")

_RATIO: Mapping[str, Any] = {"target": 1.0, "ratio": True}  # ideal value 1, log scale
_LESS: Mapping[str, Any] = {"target": None}  # lower is better
_MORE: Mapping[str, Any] = {"target": None, "lower_is_better": False}  # higher is better
# Arguments of best_and_tied() by metric.
_RULES: Mapping[str, Mapping[str, Any]] = {
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
_LESS_PREFIXES, _LESS_SUFFIXES = ("coverage_", "fid"), ("_mm", "_cm2")  # lower is better
# Metrics that are proportions; the denominator is this multiple of the number of draws.
_PROPORTIONS = {"precision": 1, "recall": 1, "mode_proportions_tv": 1, "c2st": 2}
_DISTANCES_TO_TRUTH = ("acceleration_error", "velocity_error", "pck")


def headline_metric(table: pd.DataFrame) -> str | None:
    """Return the first of :data:`HEADLINE_METRICS` with a finite positive value, or None."""
    values = table["value"].to_numpy(float)
    measured = set(table["metric"][np.isfinite(values) & (values > 0)])
    return next((name for name in HEADLINE_METRICS if name in measured), None)


def headline_metrics(table: pd.DataFrame) -> list[str]:
    """Return the metrics of a table for a paper, in order of preference."""
    measured = set(table["metric"])
    return [
        name
        for name in (*HEADLINE_METRICS, *_FURTHER_METRICS)
        if name in measured and not ("swd_ratio" in measured and _is_distance_to_truth(name))
    ]


def seed_values(table: pd.DataFrame) -> dict[tuple[str, str], pd.Series]:
    """Return the values by seed for each sampler and metric of a problem."""
    return {
        (str(sampler), str(metric)): group.set_index("seed")["value"]
        for (sampler, metric), group in table.groupby(["sampler", "metric"], sort=False)
    }


def best_of(
    metric: str,
    values: Mapping[str, pd.Series],
    seeds: Iterable[int],
    measured: Collection[str] = (),
    draws: int | None = None,
) -> tuple[str | None, set[str]]:
    """Return the best sampler and all samplers that are statistically tied with it.

    Returns None and an empty set for metrics without a best value, such as costs; for metrics with
    fewer than two samplers or two seeds; and for distances of single draws to the truth if there
    are references, because overconfident draws are closer to the truth.

    ``values`` contains the values of each sampler by seed, ``measured`` all metrics of the problem;
    ``draws`` is the number of draws per value.
    """
    rule = _RULES.get(metric)
    if rule is None and (metric.startswith(_LESS_PREFIXES) or metric.endswith(_LESS_SUFFIXES)):
        rule = _LESS
    if rule is None or ("swd_ratio" in measured and _is_distance_to_truth(metric)):
        return None, set()
    rows = {name: row.reindex(list(seeds)).to_numpy(float) for name, row in values.items()}
    # Infinite values and ratios of 0 exclude a sampler.
    errors = {
        name: row
        for name, row in rows.items()
        if np.isfinite(row).any()
        and not np.isinf(row).any()
        and not (rule.get("ratio") and (row <= 0).any())
    }
    if len(errors) < 2 or max(np.isfinite(row).sum() for row in errors.values()) < 2:
        return None, set()
    step = 1 / (_PROPORTIONS[metric] * draws) if draws and metric in _PROPORTIONS else 0.0
    return best_and_tied(errors, **rule, step=step)


def _is_distance_to_truth(metric: str) -> bool:
    """Whether a metric is a distance of single draws, not of their mean, to the truth."""
    return metric in _DISTANCES_TO_TRUTH or (metric.endswith("_mm") and "_mean_" not in metric)
