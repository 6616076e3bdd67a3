"""What stands around the tables of a comparison's page: what was compared, how to read, notes."""

from __future__ import annotations

import json
from html import escape
from typing import TYPE_CHECKING

from probmotion.comparison.results.table import ComparisonTable

if TYPE_CHECKING:
    from probmotion.comparison.results.grid_results import GridResults

__all__ = ["contents", "facts", "note_ids", "notes", "reading"]


def facts(comparison: GridResults, table: ComparisonTable) -> str:
    """Return what was compared as a list in HTML: problems, samplers, numbers, versions."""
    plan = comparison.plan
    failed = len(comparison.failures)
    total = len(plan.problems) * len(plan.samplers) * plan.seeds
    cells = f"{len(comparison.results)} of {total} finished, {failed} of them without draws"
    entries = {
        "problems": ", ".join(plan.problems),
        "samplers": ", ".join(plan.samplers),
        "draws": f"{plan.draws} of every sampler, on {plan.chains} chain{'s' * (plan.chains != 1)}",
        "seeds": f"{plan.seeds}: numbers are mean ± standard deviation over them"
        if plan.seeds > 1
        else "1: there is no spread to judge a difference by",
        "cells": cells,
        "versions": _versions(comparison),
    }
    listed = "".join(
        f"<dt>{name}</dt><dd>{escape(words)}</dd>" for name, words in entries.items() if words
    )
    return f'<dl class="facts">{listed}</dl>'


def _versions(comparison: GridResults) -> str:
    """What the draws say they were made with; they all say the same, or are not reused."""
    for result in comparison.results:
        if result.failure is None:
            draws = comparison.draws(result.problem, result.sampler, result.seed)
            versions = json.loads(draws.dataset.attrs["versions"])
            return ", ".join(f"{name} {number}" for name, number in versions.items())
    return ""


def contents(comparison: GridResults, with_calibration: bool) -> str:
    """Return the links to all sections as HTML."""
    links = [(f"problem-{place}", name) for place, name in enumerate(comparison.plan.problems)]
    links += [("calibration", "calibration")] if with_calibration else []
    links.append(("notes", "notes"))
    items = "".join(f'<li><a href="#{where}">{escape(name)}</a></li>' for where, name in links)
    return f'<nav aria-label="Sections"><ul>{items}</ul></nav>'


def reading(comparison: GridResults, table: ComparisonTable) -> str:
    """Return how the measures and the skeletons are to be read, as HTML."""
    legends = "".join(f"<p>{escape(legend)}</p>" for legend in table.legends())
    marks = (
        "With one seed no sampler can be told from another, and none is marked."
        if comparison.plan.seeds == 1
        else "★ is the best of its column, of those with draws at every seed, ☆ cannot be told "
        "from it: 95 % intervals of the differences seed by seed, at Holm's levels, hold zero."
    )
    return f"""\
<details open><summary>How to read this page</summary>
{legends}
<p>{marks}</p>
<p>A press on a table's head sorts by it, least first, then greatest first. –: does not apply, or
was not measured. A word in place of numbers says why there are none; it leads to the notes.</p>
<p id="keys">Skeletons of one problem play and turn together. Drag them, or click on them and use
the keys: <kbd>space</kbd> plays and stops, the arrow keys turn, <kbd>,</kbd> and <kbd>.</kbd> go
one frame back and forth, <kbd>Home</kbd> and <kbd>End</kbd> to the first and the last,
<kbd>c</kbd> to the camera's view and back.</p>
</details>"""


def note_ids(comparison: GridResults) -> dict[tuple[str, str], str]:
    """Return the id of the note on each problem and sampler that failed."""
    sentences = comparison.notes
    ids: dict[tuple[str, str], str] = {}
    for result in comparison.failures:
        assert result.failure is not None
        begins = f"{result.sampler} on {result.problem}: {result.failure.message}"
        for place, sentence in enumerate(sentences):
            if sentence.startswith(begins):
                ids.setdefault((result.problem, result.sampler), f"note-{place}")
    return ids


def notes(comparison: GridResults) -> str:
    """Return the sentences to read with the tables as HTML."""
    items = "".join(
        f'<li id="note-{place}">{escape(sentence)}</li>'
        for place, sentence in enumerate(comparison.notes)
    )
    listed = f'<ul class="notes">{items}</ul>' if items else "<p>There are none.</p>"
    return f"""\
<section id="notes" aria-labelledby="notes-name">
<header><h2 id="notes-name">Notes</h2></header>
{listed}
</section>"""
