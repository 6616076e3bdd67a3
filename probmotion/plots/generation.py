"""Tables of generated motion as a picture: a row per generator, a panel per measure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from probmotion.plots.colours import GREY, INK, LEFT, RIGHT, save_figure

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["draw_generation"]


def draw_generation(
    table: pd.DataFrame,
    measures: Mapping[str, str],
    path: str | Path | None = None,
    *,
    side: str = "_side",
    logarithmic: Sequence[str] = (),
    title: str = "",
) -> Figure:
    """Return a figure of every row's measures with their ±, and write it as PNG.

    A filled mark is of views from all around, an open one of those from the side.

    Parameters
    ----------
    table : DataFrame
        A row per generator: ``name``, the measures, and where they have one ``<measure>_sd``,
        ``<measure><side>`` and ``<measure><side>_sd``. What is NaN is not drawn.
    measures : mapping of str to str
        What to call each measure, in the panels' order.
    path : str or Path, optional
        Where to write, ``.png``; nowhere by default.
    side : str
        What ends the names of measures from the side.
    logarithmic : sequence of str
        Measures whose axis is logarithmic.
    title : str
        Above the picture.

    Raises
    ------
    ValueError
        If there is no row, or a column is missing.
    """
    from matplotlib.figure import Figure

    missing = [name for name in ("name", *measures) if name not in table]
    if missing or len(table) == 0:
        problem = f"lacks the columns {', '.join(missing)}" if missing else "has no row"
        raise ValueError(f"table {problem}, expected name and the measures")
    figure = Figure(
        figsize=(1.6 + 2.4 * len(measures), 1.2 + 0.28 * len(table)), layout="constrained"
    )
    panels = figure.subplots(1, len(measures), squeeze=False, sharey=True)[0]
    places = np.arange(len(table))[::-1]
    for axes, (measure, words) in zip(panels, measures.items(), strict=True):
        _draw_marks(axes, table, measure, places + 0.12, LEFT, filled=True)
        if f"{measure}{side}" in table:
            _draw_marks(axes, table, f"{measure}{side}", places - 0.12, RIGHT, filled=False)
        axes.set_title(words, loc="left", size=10, color=INK)
        _dress(axes, measure in logarithmic)
    panels[0].set_yticks(places, list(table["name"]))
    _write_key(figure)
    if title:
        figure.suptitle(title, size=12, color=INK, x=0.02, ha="left")
    if path is not None:
        save_figure(figure, path)
    return figure


def _draw_marks(
    axes: Axes, table: pd.DataFrame, measure: str, places: np.ndarray, colour: str, filled: bool
) -> None:
    deviations = f"{measure}_sd"
    axes.errorbar(
        table[measure].to_numpy(dtype=float),
        places,
        xerr=table[deviations].to_numpy(dtype=float) if deviations in table else None,
        fmt="o" if filled else "s",
        color=colour,
        markersize=5,
        markerfacecolor=colour if filled else "white",
        elinewidth=1.0,
    )


def _dress(axes: Axes, logarithmic: bool) -> None:
    if logarithmic:
        axes.set_xscale("log")
    else:
        axes.set_xlim(left=0)
    axes.grid(color=GREY, linewidth=0.5, alpha=0.6, axis="both")
    axes.set_axisbelow(True)
    axes.tick_params(color=GREY, labelcolor=INK, labelsize=8.5)
    for name in ("top", "right"):
        axes.spines[name].set_visible(False)


def _write_key(figure: Figure) -> None:
    from matplotlib.lines import Line2D

    kinds = {"all around": ("o", LEFT, LEFT), "from the side": ("s", RIGHT, "white")}
    handles = [
        Line2D([], [], marker=shape, color=colour, markerfacecolor=face, linestyle="", label=words)
        for words, (shape, colour, face) in kinds.items()
    ]
    figure.legend(
        handles=handles, loc="outside lower center", ncols=2, frameon=False, labelcolor=INK
    )
