"""Histograms of the log densities of real poses, draws and the seed pose."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from probmotion.plots.style import (
    CYCLE,
    finish_figure,
    legend_below,
    paper_panels,
    plain_axes,
    title_axes,
)  # fmt: skip

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["draw_calibration"]


def draw_calibration(
    levels: Mapping[str, Mapping[str, np.ndarray]], path: str | Path | None = None
) -> Figure:
    """Return a figure of log-density histograms, with a panel per term of the density.

    Parameters
    ----------
    levels : mapping of mapping of ndarray, (n,)
        Log densities in nats, by kind of pose (real, draws, seed), then by term of the density. All
        kinds have the same terms. A single pose is drawn as a line. Values below the lowest bin,
        which starts at about the 1 % quantile of all finite values, are drawn in this bin.
    path : str or Path, optional
        File to write: .png, .pdf or .svg.

    Raises
    ------
    ValueError
        If ``levels`` is empty, or the kinds have different terms.
    """
    if not levels:
        raise ValueError("levels must contain at least one kind of pose, got none")
    terms = list(next(iter(levels.values())))
    for kind, by_term in levels.items():
        if list(by_term) != terms:
            raise ValueError(f"levels[{kind!r}] must have the terms {terms}, got {list(by_term)}")
    figure, panels = paper_panels(len(terms), 2.3, across=3)
    for axes, term in zip(panels, terms, strict=True):
        values = {kind: np.asarray(by_term[term]) for kind, by_term in levels.items()}
        finite = np.concatenate([level[np.isfinite(level)] for level in values.values()])
        # Low outliers would compress the histograms.
        low, high = np.quantile(finite, 0.01), finite.max()
        edges = np.linspace(low - 0.02 * (high - low) - 1e-9, high + 0.02 * (high - low) + 1e-9, 41)
        for index, (kind, level) in enumerate(values.items()):
            colour = CYCLE[index % len(CYCLE)]
            if level.size == 1:
                axes.axvline(float(level[0]), color=colour, linewidth=2, linestyle="--", label=kind)
                continue
            weights = np.full(level.size, 1 / level.size)
            clipped = np.maximum(level, edges[0])
            axes.hist(
                clipped, edges.tolist(), weights=weights, color=colour, alpha=0.55, label=kind
            )
        title_axes(axes, term)
        axes.set_xlabel("log density (nats)")
        plain_axes(axes)
    panels[0].set_ylabel("proportion")
    legend_below(figure, min(len(levels), 4))
    return finish_figure(figure, path)
