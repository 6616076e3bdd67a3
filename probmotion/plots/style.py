"""Colours, markers and axes shared by all figures, and saving of figures as PNG.

The palette is that of Okabe and Ito (2008), distinguishable with colour-vision deficiency, with
lighter colours darkened for text on white.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from probmotion.files import written_whole

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = [
    "CYCLE", "GREY", "INK", "LEFT", "RIGHT", "check_columns", "finish_figure", "legend_below",
    "plain_axes", "style_of",
]  # fmt: skip

LEFT = "#0072B2"  # left limbs
RIGHT = "#D55E00"  # right limbs
INK = "#333333"  # text and dark lines
GREY = "#C4C4C4"  # ticks, grids and bands

# Colours and markers of samplers, in order; markers distinguish samplers without colour.
CYCLE = (
    "#000000", "#0072B2", "#D55E00", "#009E73", "#B8578F", "#B07A00", "#3D9BD6", "#6B4F2A",
    "#7A7A7A",
)  # fmt: skip
_MARKERS = ("o", "s", "D", "^", "v", "P", "X", "p", "<", ">")
_DOTS_PER_INCH = 150


def style_of(place: int) -> tuple[str, str]:
    """Return the colour and marker of the sampler at index ``place``; the first 90 differ."""
    return CYCLE[place % len(CYCLE)], _MARKERS[place % len(_MARKERS)]


def plain_axes(
    axes: Axes,
    hidden: Sequence[str] = ("top", "right"),
    size: float = 8.5,
    grid: Literal["both", "x", "y"] | None = None,
) -> None:
    """Hide the given spines, style the ticks and draw a grid along the given axes."""
    for name in hidden:
        axes.spines[name].set_visible(False)
    axes.tick_params(which="both", color=GREY, labelcolor=INK, labelsize=size)
    if grid is not None:
        axes.grid(color=GREY, linewidth=0.5, alpha=0.6, axis=grid)
        axes.set_axisbelow(True)


def check_columns(table: pd.DataFrame, columns: Sequence[str]) -> None:
    """Raise ``ValueError`` unless a table has rows and all of ``columns``."""
    missing = [name for name in columns if name not in table]
    if missing or len(table) == 0:
        problem = f"no columns {', '.join(missing)}" if missing else "no row"
        raise ValueError(f"table must have rows with {', '.join(columns)}, got {problem}")


def legend_below(figure: Figure, ncols: int, axes: Axes | None = None, **options: Any) -> None:
    """Add a legend of ``axes``, by default the first of the figure, below the figure."""
    handles, labels = (axes or figure.axes[0]).get_legend_handles_labels()
    options |= {"loc": "outside lower center", "frameon": False, "labelcolor": INK}
    figure.legend(handles, labels, ncols=ncols, **options)


def finish_figure(figure: Figure, path: str | Path | None) -> Figure:
    """Save a figure as PNG if a path is given, and return it; no file is written on failure.

    Raises
    ------
    ValueError
        If the path does not end in ``.png``.
    OSError
        If the folder cannot be written to.
    """
    if path is None:
        return figure
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise ValueError(f"path must end in .png, got {str(path)!r}")
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    with written_whole(path) as unfinished:
        FigureCanvasAgg(figure).figure.savefig(
            unfinished, format="png", dpi=_DOTS_PER_INCH, facecolor="white"
        )
    return figure
