"""The first table of a comparison's page: every sampler on every problem, by the main measure."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import TYPE_CHECKING

import pandas as pd

from probmotion.comparison.results.qualities import QUALITIES, best_of, first_quality
from probmotion.comparison.results.table import ComparisonTable
from probmotion.report.plots import marker
from probmotion.report.tables import Outcome, value_cell

if TYPE_CHECKING:
    from probmotion.comparison.results.grid_results import GridResults

__all__ = ["overview"]


def overview(
    comparison: GridResults, table: ComparisonTable, outcomes: Mapping[str, Mapping[str, Outcome]]
) -> str:
    """Return a table in HTML, problems down and samplers across; empty of a single problem.

    Parameters
    ----------
    comparison : GridResults
        What was drawn.
    table : ComparisonTable
        Its table.
    outcomes : mapping of mapping of Outcome
        By problem and sampler.
    """
    plan = comparison.plan
    if len(plan.problems) < 2:
        return ""
    heads = "".join(
        f'<th scope="col"><svg viewBox="-8 -8 16 16" width="12" height="12" aria-hidden="true">'
        f"{marker(place)}</svg> {escape(sampler)}</th>"
        for place, sampler in enumerate(plan.samplers)
    )
    body = "\n".join(
        _row(table, name, place, outcomes[name]) for place, name in enumerate(plan.problems)
    )
    used = {_quality(table, name) for name in plan.problems} & set(QUALITIES)
    legend = "; ".join(f"{name}: {words}" for name, words in QUALITIES.items() if name in used)
    return f"""\
<div class="scroll" tabindex="0" role="region" aria-label="overview"><table class="overview">
<caption>every sampler on every problem, by the first of its measures</caption>
<thead><tr><th scope="col">problem</th><th scope="col">measure</th>{heads}</tr></thead>
<tbody>
{body}
</tbody></table></div>
<p class="quiet">{escape(legend)}</p>"""


def _quality(table: ComparisonTable, problem: str) -> str:
    """Return the measure that says most; a dash where none is there."""
    return first_quality(pd.DataFrame(table[table["problem"] == problem])) or "–"


def _row(table: ComparisonTable, problem: str, place: int, outcomes: Mapping[str, Outcome]) -> str:
    quality = _quality(table, problem)
    rows = table[(table["problem"] == problem) & (table["metric"] == quality)]
    values = {
        str(name): cells.set_index("seed")["value"]
        for name, cells in rows.groupby("sampler", sort=False)
    }
    best = best_of(quality, values, range(max(outcome.seeds for outcome in outcomes.values())))
    cells = "".join(
        f'<td class="failed">{outcome.link()}</td>'
        if outcome.failed == outcome.seeds
        else value_cell(values.get(sampler), sampler, best)
        for sampler, outcome in outcomes.items()
    )
    link = f'<a href="#problem-{place}">{escape(problem)}</a>'
    return f'<tr><th scope="row">{link}</th><td>{escape(quality)}</td>{cells}</tr>'
