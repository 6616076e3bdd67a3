"""Figure of the quality and cost of samplers, with a panel per problem."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from textwrap import fill, wrap
from typing import TYPE_CHECKING

import numpy as np

from probmotion.comparison.results.headline_metrics import HEADLINE_METRICS, headline_metric
from probmotion.plots.label_placement import Box, place_labels
from probmotion.plots.style import (
    INK,
    SIZE,
    SMALL,
    finish_figure,
    log_axis,
    paper_panels,
    plain_axes,
    sampler_style,
    title_axes,
    without_formulas,
)  # fmt: skip

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from probmotion.metrics.verdict import Verdict

__all__ = ["plot_quality_against_cost", "quality_points"]

_LETTERS = 36  # characters per line of axis labels
_MAX_UNLINKED_DISTANCE = 14  # maximum distance of labels without a line from their points, pixels

# Seconds and quality of a sampler's runs, (seeds,) each.
Point = tuple[np.ndarray, np.ndarray]


def plot_quality_against_cost(
    table: pd.DataFrame,
    path: str | Path | None = None,
    *,
    verdicts: Mapping[str, Mapping[str, Verdict]] | None = None,
) -> Figure:
    """Return a figure of the headline metric against seconds on logarithmic axes.

    A point is the mean over seeds, with error bars from minimum to maximum. Samplers without a
    point are listed below the panel with the reason.

    Parameters
    ----------
    table : DataFrame
        Columns problem, sampler, seed, metric, value, as returned by :meth:`Comparison.table`.
    path : str or Path, optional
        File to write: .png, .pdf or .svg.
    verdicts : mapping of mapping of Verdict, optional
        Verdicts by problem and sampler, as returned by :meth:`Comparison.verdicts`. Markers of
        samplers that are right are filled and all others open; by default all are filled.

    Raises
    ------
    ValueError
        If no sampler has a positive headline metric and positive seconds.
    """
    quality = headline_metric(table)
    problems = [str(name) for name in dict.fromkeys(table["problem"])]
    points: dict[str, dict[str, Point]] = {
        problem: quality_points(table[table["problem"] == problem], quality) if quality else {}
        for problem in problems
    }
    if quality is None or not any(points.values()):
        raise ValueError("table must have a sampler with a headline metric and seconds, got none")
    draws = table.attrs.get("draws")
    figure, panels = paper_panels(len(problems), 3.0)
    for panel, problem in zip(panels, problems, strict=True):
        shown = points[problem]
        judged = {} if verdicts is None else verdicts.get(problem, {})
        filled = {
            name for name in shown if verdicts is None or (name in judged and judged[name].is_right)
        }
        _draw_panel(panel, shown, filled)
        title_axes(panel, problem, weight="bold")
        if quality == "swd_ratio" and shown:
            panel.axhline(1.0, color=INK, linewidth=0.8, linestyle=(0, (4, 3)), zorder=1)
        cost = "seconds" if draws is None else f"seconds for {draws} draws"
        panel.set_xlabel("\n".join([cost, *_missing(table, problem, shown)]))
        plain_axes(panel, grid="both")
    for panel in panels[::2]:
        panel.set_ylabel(fill(HEADLINE_METRICS[quality], _LETTERS))
    if verdicts is not None:
        figure.supxlabel("filled: verdict right; open: other verdicts", size=SIZE, color=INK)
    # Label positions depend on the layout.
    without_formulas(figure)
    figure.draw_without_rendering()
    for panel, problem in zip(panels, problems, strict=True):
        _label_points(panel, points[problem])
    return finish_figure(figure, path)


def quality_points(rows: pd.DataFrame, quality: str) -> dict[str, Point]:
    """Return seconds and quality by sampler, over the seeds with positive values of both."""
    points = {}
    rows = rows[rows["metric"].isin([quality, "seconds"])]
    for sampler, group in rows.groupby("sampler", sort=False):
        wide = group.pivot(index="seed", columns="metric", values="value")
        wide = wide.reindex(columns=["seconds", quality]).dropna().astype(float)
        wide = wide[(wide > 0).all(axis=1) & np.isfinite(wide).all(axis=1)]
        if len(wide):
            points[str(sampler)] = (wide["seconds"].to_numpy(), wide[quality].to_numpy())
    return points


def _missing(table: pd.DataFrame, problem: str, points: Mapping[str, Point]) -> list[str]:
    """Return lines that list the samplers without a point, with the reasons."""
    words = table.attrs.get("words", {})
    rows = table[table["problem"] == problem]
    reasons = []
    for sampler, group in rows.groupby("sampler", sort=False):
        if sampler not in points:
            reason = group["metric"].iloc[0] if len(group) == 1 else "not measured"
            reasons.append(f"{sampler} ({words.get(f'{problem}/{sampler}', reason)})")
    return wrap(f"no point: {', '.join(reasons)}", _LETTERS) if reasons else []


def _draw_panel(axes: Axes, points: Mapping[str, Point], filled: Collection[str]) -> None:
    if not points:
        axes.set(xticks=[], yticks=[])
        return
    for name, (cost, quality) in points.items():
        style = sampler_style(name)
        axes.errorbar(
            [cost.mean()], [quality.mean()], xerr=_bar(cost), yerr=_bar(quality),
            fmt=style.marker, color=style.colour, markersize=5.5,
            markerfacecolor=style.colour if name in filled else "white",
            markeredgewidth=1.1, elinewidth=1.1, capsize=2, zorder=3,
        )  # fmt: skip
    spans = [np.concatenate(values) for values in zip(*points.values(), strict=True)]
    axes.set_xlim(log_axis(axes.xaxis, spans[0]))
    # Enforce a minimum range, so that small differences do not look large.
    axes.set_ylim(log_axis(axes.yaxis, np.append(spans[1], [0.9, 2.0])))


def _bar(values: np.ndarray) -> np.ndarray:
    """Return the distances of minimum and maximum from the mean, (2, 1)."""
    distances = [[values.mean() - values.min()], [values.max() - values.mean()]]
    return np.maximum(distances, 0.0)


def _label_points(axes: Axes, points: Mapping[str, Point]) -> None:
    """Write the sampler's name beside each point."""
    from matplotlib.patheffects import withStroke

    markers = {name: _marker_box(axes, point) for name, point in points.items()}
    texts, sizes = {}, {}
    for name in markers:
        text = axes.text(
            0, 0, name, size=SMALL, color=sampler_style(name).colour, ha="center", va="center",
            parse_math=False,
        )  # fmt: skip
        text.set_path_effects([withStroke(linewidth=2, foreground="white")])
        extent = text.get_window_extent()
        texts[name], sizes[name] = text, (extent.width, extent.height)
    room = (axes.bbox.x0, axes.bbox.y0, axes.bbox.x1, axes.bbox.y1)
    to_data = axes.transData.inverted()
    for name, (box, needs_line) in place_labels(markers, sizes, room).items():
        texts[name].set_position(tuple(to_data.transform(_middle(box))))
        x, y = _middle(markers[name])
        nearest = min(max(x, box[0]), box[2]), min(max(y, box[1]), box[3])
        if needs_line or np.hypot(nearest[0] - x, nearest[1] - y) > _MAX_UNLINKED_DISTANCE:
            axes.plot(
                *to_data.transform([(x, y), nearest]).T,
                color=sampler_style(name).colour,
                linewidth=0.5,
                zorder=1,
            )


def _marker_box(axes: Axes, point: Point) -> Box:
    """Return the box of a point's marker and error bars in pixels."""
    cost, quality = point
    corners = [(cost.min(), quality.min()), (cost.max(), quality.max())]
    (left, bottom), (right, top) = axes.transData.transform(corners)
    return left - 5, bottom - 5, right + 5, top + 5


def _middle(box: Box) -> tuple[float, float]:
    return 0.5 * (box[0] + box[2]), 0.5 * (box[1] + box[3])
