"""What ranks say: a tidy data frame that prints a line per sampler, and a verdict in words."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from probmotion.comparison.results.failures import Failure
from probmotion.metrics.credible_sets import DENSITY, DISTANCE, credible_level
from probmotion.metrics.uniformity import adjusted_p_values, uniformity_p_value

__all__ = ["LEVELS", "CalibrationTable", "Ranked", "coverage_curve", "coverage_frame", "verdict"]

LEVELS = np.arange(1, 20) / 20
"""Of credible sets: 0.05, 0.1, …, 0.95."""

_COLUMNS = [
    "problem", "sampler", "quantity", "p_value", "coverage_90", "coverage_error", "simulations",
    "failed",
]  # fmt: skip
_SHOWN = 0.9
_SIGNIFICANT = 0.05
_FEWEST = 2
_LEGEND = """\
p: that ranks are uniform, of all quantities together (Holm); worst: the quantity that is furthest
from it; 90 % holds: share of central 90 % intervals that hold the truth, mean over quantities;
density, distance: the same of the sets of highest density and of balls about random motions (TARP);
error: mean |coverage − level|, mean over quantities; exact draws have about 0.3/√simulations."""


@dataclass(frozen=True, eq=False)
class Ranked:
    """The ranks of one sampler on one problem.

    Parameters
    ----------
    problem, sampler : str
        Their names.
    ranks : mapping of str to ndarray, (n,)
        The truth's ranks in [0, 1] by quantity, of the simulations that worked.
    failures : sequence of Failure
        Of the simulations that did not work.
    simulations, planned : int
        How many are finished, and how many were asked for.
    """

    problem: str
    sampler: str
    ranks: Mapping[str, np.ndarray]
    failures: Sequence[Failure]
    simulations: int
    planned: int


class CalibrationTable(pd.DataFrame):
    """A row per problem, sampler and quantity, as :meth:`Calibration.table` says.

    ``print`` shows a line per sampler and the verdicts, which ``attrs`` hold beside notes.
    Whatever is cut from it is a plain data frame.
    """

    @classmethod
    def of(cls, ranked: Sequence[Ranked], notes: Sequence[str]) -> CalibrationTable:
        """Return the table of every sampler's ranks on every problem."""
        rows: list[tuple] = []
        for one in ranked:
            worked = one.simulations - len(one.failures)
            counts = (worked, len(one.failures))
            rows += [(one.problem, one.sampler, *score, *counts) for score in _scores(one.ranks)]
        table = cls(rows, columns=_COLUMNS)
        table.attrs = {"verdicts": [verdict(one) for one in ranked], "notes": list(notes)}
        return table

    @property
    def _constructor(self) -> type[pd.DataFrame]:
        return pd.DataFrame

    def __str__(self) -> str:
        return self.summary()

    def __repr__(self) -> str:
        return self.summary()

    def _repr_html_(self) -> None:
        return None

    def summary(self) -> str:
        """Return the table as text: a block per problem, the verdicts, the notes."""
        blocks = []
        for problem in dict.fromkeys(self["problem"]):
            rows = pd.DataFrame(self[self["problem"] == problem])
            lines = [_line(str(name), cells) for name, cells in rows.groupby("sampler", sort=False)]
            blocks.append(f"{problem}\n{pd.DataFrame(lines).to_string(index=False)}")
        blocks.append("\n".join(self.attrs["verdicts"]))
        blocks.append(_LEGEND)
        if notes := self.attrs["notes"]:
            blocks.append("\n".join(notes))
        return "\n\n".join(blocks)


def coverage_curve(quantity: str, ranks: np.ndarray) -> np.ndarray:
    """Return the share of truths that credible sets of each of :data:`LEVELS` hold, (19,)."""
    return (credible_level(quantity, ranks)[:, None] <= LEVELS).mean(axis=0)


def coverage_frame(ranks: Mapping[str, np.ndarray]) -> pd.DataFrame:
    """Return columns quantity, level, coverage, lower, upper: a 95 % interval (Wilson 1927)."""
    rows = []
    for name, values in ranks.items():
        n = len(values)
        for level, share in zip(LEVELS, coverage_curve(name, values), strict=True):
            interval = binomtest(round(share * n), n).proportion_ci(0.95, "wilson")
            rows.append((name, float(level), float(share), interval.low, interval.high))
    return pd.DataFrame(rows, columns=["quantity", "level", "coverage", "lower", "upper"])


def verdict(ranked: Ranked) -> str:
    """Return in one sentence whether a sampler is calibrated on a problem, and how it is not."""
    failed, ranks, finished = ranked.failures, ranked.ranks, ranked.simulations
    worked = finished - len(failed)
    where = f"{ranked.sampler} on {ranked.problem}"
    but = ""
    if failed:
        said = failed[0].message
        if not worked and all(failure.unsupported for failure in failed):
            return f"{where}: not supported, {said}"
        more = f"{len(failed)} of {finished} simulations failed, the first: {said}"
        but = f"; {more}"
    if worked < _FEWEST:
        return f"{where}: nothing to judge by, {worked} of {ranked.planned} worked{but}"
    p_values = {name: uniformity_p_value(values) for name, values in ranks.items()}
    p = float(adjusted_p_values(np.array(list(p_values.values()))).min())
    if p >= _SIGNIFICANT:
        found = f"no deviation found in {worked} simulations ({_probability(p)})"
    else:
        found = f"{_deviation(ranks, p_values)} ({_probability(p)}, {worked} simulations)"
    return f"{where}: {found}{but}"


def _deviation(ranks: Mapping[str, np.ndarray], p_values: Mapping[str, float]) -> str:
    """How ranks deviate: too few truths within central intervals, too many, or else where."""
    holds = _central(ranks)
    n = len(next(iter(ranks.values())))
    # Quantities of one motion hang together: no more sure than one of them.
    doubt = 2 * math.sqrt(_SHOWN * (1 - _SHOWN) / n)
    intervals = f"90 % intervals hold {100 * holds:.0f} %"
    if holds < _SHOWN - doubt:
        return f"too sure: {intervals}"
    if holds > _SHOWN + doubt:
        return f"too unsure: {intervals}"
    worst = min(p_values, key=lambda name: p_values[name])
    stands = 100 * float(ranks[worst].mean())
    return f"wrong: {intervals}, but by {worst} the truth lies above {stands:.0f} % of draws"


def _central(ranks: Mapping[str, np.ndarray]) -> float:
    """Mean coverage of central 90 % intervals over all quantities that have such."""
    levels = [
        credible_level(name, values)
        for name, values in ranks.items()
        if name not in (DENSITY, DISTANCE)
    ]
    return float((np.array(levels) <= _SHOWN).mean())


def _scores(ranks: Mapping[str, np.ndarray]) -> list[tuple[str, float, float, float]]:
    """Quantity, p-value, coverage of 90 % sets, mean error of coverage; first of all together."""
    if not ranks or len(next(iter(ranks.values()))) < _FEWEST:
        return [("all", math.nan, math.nan, math.nan)]
    scores = []
    for name, values in ranks.items():
        error = float(np.abs(coverage_curve(name, values) - LEVELS).mean())
        held = float((credible_level(name, values) <= _SHOWN).mean())
        scores.append((name, uniformity_p_value(values), held, error))
    p = float(adjusted_p_values(np.array([score[1] for score in scores])).min())
    error = float(np.mean([score[3] for score in scores]))
    return [("all", p, _central(ranks), error), *scores]


def _line(sampler: str, cells: pd.DataFrame) -> dict[str, str]:
    rows = cells.set_index("quantity")
    whole = rows.loc["all"]
    others = rows.drop(index="all")["p_value"]
    held = rows["coverage_90"]
    return {
        "sampler": sampler,
        "p": _number(float(whole["p_value"])),
        "worst": "-" if others.empty else str(others.idxmin()),
        "90 % holds": _percent(float(whole["coverage_90"])),
        "density": _percent(float(held.get(DENSITY, math.nan))),
        "distance": _percent(float(held.get(DISTANCE, math.nan))),
        "error": _number(float(whole["coverage_error"])),
        "simulations": f"{whole['simulations']:.0f}",
        "failed": f"{whole['failed']:.0f}",
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
