"""Figures of the coverage of real poses by draws: embeddings and coverage curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from probmotion.plots.style import (
    GREY,
    LEFT,
    check_columns,
    finish_figure,
    legend_below,
    paper_panels,
    plain_axes,
    style_of,
    title_axes,
)  # fmt: skip
from probmotion.validation import check_count, check_finite, check_shape

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["classical_scaling", "draw_coverage", "draw_embedding"]

# Colour, marker and size of each kind of pose, in drawing order.
_KINDS = {
    "real": (LEFT, "o", 9.0),
    "prior": ("#009E73", "^", 10.0),
    "posterior": ("#B8578F", "D", 7.0),
    "seed": ("#000000", "x", 45.0),
}
_TITLES = {
    "interaction": "interaction coordinates (m)",
    "cartesian": "Cartesian coordinates (m)",
    "shape-context": "shape contexts",
}


def classical_scaling(distances: np.ndarray, dim: int = 2) -> np.ndarray:
    """Embed points by classical multidimensional scaling of their distances (Torgerson 1952).

    The coordinates are scaled leading eigenvectors of the doubly centred squared distances. For
    points in ``dim`` dimensions, they are exact up to a rigid motion or reflection. Negative
    eigenvalues are set to 0. The entry of largest magnitude on each axis is positive.

    Parameters
    ----------
    distances : ndarray, (n, n)
        Dissimilarities; d_ij and d_ji are averaged.
    dim : int
        Number of dimensions of the embedding.

    Returns
    -------
    points : ndarray, (n, dim)
        Centred points, with axes in order of decreasing variance.

    Raises
    ------
    ValueError
        If ``distances`` is not square or finite, or has fewer than ``dim`` points.
    """
    check_count("dim", dim)
    distances = np.asarray(distances, dtype=np.float64)
    check_shape("distances", distances, (len(distances), len(distances)))
    check_finite("distances", distances)
    if len(distances) < dim:
        raise ValueError(f"distances must be between at least {dim=} points, got {len(distances)}")
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
) -> Figure:
    """Return a figure of embedded poses (Yin et al. 2018, figure 8).

    Parameters
    ----------
    points : ndarray, (n, 2)
        Result of :func:`classical_scaling`.
    kinds : sequence of str, (n,)
        Kind of each pose: ``"real"``, ``"prior"``, ``"posterior"`` or ``"seed"``.
    path : str or Path, optional
        File to write: .png, .pdf or .svg.
    counts : mapping of str to int, optional
        Number of draws of the prior, and of the posterior, in each panel, by title of the panel.
        By default, one panel shows all draws.

    Raises
    ------
    ValueError
        If shapes do not match or a kind is unknown.
    """
    points = np.asarray(points, dtype=np.float64)
    check_shape("points", points, ("n", 2))
    check_shape("kinds", np.asarray(kinds), (len(points),))
    if unknown := sorted(set(kinds) - set(_KINDS)):
        raise ValueError(f"kinds must be {', '.join(_KINDS)}, got {', '.join(unknown)}")
    panels: Mapping[str, int | None] = {"": None} if counts is None else counts
    figure, shown = paper_panels(
        len(panels), 3.6 if len(panels) == 1 else 2.6, across=3, sharex=True, sharey=True
    )
    for axes, (label, count) in zip(shown, panels.items(), strict=True):
        _draw_points(axes, points, np.asarray(kinds), count)
        title_axes(axes, label)
    middle, reach = 0.5 * (points.min(axis=0) + points.max(axis=0)), np.ptp(points, axis=0).max()
    limits = np.stack([middle - 0.54 * reach, middle + 0.54 * reach], axis=1)
    shown[0].set(xlim=limits[0], ylim=limits[1])
    ncols = len(shown[-1].collections) if len(panels) > 1 else 2
    legend_below(figure, ncols, axes=shown[-1])
    return finish_figure(figure, path)


def draw_coverage(table: pd.DataFrame, path: str | Path | None = None) -> Figure:
    """Return a figure of coverage against the number of draws (Yin et al. 2018, figure 9).

    The figure has a panel per distance measure and a line per density.

    Parameters
    ----------
    table : DataFrame
        Columns ``measure``, ``density``, ``draws`` and ``coverage``. Rows that differ only in
        coverage, such as seeds, are drawn as their mean with an error bar from minimum to maximum.
    path : str or Path, optional
        File to write: .png, .pdf or .svg.

    Raises
    ------
    ValueError
        If a column is missing, the table is empty or a number of draws is below 1.
    """
    check_columns(table, ("measure", "density", "draws", "coverage"))
    if not (table["draws"] >= 1).all():
        raise ValueError(f"draws in table must be at least 1, got {table['draws'].min()}")
    measures = list(dict.fromkeys(table["measure"]))
    densities = list(dict.fromkeys(table["density"]))
    figure, panels = paper_panels(len(measures), 2.6, across=3)
    for axes, measure in zip(panels, measures, strict=True):
        rows = table[table["measure"] == measure]
        for index, density in enumerate(densities):
            _draw_line(axes, rows[rows["density"] == density], str(density), index)
        title_axes(axes, _TITLES.get(measure, measure))
        _style_coverage_axes(axes)
    panels[0].set_ylabel("mean distance of a real pair\nto the nearest draw")
    legend_below(figure, min(len(densities), 4 if len(measures) > 1 else 2))
    return finish_figure(figure, path)


def _draw_line(axes: Axes, rows: pd.DataFrame, density: str, place: int) -> None:
    by_count = rows.groupby("draws")["coverage"].agg(["mean", "min", "max"])
    counts, mean = by_count.index.to_numpy(dtype=float), by_count["mean"].to_numpy()
    bars = np.stack([mean - by_count["min"], by_count["max"] - mean])
    colour, marker = style_of(place)
    axes.errorbar(
        counts, mean, bars, label=density, color=colour, marker=marker,
        markersize=4, linewidth=1.2, elinewidth=0.9, capsize=2,
    )  # fmt: skip


def _style_coverage_axes(axes: Axes) -> None:
    from matplotlib.ticker import FuncFormatter, MaxNLocator, NullLocator

    axes.set_xscale("log")
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.set_xlabel("draws")
    plain_axes(axes, grid="both")


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
