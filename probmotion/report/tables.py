"""Sortable tables of a problem, one per group of metrics."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

import pandas as pd

from probmotion.comparison.results.headline_metrics import best_of, seed_values
from probmotion.comparison.results.table import BLOCKS, mean_and_sd
from probmotion.plots.style import sampler_style

__all__ = ["Outcome", "problem_tables", "sampler_name"]

_FAILURES = ("unsupported", "failed")  # Metrics that mark runs without draws.
_MARKERS = {
    "o": "M-5 0a5 5 0 1 0 10 0a5 5 0 1 0-10 0z",
    "s": "M-4.5-4.5h9v9h-9z",
    "D": "M0-6L6 0L0 6L-6 0z",
    "d": "M0-6L3.6 0L0 6L-3.6 0z",
    "*": "M0 -6.5L1.5 -2.1L6.2 -2L2.5 0.8L3.8 5.3L0 2.6L-3.8 5.3L-2.5 0.8L-6.2 -2L-1.5 -2.1z",
    "^": "M0-6L5.5 4.5h-11z",
    "v": "M0 6L5.5-4.5h-11z",
    "P": "M-2-6h4v4h4v4h-4v4h-4v-4h-4v-4h4z",
    "X": "M-5.5-3L-3-5.5L0-2.5L3-5.5L5.5-3L2.5 0L5.5 3L3 5.5L0 2.5L-3 5.5L-5.5 3L-2.5 0z",
    "p": "M0-6L5.7-1.9L3.5 4.9H-3.5L-5.7-1.9z",
    "<": "M-6 0L4.5-5.5v11z",
    ">": "M6 0L-4.5-5.5v11z",
    "8": "M-2.1-5.1h4.2l3 3v4.2l-3 3h-4.2l-3-3v-4.2z",
    "h": "M0 -5 4.33 -2.5 4.33 2.5 0 5 -4.33 2.5 -4.33 -2.5Z",
}
"""SVG paths of the markers of :func:`~probmotion.plots.style.sampler_style`."""


@dataclass(frozen=True)
class Outcome:
    """Number of seeds without draws of a sampler on a problem, and the reason.

    ``word`` is the short reason, ``sentences`` the long reason, and ``note`` the HTML id of the
    note with the reason. ``failed`` of the ``seeds`` runs have no draws; if ``unsupported``,
    because the sampler does not support the problem.
    """

    word: str = ""
    sentences: str = ""
    note: str = ""
    failed: int = 0
    seeds: int = 1
    unsupported: bool = False

    def link(self) -> str:
        """Return the word as a link to the note, with the sentences as its title."""
        title = escape(self.sentences)
        return f'<a href="#{self.note}" title="{title}">{escape(self.word)}</a>'


def problem_tables(
    table: pd.DataFrame, problem: str, samplers: Sequence[str], outcomes: Mapping[str, Outcome]
) -> str:
    """Return the tables of one problem as HTML, with further metrics in a collapsed table."""
    rows = table[(table["problem"] == problem) & ~table["metric"].isin(_FAILURES)]
    values = seed_values(rows)
    measured = list(dict.fromkeys(str(name) for name in rows["metric"]))
    draws = table.attrs.get("draws")
    parts, shown = [], {"seconds"}
    for title, columns in BLOCKS.items():
        headings = {name: words for name, words in columns.items() if name in measured}
        if set(headings) - {"seconds"}:
            shown |= set(headings)
            parts.append(_table(title, headings, samplers, values, outcomes, draws))
    others = {name: name for name in measured if name not in shown}
    if others:
        inside = _table("further metrics", others, samplers, values, outcomes, draws)
        parts.append(f"<details><summary>{len(others)} further metrics</summary>{inside}</details>")
    if not parts:
        parts.append(_table("no draws", {"seconds": "seconds"}, samplers, values, outcomes, draws))
    return "\n".join(parts)


def _table(
    title: str,
    headings: Mapping[str, str],
    samplers: Sequence[str],
    values: Mapping[tuple[str, str], pd.Series],
    outcomes: Mapping[str, Outcome],
    draws: int | None,
) -> str:
    seeds = range(max(outcome.seeds for outcome in outcomes.values()))
    best = {}
    for metric in headings:
        by_sampler = {name: values[name, metric] for name in samplers if (name, metric) in values}
        best[metric] = best_of(metric, by_sampler, seeds, {other for _, other in values}, draws)
    body = []
    for sampler in samplers:
        outcome = outcomes[sampler]
        partial = f" ({outcome.seeds - outcome.failed} of {outcome.seeds} seeds; {outcome.link()})"
        name = (
            f'<th scope="row" data-value="{escape(sampler)}">{sampler_name(sampler)}'
            f"{partial if 0 < outcome.failed < outcome.seeds else ''}</th>"
        )
        if outcome.failed == outcome.seeds:
            entries = f'<td class="failed" colspan="{len(headings)}">{outcome.link()}</td>'
        else:
            entries = "".join(
                _value(values.get((sampler, metric)), sampler, best[metric]) for metric in headings
            )
        body.append(f"<tr>{name}{entries}</tr>")
    row = "".join(
        f'<th scope="col"><button type="button" title="{escape(metric)} in table.csv">'
        f"{escape(words)}</button></th>"
        for metric, words in headings.items()
    )
    return f"""\
<div class="scroll" tabindex="0" role="region" aria-label="{escape(title)}"><table>
<caption>{escape(title)}</caption>
<thead><tr><th scope="col"><button type="button">sampler</button></th>{row}</tr></thead>
<tbody>
{chr(10).join(body)}
</tbody></table></div>"""


def sampler_name(sampler: str) -> str:
    """Return a sampler's marker and name as HTML."""
    style = sampler_style(sampler)
    return (
        '<svg class="marker" viewBox="-8 -8 16 16" width="12" height="12" aria-hidden="true">'
        f'<path fill="{style.colour}" d="{_MARKERS[style.marker]}"/></svg> {escape(sampler)}'
    )


def _value(values: pd.Series | None, sampler: str, best: tuple[str | None, set[str]]) -> str:
    """Return the values of a metric as an HTML cell, highlighted if best or tied with the best."""
    if values is None:
        return '<td><span class="quiet" title="not applicable or not measured">–</span></td>'
    text = mean_and_sd(values)
    each = "; ".join(f"seed {seed}: {value:.6g}" for seed, value in values.items())
    mean = float(values.mean())
    sortable = f' data-value="{mean:.8g}"' if math.isfinite(mean) else ""
    kind = ""
    if sampler == best[0]:
        kind, text = ' class="best"', text + '<span class="highlight" title="best">★</span>'
    elif sampler in best[1]:
        kind, text = (
            ' class="tied"',
            f'{text}<span class="highlight" title="tied with the best">☆</span>',
        )
    return f'<td{kind}{sortable} title="{each}">{text}</td>'
