"""Calibration table, and verdicts on the calibration of samplers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from probmotion.comparison.results.failures import Failure
from probmotion.metrics.uniformity import (
    DENSITY,
    DISTANCE,
    adjusted_p_values,
    credible_level,
    uniformity_p_value,
)

__all__ = [
    "LEVELS", "CalibrationRanks", "CalibrationTable", "coverage_curve", "coverage_frame", "verdict",
]  # fmt: skip

# Levels of credible sets: 0.05, 0.1, …, 0.95.
LEVELS = np.arange(1, 20) / 20

_COLUMNS = [
    "problem", "sampler", "quantity", "p_value", "coverage_90", "coverage_error", "simulations",
    "failed",
]  # fmt: skip
_LEVEL = 0.9  # level of the credible sets in the table and the verdicts
_SIGNIFICANT = 0.05  # significance level of the verdicts
_MIN_SIMULATIONS = 2  # minimum number of simulations for a verdict
_LEGEND = """\
p: p-value of uniform ranks, all quantities together (Holm); worst: quantity with the smallest p;
90 % coverage: fraction of truths in central 90 % intervals, mean over quantities; density,
distance: the same for highest-density sets and balls around random motions (TARP); error:
mean |coverage − level|, mean over quantities, about 0.3/√simulations for exact draws"""


@dataclass(frozen=True, eq=False)
class CalibrationRanks:
    """Ranks of the truths in [0, 1] by quantity, (n,), for one sampler on one problem.

    Failed simulations have an entry in ``failures`` instead of ranks; ``simulations`` and
    ``planned`` are the numbers of finished and planned simulations.
    """

    problem: str
    sampler: str
    ranks: Mapping[str, np.ndarray]
    failures: Sequence[Failure]
    simulations: int
    planned: int


class CalibrationTable(pd.DataFrame):
    """Data frame of :meth:`Calibration.table`, printed as a summary; slices are plain frames."""

    @classmethod
    def of(cls, ranked: Sequence[CalibrationRanks], notes: Sequence[str]) -> CalibrationTable:
        """Return the table of every sampler's ranks on every problem."""
        rows: list[tuple] = []
        for item in ranked:
            counts = (item.simulations - len(item.failures), len(item.failures))
            rows += [(item.problem, item.sampler, *score, *counts) for score in _scores(item.ranks)]
        table = cls(rows, columns=_COLUMNS)
        table.attrs = {"verdicts": [verdict(item) for item in ranked], "notes": list(notes)}
        return table

    @property
    def _constructor(self) -> type[pd.DataFrame]:
        return pd.DataFrame

    def __repr__(self) -> str:
        return self.summary()

    __str__ = __repr__

    def _repr_html_(self) -> None:
        return None

    def summary(self) -> str:
        """Return the table as text, with verdicts and notes."""
        blocks = []
        for problem in dict.fromkeys(self["problem"]):
            rows = pd.DataFrame(self[self["problem"] == problem])
            lines = [_line(str(name), group) for name, group in rows.groupby("sampler", sort=False)]
            blocks.append(f"{problem}\n{pd.DataFrame(lines).to_string(index=False)}")
        blocks.append("\n".join(self.attrs["verdicts"]))
        blocks.append(_LEGEND)
        if notes := self.attrs["notes"]:
            blocks.append("\n".join(notes))
        return "\n\n".join(blocks)


def coverage_curve(quantity: str, ranks: np.ndarray) -> np.ndarray:
    """Return the fraction of truths in credible sets of each of :data:`LEVELS`, (19,)."""
    return (credible_level(quantity, ranks)[:, None] <= LEVELS).mean(axis=0)


def coverage_frame(ranks: Mapping[str, np.ndarray]) -> pd.DataFrame:
    """Return coverage by quantity and level with its 95 % interval (Wilson 1927)."""
    rows = []
    for name, values in ranks.items():
        n = len(values)
        for level, fraction in zip(LEVELS, coverage_curve(name, values), strict=True):
            interval = binomtest(round(fraction * n), n).proportion_ci(0.95, "wilson")
            rows.append((name, float(level), float(fraction), interval.low, interval.high))
    return pd.DataFrame(rows, columns=["quantity", "level", "coverage", "lower", "upper"])


def verdict(ranked: CalibrationRanks) -> str:
    """Return a one-sentence verdict on a sampler's calibration on a problem."""
    failed, ranks, finished = ranked.failures, ranked.ranks, ranked.simulations
    succeeded = finished - len(failed)
    where = f"{ranked.sampler} on {ranked.problem}"
    note = ""
    if failed:
        first = failed[0].message
        if not succeeded and all(failure.unsupported for failure in failed):
            return f"{where}: not supported, {first}"
        note = f"; {len(failed)} of {finished} simulations failed, the first: {first}"
    if succeeded < _MIN_SIMULATIONS:
        return f"{where}: too few simulations, {succeeded} of {ranked.planned} succeeded{note}"
    p_values = {name: uniformity_p_value(values) for name, values in ranks.items()}
    p = float(adjusted_p_values(np.array(list(p_values.values()))).min())
    if p >= _SIGNIFICANT:
        result = f"no deviation found in {succeeded} simulations ({_probability(p)})"
    else:
        result = f"{_deviation(ranks, p_values)} ({_probability(p)}, {succeeded} simulations)"
    return f"{where}: {result}{note}"


def _deviation(ranks: Mapping[str, np.ndarray], p_values: Mapping[str, float]) -> str:
    """Describe the deviation of ranks: overconfident, underconfident or biased."""
    coverage = _central(ranks)
    n = len(next(iter(ranks.values())))
    # Two standard errors of a single quantity, because quantities of a motion are correlated.
    error = 2 * math.sqrt(_LEVEL * (1 - _LEVEL) / n)
    intervals = f"90 % intervals cover {100 * coverage:.0f} %"
    if coverage < _LEVEL - error:
        return f"overconfident: {intervals}"
    if coverage > _LEVEL + error:
        return f"underconfident: {intervals}"
    worst = min(p_values, key=lambda name: p_values[name])
    mean = 100 * float(ranks[worst].mean())
    return f"biased: {intervals}, but the truth's {worst} exceeds that of {mean:.0f} % of draws"


def _central(ranks: Mapping[str, np.ndarray]) -> float:
    """Return the mean coverage of central 90 % intervals over quantities."""
    central = [name for name in ranks if name not in (DENSITY, DISTANCE)]
    levels = np.array([credible_level(name, ranks[name]) for name in central])
    return float((levels <= _LEVEL).mean())


def _scores(ranks: Mapping[str, np.ndarray]) -> list[tuple[str, float, float, float]]:
    """Return quantity, p-value, 90 % coverage and coverage error; the first row combines all."""
    if not ranks or len(next(iter(ranks.values()))) < _MIN_SIMULATIONS:
        return [("all", math.nan, math.nan, math.nan)]
    scores = []
    for name, values in ranks.items():
        error = float(np.abs(coverage_curve(name, values) - LEVELS).mean())
        covered = float((credible_level(name, values) <= _LEVEL).mean())
        scores.append((name, uniformity_p_value(values), covered, error))
    p = float(adjusted_p_values(np.array([score[1] for score in scores])).min())
    error = float(np.mean([score[3] for score in scores]))
    return [("all", p, _central(ranks), error), *scores]


def _line(sampler: str, table: pd.DataFrame) -> dict[str, str]:
    rows = table.set_index("quantity")
    combined = rows.loc["all"]
    p_values = rows.drop(index="all")["p_value"]
    covered = rows["coverage_90"]
    return {
        "sampler": sampler,
        "p": _number(float(combined["p_value"])),
        "worst": "-" if p_values.empty else str(p_values.idxmin()),
        "90 % coverage": _percent(float(combined["coverage_90"])),
        "density": _percent(float(covered.get(DENSITY, math.nan))),
        "distance": _percent(float(covered.get(DISTANCE, math.nan))),
        "error": _number(float(combined["coverage_error"])),
        "simulations": f"{combined['simulations']:.0f}",
        "failed": f"{combined['failed']:.0f}",
    }


def _probability(p: float) -> str:
    return "p < .001" if p < 0.001 else f"p = {_number(p)}"


def _number(value: float) -> str:
    if math.isnan(value):
        return "-"
    if value < 0.001:
        return "<.001"
    digits = f"{value:.3f}" if value < 0.1 else f"{value:.2f}"
    return digits.removeprefix("0")


def _percent(value: float) -> str:
    return "-" if math.isnan(value) else f"{100 * value:.0f} %"
