"""Figures of ranks of simulated truths: histograms, distribution functions and coverage.

The figures follow Talts et al. (2018), figures 1 and 2, and Säilynoja et al. (2022), figure 3.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import binom

from probmotion.metrics.uniformity import ecdf_band, evaluation_points
from probmotion.plots.style import (
    CYCLE,
    GREY,
    INK,
    PAGE,
    SIZE,
    SMALL,
    TITLE,
    finish_figure,
    plain_axes,
    title_axes,
)  # fmt: skip
from probmotion.validation import check_shape

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["draw_ranks"]

_LEVEL = 0.95  # probability that uniform ranks lie within a grey band
_MAX_BINS, _MIN_PER_BIN = 20, 10  # maximum number of bins and minimum of ranks per bin
_ACROSS = 4  # histograms per row
_LETTERS, _NAME = 90, 16  # characters per line of a title and of the name of a quantity
# Inches: space above a block, per title line and below; height of a row and of the two curves.
_HEADER, _LINE, _FOOT, _PANEL, _CURVES = 0.28, 0.16, 0.42, 0.92, 2.9


def draw_ranks(
    blocks: Mapping[str, Mapping[str, np.ndarray]], path: str | Path | None = None
) -> Figure:
    """Return a figure of the ranks of simulated truths, with a block per sampler.

    A block has a histogram per quantity, the difference F(z) − z between the empirical and the
    uniform distribution function, and the coverage of credible sets against their level. The grey
    bands contain uniform ranks with a probability of 95 %, simultaneously for all bars of a
    histogram or all points of a line. Overconfident samplers have ∪-shaped histograms and coverage
    below the level, underconfident ones ∩-shaped histograms and coverage above it.

    Parameters
    ----------
    blocks : mapping of mapping of ndarray, (n,)
        Ranks in [0, 1], one per simulation (at least two), by title of the block (e.g. the
        sampler's verdict) and by quantity.
    path : str or Path, optional
        File to write: .png, .pdf or .svg.

    Raises
    ------
    ValueError
        If there are no blocks, a block has no quantities, or ranks are not one-dimensional.
    """
    from matplotlib.figure import Figure

    if not blocks:
        raise ValueError("blocks must contain at least one sampler with ranks, got none")
    for title, ranks in blocks.items():
        if not ranks:
            raise ValueError(f"blocks[{title!r}] must contain at least one quantity, got none")
        for name, values in ranks.items():
            check_shape(f"blocks[{title!r}][{name!r}]", values, ("n",))
    titles = [textwrap.fill(title, _LETTERS) for title in blocks]
    headers = [_HEADER + _LINE * (1 + title.count("\n")) for title in titles]
    heights = [
        header + max(_CURVES, _PANEL * -(-len(ranks) // _ACROSS)) + _FOOT
        for header, ranks in zip(headers, blocks.values(), strict=True)
    ]
    # A constrained layout would take time quadratic in the number of panels.
    figure = Figure(figsize=(PAGE, sum(heights)))
    parts = figure.subfigures(len(blocks), 1, height_ratios=heights, squeeze=False)[:, 0]
    for part, title, header, height, ranks in zip(
        parts, titles, headers, heights, blocks.values(), strict=True
    ):
        part.suptitle(
            title, size=TITLE, color=INK, weight="bold", x=0.01, ha="left", va="top",
            y=1 - 0.3 * _LINE / height,
        )  # fmt: skip
        margins = {"top": 1 - header / height, "bottom": _FOOT / height}
        left, right = part.subfigures(1, 2, width_ratios=[1.75, 1])
        colours = {name: CYCLE[index % len(CYCLE)] for index, name in enumerate(ranks)}
        _draw_histograms(left, height, ranks, colours, {"left": 0.075, "right": 0.98, **margins})
        tall = {"left": 0.17, "right": 0.96, "hspace": 0.55, **margins}
        upper, lower = right.subplots(2, 1, gridspec_kw=tall)
        _draw_difference(upper, ranks, colours)
        _draw_coverage(lower, ranks, colours)
    return finish_figure(figure, path)


def _draw_histograms(
    part: Any,
    height: float,
    ranks: Mapping[str, np.ndarray],
    colours: Mapping[str, str],
    place: Mapping[str, float],
) -> None:
    """Draw a histogram per quantity with a Bonferroni-corrected band."""
    columns = min(_ACROSS, len(ranks))
    spacing = {"hspace": 0.55, "wspace": 0.5, **place}
    lines = -(-len(ranks) // columns)
    panels = part.subplots(lines, columns, squeeze=False, sharex=True, gridspec_kw=spacing).ravel()
    for index, (axes, (name, values)) in enumerate(zip(panels, ranks.items(), strict=False)):
        n = len(values)
        bins = max(2, min(_MAX_BINS, n // _MIN_PER_BIN))
        tail = 0.5 * (1 - _LEVEL) / bins
        low, high = binom.ppf([tail, 1 - tail], n, 1 / bins)
        axes.axhspan(low, high, color=GREY, alpha=0.6, linewidth=0)
        axes.axhline(n / bins, color=INK, linewidth=0.7)
        axes.hist(values, np.linspace(0, 1, bins + 1), color=colours[name], alpha=0.75, rwidth=0.92)
        axes.set_title(
            textwrap.fill(name, _NAME), loc="left", size=SMALL, color=colours[name], pad=3
        )
        axes.set(xlim=(0, 1), xticks=[0, 0.5, 1], ylim=(0, max(1.05 * high, axes.get_ylim()[1])))
        axes.set_xticklabels(["0", "½", "1"])
        axes.tick_params(labelbottom=index >= len(ranks) - columns)
        plain_axes(axes)
    for axes in panels[len(ranks) :]:
        axes.set_visible(False)
    part.supxlabel("rank of the truth among the draws", size=SIZE, color=INK, y=0.06 / height)


def _draw_difference(
    axes: Axes, ranks: Mapping[str, np.ndarray], colours: Mapping[str, str]
) -> None:
    for n in {len(values) for values in ranks.values()}:
        _draw_band(axes, n, less=1)
    for name, values in ranks.items():
        points = evaluation_points(len(values))
        counts = np.searchsorted(np.sort(values), points, side="right")
        axes.plot(points, counts / len(values) - points, color=colours[name], linewidth=0.9)
    title_axes(axes, "ECDF minus uniform")
    axes.set_xlabel("rank", labelpad=1)
    axes.set_xlim(0, 1)
    plain_axes(axes)


def _draw_coverage(axes: Axes, ranks: Mapping[str, np.ndarray], colours: Mapping[str, str]) -> None:
    from probmotion.metrics.uniformity import DENSITY, DISTANCE, credible_level

    for n in {len(values) for values in ranks.values()}:
        _draw_band(axes, n, less=0)
    words = {DENSITY: "highest density", DISTANCE: "balls (TARP)"}
    strokes = {DENSITY: "solid", DISTANCE: (0, (2.0, 0.8))}
    for name, values in ranks.items():
        points = evaluation_points(len(values))
        levels = np.sort(credible_level(name, values))
        coverage = np.searchsorted(levels, points, side="right") / len(values)
        axes.plot(
            points, coverage, color=colours[name], label=words.get(name),
            linewidth=2.0 if name in words else 0.9, linestyle=strokes.get(name, "solid"),
        )  # fmt: skip
    if set(ranks) - set(words):
        axes.plot([], [], color=INK, linewidth=1.0, label="central intervals")
    title_axes(axes, "coverage of credible sets")
    axes.set_xlabel("level", labelpad=1)
    axes.set(xlim=(0, 1), ylim=(0, 1))
    plain_axes(axes)
    axes.legend(
        frameon=False, fontsize=SMALL, labelcolor=INK, loc="upper left", handlelength=1.4,
        borderaxespad=0.1, labelspacing=0.3,
    )  # fmt: skip


def _draw_band(axes: Axes, n: int, less: float) -> None:
    """Draw the band of the distribution function F(z) of uniform ranks, minus ``less`` × z."""
    points = evaluation_points(n)
    lower, upper = ecdf_band(n, _LEVEL)
    shift = less * points
    axes.fill_between(points, lower - shift, upper - shift, color=GREY, alpha=0.6, linewidth=0)
    axes.plot([0, 1], [0, 1 - less], color=INK, linewidth=0.7)
