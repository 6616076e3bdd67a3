"""What a density says of real poses, of its seed and of its own draws."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from probmotion.plots.colours import CYCLE, GREY, INK, save_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["draw_calibration"]


def draw_calibration(
    levels: Mapping[str, Mapping[str, np.ndarray]], path: str | Path | None = None, title: str = ""
) -> Figure:
    """Return a figure of the distributions of log densities, and write it as PNG.

    Parameters
    ----------
    levels : mapping of mapping of ndarray, (n,)
        By kind of pose (real, draws, the seed), then by part of the density, the same parts for
        every kind: nats. A panel per part; a kind of a single pose is a line. What lies below the
        lowest hundredth of all, or is −∞, stands in the lowest bar.
    path : str or Path, optional
        Where to write, ``.png``; nowhere by default.
    title : str
        Above the picture.

    Raises
    ------
    ValueError
        If there is no kind, or one has other parts than the first.
    """
    from matplotlib.figure import Figure

    if not levels:
        raise ValueError("levels must contain at least one kind of pose, got none")
    parts = list(next(iter(levels.values())))
    for kind, found in levels.items():
        if list(found) != parts:
            raise ValueError(f"levels[{kind!r}] has {list(found)}, expected {parts}")
    figure = Figure(figsize=(0.4 + 3.4 * len(parts), 3.2), layout="constrained")
    for axes, part in zip(figure.subplots(1, len(parts), squeeze=False)[0], parts, strict=True):
        values = {kind: np.asarray(found[part]) for kind, found in levels.items()}
        finite = np.concatenate([some[np.isfinite(some)] for some in values.values()])
        # The lowest hundredth would leave no room for the rest.
        low, high = np.quantile(finite, 0.01), finite.max()
        edges = np.linspace(low - 0.02 * (high - low) - 1e-9, high + 0.02 * (high - low) + 1e-9, 41)
        for place, (kind, some) in enumerate(values.items()):
            colour = CYCLE[place % len(CYCLE)]
            if some.size == 1:
                axes.axvline(float(some[0]), color=colour, linewidth=2, linestyle="--", label=kind)
                continue
            shares = np.full(some.size, 1 / some.size)
            axes.hist(np.maximum(some, edges[0]), edges, weights=shares, color=colour, alpha=0.55,
                      label=kind)  # fmt: skip
        axes.set_title(part, loc="left", size=10.5, color=INK)
        axes.set_xlabel("nats", color=INK)
        axes.tick_params(color=GREY, labelcolor=INK, labelsize=8.5)
        for name in ("top", "right"):
            axes.spines[name].set_visible(False)
    figure.axes[0].set_ylabel("share", color=INK)
    figure.legend(
        *figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(levels),
        frameon=False, labelcolor=INK,
    )  # fmt: skip
    if title:
        figure.suptitle(title, size=12, color=INK, x=0.02, ha="left")
    if path is not None:
        save_figure(figure, path)
    return figure
