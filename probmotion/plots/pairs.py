"""Stick figures of pose-pairs: each character in its own colour, all at one scale."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from probmotion.geometry.cameras import Cameras
from probmotion.motion.skeleton import Skeleton
from probmotion.plots.colours import GREY, INK, LEFT, RIGHT, save_figure
from probmotion.validation import check_count, check_finite, check_shape

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["draw_pairs"]

_CHARACTERS = (LEFT, RIGHT, "#009E73", "#B8578F")
"""One colour per character, in the order of the roots; a fifth has the first one's again."""

_LABEL, _HEAD, _GAP = 1.15, 0.42, 0.1
"""Room for the rows' labels, for the title and between pictures, inches."""


def draw_pairs(
    rows: Mapping[str, np.ndarray],
    skeleton: Skeleton,
    path: str | Path | None = None,
    *,
    columns: int = 6,
    azimuth: float = 0.0,
    elevation: float = 0.0,
    title: str = "",
) -> Figure:
    """Return a figure with one row of pose-pairs per entry of ``rows``, and write it as PNG.

    All pictures have one scale. A character's right limbs are drawn paler than the rest of it.

    Parameters
    ----------
    rows : mapping of str to ndarray, (n, J, 3) or (n, J, 2)
        Pose-pairs in metres by label, drawn from the top down; the first ``columns`` of each are
        shown. Those in space stand with their lowest joint on a ground line; those in the plane,
        y up, are annotations, whose bones are dashed and whose hidden joints are NaN.
    skeleton : Skeleton
        The J joints; each tree is a character.
    path : str or Path, optional
        Where to write, ``.png``; nowhere by default.
    columns : int
        Pose-pairs per row.
    azimuth, elevation : float
        Where the pairs in space are looked at from, radians, as in :meth:`Cameras.ring`.
    title : str
        Above the picture.

    Raises
    ------
    ValueError
        If there is no row, a row is empty, a shape does not fit the skeleton, or a pose in space
        is not finite.
    """
    check_count("columns", columns)
    if not rows:
        raise ValueError("rows must contain at least one label with pose-pairs, got none")
    camera = Cameras.around(np.array([azimuth]), np.array([elevation]))
    lines = [
        _Line(label, *_seen(camera, f"rows[{label!r}]", np.asarray(poses)[:columns], skeleton))
        for label, poses in rows.items()
    ]
    figure = _compose(lines, skeleton, title)
    if path is not None:
        save_figure(figure, path)
    return figure


class _Line(NamedTuple):
    """A row's label, its pictures (n, J, 2), metres, y up, and whether they are of space."""

    label: str
    pictures: np.ndarray
    in_space: bool

    @property
    def span(self) -> tuple[float, float]:
        """The lowest and the highest place of the row, with a margin, metres."""
        low, high = float(np.nanmin(self.pictures[..., 1])), float(np.nanmax(self.pictures[..., 1]))
        margin = 0.04 * (high - low) + 1e-9
        return low - margin, high + margin


def _seen(
    camera: Cameras, name: str, poses: np.ndarray, skeleton: Skeleton
) -> tuple[np.ndarray, bool]:
    """Return pictures with the middle at x = 0 and the lowest joint at y = 0."""
    in_space = poses.shape[-1:] == (3,)
    check_shape(name, poses, ("n", skeleton.n_joints, 3 if in_space else 2))
    if len(poses) == 0:
        raise ValueError(f"{name} must contain at least one pose-pair, got none")
    pictures = np.asarray(poses, dtype=np.float64)
    if in_space:
        check_finite(name, pictures)
        pictures = camera.project(pictures[:, None])[:, 0, 0] * np.array([1.0, -1.0])
    blank = np.isnan(pictures[..., 0]) | np.isnan(pictures[..., 1])
    for index in np.flatnonzero(blank.all(axis=1)):
        raise ValueError(f"{name}[{index}] has no joint to draw, expected at least one")
    low, high = np.nanmin(pictures, axis=1), np.nanmax(pictures, axis=1)
    middle = np.stack([0.5 * (low[:, 0] + high[:, 0]), low[:, 1]], axis=-1)
    return pictures - middle[:, None], in_space


def _compose(lines: list[_Line], skeleton: Skeleton, title: str) -> Figure:
    from matplotlib.figure import Figure

    reach = 1.04 * max(float(np.nanmax(line.pictures[..., 0])) for line in lines) + 1e-9
    slots = max(len(line.pictures) for line in lines)
    slot = max(1.2, 5.0 / slots)
    scale = slot / (2 * reach)
    width = _LABEL + slots * (slot + _GAP)
    height = _HEAD + sum((line.span[1] - line.span[0]) * scale + _GAP for line in lines)
    figure = Figure(figsize=(width, height))
    top = height - _HEAD
    for line in lines:
        low, high = line.span
        tall = (high - low) * scale
        bottom = top - tall
        label_at = ((_LABEL - 0.12) / width, (bottom + tall / 2) / height)
        figure.text(*label_at, line.label, ha="right", va="center", size=10, color=INK)
        for column, picture in enumerate(line.pictures):
            left = _LABEL + column * (slot + _GAP)
            axes = figure.add_axes((left / width, bottom / height, slot / width, tall / height))
            axes.set(xlim=(-reach, reach), ylim=(low, high))
            axes.set_axis_off()
            axes.set_facecolor("none")
            _draw_pair(axes, picture, skeleton, line.in_space)
        top = bottom - _GAP
    figure.text(0.12 / width, 1 - 0.1 / height, title, va="top", size=12, color=INK)
    return figure


def _draw_pair(axes: Axes, picture: np.ndarray, skeleton: Skeleton, in_space: bool) -> None:
    from matplotlib.collections import LineCollection

    if in_space:
        low = axes.get_ylim()[0]
        axes.plot(axes.get_xlim(), [low, low], color=GREY, linewidth=1.2, solid_capstyle="butt")
    right = {joint for _, joint in skeleton.mirrored_pairs}
    for place, root in enumerate(skeleton.roots):
        bones = [
            (joint, parent)
            for joint, parent in skeleton.bones
            if root in skeleton.ancestors(joint) and np.isfinite(picture[[joint, parent]]).all()
        ]
        colour = _CHARACTERS[place % len(_CHARACTERS)]
        style: dict[str, Any] = {"capstyle": "round", "linewidths": 1.5, "colors": colour}
        style["linestyles"] = "solid" if in_space else (0, (1.6, 1.6))
        for paler, alpha in ((True, 0.5), (False, 1.0)):
            chosen = [picture[list(bone)] for bone in bones if (bone[0] in right) == paler]
            axes.add_collection(LineCollection(chosen, alpha=alpha, **style))
