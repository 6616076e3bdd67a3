"""Figure of generation metrics, with a row per generator and a panel per metric."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from probmotion.plots.style import (
    LEFT,
    RIGHT,
    check_columns,
    finish_figure,
    legend_below,
    log_axis,
    paper_panels,
    plain_axes,
    title_axes,
)  # fmt: skip

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["draw_generation"]

# Marker, colour and fill colour by direction of the views.
_VIEWS = {"all around": ("o", LEFT, LEFT), "from the side": ("s", RIGHT, "white")}
_ACROSS = 3  # panels per row


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
        File to write: .png, .pdf or .svg.
    logarithmic : sequence of str
        Names of the metrics with a logarithmic axis.

    Raises
    ------
    ValueError
        If the table has no rows, or a column is missing.
    """
    check_columns(table, ("name", *measures))
    figure, panels = paper_panels(
        len(measures), 0.7 + 0.24 * len(table), across=_ACROSS, sharey=True
    )
    heights = np.arange(len(table))[::-1]
    for axes, (measure, title) in zip(panels, measures.items(), strict=True):
        _draw_markers(axes, table, measure, heights + 0.12, "all around")
        _draw_markers(axes, table, f"{measure}_side", heights - 0.12, "from the side")
        title_axes(axes, title)
        if measure in logarithmic:
            values = table[[c for c in (measure, f"{measure}_side") if c in table]].to_numpy(float)
            axes.set_xlim(log_axis(axes.xaxis, values[values > 0]))
        else:
            # Markers at 0 are not clipped.
            axes.set_xlim(left=-0.04 * axes.get_xlim()[1])
        plain_axes(axes, grid="both")
    panels[0].set_yticks(heights, list(table["name"]))
    legend_below(figure, 2, axes=panels[0])
    return finish_figure(figure, path)


def _draw_markers(
    axes: Axes, table: pd.DataFrame, measure: str, places: np.ndarray, label: str
) -> None:
    if measure not in table:
        return
    shape, colour, face = _VIEWS[label]
    deviations = table.get(f"{measure}_sd")
    axes.errorbar(
        table[measure], places, xerr=deviations, fmt=shape, color=colour, markersize=4,
        markerfacecolor=face, elinewidth=0.9, capsize=2, label=label,
    )  # fmt: skip
