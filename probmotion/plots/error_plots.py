"""Figures of the error decomposition of a sampler, as stacked bars."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from probmotion.plots.style import (
    CYCLE,
    INK,
    SMALL,
    TITLE,
    check_columns,
    finish_figure,
    legend_below,
    paper_panels,
    plain_axes,
    title_axes,
)  # fmt: skip

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["draw_error_decomposition"]

_FLOOR, _WHOLE = "floor", "whole"  # table rows of exact draws and of the sum of parts
_COLOURS = {
    "remainder": "#7A7A7A",
    "discretisation": CYCLE[6],
    "integrator": CYCLE[2],
    "single view": CYCLE[3],
    "independent noise": CYCLE[4],
    "guidance": CYCLE[5],
    "network": CYCLE[1],
}
_PALE, _FULL = 0.35, 0.95  # opacities
_WIDTH = 0.8  # of the stack
_LETTERS = 26  # maximum line length of panel titles


def draw_error_decomposition(
    table: pd.DataFrame,
    path: str | Path | None = None,
    *,
    words: Mapping[str, str] | None = None,
    notes: Sequence[str] = (),
) -> Figure:
    """Return a figure of the error decomposition of one setting, with a panel per metric.

    The error of exact draws is at 0. Positive parts are stacked upwards from 0 and negative parts
    downwards; a black line marks the total. Beside the stack, each part is drawn with its interval.
    Parts with an interval that contains 0 are pale.

    Parameters
    ----------
    table : DataFrame
        Table of :meth:`~probmotion.calibration.error_result.ErrorDecomposition.table`, one setting.
    path : str or Path, optional
        File to write: .png, .pdf or .svg.
    words : mapping of str to str, optional
        Titles of the panels, by name of the metric; the names by default.
    notes : sequence of str
        Notes below the figure.

    Raises
    ------
    ValueError
        If a column is missing, or the table has several settings.
    """
    check_columns(table, ("setting", "measure", "part", "mean", "low", "high"))
    settings = list(dict.fromkeys(table["setting"]))
    if len(settings) != 1:
        raise ValueError(f"table must have one setting, got {len(settings)}")
    measures = list(dict.fromkeys(table["measure"]))
    parts = [part for part in dict.fromkeys(table["part"]) if part not in (_FLOOR, _WHOLE)]
    colours = {part: _COLOURS.get(part, CYCLE[6 + index % 2]) for index, part in enumerate(parts)}
    figure, panels = paper_panels(len(measures), 2.9, across=3)
    for axes, measure in zip(panels, measures, strict=True):
        rows = table[table["measure"] == measure].set_index("part")
        _draw_stack(axes, rows, colours)
        _draw_intervals(axes, rows, colours)
        axes.axhline(0.0, color=INK, linewidth=0.8)
        axes.set_xlim(-0.6, 0.25 + 0.55 * (len(parts) + 1) + 0.4)
        axes.set_xticks([])
        title_axes(axes, textwrap.fill((words or {}).get(measure, measure), _LETTERS))
        plain_axes(axes, ("top", "right", "bottom"), grid="y")
    for axes in panels[::3]:
        axes.set_ylabel("above exact draws")
    _write_key(figure, colours, notes, wide=len(measures) > 1)
    figure.suptitle(settings[0], size=TITLE, color=INK, x=0.01, ha="left", weight="bold")
    return finish_figure(figure, path)


def _draw_stack(axes: Axes, rows: pd.DataFrame, colours: Mapping[str, str]) -> None:
    up = down = 0.0
    for part, colour in colours.items():
        height = float(rows.loc[part, "mean"])
        bottom = up if height >= 0 else down
        axes.bar(
            0.0, height, _WIDTH, bottom=bottom, color=colour, alpha=_opacity(rows.loc[part]),
            edgecolor="white", linewidth=0.8,
        )  # fmt: skip
        up, down = (up + height, down) if height >= 0 else (up, down + height)
    total = float(rows.loc[_WHOLE, "mean"])
    axes.plot([-0.55 * _WIDTH, 0.55 * _WIDTH], [total, total], color="black", linewidth=1.8)


def _draw_intervals(axes: Axes, rows: pd.DataFrame, colours: Mapping[str, str]) -> None:
    """Draw the intervals of every part and of the total, side by side."""
    for index, (part, colour) in enumerate([*colours.items(), (_WHOLE, "black")], start=1):
        row = rows.loc[part]
        x = 0.25 + 0.55 * index
        opacity = _opacity(row)
        axes.plot([x, x], [row["low"], row["high"]], color=colour, alpha=opacity,
                  linewidth=1.6, solid_capstyle="butt")  # fmt: skip
        axes.plot(x, row["mean"], "o" if part != _WHOLE else "D", color=colour, alpha=opacity,
                  markersize=4)  # fmt: skip


def _write_key(
    figure: Figure, colours: Mapping[str, str], notes: Sequence[str], wide: bool
) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Any] = [Patch(color=colour, label=part) for part, colour in colours.items()]
    handles.append(Line2D([], [], color="black", marker="D", markersize=4, label=_WHOLE))
    handles.append(Line2D([], [], linestyle="", label="pale: interval contains 0"))
    labels = [handle.get_label() for handle in handles]
    key = legend_below(
        figure, 4 if wide else 2, handles=handles, labels=labels,
        title=textwrap.fill("; ".join(notes), 110 if wide else 50), title_fontsize=SMALL,
    )  # fmt: skip
    key.get_title().set_color(INK)


def _opacity(row: Any) -> float:
    return _FULL if row["low"] > 0 or row["high"] < 0 else _PALE
