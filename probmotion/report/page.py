"""HTML report of a comparison with tables, plots and animated draws.

The page is self-contained and opens offline.
"""

from __future__ import annotations

import base64
import io
import tempfile
from collections.abc import Callable, Mapping
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd

from probmotion.comparison.results.headline_metrics import headline_metric
from probmotion.comparison.results.table import ComparisonTable
from probmotion.files import written_whole
from probmotion.metrics.verdict import Verdict
from probmotion.plots.animation import animated_page
from probmotion.plots.motion_data import Shown
from probmotion.plots.quality import plot_quality_against_cost, quality_points
from probmotion.report.animations import BUDGET, animation, featured_problem, shown_problems
from probmotion.report.first_screen import first_screen
from probmotion.report.header import facts, heading, note_ids, notes, reading_guide
from probmotion.report.tables import Outcome, problem_tables

if TYPE_CHECKING:
    from probmotion.calibration.result import Calibration
    from probmotion.comparison.results.grid_results import GridResults

__all__ = ["write_report"]

_LEAST = BUDGET // 9
"""Minimum budget for motions in bytes, whatever the size of the figures."""


def write_report(
    comparison: GridResults, path: str | Path, calibration: Calibration | None = None
) -> Path:
    """Write the report of a comparison as one HTML page and return its path.

    Parameters
    ----------
    comparison : GridResults
        Results to report; unfinished runs are marked in the tables.
    path : str or Path
        HTML file to write.
    calibration : Calibration, optional
        Calibration of the same samplers, added as a table and a figure.

    Raises
    ------
    ValueError
        If the path does not end in ``.html``.
    OSError
        If the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".html":
        raise ValueError(f"path must end in .html, got {str(path)!r}")
    page = _page(comparison, calibration)
    with written_whole(path) as unfinished:
        unfinished.write_text(page, encoding="utf-8")
    return path


def _page(comparison: GridResults, calibration: Calibration | None) -> str:
    plan, table = comparison.plan, comparison.table()
    verdicts = comparison.verdicts()
    plots = {name: _quality_plot(table, name, verdicts[name]) for name in plan.problems}
    ranks = b"" if calibration is None or not calibration.ranked else _png(calibration.plot)
    size = len(ranks) + sum(map(len, plots.values()))
    shown = shown_problems(comparison, max(_LEAST, BUDGET - size))
    ids = note_ids(comparison)
    outcomes = {
        name: {sampler: _outcome(comparison, name, sampler, ids) for sampler in plan.samplers}
        for name in plan.problems
    }
    images = {name: _quality_image(name, plot) for name, plot in plots.items()}
    featured = images.pop(featured_problem(comparison))
    sections = [
        _section(comparison, table, name, i, each, outcomes[name], images.get(name, ""))
        for i, (name, each) in enumerate(zip(plan.problems, shown, strict=True))
    ]
    if calibration is not None:
        sections.append(_calibration(calibration, ranks))
    title = heading(comparison)
    body = f"""\
<main>
<header class="top">
<h1>{escape(title)}</h1>
{facts(comparison)}
</header>
{first_screen(comparison, verdicts, outcomes, featured)}
{chr(10).join(sections)}
{notes(comparison)}
{reading_guide(comparison, table)}
</main>"""
    functions = {"table": _text("tables.js"), "[data-does=copy]": _text("copy.js")}
    return animated_page(title, body, _text("page.css"), functions)


def _section(
    comparison: GridResults,
    table: ComparisonTable,
    name: str,
    place: int,
    shown: Shown | None,
    outcomes: Mapping[str, Outcome],
    image: str,
) -> str:
    draws = '<p class="quiet">No draws are available.</p>'
    if shown is not None:
        missing = {
            sampler: outcome.link()
            for sampler, outcome in outcomes.items()
            if outcome.failed == outcome.seeds
        }
        draws = animation(name, shown, place, missing)
    return f"""\
<section class="part" id="problem-{place}" aria-labelledby="problem-{place}-name">
<header><h2 id="problem-{place}-name">{escape(name)}</h2></header>
<p>{escape(comparison.plan.problems[name])}</p>
{problem_tables(table, name, list(outcomes), outcomes)}
{image}
<h3 id="skeletons-{place}">Draws on {escape(name)}</h3>
{draws}
</section>"""


def _outcome(
    comparison: GridResults, problem: str, sampler: str, ids: Mapping[tuple[str, str], str]
) -> Outcome:
    """Return the number of seeds without draws, and the reasons."""
    seeds = comparison.plan.seeds
    results = [r for r in comparison.results if (r.problem, r.sampler) == (problem, sampler)]
    failures = [result.failure for result in results if result.failure is not None]
    words = list(dict.fromkeys(failure.word for failure in failures))
    sentences = list(dict.fromkeys(failure.message for failure in failures))
    if missing := seeds - len(results):
        words.append("unfinished")
        sentences.append(f"{missing} of {seeds} seeds are not finished")
    return Outcome(
        word=", ".join(words),
        sentences="; ".join(sentences),
        note=ids.get((problem, sampler), "notes"),
        failed=len(failures) + missing,
        seeds=seeds,
        unsupported=bool(failures) and all(failure.unsupported for failure in failures),
    )


def _quality_plot(table: ComparisonTable, problem: str, verdicts: Mapping[str, Verdict]) -> bytes:
    """Return the plot of quality against cost as a PNG file; empty if no sampler has a point."""
    rows = pd.DataFrame(table[table["problem"] == problem])
    rows.attrs = table.attrs
    quality = headline_metric(rows)
    if quality is None or not quality_points(rows, quality):
        return b""
    judged = {problem: verdicts} if verdicts else None
    return _png(lambda path: plot_quality_against_cost(rows, path, verdicts=judged))


def _quality_image(problem: str, plot: bytes) -> str:
    return _image(plot, f"Quality against cost on {problem}; the tables contain the numbers.")


def _png(plot: Callable[[Path], object]) -> bytes:
    """Return a figure as a small PNG file."""
    from PIL import Image

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "figure.png"
        plot(path)
        with Image.open(path) as image:
            # A palette reduces the size to a third without visibly changing lines and bars.
            small = image.convert("RGB").quantize(256, dither=Image.Dither.NONE)
    encoded = io.BytesIO()
    small.save(encoded, "png")
    return encoded.getvalue()


def _image(png: bytes, description: str, kind: str = "plot") -> str:
    if not png:
        return ""
    encoded = base64.b64encode(png).decode("ascii")
    source = f"data:image/png;base64,{encoded}"
    return f'<img class="{kind}" src="{source}" alt="{escape(description)}">'


def _calibration(calibration: Calibration, figure: bytes) -> str:
    """Return the figure, if any, and the table of a calibration as HTML."""
    description = "Rank histograms and expected coverage; the numbers follow as text."
    shown = _image(figure, description, "plot calibration")
    if not figure:
        shown = "<p>No sampler has ranks; the table contains the reasons.</p>"
    return f"""\
<section class="part" id="calibration" aria-labelledby="calibration-name">
<header><h2 id="calibration-name">Calibration</h2></header>
<p>Truths are drawn from the prior and observations are simulated from them. For a calibrated
sampler the rank of a truth among the draws is uniform, and credible sets have nominal coverage.</p>
{shown}
<details><summary>Table</summary><pre tabindex="0">{escape(str(calibration.table()))}</pre>
</details>
</section>"""


def _text(name: str) -> str:
    return files("probmotion.report").joinpath(name).read_text(encoding="utf-8")
