"""Colours, markers, sizes and axes shared by all figures, and saving of figures.

Figures fit a column or a page of a paper. The colours of samplers differ from each other by at
least 27 units of CIELAB with normal vision, protanopia, deuteranopia and tritanopia, and their
contrast with white is at least 3. Left and right have the colours of Okabe and Ito (2008).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal
from zlib import crc32

import numpy as np

from probmotion.files import written_whole

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.legend import Legend

__all__ = [
    "COLUMN", "CYCLE", "GREY", "INK", "LEFT", "MARKERS", "PAGE", "RIGHT", "SIZE", "SMALL", "TITLE",
    "SamplerStyle", "check_columns", "finish_figure", "legend_below", "log_axis", "paper_panels",
    "plain_axes", "sampler_style", "style_of", "title_axes", "without_formulas",
]  # fmt: skip

LEFT = "#0072B2"  # left limbs
RIGHT = "#D55E00"  # right limbs
INK = "#333333"  # text and dark lines
GREY = "#C4C4C4"  # ticks, grids and bands

COLUMN, PAGE = 3.3, 6.9  # widths of figures, inches
TITLE, SIZE, SMALL = 9.0, 8.0, 7.0  # sizes of text, points

CYCLE = (
    "#000000", "#0747E3", "#A42D10", "#146E55", "#E768AF", "#C08901", "#0D99FD", "#3F244F",
    "#664AA4",
)  # fmt: skip
MARKERS = ("o", "s", "D", "^", "v", "P", "X", "p", "<", ">")
_DOTS_PER_INCH = 200


@dataclass(frozen=True)
class SamplerStyle:
    """Colour and Matplotlib marker of a sampler; the marker distinguishes it without colour."""

    colour: str
    marker: str


_SAMPLERS = {
    "exact": SamplerStyle("#000000", "o"),
    "reference": SamplerStyle("#000000", ">"),
    "ancestral3d": SamplerStyle("#664AA4", "p"),
    "mas": SamplerStyle("#A42D10", "D"),
    "mvpc": SamplerStyle("#0D99FD", "v"),
    "split-gibbs": SamplerStyle("#5A000F", "h"),
    "sds": SamplerStyle("#E768AF", "X"),
    "mh": SamplerStyle("#3F244F", "<"),
    "nuts": SamplerStyle("#0747E3", "s"),
    "ensemble": SamplerStyle("#C08901", "P"),
    "tempered": SamplerStyle("#60A060", "*"),
    "tempered-pairs": SamplerStyle("#240C9C", "8"),
    "smc": SamplerStyle("#000060", "d"),
    "dvae": SamplerStyle("#146E55", "^"),
}


def sampler_style(name: str) -> SamplerStyle:
    """Return the style of a sampler, the same in all figures and independent of other samplers.

    Variants of a registered sampler, such as ``mas.paper`` or ``mas-a``, have its colour and
    another marker. All other names have a combination that no registered sampler uses.
    """
    if name in _SAMPLERS:
        return _SAMPLERS[name]
    base = _SAMPLERS.get(re.split(r"\W", name)[0])
    free = [
        style
        for colour in (CYCLE[1:] if base is None else [base.colour])
        for marker in MARKERS
        if (style := SamplerStyle(colour, marker)) not in _SAMPLERS.values()
    ]
    return free[crc32(name.encode()) % len(free)]


def style_of(place: int) -> tuple[str, str]:
    """Return the colour and marker at index ``place`` of an ordered series; the first 90 differ."""
    return CYCLE[place % len(CYCLE)], MARKERS[place % len(MARKERS)]


def paper_panels(
    n: int, height: float, *, across: int = 2, **options: Any
) -> tuple[Figure, list[Axes]]:
    """Return a figure of n panels: one in the width of a column, several in that of a page.

    Parameters
    ----------
    n : int
        Number of panels.
    height : float
        Height of each row of panels, inches.
    across : int
        Maximum number of panels per row.
    **options
        Options of :meth:`matplotlib.figure.Figure.subplots`.
    """
    from matplotlib.figure import Figure

    columns = min(n, across)
    rows = -(-n // columns)
    size = (COLUMN if n == 1 else PAGE, rows * height)
    figure = Figure(figsize=size, layout="constrained")
    panels = list(figure.subplots(rows, columns, squeeze=False, **options).ravel())
    for axes in panels[n:]:
        axes.remove()
    return figure, panels[:n]


def title_axes(axes: Axes, title: str, weight: str = "normal") -> None:
    """Write a title at the left above axes."""
    axes.set_title(title, loc="left", size=TITLE, color=INK, weight=weight)


def plain_axes(
    axes: Axes,
    hidden: Sequence[str] = ("top", "right"),
    grid: Literal["both", "x", "y"] | None = None,
) -> None:
    """Hide the given spines, style ticks and labels, and draw a grid along the given axes."""
    for name in hidden:
        axes.spines[name].set_visible(False)
    axes.tick_params(which="both", color=GREY, labelcolor=INK, labelsize=SMALL)
    for axis in (axes.xaxis, axes.yaxis):
        axis.label.set(size=SIZE, color=INK)
        axis.get_offset_text().set_fontsize(SMALL)
    if grid is not None:
        axes.grid(color=GREY, linewidth=0.5, alpha=0.6, axis=grid)
        axes.set_axisbelow(True)


def log_axis(axis: Any, values: np.ndarray) -> tuple[float, float]:
    """Make an axis logarithmic with ticks at round numbers; return limits with a margin."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    low, high = np.log10(values.min()), np.log10(values.max())
    margin = max(0.14 * (high - low), 0.12)
    decades = high - low + 2 * margin
    multiples = (
        (1.0,) if decades > 3 else (1.0, 2.0, 5.0) if decades > 1 else (1.0, 1.5, 2.0, 3.0, 5.0)
    )
    getattr(axis.axes, f"set_{axis.axis_name}scale")("log")
    axis.set_major_locator(LogLocator(subs=multiples, numticks=99))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    return 10 ** (low - margin), 10 ** (high + margin)


def check_columns(table: pd.DataFrame, columns: Sequence[str]) -> None:
    """Raise ``ValueError`` unless a table has rows and all of ``columns``."""
    missing = [name for name in columns if name not in table]
    if missing or len(table) == 0:
        problem = f"no columns {', '.join(missing)}" if missing else "no row"
        raise ValueError(f"table must have rows with {', '.join(columns)}, got {problem}")


def legend_below(figure: Figure, ncols: int, axes: Axes | None = None, **options: Any) -> Legend:
    """Add a legend of ``axes``, by default the first of the figure, below the figure."""
    handles, labels = (axes or figure.axes[0]).get_legend_handles_labels()
    options = {"handles": handles, "labels": labels, "ncols": ncols, "fontsize": SIZE} | options
    return figure.legend(loc="outside lower center", frameon=False, labelcolor=INK, **options)


def without_formulas(figure: Figure) -> None:
    """Draw dollar signs of all texts so far as dollar signs."""
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        if "$" in text.get_text():
            text.set_parse_math(False)


def finish_figure(figure: Figure, path: str | Path | None) -> Figure:
    """Save a figure as PNG, PDF or SVG if a path is given, and return it.

    Names are drawn as they are: dollar signs do not make them formulas. Equal figures give equal
    files. PDF files contain TrueType fonts; in SVG files, text is drawn as paths, so that it looks
    the same without the fonts. No file is written on failure.

    Raises
    ------
    ValueError
        If the path does not end in ``.png``, ``.pdf`` or ``.svg``.
    OSError
        If the folder cannot be written to.
    """
    without_formulas(figure)
    if path is None:
        return figure
    from matplotlib import rc_context

    path = Path(path)
    kind = path.suffix.lower().removeprefix(".")
    dates: dict[str, Any] = {"png": {}, "pdf": {"CreationDate": None}, "svg": {"Date": None}}
    if kind not in dates:
        raise ValueError(f"path must end in .png, .pdf or .svg, got {str(path)!r}")
    options = {"pdf.fonttype": 42, "svg.fonttype": "path", "svg.hashsalt": "probmotion"}
    with written_whole(path) as unfinished, rc_context(options):
        figure.savefig(
            unfinished, format=kind, dpi=_DOTS_PER_INCH, facecolor="white", metadata=dates[kind]
        )
    return figure
