"""Header, reading guide and notes of the report."""

from __future__ import annotations

import json
from html import escape
from typing import TYPE_CHECKING

from probmotion.comparison.results.table import ComparisonTable

if TYPE_CHECKING:
    from probmotion.comparison.results.grid_results import GridResults

__all__ = ["contents", "facts", "note_ids", "notes", "reading_guide"]


def facts(comparison: GridResults) -> str:
    """Return problems, samplers, numbers of draws and library versions as an HTML list."""
    plan = comparison.plan
    failed = len(comparison.failures)
    total = len(plan.problems) * len(plan.samplers) * plan.seeds
    entries = {
        "problems": ", ".join(plan.problems),
        "samplers": ", ".join(plan.samplers),
        "draws": f"{plan.draws} per sampler, on {plan.chains} chain{'s' * (plan.chains != 1)}",
        "seeds": f"{plan.seeds}; numbers are mean ± standard deviation"
        if plan.seeds > 1
        else "1; without standard deviations",
        "runs": f"{len(comparison.results)} of {total} finished, {failed} of them without draws",
        "versions": _versions(comparison),
    }
    listed = "".join(
        f"<dt>{name}</dt><dd>{escape(text)}</dd>" for name, text in entries.items() if text
    )
    return f'<dl class="facts">{listed}</dl>'


def _versions(comparison: GridResults) -> str:
    """Return the library versions of the first draws; empty if every run failed."""
    for result in comparison.results:
        if result.failure is None:
            draws = comparison.draws(result.problem, result.sampler, result.seed)
            versions = json.loads(draws.dataset.attrs["versions"])
            return ", ".join(f"{name} {number}" for name, number in versions.items())
    return ""


def contents(comparison: GridResults, with_calibration: bool) -> str:
    """Return links to all sections as HTML."""
    links = [(f"problem-{i}", name) for i, name in enumerate(comparison.plan.problems)]
    links += [("calibration", "calibration")] if with_calibration else []
    links.append(("notes", "notes"))
    items = "".join(f'<li><a href="#{anchor}">{escape(name)}</a></li>' for anchor, name in links)
    return f'<nav aria-label="Sections"><ul>{items}</ul></nav>'


def reading_guide(comparison: GridResults, table: ComparisonTable) -> str:
    """Return explanations of metrics, highlights and animation controls as HTML."""
    legends = "".join(f"<p>{escape(legend)}</p>" for legend in table.legends())
    highlights = (
        "With one seed no sampler can be distinguished from another, so none is highlighted."
        if comparison.plan.seeds == 1
        else "★ is the best of its column among samplers with draws at every seed; ☆ is "
        "statistically tied with it: Holm-corrected 95 % intervals of the paired differences "
        "over seeds contain 0."
    )
    return f"""\
<details open><summary>How to read this report</summary>
{legends}
<p>{highlights}</p>
<p>Click a column heading to sort by it, in ascending, then in descending order. –: not
applicable or not measured. Words instead of numbers link to the note with the reason.</p>
<p id="keys">All skeletons of a problem move and turn together. Drag them, or click on them and use
the keys: <kbd>space</kbd> plays and stops, the arrow keys turn, <kbd>,</kbd> and <kbd>.</kbd> step
one frame back or forward, <kbd>Home</kbd> and <kbd>End</kbd> jump to the first or last frame,
<kbd>c</kbd> switches the camera view on or off.</p>
</details>"""


def note_ids(comparison: GridResults) -> dict[tuple[str, str], str]:
    """Return the HTML ids of the notes on failures, by problem and sampler."""
    sentences = comparison.notes
    ids: dict[tuple[str, str], str] = {}
    for result in comparison.failures:
        assert result.failure is not None
        prefix = f"{result.sampler} on {result.problem}: {result.failure.message}"
        for i, sentence in enumerate(sentences):
            if sentence.startswith(prefix):
                ids.setdefault((result.problem, result.sampler), f"note-{i}")
    return ids


def notes(comparison: GridResults) -> str:
    """Return the section with the notes of the comparison as HTML."""
    items = "".join(
        f'<li id="note-{i}">{escape(sentence)}</li>' for i, sentence in enumerate(comparison.notes)
    )
    listed = f'<ul class="notes">{items}</ul>' if items else "<p>No notes.</p>"
    return f"""\
<section id="notes" aria-labelledby="notes-name">
<header><h2 id="notes-name">Notes</h2></header>
{listed}
</section>"""
