"""Colours that every kind of eye can tell apart, and how a figure is saved.

The palette is Okabe and Ito's (2008), its lighter colours darkened so that words in them can be
read on white.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from probmotion.files import written_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["CYCLE", "GREY", "INK", "LEFT", "RIGHT", "save_figure", "style_of"]

LEFT = "#0072B2"
RIGHT = "#D55E00"
INK = "#333333"
GREY = "#C4C4C4"

CYCLE = (
    "#000000", "#0072B2", "#D55E00", "#009E73", "#B8578F", "#B07A00", "#3D9BD6", "#6B4F2A",
    "#7A7A7A",
)  # fmt: skip
"""One colour per sampler, in the order in which they are first seen."""

_MARKERS = ("o", "s", "D", "^", "v", "P", "X", "p", "<", ">")
"""One shape per sampler, for prints without colour."""


def style_of(place: int) -> tuple[str, str]:
    """Return colour and shape of the sampler at a place in the order; 90 places differ."""
    return CYCLE[place % len(CYCLE)], _MARKERS[place % len(_MARKERS)]


def save_figure(figure: Figure, path: str | Path, dots_per_inch: int = 150) -> None:
    """Write a figure as PNG; nothing is left at ``path`` if writing fails.

    Raises
    ------
    ValueError
        If the path does not end in ``.png``.
    OSError
        If the folder cannot be written to.
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise ValueError(f"path must be a name that ends in .png, got {str(path)!r}")
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    with written_whole(path) as unfinished:
        FigureCanvasAgg(figure).figure.savefig(
            unfinished, format="png", dpi=dots_per_inch, facecolor="white"
        )
