"""Summary of a comparison: a sentence per problem and a table of verdicts."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from textwrap import fill, shorten
from typing import Protocol

import numpy as np

from probmotion.comparison.results.failures import NOT_INSTALLED
from probmotion.comparison.results.headline_metrics import HEADLINE_METRICS
from probmotion.comparison.results.plan import Plan
from probmotion.comparison.results.run_results import RunResult
from probmotion.metrics.verdict import Verdict

__all__ = ["problem_sentence", "summary", "verdict_text"]

_WIDTH = 100
_MAX_COLUMNS = 6
_MAX_REASONS = 2  # maximum number of failure reasons in a summary
# Predicates of one sampler and of several, by word of a verdict; others follow "is" and "are".
_PREDICATES: Mapping[str, tuple[str, str]] = {
    "misses modes": ("misses modes", "miss modes"),
    "differs": ("differs from the references", "differ from the references"),
    "not mixed": ("has not mixed", "have not mixed"),
    "failed": ("failed", "failed"),
}


class Judged(Protocol):
    """Results of a grid with verdicts."""

    plan: Plan
    results: list[RunResult]

    def verdict(self, problem: str, sampler: str) -> Verdict | None:
        """Return the verdict on a sampler; None without reference draws."""


def summary(results: Judged) -> str:
    """Return a sentence per problem, a table of at most six columns, failures and the setup.

    With more problems than columns there is no table.
    """
    if not results.results:
        return "no finished runs"
    sentences = []
    for problem in results.plan.problems:
        sentence = problem_sentence(results, problem)
        text = f"{problem}: {sentence[0].lower()}{sentence[1:]}"
        sentences.append(fill(text, _WIDTH, subsequent_indent="  ", break_on_hyphens=False))
    below = "\n".join([*_reasons(results), _setup(results)])
    parts = ["\n".join(sentences), _table(results), below]
    return "\n\n".join(part for part in parts if part)


def problem_sentence(results: Judged, problem: str) -> str:
    """Return which sampler to take for a problem, and what is wrong with the others.

    Samplers with the same fault are grouped, in the order of the comparison.
    """
    runs = _runs(results, problem)
    verdicts = {name: results.verdict(problem, name) for name in runs}
    judged = {name: verdict for name, verdict in verdicts.items() if verdict is not None}
    drawn = {name for name in runs if judged.get(name) is None or judged[name].word != "failed"}
    if not drawn:
        return "No sampler has draws."
    if not drawn & set(judged):
        return " ".join(["No verdicts without reference draws.", *_best_headline(runs)])
    right = sorted(
        (name for name, verdict in judged.items() if verdict.is_right),
        key=lambda name: _means(runs, "seconds").get(name) or math.inf,
    )
    # Exact draws exist for few posteriors, so another sampler is named as well.
    recommended = right[:2] if right[:1] == ["exact"] else right[:1]
    wrong = {
        name: verdict
        for name, verdict in judged.items()
        if verdict.is_wrong and not _is_unsupported(runs[name])
    }
    undecided = {name: verdict for name, verdict in judged.items() if verdict.word == "undecided"}
    parts = []
    if recommended:
        times = {name: f" in {time}" if (time := _time(runs[name])) else "" for name in recommended}
        named = " or ".join(f"{name} (right{times[name]})" for name in recommended)
        parts.append(f"Take {named}.")
    elif undecided:
        parts.append(f"No sampler is shown to be right: {_undecided_clause(undecided)}.")
    else:
        parts.append("No sampler is right.")
    if wrong:
        parts.append(f"{_faults(wrong)}.")
    if recommended and undecided:
        parts.append(f"{_undecided_clause(undecided)}.")
    return " ".join(parts)


def verdict_text(results: Judged, problem: str, sampler: str) -> str:
    """Return a verdict with its size, such as ``overconfident ×1.3``, or why there is none."""
    runs = [run for run in results.results if (run.problem, run.sampler) == (problem, sampler)]
    for run in runs:
        if run.failure is not None:
            return f"{'no draws' if run.failure.unsupported else 'failed'} ({run.failure.word})"
    verdict = results.verdict(problem, sampler)
    if verdict is None:
        return "no verdict" if runs else "not finished"
    return _short(verdict)


def _short(verdict: Verdict) -> str:
    if verdict.word in ("overconfident", "underconfident", "biased"):
        return verdict.sentence.split(" and ")[0]
    return verdict.word


def _undecided_clause(undecided: Mapping[str, Verdict]) -> str:
    """Return at how many draws samplers are undecided, and how many would decide."""
    sizes = [each.n for each in undecided.values()]
    sentences = " ".join(each.sentence for each in undecided.values())
    needed = [int(n.replace(",", "")) for n in re.findall(r"about ([\d,]+) would", sentences)]
    would = f" (about {_range(needed)} would decide)" if needed else ""
    verb = "is" if len(undecided) == 1 else "are"
    return f"{_listed(undecided)} {verb} undecided at {_range(sizes)} draws{would}"


def _faults(wrong: Mapping[str, Verdict]) -> str:
    """Return the worst faults, with samplers of the same fault together."""
    groups: dict[str, list[str]] = {}
    for name, verdict in wrong.items():
        groups.setdefault(verdict.word, []).append(name)
    clauses = []
    for word, names in groups.items():
        texts = dict.fromkeys(_short(wrong[name]) for name in names)
        one, several = _PREDICATES.get(
            word, (f"is {_merged(list(texts))}", f"are {_merged(list(texts))}")
        )
        clauses.append(f"{_listed(names)} {one if len(names) == 1 else several}")
    return "; ".join(clauses)


def _merged(texts: Sequence[str]) -> str:
    """Return texts that differ in one number as a text with the range of the numbers."""
    number = r"\d[\d.]*(?:e[+-]?\d+)?"
    numbers = sorted((each for text in texts for each in re.findall(number, text)), key=float)
    return re.sub(number, f"{numbers[0]}–{numbers[-1]}", texts[0]) if len(texts) > 1 else texts[0]


def _is_unsupported(runs: Sequence[RunResult]) -> bool:
    return any(run.failure is not None and run.failure.unsupported for run in runs)


def _best_headline(runs: Mapping[str, Sequence[RunResult]]) -> list[str]:
    """Return the lowest headline metric of a problem without reference draws, if any."""
    for metric, description in HEADLINE_METRICS.items():
        values = _means(runs, metric)
        if values:
            best = min(values, key=values.__getitem__)
            return [f"Lowest {description}: {best}, {values[best]:.3g} in {_time(runs[best])}."]
    return []


def _table(results: Judged) -> str:
    """Return the verdicts by sampler and problem, with seconds if there is space; may be empty."""
    problems, samplers = list(results.plan.problems), list(results.plan.samplers)
    with_seconds = 1 + 2 * len(problems) <= _MAX_COLUMNS
    columns = [["sampler", *samplers]]
    for problem in problems:
        runs = _runs(results, problem)
        columns.append([problem, *(verdict_text(results, problem, s) for s in samplers)])
        if with_seconds:
            times = [_time(runs[name]) if name in runs else "" for name in samplers]
            columns.append(["seconds", *(time.removesuffix(" s") for time in times)])
    if len(columns) > _MAX_COLUMNS:
        return ""
    widths = [max(map(len, column)) for column in columns]
    lines = []
    for row in zip(*columns, strict=True):
        cells = [
            entry.rjust(width) if columns[n][0] == "seconds" else entry.ljust(width)
            for n, (entry, width) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines) if max(map(len, lines)) <= _WIDTH else ""


def _setup(results: Judged) -> str:
    """Return draws, budget and seeds."""
    plan = results.plan
    budget = f", {plan.budget}" if plan.budget else ""
    return f"{plan.draws} draws{budget}, {plan.seeds} seed{'s' * (plan.seeds > 1)}"


def _reasons(results: Judged) -> Iterator[str]:
    """Yield a line for each failure, apart from samplers that do not support a problem."""
    failed: dict[tuple[str, str], dict[str, None]] = {}
    for run in results.results:
        if run.failure is not None and not run.failure.unsupported:
            # Libraries are missing on every problem.
            where = "" if run.failure.word == NOT_INSTALLED else f" on {run.problem}"
            failed.setdefault((where, run.failure.message), {})[run.sampler] = None
    for (where, message), samplers in list(failed.items())[:_MAX_REASONS]:
        yield shorten(f"{_listed(samplers)}{where}: {message}", _WIDTH, placeholder=" …")
    if len(failed) > _MAX_REASONS:
        yield f"and {len(failed) - _MAX_REASONS} more failures, see failures.json"


def _runs(results: Judged, problem: str) -> dict[str, list[RunResult]]:
    """Return the finished runs of a problem by sampler, in the order of the plan."""
    runs: dict[str, list[RunResult]] = {name: [] for name in results.plan.samplers}
    for run in results.results:
        if run.problem == problem:
            runs[run.sampler].append(run)
    return {name: each for name, each in runs.items() if each}


def _means(runs: Mapping[str, Sequence[RunResult]], metric: str) -> dict[str, float]:
    """Return the mean of a metric over seeds by sampler, where it is finite."""
    values = {
        name: np.mean([run.metrics[metric] for run in each if metric in run.metrics])
        for name, each in runs.items()
        if any(metric in run.metrics for run in each)
    }
    return {name: float(value) for name, value in values.items() if np.isfinite(value)}


def _time(runs: Sequence[RunResult]) -> str:
    """Return the mean time of a run with its unit; empty if it is unknown, as of an array."""
    seconds = _means({"": runs}, "seconds").get("")
    if not seconds:
        return ""
    return f"{seconds:.0f} s" if seconds >= 10 else f"{seconds:.{1 + (seconds >= 1)}g} s"


def _range(numbers: Sequence[int]) -> str:
    low, high = min(numbers), max(numbers)
    return f"{low}" if low == high else f"{low}–{high}"


def _listed(names: Iterable[str]) -> str:
    """Return names joined by commas and a last "and"."""
    *first, last = names
    return f"{', '.join(first)} and {last}" if first else last
