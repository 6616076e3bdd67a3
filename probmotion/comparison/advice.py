"""Advice for one problem: which sampler, how wrong it is, and what is wrong with the others."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import fill
from typing import TYPE_CHECKING

from scipy.stats import binom

from probmotion.comparison.measurements import Measured, measured
from probmotion.comparison.results.qualities import QUALITIES, best_of, first_quality

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["Advice", "Standing", "advise"]

_WIDTH = 100
# What is as good for less than this share of the best's time is what to take.
_CHEAPER = 0.5


@dataclass(frozen=True)
class Standing:
    """How a sampler fared.

    Parameters
    ----------
    sampler : str
        Its name.
    value, spread : float
        Mean and standard deviation over seeds of the measure that says most; the latter NaN of one.
    seconds : float
        Mean time of a cell.
    warnings : tuple of str
        What tells against it, with the figures; that some seeds have no draws is one.
    """

    sampler: str
    value: float
    spread: float
    seconds: float
    warnings: tuple[str, ...] = ()

    def __str__(self) -> str:
        spread = f" ± {self.spread:.2g}" if math.isfinite(self.spread) else ""
        told = f"{self.sampler} {self.value:.3g}{spread} in {self.seconds:.2g} s"
        return f"{told} ({'; '.join(self.warnings)})" if self.warnings else told


@dataclass(frozen=True)
class Advice:
    """Which sampler to take for a problem; ``print`` says it in sentences, each with its figure.

    Parameters
    ----------
    problem, description : str
        What it is.
    how : str
        What was measured, and how.
    measure : str
        The measure that the samplers are ranked by, in words.
    take : Standing
        Of the best and those that cannot be told from it: one that nothing tells against, if there
        is one; the nearest, or one that takes less than half as long.
    alike : tuple of Standing
        Others that cannot be told from the best and that nothing tells against, the nearest first.
    doubtful : tuple of Standing
        Those that this measure cannot tell from the best, but something tells against.
    worse : tuple of Standing
        Those that can, the nearest first.
    without : dict of str
        By sampler, why it has no draws, in a word.
    """

    problem: str
    description: str
    how: str
    measure: str
    take: Standing
    alike: tuple[Standing, ...]
    doubtful: tuple[Standing, ...]
    worse: tuple[Standing, ...]
    without: dict[str, str]

    def __str__(self) -> str:
        verdict = "none is right at this cost; nearest" if self.take.warnings else "take"
        lines = [
            f"{self.problem}: {self.description}",
            f"measured: {self.how}",
            f"ranked by: {self.measure}",
            f"{verdict}: {self.take}",
            f"as good, as far as can be told: {_listed(self.alike)}",
            f"not told from the best by this measure, but: {_listed(self.doubtful)}",
            f"worse: {_listed(self.worse)}",
        ]
        if self.without:
            words = ", ".join(f"{name} ({word})" for name, word in self.without.items())
            lines.append(f"without draws: {words}")
        return "\n".join(fill(line, _WIDTH, subsequent_indent="  ") for line in lines)


def advise(problem: str, found: Measured | None = None) -> Advice:
    """Return which sampler to take for a problem.

    Parameters
    ----------
    problem : str
        The name of one that was measured.
    found : Measured, optional
        Measurements; by default those that come with the package.

    Raises
    ------
    ValueError
        If the problem was not measured; the message lists those that were. Of a problem of one's
        own, :func:`~probmotion.comparison.compare` finds out.
    """
    found = measured() if found is None else found
    if problem not in found.problems:
        raise ValueError(
            f"problem is {problem!r}, expected one that was measured: {', '.join(found.problems)}; "
            "of others, probmotion compare finds out"
        )
    rows = found.rows[found.rows["problem"] == problem]
    quality = first_quality(rows)
    if quality is None:
        raise ValueError(f"problem is {problem!r}, of which no sampler has a quality")
    values = {
        str(name): cells.set_index("seed")["value"]
        for name, cells in rows[rows["metric"] == quality].groupby("sampler", sort=False)
        if cells["value"].notna().any()
    }
    # A single sampler has nobody to be compared with.
    tied = best_of(quality, values, range(found.seeds))[1] or set(values)
    standings = [_standing(rows, name, quality, found) for name in values]
    standings.sort(key=lambda each: _wrong(quality, each.value))
    alike = [each for each in standings if each.sampler in tied]
    take = _taken(alike)
    return Advice(
        problem,
        found.problems[problem],
        f"{found.draws} draws, {found.seeds} seeds, {'; '.join(found.notes)} ({found.command})",
        f"{quality}, {QUALITIES[quality]}",
        take,
        tuple(each for each in alike if each != take and not each.warnings),
        tuple(each for each in alike if each != take and each.warnings),
        tuple(each for each in standings if each.sampler not in tied),
        {
            name: found.words[f"{problem}/{name}"]
            for name in found.samplers
            if name not in values and f"{problem}/{name}" in found.words
        },
    )


def _taken(alike: Sequence[Standing]) -> Standing:
    """Return which of those that cannot be told apart to take, the nearest first."""
    sound = [each for each in alike if not each.warnings] or list(alike)
    cheapest = min(sound, key=lambda each: each.seconds)
    return cheapest if cheapest.seconds < _CHEAPER * sound[0].seconds else sound[0]


def _wrong(quality: str, value: float) -> float:
    """Return how far a value is from the right one, in the order that :func:`best_of` has."""
    if quality != "swd_ratio":
        return value
    return abs(math.log(value)) if value > 0 else math.inf


def _standing(rows: pd.DataFrame, sampler: str, quality: str, found: Measured) -> Standing:
    own = rows[rows["sampler"] == sampler].groupby("metric")["value"]
    means = own.mean()
    said = [
        words.format(float(means[metric]))
        for metric, low, high, words in _WARNINGS
        if metric in means.index and not low <= float(means[metric]) <= high
    ]
    if "rhat" in means.index:
        said += _apart(own.get_group("rhat"), found.rhat_at_most)
    if (there := int(own.count()[quality])) < found.seeds:
        said.append(f"draws at {there} of {found.seeds} seeds")
    return Standing(
        sampler,
        float(means[quality]),
        float(own.std()[quality]),
        float(means["seconds"]),
        tuple(said),
    )


def _apart(rhat: pd.Series, at_most: float) -> list[str]:
    """Return what R-hat tells against a sampler, a run at a time: the mean may hide some.

    Chains that have mixed are above the limit 5 times in 100: so many seeds are, by chance, in no
    more than 5 of 100 tables.
    """
    above, n = int((rhat > at_most).sum()), len(rhat)
    if above and binom.sf(above - 1, n, _BY_CHANCE) <= _BY_CHANCE:
        where = "" if above == n else f" at {above} of {n} seeds"
        return [f"chains do not agree{where}: R-hat {float(rhat[rhat > at_most].mean()):.3g}"]
    return []


_BY_CHANCE = 0.05

_WARNINGS: Sequence[tuple[str, float, float, str]] = (
    ("swd_ratio", 1 / 1.5, 1.5, "far from reference draws: swd {:.3g}"),
    ("variance_ratio", 1 / 1.5, 1.5, "spread wrong: trace of covariance {:.2g} of the references'"),
    (
        "off_manifold_ratio",
        1 / 1.5,
        1.5,
        "variance off the prior's manifold {:.2g} of the references'",
    ),
    ("c2st", 0.0, 0.75, "a classifier tells its draws from reference ones: C2ST {:.2g}"),
    ("mode_proportions_tv", 0.0, 0.3, "styles' shares wrong by {:.2g}"),
)
"""What tells against a sampler: a measure, within what it is right enough, and the words."""


def _listed(standings: Sequence[Standing]) -> str:
    return "; ".join(map(str, standings)) or "none"
