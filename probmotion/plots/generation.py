"""Figure of generation metrics, with a row per generator and a panel per metric."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from probmotion.plots.style import (
    INK,
    LEFT,
    RIGHT,
    check_columns,
    finish_figure,
    legend_below,
    plain_axes,
)  # fmt: skip

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["draw_generation"]

# Marker, colour and fill colour by direction of the views.
_VIEWS = {"all around": ("o", LEFT, LEFT), "from the side": ("s", RIGHT, "white")}


def draw_generation(
    table: pd.DataFrame,
    measures: Mapping[str, str],
    path: str | Path | None = None,
    *,
    logarithmic: Sequence[str] = (),
) -> Figure:
    """Return a figure of generation metrics with error bars.

    Filled markers denote views from all azimuths, open markers views from the side.

    Parameters
    ----------
    table : DataFrame
        One row per generator, with a column ``name``, a column per metric and, optionally, columns
        ``<metric>_sd``, ``<metric>_side`` and ``<metric>_side_sd``. NaN values are not drawn.
    measures : mapping of str to str
        Titles of the panels, by name of the metric.
    path : str or Path, optional
        PNG file to write.
    logarithmic : sequence of str
        Names of the metrics with a logarithmic axis.

    Raises
    ------
    ValueError
        If the table has no rows, or a column is missing.
    """
    from matplotlib.figure import Figure

    check_columns(table, ("name", *measures))
    size = (1.6 + 2.4 * len(measures), 1.2 + 0.28 * len(table))
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(1, len(measures), squeeze=False, sharey=True)[0]
    heights = np.arange(len(table))[::-1]
    for axes, (measure, title) in zip(panels, measures.items(), strict=True):
        _draw_markers(axes, table, measure, heights + 0.12, "all around")
        _draw_markers(axes, table, f"{measure}_side", heights - 0.12, "from the side")
        axes.set_title(title, loc="left", size=10, color=INK)
        if measure in logarithmic:
            axes.set_xscale("log")
        else:
            axes.set_xlim(left=0)
        plain_axes(axes, grid="both")
    panels[0].set_yticks(heights, list(table["name"]))
    legend_below(figure, 2)
    return finish_figure(figure, path)


def _draw_markers(
    axes: Axes, table: pd.DataFrame, measure: str, places: np.ndarray, label: str
) -> None:
    if measure not in table:
        return
    shape, colour, face = _VIEWS[label]
    deviations = table.get(f"{measure}_sd")
    axes.errorbar(
        table[measure], places, xerr=deviations, fmt=shape, color=colour, markersize=5,
        markerfacecolor=face, elinewidth=1.0, label=label,
    )  # fmt: skip
