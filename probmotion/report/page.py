"""The page of a comparison: tables, quality against cost, and every sampler's draws that play.

One file that asks nothing of the network: what is in it can be put into a paper's supplement.
"""

from __future__ import annotations

import base64
import io
import tempfile
from collections.abc import Mapping
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

from probmotion.comparison.results.table import ComparisonTable
from probmotion.files import written_whole
from probmotion.plots.colours import CYCLE, LEFT, RIGHT
from probmotion.report.animations import BUDGET, players, shown_problems
from probmotion.report.header import contents, facts, note_ids, notes, reading
from probmotion.report.motions import Shown
from probmotion.report.overview import overview
from probmotion.report.plots import quality_against_cost
from probmotion.report.tables import Outcome, problem_tables

if TYPE_CHECKING:
    from probmotion.calibration.result import Calibration
    from probmotion.comparison.results.grid_results import GridResults

__all__ = ["write_report"]

_ON_DARK = (
    "#FFFFFF", "#5BB3E8", "#F58A4B", "#2FC79B", "#E39BC2", "#DDA92E", "#9CD0F5", "#C2A27E",
    "#A8A8A8",
)  # fmt: skip
"""The colours of CYCLE where paper is dark."""
_LEFT_ON_DARK, _RIGHT_ON_DARK = "#5BB3E8", "#F58A4B"
_LEAST = BUDGET // 9
"""Bytes that are left for motions however large a calibration's picture is."""


def write_report(
    comparison: GridResults, path: str | Path, calibration: Calibration | None = None
) -> Path:
    """Write a comparison as one HTML page and return where.

    Parameters
    ----------
    comparison : GridResults
        What was drawn; what is not finished is left out.
    path : str or Path
        Where to write, ``.html``.
    calibration : Calibration, optional
        Of the same samplers: its table and its plot are shown.

    Raises
    ------
    ValueError
        If the path does not end in ``.html``.
    OSError
        If the folder cannot be written to.
    """
    path = Path(path)
    if path.suffix.lower() != ".html":
        raise ValueError(f"path must be a name that ends in .html, got {str(path)!r}")
    page = _page(comparison, calibration)
    with written_whole(path) as unfinished:
        unfinished.write_text(page, encoding="utf-8")
    return path


def _page(comparison: GridResults, calibration: Calibration | None) -> str:
    plan, table = comparison.plan, comparison.table()
    picture = b"" if calibration is None or not calibration.ranked else _picture(calibration)
    shown = shown_problems(comparison, max(_LEAST, BUDGET - len(picture)))
    ids = note_ids(comparison)
    outcomes = {
        name: {sampler: _outcome(comparison, name, sampler, ids) for sampler in plan.samplers}
        for name in plan.problems
    }
    sections = [
        _section(comparison, table, name, place, shown.get(name), outcomes[name])
        for place, name in enumerate(plan.problems)
    ]
    if calibration is not None:
        sections.append(_calibration(calibration, picture))
    count = len(plan.samplers), len(plan.problems)
    title = " on ".join(
        f"{n} {kind}{'s' * (n != 1)}" for n, kind in zip(count, ("sampler", "problem"), strict=True)
    )
    # What the page may load: nothing.
    policy = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; "
    policy += "script-src 'unsafe-inline'"
    return f"""\
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title} — a comparison</title>
<style>
{_text("page.css")}{_colours()}</style>
</head>
<body>
<main>
<h1>{title}</h1>
{facts(comparison, table)}
{contents(comparison, calibration is not None)}
{reading(comparison, table)}
{overview(comparison, table, outcomes)}
{chr(10).join(sections)}
{notes(comparison)}
</main>
<script>
document.querySelectorAll("table").forEach({_text("tables.js")});
document.querySelectorAll(".player").forEach({_text("animations.js")});
</script>
</body>
</html>
"""


def _section(
    comparison: GridResults,
    table: ComparisonTable,
    name: str,
    place: int,
    shown: Shown | None,
    outcomes: Mapping[str, Outcome],
) -> str:
    samplers = list(comparison.plan.samplers)
    words = {sampler: outcomes[sampler].word for sampler in samplers}
    seen = '<p class="quiet">No sampler drew from it: there is nothing to be seen.</p>'
    if shown is not None:
        missing = {
            sampler: outcome.link()
            for sampler, outcome in outcomes.items()
            if outcome.failed == outcome.seeds
        }
        seen = players(name, shown, place, missing)
    return f"""\
<section id="problem-{place}" aria-labelledby="problem-{place}-name">
<header><h2 id="problem-{place}-name">{escape(name)}</h2></header>
<p>{escape(comparison.plan.problems[name])}</p>
{problem_tables(table, name, samplers, outcomes)}
{quality_against_cost(table, name, words, place)}
<h3 id="skeletons-{place}">Draws on {escape(name)}</h3>
{seen}
</section>"""


def _outcome(
    comparison: GridResults, problem: str, sampler: str, ids: Mapping[tuple[str, str], str]
) -> Outcome:
    """How a sampler fared: a cell that is not there was not run."""
    seeds = comparison.plan.seeds
    found = [r for r in comparison.results if (r.problem, r.sampler) == (problem, sampler)]
    failures = [result.failure for result in found if result.failure is not None]
    words = list(dict.fromkeys(failure.word for failure in failures))
    sentences = list(dict.fromkeys(failure.message for failure in failures))
    if missing := seeds - len(found):
        words.append("unfinished")
        sentences.append(f"{missing} of {seeds} seeds are not finished")
    return Outcome(
        word=", ".join(words),
        sentences="; ".join(sentences),
        note=ids.get((problem, sampler), "notes"),
        failed=len(failures) + missing,
        seeds=seeds,
    )


def _picture(calibration: Calibration) -> bytes:
    """Return the plot of a calibration as it is written for paper: PNG of as few bytes as serve."""
    from PIL import Image

    with tempfile.TemporaryDirectory() as folder:
        picture = Path(folder) / "calibration.png"
        calibration.plot(picture)
        with Image.open(picture) as drawn:
            # A palette takes a third of the bytes, and nobody sees it in lines and bars.
            few = drawn.convert("RGB").quantize(256, dither=Image.Dither.NONE)
    coded = io.BytesIO()
    few.save(coded, "png")
    return coded.getvalue()


def _calibration(calibration: Calibration, picture: bytes) -> str:
    """The plot, where there is one, and its numbers and verdicts as words."""
    coded = base64.b64encode(picture).decode("ascii")
    shown = (
        f"""<img class="calibration" src="data:image/png;base64,{coded}"
 alt="Rank histograms and expected coverage of each sampler; their numbers follow as text.">"""
        if picture
        else "<p>No sampler has ranks; why is said below.</p>"
    )
    return f"""\
<section id="calibration" aria-labelledby="calibration-name">
<header><h2 id="calibration-name">Calibration</h2></header>
<p>Truths are drawn from the prior and evidence from the truths: a truth's rank among an honest
sampler's draws is uniform, and its intervals hold the truth as often as they say.</p>
{shown}
<details><summary>The numbers</summary><pre tabindex="0">{escape(str(calibration.table()))}</pre>
</details>
</section>"""


def _colours() -> str:
    """The package's colours as properties, on light paper and on dark."""

    def properties(left: str, right: str, cycle: tuple[str, ...]) -> str:
        samplers = "".join(f"--sampler-{place}: {colour}; " for place, colour in enumerate(cycle))
        return f":root {{ --left: {left}; --right: {right}; {samplers}}}\n"

    classes = "".join(
        f".sampler-{place} {{ fill: var(--sampler-{place}); stroke: none; }}\n"
        f".bar.sampler-{place} {{ stroke: var(--sampler-{place}); stroke-width: 1.5; }}\n"
        for place in range(len(CYCLE))
    )
    dark = properties(_LEFT_ON_DARK, _RIGHT_ON_DARK, _ON_DARK)
    return (
        properties(LEFT, RIGHT, CYCLE)
        + f"@media screen and (prefers-color-scheme: dark) {{ {dark}}}\n"
        + classes
    )


def _text(name: str) -> str:
    return files("probmotion.report").joinpath(name).read_text(encoding="utf-8")
