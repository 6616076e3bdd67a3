"""Filmstrips of skeletons: draws of several samplers, row under row, at one scale."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from probmotion.geometry.cameras import Cameras
from probmotion.motion.skeleton import Skeleton
from probmotion.plots.colours import GREY, INK, LEFT, RIGHT, save_figure
from probmotion.validation import check_count, check_finite, check_shape

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["draw_skeletons"]


def draw_skeletons(
    rows: Mapping[str, np.ndarray],
    skeleton: Skeleton,
    path: str | Path | None = None,
    *,
    draws: int = 4,
    moments: int = 5,
    azimuth: float = 0.0,
    elevation: float = 0.0,
    heading: float | None = None,
    truth: np.ndarray | None = None,
    title: str = "",
) -> Figure:
    """Return a figure with one row of filmstrips per entry of ``rows``, and write it as PNG.

    Every strip shows ``moments`` frames of one motion side by side, the body's left in blue and
    its right in red. All are drawn at the same scale; what leaves its strip is cut off.

    Parameters
    ----------
    rows : mapping of str to ndarray, (n, L, J, 3)
        Motions in metres by label, drawn from the top down; the first ``draws`` of each are shown.
        The first row sets the scale.
    skeleton : Skeleton
        The J joints.
    path : str or Path, optional
        Where to write, ``.png``; nowhere by default.
    draws : int
        Motions per row.
    moments : int
        Frames per motion, evenly spaced from the first to the last.
    azimuth, elevation : float
        Where the motions are looked at from, radians, as in :meth:`Cameras.ring`.
    heading : float, optional
        Turn every motion about the vertical so that its body faces this way on average, radians
        from +Z towards +X; as drawn by default.
    truth : ndarray, (L, J, 3), optional
        Drawn in grey behind every motion, at the place it has relative to it.
    title : str
        Above the picture.

    Raises
    ------
    ValueError
        If there is no row, a shape does not fit the skeleton, a value is not finite, or
        ``heading`` is given for a skeleton without named sides.
    """
    check_count("draws", draws)
    check_count("moments", moments)
    if not rows:
        raise ValueError("rows must contain at least one label with motions, got none")
    shown = {}
    for label, motions in rows.items():
        check_shape(f"rows[{label!r}]", motions, ("n", "L", skeleton.n_joints, 3))
        check_finite(f"rows[{label!r}]", np.asarray(motions))
        shown[label] = np.asarray(motions, dtype=np.float64)[:draws]
    if heading is not None:
        shown = {label: _facing(motions, skeleton, heading) for label, motions in shown.items()}
    camera = Cameras.around(np.array([azimuth]), np.array([elevation]))
    strips = {label: _seen(camera, motions, moments) for label, motions in shown.items()}
    behind = None if truth is None else _seen(camera, np.asarray(truth)[None], moments)[0]
    figure = _compose(strips, skeleton, behind, title)
    if path is not None:
        save_figure(figure, path)
    return figure


def _facing(motions: np.ndarray, skeleton: Skeleton, heading: float) -> np.ndarray:
    """Turn motions so that the left side of each is, on average, a quarter turn left of heading."""
    if not skeleton.mirrored_pairs:
        raise ValueError("heading is given, but skeleton has no left-right pairs to take it from")
    left, right = np.array(skeleton.mirrored_pairs).T
    across = (motions[:, :, left] - motions[:, :, right]).mean(axis=(1, 2))
    # A body that faces +Z has its left on +X.
    yaw = heading - np.arctan2(-across[:, 2], across[:, 0])
    c, s = np.cos(yaw)[:, None, None], np.sin(yaw)[:, None, None]
    x, y, z = motions[..., 0], motions[..., 1], motions[..., 2]
    return np.stack([c * x + s * z, y, c * z - s * x], axis=-1)


def _seen(camera: Cameras, motions: np.ndarray, moments: int) -> np.ndarray:
    """Return ``(n, L, J, 3) → (n, moments, J, 2)``, metres on the picture, y up."""
    frames = np.linspace(0, motions.shape[1] - 1, moments).round().astype(int)
    picture = camera.project(motions[:, frames])[:, 0]
    return picture * np.array([1.0, -1.0])


def _compose(
    strips: Mapping[str, np.ndarray], skeleton: Skeleton, truth: np.ndarray | None, title: str
) -> Figure:
    from matplotlib.figure import Figure

    moments = next(iter(strips.values())).shape[1]
    columns = max(len(strip) for strip in strips.values())
    slot, low, high = _extent(strips, truth)
    strip_width = max(2.35, 7.0 / columns)
    strip_height = strip_width * (high - low) / (slot * moments)
    # A letter of this size is about .09 inches wide.
    label_width, head = max(1.15, 0.2 + 0.09 * max(map(len, strips))), 0.42
    width = label_width + columns * (strip_width + 0.1)
    height = head + len(strips) * (strip_height + 0.08) + 0.05
    figure = Figure(figsize=(width, height))
    top = height - head
    for row, (label, motions) in enumerate(strips.items()):
        bottom = top - (row + 1) * (strip_height + 0.08) + 0.08
        middle = (bottom + strip_height / 2) / height
        figure.text(
            (label_width - 0.12) / width, middle, label, ha="right", va="center", size=10, color=INK
        )
        for column, motion in enumerate(motions):
            left = label_width + column * (strip_width + 0.1)
            box = (left / width, bottom / height, strip_width / width, strip_height / height)
            axes = figure.add_axes(box)
            axes.set(xlim=(0, slot * moments), ylim=(low, high))
            axes.set_aspect("equal")
            axes.set_axis_off()
            axes.set_facecolor("none")
            _draw_strip(axes, motion, truth, skeleton, slot, low)
    _write_key(figure, title, truth is not None, width, height)
    return figure


def _anchor(motion: np.ndarray, truth: np.ndarray | None) -> np.ndarray:
    """The point of each moment that stands in the middle of its slot, (moments,)."""
    body = motion if truth is None else truth
    return np.median(body[..., 0], axis=-1)


def _extent(
    strips: Mapping[str, np.ndarray], truth: np.ndarray | None
) -> tuple[float, float, float]:
    """Width of one moment's slot and the lowest and highest point of a strip, metres."""
    reference = np.stack([*next(iter(strips.values()))])
    sideways = np.stack(
        [np.abs(motion[..., 0] - _anchor(motion, truth)[:, None]) for motion in reference]
    )
    low, high = float(reference[..., 1].min()), float(reference[..., 1].max())
    margin = 0.08 * (high - low) + 1e-9
    return 2.1 * float(np.quantile(sideways, 0.995)) + 1e-9, low - margin, high + margin


def _draw_strip(
    axes: Axes,
    motion: np.ndarray,
    truth: np.ndarray | None,
    skeleton: Skeleton,
    slot: float,
    low: float,
) -> None:
    from matplotlib.collections import LineCollection

    moments = len(motion)
    shift = np.zeros((moments, 1, 2))
    shift[:, 0, 0] = slot * (np.arange(moments) + 0.5) - _anchor(motion, truth)
    axes.plot([0, slot * moments], [low, low], color=GREY, linewidth=1.2, solid_capstyle="butt")
    style: dict[str, Any] = {"capstyle": "round", "joinstyle": "round"}
    if truth is not None:
        bones = _bones(truth + shift, skeleton.bones)
        axes.add_collection(LineCollection(bones, colors=GREY, linewidths=2.6, **style))
    sides = _sides(skeleton)
    # The middle first, so that limbs are seen before the trunk.
    for side, colour in (("middle", INK), ("right", RIGHT), ("left", LEFT)):
        chosen = [bone for bone in skeleton.bones if sides[bone[0]] == side]
        lines = _bones(motion + shift, chosen)
        axes.add_collection(LineCollection(lines, colors=colour, linewidths=1.3, **style))


def _bones(moments: np.ndarray, bones: list[tuple[int, int]] | tuple[tuple[int, int], ...]) -> list:
    return [pose[[joint, parent]] for pose in moments for joint, parent in bones]


def _sides(skeleton: Skeleton) -> list[str]:
    sides = ["middle"] * skeleton.n_joints
    for left, right in skeleton.mirrored_pairs:
        sides[left], sides[right] = "left", "right"
    return sides


def _write_key(figure: Figure, title: str, with_truth: bool, width: float, height: float) -> None:
    """Write the title and, from the right, what each colour means."""
    top = 1 - 0.1 / height
    figure.text(0.12 / width, top, title, va="top", size=12, color=INK)
    entries = [("left side", LEFT), ("right side", RIGHT)]
    entries += [("truth", "#8F8F8F")] if with_truth else []
    right = 1 - 0.12 / width
    for words, colour in reversed(entries):
        text = figure.text(right, top, words, ha="right", va="top", size=10, color=colour)
        text.set_fontweight("bold")
        right -= (text.get_window_extent().width / figure.dpi + 0.16) / width
