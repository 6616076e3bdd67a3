"""Header, reading guide and notes of the report."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING

from probmotion.comparison.results.table import ComparisonTable

if TYPE_CHECKING:
    from probmotion.comparison.results.grid_results import GridResults

__all__ = ["facts", "heading", "note_ids", "notes", "reading_guide"]

_MAX_NAMED = 3  # Maximum number of problems in the title.
_PACKAGES = ("probmotion", "numpy", "torch")


def heading(comparison: GridResults) -> str:
    """Return the title of the report as text."""
    problems = list(comparison.plan.problems)
    is_short = len(problems) <= _MAX_NAMED
    return f"probmotion · {', '.join(problems) if is_short else f'{len(problems)} problems'}"


def facts(comparison: GridResults) -> str:
    """Return date, machine, budget, seeds, versions and command as an HTML list."""
    plan = comparison.plan
    total = len(plan.problems) * len(plan.samplers) * plan.seeds
    finished = len(comparison.results)
    chains = f" on {plan.chains} chains" if plan.chains > 1 else ""
    entries = [
        plan.date,
        plan.machine,
        f"{plan.draws} draws{chains}",
        plan.budget,
        "seed 0" if plan.seeds == 1 else f"seeds 0–{plan.seeds - 1}",
        ", ".join(f"{name} {plan.versions[name]}" for name in _PACKAGES if name in plan.versions),
        f"{finished} of {total} runs finished" if finished < total else "",
    ]
    items = "".join(f"<li>{escape(text)}</li>" for text in entries if text)
    if plan.command:
        items += (
            f'<li class="command"><code title="{escape(plan.command)}">{escape(plan.command)}'
            '</code> <button type="button" data-does="copy">copy</button></li>'
        )
    return f'<ul class="facts">{items}</ul>'


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
<details><summary>How to read this report</summary>
<p>A sampler is right (●) if every quantity is shown to lie within its tolerance of the reference
draws, wrong (▲) if one is shown to differ and its estimate is outside, and otherwise undecided (○).
Hover over a verdict, or select it, for the numbers. ✕: no draws; –: no reference draws, or not
supported.</p>
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
<section class="part" id="notes" aria-labelledby="notes-name">
<header><h2 id="notes-name">Notes</h2></header>
{listed}
</section>"""
