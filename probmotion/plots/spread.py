"""Figure of the spread of draws: overlaid motions, coloured by standard deviation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from probmotion.geometry.cameras import Cameras
from probmotion.motion.skeleton import Skeleton
from probmotion.plots.skeletons import (
    WIDEST,
    checked_rows,
    draw_ground,
    face_heading,
    head_circles,
    head_joints,
    project_frames,
    vertical_range,
    write_key,
)
from probmotion.plots.style import GREY, INK, PAGE, SIZE, SMALL, finish_figure, sampler_style
from probmotion.validation import check_count, check_shape

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap, Normalize
    from matplotlib.figure import Figure

__all__ = ["joint_sd", "plot_spread"]

# Space for the title, above each panel, between panels and for the colour bar, inches.
_TOP, _HEADER, _GAP, _FOOT = 0.34, 0.2, 0.12, 0.5
_MIN_FRAME_WIDTH = 0.55  # minimum width of a frame, inches
_MAX_PANEL_HEIGHT = 1.8  # maximum height of a panel, inches


def joint_sd(motions: np.ndarray) -> np.ndarray:
    """Return the standard deviation of each joint's position over draws, metres.

    Parameters
    ----------
    motions : ndarray, (n, L, J, 3)
        At least two draws, metres.

    Returns
    -------
    sd : ndarray, (L, J)
        Square root of the total variance of the position, i.e. of the sum over the three axes.
    """
    return np.sqrt(np.asarray(motions, dtype=np.float64).var(axis=0, ddof=1).sum(axis=-1))


def plot_spread(
    rows: Mapping[str, np.ndarray],
    skeleton: Skeleton,
    path: str | Path | None = None,
    *,
    draws: int = 30,
    moments: int = 3,
    azimuth: float = 0.0,
    elevation: float = 0.0,
    heading: float | None = None,
    truth: np.ndarray | None = None,
    title: str = "",
) -> Figure:
    """Return a figure of overlaid draws, with a panel per sampler.

    A panel shows ``moments`` frames side by side. Bones and joints have the colour of their
    posterior standard deviation, :func:`joint_sd`, over all draws of the sampler; its
    root mean square over joints and frames is written beside the sampler's name. The first
    sampler, such as exact draws, determines the range of colours and the scale; larger deviations
    have the last colour, and much larger motions are clipped.

    Parameters
    ----------
    rows : mapping of str to ndarray, (n, L, J, 3)
        Draws in metres by sampler, at least two each.
    skeleton : Skeleton
        Skeleton of the J joints.
    path : str or Path, optional
        File to write: .png, .pdf or .svg.
    draws : int
        Maximum number of overlaid draws per sampler, evenly spaced.
    moments : int
        Number of evenly spaced frames; 1 shows the first.
    azimuth, elevation : float
        Direction of the camera in radians, as in :meth:`Cameras.ring`.
    heading : float, optional
        Mean heading, in radians from +Z towards +X, to which draws are rotated, if given.
    truth : ndarray, (L, J, 3), optional
        True motion, drawn in grey.
    title : str
        Title of the figure.

    Raises
    ------
    ValueError
        If there are no rows, a row has fewer than two draws, a shape does not match the skeleton, a
        value is not finite, or ``heading`` is given for a skeleton without left-right pairs.

    Examples
    --------
    >>> import numpy as np
    >>> from probmotion.data.synthetic.gaits import make_gait
    >>> from probmotion.plots import plot_spread
    >>> walk = make_gait("walk", frames=20)
    >>> rng = np.random.default_rng(0)
    >>> draws = walk.positions + 0.03 * rng.normal(size=(50, *walk.positions.shape))
    >>> figure = plot_spread({"nuts": draws}, walk.skeleton, truth=walk.positions)
    """
    check_count("draws", draws)
    check_count("moments", moments)
    shown = checked_rows(rows, skeleton)
    for label, motions in shown.items():
        if len(motions) < 2:
            raise ValueError(f"rows[{label!r}] must contain at least two draws, got one")
    if heading is not None:
        shown = {
            label: face_heading(motions, skeleton, heading) for label, motions in shown.items()
        }
    sds = {label: joint_sd(motions) for label, motions in shown.items()}
    camera = Cameras.around(np.array([azimuth]), np.array([elevation]))
    overlaid = {
        label: project_frames(camera, motions[:: -(-len(motions) // draws)], moments)
        for label, motions in shown.items()
    }
    true = None
    if truth is not None:
        check_shape("truth", truth, next(iter(shown.values())).shape[1:])
        true = project_frames(camera, np.asarray(truth)[None], moments)[0]
    return finish_figure(_compose(overlaid, sds, skeleton, true, title), path)


def _compose(
    overlaid: Mapping[str, np.ndarray],
    sds: Mapping[str, np.ndarray],
    skeleton: Skeleton,
    truth: np.ndarray | None,
    title: str,
) -> Figure:
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    first = next(iter(overlaid.values()))
    moments = first.shape[1]
    anchor = np.median(first if truth is None else truth[None], axis=(0, 2))[:, 0]
    slot = _slot_width([*overlaid.values()], anchor)
    shown = first if truth is None else np.append(first, truth[None], 0)
    low, high = vertical_range(shown, skeleton)
    shape = (high - low) / (slot * moments)
    lines = -(-len(overlaid) // max(1, int(PAGE / (moments * _MIN_FRAME_WIDTH))))
    across = -(-len(overlaid) // lines)
    panel_width = min(PAGE / across - _GAP, _MAX_PANEL_HEIGHT / shape)
    panel_height = panel_width * shape
    height = _TOP + lines * (_HEADER + panel_height + _GAP) + _FOOT
    figure = Figure(figsize=(PAGE, height))
    # The lightest colours are invisible on white.
    colours = ListedColormap(colormaps["plasma"](np.linspace(0, 0.84, 256)))
    unit, metre = ("mm", 1000.0) if max(sd.max() for sd in sds.values()) < 0.01 else ("cm", 100.0)
    largest = metre * next(iter(sds.values())).max() or 1.0
    scale = Normalize(0.0, largest)
    for place, (label, draws) in enumerate(overlaid.items()):
        row, column = divmod(place, across)
        left = (column + 0.5) * PAGE / across - panel_width / 2
        bottom = height - _TOP - row * (_HEADER + panel_height + _GAP) - _HEADER - panel_height
        box = (left / PAGE, bottom / height, panel_width / PAGE, panel_height / height)
        axes = figure.add_axes(box)
        axes.set(xlim=(0, slot * moments), ylim=(low, high))
        axes.set_aspect("equal")
        axes.set_axis_off()
        shift = np.zeros((moments, 1, 2))
        shift[:, 0, 0] = slot * (np.arange(moments) + 0.5) - anchor
        frames = np.linspace(0, len(sds[label]) - 1, moments).round().astype(int)
        _draw_panel(
            axes, draws + shift, metre * sds[label][frames], skeleton,
            None if truth is None else truth + shift, colours, scale,
        )  # fmt: skip
        style, y = sampler_style(label), (bottom + panel_height + 0.07) / height
        figure.add_artist(
            Line2D([(left + 0.06) / PAGE], [y], marker=style.marker, color=style.colour,
                   markersize=5, markeredgewidth=0)
        )  # fmt: skip
        mean = metre * np.sqrt(np.mean(sds[label] ** 2))
        words = f"{label} ({mean:.2g} {unit})"
        figure.text((left + 0.16) / PAGE, y, words, size=SIZE, color=INK, va="center_baseline")
    beyond = any(metre * sd.max() > largest for sd in sds.values())
    bar = figure.colorbar(
        ScalarMappable(scale, colours), orientation="horizontal", extend="max" if beyond else None,
        cax=figure.add_axes((0.3, 0.34 / height, 0.4, 0.09 / height)),
    )  # fmt: skip
    words = f"posterior sd of joint position ({unit}); beside names: root mean square"
    bar.set_label(words, size=SIZE, color=INK, labelpad=1)
    bar.ax.tick_params(labelsize=SMALL, color=GREY, labelcolor=INK, pad=1.5)
    bar.outline.set_visible(False)
    write_key(figure, title, {} if truth is None else {"truth": "#8F8F8F"})
    return figure


def _slot_width(rows: Sequence[np.ndarray], anchor: np.ndarray) -> float:
    """Return the width of a frame's slot, metres."""
    reach = [float(np.quantile(np.abs(row[..., 0] - anchor[:, None]), 0.998)) for row in rows]
    return 2.1 * min(max(reach), WIDEST * reach[0]) + 1e-9


def _draw_panel(
    axes: Axes,
    draws: np.ndarray,
    sd: np.ndarray,
    skeleton: Skeleton,
    truth: np.ndarray | None,
    colours: Colormap,
    scale: Normalize,
) -> None:
    """Draw poses (n, moments, J, 2) with standard deviations (moments, J), over the truth."""
    from matplotlib.collections import LineCollection, PatchCollection

    draw_ground(axes)
    child, parent = np.array(skeleton.bones).T
    bones = np.stack([draws[:, :, child], draws[:, :, parent]], axis=-2)
    alpha = float(np.clip(4.0 / len(draws), 0.15, 0.8))
    style: dict[str, Any] = {"capstyle": "round", "joinstyle": "round"}
    if truth is not None:
        ends = np.stack([truth[:, child], truth[:, parent]], axis=-2)
        axes.add_collection(
            LineCollection(list(ends.reshape(-1, 2, 2)), colors=GREY, linewidths=2.4, **style)
        )
        axes.add_collection(PatchCollection(head_circles(truth, skeleton), facecolors=GREY))
    along = np.broadcast_to(0.5 * (sd[:, child] + sd[:, parent]), bones.shape[:3])
    axes.add_collection(
        LineCollection(
            list(bones.reshape(-1, 2, 2)), array=along.ravel(), cmap=colours, norm=scale,
            alpha=alpha, linewidths=0.7, **style,
        )
    )  # fmt: skip
    if head := head_joints(skeleton):
        circles = head_circles(draws.reshape(-1, *draws.shape[2:]), skeleton)
        edges = colours(scale(np.tile(sd[:, head].mean(axis=1), len(draws))))
        axes.add_collection(
            PatchCollection(
                circles, facecolors="none", edgecolors=edges, alpha=alpha, linewidths=0.6
            )
        )
    across, up = draws.reshape(-1, 2).T
    axes.scatter(
        across, up, c=np.broadcast_to(sd, draws.shape[:3]).ravel(), s=2.5,
        cmap=colours, norm=scale, alpha=min(1.0, 2 * alpha), linewidths=0,
    )  # fmt: skip
