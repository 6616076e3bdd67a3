"""Figure of the quality and cost of samplers, with a panel per problem."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np

from probmotion.comparison.results.headline_metrics import HEADLINE_METRICS, headline_metric
from probmotion.plots.label_placement import Box, place_labels
from probmotion.plots.style import GREY, INK, finish_figure, plain_axes, style_of

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["plot_quality_against_cost", "quality_points"]

_LETTERS = 46  # characters per line of the vertical axis label

# Seconds and quality of a sampler's runs, (seeds,) each.
Point = tuple[np.ndarray, np.ndarray]
# Colour and marker of a sampler.
Style = tuple[str, str]


def plot_quality_against_cost(table: pd.DataFrame, path: str | Path | None = None) -> Figure:
    """Return a figure of the headline metric against seconds on logarithmic axes.

    A point is the mean over seeds, with error bars from minimum to maximum. Samplers without a
    point are listed above the panel with the reason.

    Parameters
    ----------
    table : DataFrame
        Columns problem, sampler, seed, metric, value, as returned by :meth:`Comparison.table`.
    path : str or Path, optional
        PNG file to write.

    Raises
    ------
    ValueError
        If no sampler has a positive headline metric and positive seconds.
    """
    from matplotlib.figure import Figure

    quality = headline_metric(table)
    problems = [str(name) for name in dict.fromkeys(table["problem"])]
    points: dict[str, dict[str, Point]] = {
        problem: quality_points(table[table["problem"] == problem], quality) if quality else {}
        for problem in problems
    }
    if quality is None or not any(points.values()):
        raise ValueError("table must have a sampler with a headline metric and seconds, got none")
    samplers = table.attrs.get("samplers") or [str(n) for n in dict.fromkeys(table["sampler"])]
    styles = {name: style_of(index) for index, name in enumerate(samplers)}
    columns = min(len(problems), 3)
    lines = -(-len(problems) // columns)
    figure = Figure(figsize=(0.5 + 4.2 * columns, 0.2 + 3.9 * lines), layout="constrained")
    panels = figure.subplots(lines, columns, squeeze=False).ravel()
    for panel, problem in zip(panels, problems, strict=False):
        _draw_panel(panel, problem, points[problem], styles)
        missing = "\n".join(_missing(table, problem, points[problem]))
        panel.set_title(missing, loc="right", size=8, color=INK)
        if quality == "swd_ratio" and points[problem]:
            panel.axhline(1.0, color=INK, linewidth=0.8, linestyle=(0, (4, 3)), zorder=1)
        panel.set_xlabel("seconds", color=INK)
    for panel in panels[len(problems) :]:
        panel.set_visible(False)
    for panel in panels[::columns]:
        panel.set_ylabel(fill(HEADLINE_METRICS[quality], _LETTERS), color=INK)
    # Label positions depend on the layout.
    figure.draw_without_rendering()
    for panel, problem in zip(panels, problems, strict=False):
        _label_points(panel, points[problem], styles)
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
    """Return a line per sampler without a point, with the reason."""
    words = table.attrs.get("words", {})
    rows = table[table["problem"] == problem]
    lines = []
    for sampler, group in rows.groupby("sampler", sort=False):
        if sampler not in points:
            reason = group["metric"].iloc[0] if len(group) == 1 else "not measured"
            lines.append(f"no point: {sampler} ({words.get(f'{problem}/{sampler}', reason)})")
    return lines


def _draw_panel(
    axes: Axes, problem: str, points: Mapping[str, Point], styles: Mapping[str, Style]
) -> None:
    axes.set_title(problem, loc="left", size=11, color=INK, weight="bold")
    plain_axes(axes, grid="both")
    if not points:
        axes.set(xticks=[], yticks=[])
        return
    for name, (cost, quality) in points.items():
        colour, marker = styles[name]
        x, y = cost.mean(), quality.mean()
        style: dict[str, Any] = {"color": colour, "linewidth": 1.4, "zorder": 2}
        axes.plot([cost.min(), cost.max()], [y, y], **style)
        axes.plot([x, x], [quality.min(), quality.max()], **style)
        axes.plot([x], [y], marker, color=colour, markersize=6.5, zorder=3, markeredgewidth=0)
    spans = [np.concatenate(values) for values in zip(*points.values(), strict=True)]
    axes.set(xscale="log", yscale="log")
    axes.set_xlim(_set_ticks(axes.xaxis, spans[0]))
    # Enforce a minimum range, so that small differences do not look large.
    axes.set_ylim(_set_ticks(axes.yaxis, np.append(spans[1], [0.9, 2.0])))


def _set_ticks(axis: Any, values: np.ndarray) -> tuple[float, float]:
    """Set ticks at round numbers; return limits with a margin for labels."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    low, high = np.log10(values.min()), np.log10(values.max())
    margin = max(0.14 * (high - low), 0.12)
    decades = high - low + 2 * margin
    multiples = (
        (1.0,) if decades > 3 else (1.0, 2.0, 5.0) if decades > 1 else (1.0, 1.5, 2.0, 3.0, 5.0)
    )
    axis.set_major_locator(LogLocator(subs=multiples, numticks=99))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    return 10 ** (low - margin), 10 ** (high + margin)


def _label_points(axes: Axes, points: Mapping[str, Point], styles: Mapping[str, Style]) -> None:
    """Write the sampler's name beside each point."""
    from matplotlib.patheffects import withStroke

    markers = {name: _marker_box(axes, point) for name, point in points.items()}
    texts, sizes = {}, {}
    for name in markers:
        text = axes.text(0, 0, name, size=9, color=styles[name][0], ha="center", va="center")
        text.set_path_effects([withStroke(linewidth=3, foreground="white")])
        extent = text.get_window_extent()
        texts[name], sizes[name] = text, (extent.width, extent.height)
    room = (axes.bbox.x0, axes.bbox.y0, axes.bbox.x1, axes.bbox.y1)
    to_data = axes.transData.inverted()
    for name, (box, needs_line) in place_labels(markers, sizes, room).items():
        texts[name].set_position(tuple(to_data.transform(_middle(box))))
        if needs_line:
            x, y = _middle(markers[name])
            nearest = min(max(x, box[0]), box[2]), min(max(y, box[1]), box[3])
            axes.plot(*to_data.transform([(x, y), nearest]).T, color=GREY, linewidth=0.8, zorder=1)


def _marker_box(axes: Axes, point: Point) -> Box:
    """Return the box of a point's marker and error bars in pixels."""
    cost, quality = point
    corners = [(cost.min(), quality.min()), (cost.max(), quality.max())]
    (left, bottom), (right, top) = axes.transData.transform(corners)
    return left - 5, bottom - 5, right + 5, top + 5


def _middle(box: Box) -> tuple[float, float]:
    return 0.5 * (box[0] + box[2]), 0.5 * (box[1] + box[3])
