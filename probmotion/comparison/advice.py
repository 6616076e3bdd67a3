"""Recommendation of a sampler for a problem, based on stored measurements."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import fill
from typing import TYPE_CHECKING

from scipy.stats import binom

from probmotion.comparison.measurements import LongerRun, Measured, measured
from probmotion.comparison.results.headline_metrics import (
    HEADLINE_METRICS,
    best_of,
    headline_metric,
    seed_values,
)

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["Advice", "Standing", "advise"]

_WIDTH = 100  # line width of printed advice
# A tied sampler is preferred to the best one if it takes less than this fraction of its time.
_CHEAPER = 0.5
# Probability that R-hat of independent draws exceeds its limit, and level of the test over seeds.
_LEVEL = 0.05
_WARNINGS: Sequence[tuple[str, float, float, str]] = (
    ("swd_ratio", 1 / 1.5, 1.5, "far from the references: swd ratio {:.3g}"),
    ("variance_ratio", 1 / 1.5, 1.5, "wrong spread: variance ratio {:.2g}"),
    ("off_manifold_ratio", 1 / 1.5, 1.5, "wrong off-manifold variance: ratio {:.2g}"),
    ("c2st", 0.0, 0.75, "a classifier separates it from the references: C2ST {:.2g}"),
    ("mode_proportions_tv", 0.0, 0.3, "wrong mode proportions: TV {:.2g}"),
)
"""Metric, acceptable range and warning."""


@dataclass(frozen=True)
class Standing:
    """Result of a sampler on a problem.

    Parameters
    ----------
    sampler : str
        Name of the sampler.
    value, spread : float
        Mean of the headline metric over seeds, and its standard deviation (NaN for one seed).
    seconds : float
        Mean time of a run, seconds.
    warnings : tuple of str
        Warnings about metrics outside their acceptable range, and about seeds without draws.
    """

    sampler: str
    value: float
    spread: float
    seconds: float
    warnings: tuple[str, ...] = ()

    def __str__(self) -> str:
        spread = f" ± {self.spread:.2g}" if math.isfinite(self.spread) else ""
        text = f"{self.sampler} {self.value:.3g}{spread} in {self.seconds:.2g} s"
        return f"{text} ({'; '.join(self.warnings)})" if self.warnings else text


@dataclass(frozen=True)
class Advice:
    """Recommended sampler for a problem, and the other samplers by group, best first.

    Parameters
    ----------
    problem, description : str
        Name and description of the problem.
    how : str
        Number of draws and seeds, budget and command of the measurements.
    metric : str
        Headline metric with its description.
    recommended : Standing
        Best of the tied samplers without warnings (of all tied samplers if all have warnings), or
        the fastest of them if it takes less than half the time of the best.
    tied : tuple of Standing
        Other samplers tied with the best, without warnings.
    tied_with_warnings : tuple of Standing
        Other samplers tied with the best, with warnings.
    worse : tuple of Standing
        Samplers that are significantly worse than the best.
    without_draws : dict of str
        One-word reason for missing draws, by sampler.
    longer : LongerRun, optional
        If the recommended sampler has warnings: the sampler that is right in the least time with a
        larger budget.
    """

    problem: str
    description: str
    how: str
    metric: str
    recommended: Standing
    tied: tuple[Standing, ...]
    tied_with_warnings: tuple[Standing, ...]
    worse: tuple[Standing, ...]
    without_draws: dict[str, str]
    longer: LongerRun | None

    def __str__(self) -> str:
        verdict = "no reliable sampler; best" if self.recommended.warnings else "recommended"
        lines = [
            f"{self.problem}: {self.description}",
            f"measured with: {self.how}",
            f"ranked by: {self.metric}",
            f"{verdict}: {self.recommended}",
            *([f"right with more time: {self.longer}"] if self.longer else []),
            f"on par: {_listed(self.tied)}",
            f"on par, with warnings: {_listed(self.tied_with_warnings)}",
            f"worse: {_listed(self.worse)}",
        ]
        if self.without_draws:
            words = ", ".join(f"{name} ({word})" for name, word in self.without_draws.items())
            lines.append(f"without draws: {words}")
        return "\n".join(fill(line, _WIDTH, subsequent_indent="  ") for line in lines)


def advise(problem: str, measurements: Measured | None = None) -> Advice:
    """Return the recommended sampler for a problem.

    Parameters
    ----------
    problem : str
        Name of a measured problem.
    measurements : Measured, optional
        Measurements; the shipped ones by default.

    Raises
    ------
    ValueError
        If the problem was not measured; use :func:`~probmotion.comparison.compare` for others.
    """
    measurements = measured() if measurements is None else measurements
    if problem not in measurements.problems:
        raise ValueError(
            f"problem must be one of {', '.join(measurements.problems)}, got {problem!r}; use "
            "probmotion compare for other problems"
        )
    rows = measurements.rows[measurements.rows["problem"] == problem]
    metric = headline_metric(rows)
    if metric is None:
        raise ValueError(f"problem must have a headline metric, got none for {problem!r}")
    values = {
        name: row
        for (name, _), row in seed_values(rows[rows["metric"] == metric]).items()
        if row.notna().any()
    }
    # Without a test, i.e. with a single sampler or seed, all samplers are tied.
    tied = best_of(metric, values, range(measurements.seeds))[1] or set(values)
    standings = [_standing(rows, name, metric, measurements) for name in values]
    standings.sort(key=lambda each: _error(metric, each.value))
    on_par = [each for each in standings if each.sampler in tied]
    best = _recommended(on_par)
    right = [run for run in measurements.longer if run.problem == problem and run.right]
    notes = "; ".join(measurements.notes)
    return Advice(
        problem,
        measurements.problems[problem],
        f"{measurements.draws} draws, {measurements.seeds} seeds, {notes} ({measurements.command})",
        f"{metric}, {HEADLINE_METRICS[metric]}",
        best,
        tuple(each for each in on_par if each != best and not each.warnings),
        tuple(each for each in on_par if each != best and each.warnings),
        tuple(each for each in standings if each.sampler not in tied),
        {
            name: measurements.words[f"{problem}/{name}"]
            for name in measurements.samplers
            if name not in values and f"{problem}/{name}" in measurements.words
        },
        min(right, key=lambda run: run.seconds, default=None) if best.warnings else None,
    )


def _recommended(on_par: Sequence[Standing]) -> Standing:
    """Return the recommended sampler among tied samplers sorted by error."""
    reliable = [each for each in on_par if not each.warnings] or list(on_par)
    cheapest = min(reliable, key=lambda each: each.seconds)
    return cheapest if cheapest.seconds < _CHEAPER * reliable[0].seconds else reliable[0]


def _error(metric: str, value: float) -> float:
    """Return the error of a value: its distance from the ideal value of the metric."""
    if metric != "swd_ratio":
        return value
    return abs(math.log(value)) if value > 0 else math.inf


def _standing(rows: pd.DataFrame, sampler: str, metric: str, measurements: Measured) -> Standing:
    metrics = rows[rows["sampler"] == sampler].groupby("metric")["value"]
    means = metrics.mean()
    warnings = [
        words.format(float(means[name]))
        for name, low, high, words in _WARNINGS
        if name in means.index and not low <= float(means[name]) <= high
    ]
    if "rhat" in means.index:
        warnings += _rhat_warning(metrics.get_group("rhat"), measurements.rhat_at_most)
    if (finished := int(metrics.count()[metric])) < measurements.seeds:
        warnings.append(f"draws at {finished} of {measurements.seeds} seeds")
    return Standing(
        sampler,
        float(means[metric]),
        float(metrics.std()[metric]),
        float(means["seconds"]),
        tuple(warnings),
    )


def _rhat_warning(rhat: pd.Series, at_most: float) -> list[str]:
    """Return a warning if R-hat exceeds its limit at significantly many seeds (binomial test)."""
    above, n = int((rhat > at_most).sum()), len(rhat)
    if above and binom.sf(above - 1, n, _LEVEL) <= _LEVEL:
        where = "" if above == n else f" at {above} of {n} seeds"
        return [f"chains disagree{where}: R-hat {float(rhat[rhat > at_most].mean()):.3g}"]
    return []


def _listed(standings: Sequence[Standing]) -> str:
    return "; ".join(map(str, standings)) or "none"
