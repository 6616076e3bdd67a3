"""The tables of a comparison's page: one per problem and kind of measure, to be sorted."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING

from probmotion.comparison.results.qualities import best_of
from probmotion.comparison.results.table import _BLOCKS, _mean_and_sd
from probmotion.report.plots import marker

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["Outcome", "problem_tables", "value_cell"]

_FAILURES = ("unsupported", "failed")


@dataclass(frozen=True)
class Outcome:
    """How a sampler fared on a problem, beside its numbers.

    Parameters
    ----------
    word : str
        Why it has no draws, at one seed or more; empty where it has them all.
    sentences : str
        The same, in full.
    note : str
        Where the page says so: an id.
    failed, seeds : int
        Seeds without draws, and all seeds.
    """

    word: str = ""
    sentences: str = ""
    note: str = ""
    failed: int = 0
    seeds: int = 1

    def link(self) -> str:
        """Return the word as HTML: the sentence as its title, and a way to the note."""
        said = escape(self.sentences)
        return f'<a href="#{self.note}" title="{said}">{escape(self.word)}</a>'


def problem_tables(
    table: pd.DataFrame,
    problem: str,
    samplers: Sequence[str],
    outcomes: Mapping[str, Outcome],
) -> str:
    """Return one problem's tables as HTML; measures of no kind are in one that is folded.

    Parameters
    ----------
    table : DataFrame
        Columns problem, sampler, seed, metric, value.
    problem : str
        Its name.
    samplers : sequence of str
        All of the comparison's, in order.
    outcomes : mapping of Outcome
        By sampler.
    """
    rows = table[(table["problem"] == problem) & ~table["metric"].isin(_FAILURES)]
    values = {
        (str(sampler), str(metric)): cells.set_index("seed")["value"]
        for (sampler, metric), cells in rows.groupby(["sampler", "metric"], sort=False)
    }
    measured = list(dict.fromkeys(str(name) for name in rows["metric"]))
    draws = table.attrs.get("draws")
    parts, shown = [], {"seconds"}
    for title, columns in _BLOCKS:
        heads = {name: words for name, words in columns.items() if name in measured}
        if set(heads) - {"seconds"}:
            shown |= set(heads)
            parts.append(_table(title, heads, samplers, values, outcomes, draws))
    others = {name: name for name in measured if name not in shown}
    if others:
        inside = _table("further measures", others, samplers, values, outcomes, draws)
        parts.append(
            f"<details><summary>{len(others)} further measures</summary>{inside}</details>"
        )
    if not parts:
        parts.append(_table("no draws", {"seconds": "seconds"}, samplers, values, outcomes, draws))
    return "\n".join(parts)


def _table(
    title: str,
    heads: Mapping[str, str],
    samplers: Sequence[str],
    values: Mapping[tuple[str, str], pd.Series],
    outcomes: Mapping[str, Outcome],
    draws: int | None,
) -> str:
    seeds = range(max(outcome.seeds for outcome in outcomes.values()))
    best = {}
    for metric in heads:
        found = {name: values[name, metric] for name in samplers if (name, metric) in values}
        best[metric] = best_of(metric, found, seeds, {other for _, other in values}, draws)
    body = []
    for place, sampler in enumerate(samplers):
        outcome = outcomes[sampler]
        some = f" ({outcome.seeds - outcome.failed} of {outcome.seeds} seeds; {outcome.link()})"
        name = (
            f'<th scope="row" data-value="{escape(sampler)}">'
            f'<svg viewBox="-8 -8 16 16" width="12" height="12" aria-hidden="true">{marker(place)}'
            f"</svg> {escape(sampler)}{some if 0 < outcome.failed < outcome.seeds else ''}</th>"
        )
        if outcome.failed == outcome.seeds:
            cells = f'<td class="failed" colspan="{len(heads)}">{outcome.link()}</td>'
        else:
            cells = "".join(
                value_cell(values.get((sampler, metric)), sampler, best[metric]) for metric in heads
            )
        body.append(f"<tr>{name}{cells}</tr>")
    row = "".join(
        f'<th scope="col"><button type="button" title="{escape(metric)} in table.csv">'
        f"{escape(words)}</button></th>"
        for metric, words in heads.items()
    )
    return f"""\
<div class="scroll" tabindex="0" role="region" aria-label="{escape(title)}"><table>
<caption>{escape(title)}</caption>
<thead><tr><th scope="col"><button type="button">sampler</button></th>{row}</tr></thead>
<tbody>
{chr(10).join(body)}
</tbody></table></div>"""


def value_cell(values: pd.Series | None, sampler: str, best: tuple[str | None, set[str]]) -> str:
    """Return a sampler's number as a cell in HTML, marked where it is the best or tied with it."""
    if values is None:
        return '<td><span class="quiet" title="does not apply, or was not measured">–</span></td>'
    text = _mean_and_sd(values)
    each = "; ".join(f"seed {seed}: {value:.6g}" for seed, value in values.items())
    mean = float(values.mean())
    sortable = f' data-value="{mean:.8g}"' if math.isfinite(mean) else ""
    kind = ""
    if sampler == best[0]:
        kind, text = ' class="best"', f'{text}<span class="mark" title="best">★</span>'
    elif sampler in best[1]:
        kind = ' class="tied"'
        text = f'{text}<span class="mark" title="not to be told from the best">☆</span>'
    return f'<td{kind}{sortable} title="{each}">{text}</td>'
