"""How draws cover real poses: an embedding of both, and coverage against the number of draws."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from probmotion.plots.colours import GREY, INK, LEFT, save_figure, style_of
from probmotion.validation import check_count, check_finite, check_shape

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["classical_scaling", "draw_coverage", "draw_embedding"]

_KINDS = {
    "real": (LEFT, "o", 9.0),
    "prior": ("#009E73", "o", 9.0),
    "posterior": ("#B8578F", "o", 9.0),
    "seed": ("#000000", "x", 70.0),
}
"""Colour, marker and size of each kind of pose, drawn in this order, the last on top."""

_COLUMNS = ("measure", "density", "draws", "coverage")

_WORDS = {
    "interaction": "interaction coordinates (m)",
    "cartesian": "Cartesian coordinates (m)",
    "shape-context": "shape contexts",
}


def classical_scaling(distances: np.ndarray, dim: int = 2) -> np.ndarray:
    """Return points whose distances are nearest to the given ones (Torgerson 1952).

    The leading eigenvectors of the doubly centred squares: exact for distances between points of
    ``dim`` dimensions, up to a rigid motion. Negative eigenvalues, of distances that no points
    have, count as 0. Each axis points to where its largest entry is positive.

    Parameters
    ----------
    distances : ndarray, (n, n)
        Dissimilarities; the mean of d_ij and d_ji counts.
    dim : int
        Dimensions of the points.

    Returns
    -------
    points : ndarray, (n, dim)
        Centred, the axis of greatest variance first.

    Raises
    ------
    ValueError
        If the distances are not square, not finite, or fewer than ``dim``.
    """
    check_count("dim", dim)
    distances = np.asarray(distances, dtype=np.float64)
    check_shape("distances", distances, (len(distances), len(distances)))
    check_finite("distances", distances)
    if len(distances) < dim:
        raise ValueError(f"distances is of {len(distances)} points, expected at least dim={dim}")
    squares = (0.5 * (distances + distances.T)) ** 2
    products = squares - squares.mean(axis=0) - squares.mean(axis=1)[:, None] + squares.mean()
    values, vectors = np.linalg.eigh(-0.5 * products)
    points = vectors[:, ::-1][:, :dim] * np.sqrt(np.maximum(values[::-1][:dim], 0.0))
    largest = np.abs(points).argmax(axis=0)
    return points * np.where(points[largest, np.arange(dim)] < 0, -1.0, 1.0)


def draw_embedding(
    points: np.ndarray,
    kinds: Sequence[str],
    path: str | Path | None = None,
    *,
    counts: Mapping[str, int] | None = None,
    title: str = "",
) -> Figure:
    """Return a figure of embedded poses, and write it as PNG (Yin et al. 2018, figure 8).

    Parameters
    ----------
    points : ndarray, (n, 2)
        From :func:`classical_scaling`.
    kinds : sequence of str, (n,)
        ``"real"``, ``"prior"``, ``"posterior"`` or ``"seed"``.
    path : str or Path, optional
        Where to write, ``.png``; nowhere by default.
    counts : mapping of str to int, optional
        A panel for each, by title, with so many draws of the prior and of the posterior, the first
        ones; one panel with all by default.
    title : str
        Above the picture.

    Raises
    ------
    ValueError
        If shapes do not fit or a kind is unknown.
    """
    from matplotlib.figure import Figure

    points = np.asarray(points, dtype=np.float64)
    check_shape("points", points, ("n", 2))
    check_shape("kinds", np.asarray(kinds), (len(points),))
    unknown = sorted(set(kinds) - set(_KINDS))
    if unknown:
        raise ValueError(f"kinds has {unknown}, expected some of {', '.join(_KINDS)}")
    panels: Mapping[str, int | None] = {"": None} if counts is None else counts
    figure = Figure(figsize=(0.3 + 3.6 * len(panels), 4.1), layout="constrained")
    shown = figure.subplots(1, len(panels), squeeze=False, sharex=True, sharey=True)[0]
    for axes, (label, count) in zip(shown, panels.items(), strict=True):
        _draw_points(axes, points, np.asarray(kinds), count)
        axes.set_title(label, size=10, color=INK)
    middle, reach = 0.5 * (points.min(axis=0) + points.max(axis=0)), np.ptp(points, axis=0).max()
    limits = np.stack([middle - 0.54 * reach, middle + 0.54 * reach], axis=1)
    shown[0].set(xlim=limits[0], ylim=limits[1])
    handles, labels = shown[-1].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower center", frameon=False, labelcolor=INK,
        ncols=len(handles) if len(panels) > 1 else 2, markerscale=1.5,
    )  # fmt: skip
    if title:
        figure.suptitle(title, size=12, color=INK, x=0.02, ha="left")
    if path is not None:
        save_figure(figure, path)
    return figure


def draw_coverage(
    table: pd.DataFrame,
    path: str | Path | None = None,
    *,
    title: str = "",
) -> Figure:
    """Return a figure of coverage against the number of draws, and write it as PNG (figure 9).

    A panel per dissimilarity, a line per density.

    Parameters
    ----------
    table : DataFrame
        Columns ``measure``, ``density``, ``draws`` and ``coverage``; of several rows of one kind,
        such as seeds, the mean is a point and least and greatest are its bar.
    path : str or Path, optional
        Where to write, ``.png``; nowhere by default.
    title : str
        Above the picture.

    Raises
    ------
    ValueError
        If a column is missing, the table is empty or a number of draws is below 1.
    """
    from matplotlib.figure import Figure

    missing = [name for name in _COLUMNS if name not in table]
    if missing or len(table) == 0:
        problem = f"lacks the columns {missing}" if missing else "has no row"
        raise ValueError(f"table {problem}, expected rows with {', '.join(_COLUMNS)}")
    if not (table["draws"] >= 1).all():
        raise ValueError(f"table has {table['draws'].min()} draws, expected at least 1")
    measures = list(dict.fromkeys(table["measure"]))
    densities = list(dict.fromkeys(table["density"]))
    figure = Figure(figsize=(0.4 + 3.4 * len(measures), 3.7), layout="constrained")
    panels = figure.subplots(1, len(measures), squeeze=False)[0]
    for axes, measure in zip(panels, measures, strict=True):
        rows = table[table["measure"] == measure]
        for place, density in enumerate(densities):
            _draw_line(axes, rows[rows["density"] == density], str(density), place)
        axes.set_title(_WORDS.get(measure, measure), loc="left", size=10.5, color=INK)
        _dress(axes)
    panels[0].set_ylabel("coverage: mean distance of a real pair\nfrom the nearest draw", color=INK)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower center", ncols=len(labels), frameon=False,
        labelcolor=INK,
    )  # fmt: skip
    if title:
        figure.suptitle(title, size=12, color=INK, x=0.02, ha="left")
    if path is not None:
        save_figure(figure, path)
    return figure


def _draw_line(axes: Axes, rows: pd.DataFrame, density: str, place: int) -> None:
    found = rows.groupby("draws")["coverage"].agg(["mean", "min", "max"])
    counts, mean = found.index.to_numpy(dtype=float), found["mean"].to_numpy()
    bars = np.stack([mean - found["min"], found["max"] - mean])
    colour, marker = style_of(place)
    axes.errorbar(
        counts, mean, bars, label=density, color=colour, marker=marker,
        markersize=5, linewidth=1.6, elinewidth=1.0,
    )  # fmt: skip


def _dress(axes: Axes) -> None:
    from matplotlib.ticker import FuncFormatter, MaxNLocator, NullLocator

    axes.set_xscale("log")
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.set_xlabel("draws", color=INK)
    axes.grid(color=GREY, linewidth=0.5, alpha=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(color=GREY, labelcolor=INK, labelsize=8.5)
    for name in ("top", "right"):
        axes.spines[name].set_visible(False)


def _draw_points(axes: Axes, points: np.ndarray, kinds: np.ndarray, count: int | None) -> None:
    for kind, (colour, marker, size) in _KINDS.items():
        chosen = np.flatnonzero(kinds == kind)
        if kind in ("prior", "posterior") and count is not None:
            chosen = chosen[:count]
        if len(chosen):
            width = 2.0 if marker == "x" else 0.0
            style: dict[str, Any] = {"s": size, "c": colour, "marker": marker, "linewidths": width}
            axes.scatter(points[chosen, 0], points[chosen, 1], label=kind, **style)
    axes.set_aspect("equal")
    axes.set(xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set_color(GREY)
