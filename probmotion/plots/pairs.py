"""Stick figures of pose-pairs, with a colour per character."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from probmotion.geometry.cameras import Cameras
from probmotion.motion.skeleton import Skeleton
from probmotion.plots.skeletons import draw_ground, write_key
from probmotion.plots.style import INK, LEFT, PAGE, RIGHT, SIZE, finish_figure
from probmotion.validation import check_count, check_finite, check_shape

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["draw_pairs"]

# Colours of characters in the order of their roots, repeated after the fourth.
_CHARACTERS = (LEFT, RIGHT, "#009E73", "#B8578F")
# Space for the title and between figures, and maximum width of a figure, inches.
_TOP, _GAP, _MAX_WIDTH = 0.36, 0.08, 1.6


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
    """Return a figure with a row of pose-pairs per entry of ``rows``, all at the same scale.

    Right limbs are drawn paler than the rest of a character.

    Parameters
    ----------
    rows : mapping of str to ndarray, (n, J, 3) or (n, J, 2)
        Pose-pairs in metres by label, from top to bottom. 3D pairs are drawn on a ground
        line; 2D annotations, with y up and NaN for occluded joints, have dashed bones.
    skeleton : Skeleton
        Skeleton of the J joints; each of its trees is a character.
    path : str or Path, optional
        File to write: .png, .pdf or .svg.
    columns : int
        Maximum number of pose-pairs per row, counted from the first.
    azimuth, elevation : float
        Direction of the camera for 3D pairs in radians, as in :meth:`Cameras.ring`.
    title : str
        Title of the figure.

    Raises
    ------
    ValueError
        If there are no rows, a row is empty, a shape does not match the skeleton, or a 3D pose is
        not finite.
    """
    check_count("columns", columns)
    if not rows:
        raise ValueError("rows must contain at least one label with pose-pairs, got none")
    camera = Cameras.around(np.array([azimuth]), np.array([elevation]))
    lines = [
        _Row(label, *_project(camera, f"rows[{label!r}]", np.asarray(poses)[:columns], skeleton))
        for label, poses in rows.items()
    ]
    return finish_figure(_compose(lines, skeleton, title), path)


class _Row(NamedTuple):
    """Row of 2D poses (n, J, 2), in metres with y up; ``is_3d`` marks projected 3D poses."""

    label: str
    poses: np.ndarray
    is_3d: bool

    @property
    def span(self) -> tuple[float, float]:
        """Vertical range with a margin, metres."""
        low, high = float(np.nanmin(self.poses[..., 1])), float(np.nanmax(self.poses[..., 1]))
        margin = 0.04 * (high - low) + 1e-9
        return low - margin, high + margin


def _project(
    camera: Cameras, name: str, poses: np.ndarray, skeleton: Skeleton
) -> tuple[np.ndarray, bool]:
    """Return 2D poses, centred at x = 0 with lowest joint at y = 0, and whether they were 3D."""
    is_3d = poses.shape[-1:] == (3,)
    check_shape(name, poses, ("n", skeleton.n_joints, 3 if is_3d else 2))
    if len(poses) == 0:
        raise ValueError(f"{name} must contain at least one pose-pair, got none")
    poses = np.asarray(poses, dtype=np.float64)
    if is_3d:
        check_finite(name, poses)
        poses = camera.project(poses[:, None])[:, 0, 0] * np.array([1.0, -1.0])
    missing = np.isnan(poses).any(axis=-1)
    for index in np.flatnonzero(missing.all(axis=1)):
        raise ValueError(f"{name}[{index}] must have at least one visible joint, got none")
    low, high = np.nanmin(poses, axis=1), np.nanmax(poses, axis=1)
    middle = np.stack([0.5 * (low[:, 0] + high[:, 0]), low[:, 1]], axis=-1)
    return poses - middle[:, None], is_3d


def _compose(lines: list[_Row], skeleton: Skeleton, title: str) -> Figure:
    from matplotlib.figure import Figure

    reach = 1.04 * max(float(np.nanmax(line.poses[..., 0])) for line in lines) + 1e-9
    slots = max(len(line.poses) for line in lines)
    # A letter of a row label is about 0.075 inches wide.
    label_width = 0.25 + 0.075 * max(len(line.label) for line in lines)
    slot = min((PAGE - label_width) / slots - _GAP, _MAX_WIDTH)
    scale = slot / (2 * reach)
    height = _TOP + sum((line.span[1] - line.span[0]) * scale + _GAP for line in lines)
    figure = Figure(figsize=(PAGE, height))
    top = height - _TOP
    for line in lines:
        low, high = line.span
        tall = (high - low) * scale
        bottom = top - tall
        label_at = ((label_width - 0.1) / PAGE, (bottom + tall / 2) / height)
        figure.text(*label_at, line.label, ha="right", va="center", size=SIZE, color=INK)
        for column, pose in enumerate(line.poses):
            left = label_width + column * (slot + _GAP)
            axes = figure.add_axes((left / PAGE, bottom / height, slot / PAGE, tall / height))
            axes.set(xlim=(-reach, reach), ylim=(low, high))
            axes.set_axis_off()
            axes.set_facecolor("none")
            _draw_pair(axes, pose, skeleton, line.is_3d)
        top = bottom - _GAP
    write_key(figure, title, {})
    return figure


def _draw_pair(axes: Axes, pose: np.ndarray, skeleton: Skeleton, is_3d: bool) -> None:
    from matplotlib.collections import LineCollection

    if is_3d:
        draw_ground(axes)
    right = {joint for _, joint in skeleton.mirrored_pairs}
    for index, root in enumerate(skeleton.roots):
        bones = [
            (joint, parent)
            for joint, parent in skeleton.bones
            if root in skeleton.ancestors(joint) and np.isfinite(pose[[joint, parent]]).all()
        ]
        colour = _CHARACTERS[index % len(_CHARACTERS)]
        style: dict[str, Any] = {"capstyle": "round", "linewidths": 1.1, "colors": colour}
        style["linestyles"] = "solid" if is_3d else (0, (1.6, 1.6))
        for paler, alpha in ((True, 0.5), (False, 1.0)):
            chosen = [pose[list(bone)] for bone in bones if (bone[0] in right) == paler]
            axes.add_collection(LineCollection(chosen, alpha=alpha, **style))
