"""Quality against cost: where each sampler stands, one panel per problem."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np

from probmotion.comparison.results.qualities import QUALITIES, first_quality
from probmotion.plots.colours import GREY, INK, save_figure, style_of

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["plot_quality_against_cost"]

_LINE = 46


def plot_quality_against_cost(
    table: pd.DataFrame,
    path: str | Path | None = None,
    *,
    quality: str | None = None,
    cost: str = "seconds",
) -> Figure:
    """Return a figure of ``quality`` against ``cost``, a panel per problem, and write it as PNG.

    A point is the mean over seeds, its bars run from the least to the greatest seed. Both axes
    are logarithmic. A sampler without a point is listed above its panel, with the reason.

    Parameters
    ----------
    table : DataFrame
        Columns problem, sampler, seed, metric, value: what :meth:`Comparison.table` returns.
    path : str or Path, optional
        Where to write, ``.png``; nowhere by default.
    quality : str, optional
        Metric of the table; by default the first of
        :data:`~probmotion.comparison.results.qualities.QUALITIES` that it has.
    cost : str
        Metric of the table.

    Raises
    ------
    ValueError
        If no sampler has values above zero of both metrics.
    """
    from matplotlib.figure import Figure

    if quality is None:
        quality = first_quality(table) or "swd_ratio"
    problems = [str(name) for name in dict.fromkeys(table["problem"])]
    points = {problem: _points(table, problem, quality, cost) for problem in problems}
    if not any(points.values()):
        raise ValueError(
            f"table has no sampler with both {quality!r} and {cost!r}, expected at least one"
        )
    samplers = [str(name) for name in dict.fromkeys(table["sampler"])]
    styles = {name: style_of(place) for place, name in enumerate(samplers)}
    columns = min(len(problems), 3)
    lines = -(-len(problems) // columns)
    figure = Figure(figsize=(0.5 + 4.2 * columns, 0.2 + 3.9 * lines), layout="constrained")
    panels = figure.subplots(lines, columns, squeeze=False).ravel()
    for panel, problem in zip(panels, problems, strict=False):
        _draw_panel(
            panel, problem, points[problem], styles, _absent(table, problem, points[problem])
        )
        if quality == "swd_ratio" and points[problem]:
            panel.axhline(1.0, color=INK, linewidth=0.8, linestyle=(0, (4, 3)), zorder=1)
        panel.set_xlabel(cost, color=INK)
    for panel in panels[len(problems) :]:
        panel.set_visible(False)
    for panel in panels[::columns]:
        panel.set_ylabel(fill(QUALITIES.get(quality, quality), _LINE), color=INK)
    # Labels go where the points leave room, which is known once everything has its place.
    figure.draw_without_rendering()
    for panel, problem in zip(panels, problems, strict=False):
        _label_points(panel, points[problem], styles)
    if path is not None:
        save_figure(figure, path)
    return figure


Point = tuple[np.ndarray, np.ndarray]
"""Cost and quality, (seeds,) each."""

Style = tuple[str, str]
"""Colour and marker."""


def _points(table: pd.DataFrame, problem: str, quality: str, cost: str) -> dict[str, Point]:
    """Return cost and quality by sampler, over the seeds that have both above zero."""
    rows = table[(table["problem"] == problem) & table["metric"].isin([quality, cost])]
    points = {}
    for sampler, cells in rows.groupby("sampler", sort=False):
        wide = cells.pivot(index="seed", columns="metric", values="value")
        wide = wide.reindex(columns=[cost, quality]).dropna().astype(float)
        wide = wide[(wide > 0).all(axis=1) & np.isfinite(wide).all(axis=1)]
        if len(wide):
            points[str(sampler)] = (wide[cost].to_numpy(), wide[quality].to_numpy())
    return points


def _absent(table: pd.DataFrame, problem: str, points: Mapping[str, Point]) -> dict[str, str]:
    """Return why each sampler that has no point has none, in a word."""
    words = table.attrs.get("words", {})
    rows = table[table["problem"] == problem]
    reasons = {}
    for sampler, cells in rows.groupby("sampler", sort=False):
        if sampler not in points:
            failed = cells["metric"].iloc[0] if len(cells) == 1 else "not measured"
            reasons[str(sampler)] = str(words.get(f"{problem}/{sampler}", failed))
    return reasons


def _draw_panel(
    axes: Axes,
    problem: str,
    points: Mapping[str, Point],
    styles: Mapping[str, Style],
    absent: Mapping[str, str],
) -> None:
    lines = [f"no point: {name} ({why})" for name, why in absent.items()]
    axes.set_title("\n".join(lines), loc="right", size=8, color=INK)
    axes.set_title(problem, loc="left", size=11, color=INK, weight="bold")
    axes.grid(which="major", color=GREY, linewidth=0.5, alpha=0.6)
    axes.set_axisbelow(True)
    for name in ("top", "right"):
        axes.spines[name].set_visible(False)
    axes.tick_params(which="both", color=GREY, labelcolor=INK, labelsize=8.5)
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
    axes.set_xlim(_space_ticks(axes.xaxis, spans[0]))
    # Never so close that small differences look large.
    axes.set_ylim(_space_ticks(axes.yaxis, np.append(spans[1], [0.9, 2.0])))


def _space_ticks(axis: Any, values: np.ndarray) -> tuple[float, float]:
    """Put ticks at plain numbers; return limits that leave room for labels."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    low, high = np.log10(values.min()), np.log10(values.max())
    margin = max(0.14 * (high - low), 0.12)
    decades = high - low + 2 * margin
    between = (
        (1.0,) if decades > 3 else (1.0, 2.0, 5.0) if decades > 1 else (1.0, 1.5, 2.0, 3.0, 5.0)
    )
    axis.set_major_locator(LogLocator(subs=between, numticks=99))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    return 10 ** (low - margin), 10 ** (high + margin)


def _label_points(axes: Axes, points: Mapping[str, Point], styles: Mapping[str, Style]) -> None:
    """Write each point's name beside it, at the first place that covers least."""
    from matplotlib.patheffects import withStroke

    boxes = {name: _marked(axes, point) for name, point in points.items()}
    taken = list(boxes.values())
    room = (axes.bbox.x0, axes.bbox.y0, axes.bbox.x1, axes.bbox.y1)
    to_data = axes.transData.inverted()
    for name, box in boxes.items():
        text = axes.text(0, 0, name, size=9, color=styles[name][0], ha="center", va="center")
        text.set_path_effects([withStroke(linewidth=3, foreground="white")])
        size = text.get_window_extent()
        places = [
            _beside(box, across, up, distance, size.width, size.height)
            for distance in (3, 16, 30)
            for across, up in _AROUND
        ]
        best = min(places, key=lambda place: _covered(place, taken, room))
        taken.append(best)
        x, y = to_data.transform(_middle(best))
        text.set_position((x, y))
        if places.index(best) >= len(_AROUND):
            ends = to_data.transform([_middle(box), _nearest(best, _middle(box))])
            axes.plot(*ends.T, color=GREY, linewidth=0.8, zorder=1)


Box = tuple[float, float, float, float]
"""Left, bottom, right, top, pixels."""

_AROUND = ((1, 0), (0, 1), (0, -1), (1, 1), (1, -1), (-1, 0), (-1, 1), (-1, -1))


def _marked(axes: Axes, point: Point) -> Box:
    """The pixels that a point's marker and bars take."""
    cost, quality = point
    corners = [(cost.min(), quality.min()), (cost.max(), quality.max())]
    (left, bottom), (right, top) = axes.transData.transform(corners)
    return left - 5, bottom - 5, right + 5, top + 5


def _beside(box: Box, across: int, up: int, distance: float, width: float, height: float) -> Box:
    """A box of a size beside another one, on the side that ``across`` and ``up`` say."""
    x, y = _middle(box)
    x += across * (distance + 0.5 * (box[2] - box[0] + width))
    y += up * (distance + 0.5 * (box[3] - box[1] + height))
    return x - width / 2, y - height / 2, x + width / 2, y + height / 2


def _covered(place: Box, taken: list[Box], room: Box) -> float:
    outside = (place[2] - place[0]) * (place[3] - place[1]) - _overlap(place, room)
    return outside + sum(_overlap(place, other) for other in taken)


def _overlap(one: Box, other: Box) -> float:
    across = min(one[2], other[2]) - max(one[0], other[0])
    up = min(one[3], other[3]) - max(one[1], other[1])
    return max(across, 0.0) * max(up, 0.0)


def _middle(box: Box) -> tuple[float, float]:
    return 0.5 * (box[0] + box[2]), 0.5 * (box[1] + box[3])


def _nearest(box: Box, point: tuple[float, float]) -> tuple[float, float]:
    """The point of a box that is nearest to another point."""
    return min(max(point[0], box[0]), box[2]), min(max(point[1], box[1]), box[3])
