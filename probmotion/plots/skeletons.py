"""Filmstrips of skeletons, with a row of draws per sampler at a common scale."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from probmotion.geometry.cameras import Cameras
from probmotion.motion.skeleton import Skeleton
from probmotion.plots.style import GREY, INK, LEFT, PAGE, RIGHT, SIZE, TITLE, finish_figure
from probmotion.validation import check_count, check_finite, check_shape

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle

__all__ = [
    "WIDEST", "checked_rows", "draw_ground", "draw_skeletons", "face_heading", "head_circles",
    "head_joints", "joint_sides", "project_frames", "vertical_range", "write_key",
]  # fmt: skip

_HEAD = {"head", "head_top", "nose", "left_eye", "right_eye", "left_ear", "right_ear"}
_HEAD_RADIUS = 0.022  # relative to the sum of all bone lengths
_TOP, _GAP = 0.36, 0.06  # space for the title and between strips, inches
WIDEST = 1.4  # maximum width of a slot, relative to that of the first row
_MAX_STRIP_HEIGHT = 1.3  # maximum height of a strip, inches


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
    """Return a figure with a row of filmstrips per entry of ``rows``.

    A strip shows ``moments`` frames of one motion side by side, the left side of the body in blue
    and the right in red. All strips have the same scale; much larger motions are clipped.

    Parameters
    ----------
    rows : mapping of str to ndarray, (n, L, J, 3)
        Motions in metres by label, from top to bottom. The first row determines the scale.
    skeleton : Skeleton
        Skeleton of the J joints.
    path : str or Path, optional
        File to write: .png, .pdf or .svg.
    draws : int
        Maximum number of motions per row, counted from the first.
    moments : int
        Number of evenly spaced frames per motion.
    azimuth, elevation : float
        Direction of the camera in radians, as in :meth:`Cameras.ring`.
    heading : float, optional
        Mean heading, in radians from +Z towards +X, to which motions are rotated, if given.
    truth : ndarray, (L, J, 3), optional
        Motion drawn in grey behind every strip, at its position relative to the motion.
    title : str
        Title of the figure.

    Raises
    ------
    ValueError
        If there are no rows, a shape does not match the skeleton, a value is not finite, or
        ``heading`` is given for a skeleton without left-right pairs.
    """
    check_count("moments", moments)
    shown = checked_rows(rows, skeleton, draws)
    if heading is not None:
        shown = {
            label: face_heading(motions, skeleton, heading) for label, motions in shown.items()
        }
    camera = Cameras.around(np.array([azimuth]), np.array([elevation]))
    strips = {label: project_frames(camera, motions, moments) for label, motions in shown.items()}
    truth_strip = (
        None if truth is None else project_frames(camera, np.asarray(truth)[None], moments)[0]
    )
    return finish_figure(_compose(strips, skeleton, truth_strip, title), path)


def checked_rows(
    rows: Mapping[str, np.ndarray], skeleton: Skeleton, draws: int | None = None
) -> dict[str, np.ndarray]:
    """Return the first draws of each row, (n, L, J, 3), after checking shapes and values."""
    if draws is not None:
        check_count("draws", draws)
    if not rows:
        raise ValueError("rows must contain at least one label with motions, got none")
    shown = {}
    for label, motions in rows.items():
        check_shape(f"rows[{label!r}]", motions, ("n", "L", skeleton.n_joints, 3))
        if 0 in motions.shape[:2]:
            raise ValueError(
                f"rows[{label!r}] must contain at least one motion of at least one frame, got "
                f"shape {tuple(motions.shape)}"
            )
        check_finite(f"rows[{label!r}]", np.asarray(motions))
        shown[label] = np.asarray(motions, dtype=np.float64)[:draws]
    return shown


def face_heading(motions: np.ndarray, skeleton: Skeleton, heading: float) -> np.ndarray:
    """Rotate each motion, (n, L, J, 3), about the vertical to a mean heading in radians."""
    if not skeleton.mirrored_pairs:
        raise ValueError(f"heading must be None without left-right pairs, got {heading:g}")
    left, right = np.array(skeleton.mirrored_pairs).T
    across = (motions[:, :, left] - motions[:, :, right]).mean(axis=(1, 2))
    # The left side of a body facing +Z is at +X.
    yaw = heading - np.arctan2(-across[:, 2], across[:, 0])
    c, s = np.cos(yaw)[:, None, None], np.sin(yaw)[:, None, None]
    x, y, z = motions[..., 0], motions[..., 1], motions[..., 2]
    return np.stack([c * x + s * z, y, c * z - s * x], axis=-1)


def joint_sides(skeleton: Skeleton) -> list[str]:
    """Return "left", "right" or "middle" for each joint."""
    sides = ["middle"] * skeleton.n_joints
    for left, right in skeleton.mirrored_pairs:
        sides[left], sides[right] = "left", "right"
    return sides


def project_frames(camera: Cameras, motions: np.ndarray, moments: int) -> np.ndarray:
    """Project ``(n, L, J, 3) → (n, moments, J, 2)``, in metres with y up."""
    frames = np.linspace(0, motions.shape[1] - 1, moments).round().astype(int)
    return camera.project(motions[:, frames])[:, 0] * np.array([1.0, -1.0])


def _compose(
    strips: Mapping[str, np.ndarray], skeleton: Skeleton, truth: np.ndarray | None, title: str
) -> Figure:
    from matplotlib.figure import Figure

    moments = next(iter(strips.values())).shape[1]
    columns = max(len(strip) for strip in strips.values())
    slot = _slot_width(strips, truth)
    low, high = vertical_range(next(iter(strips.values())), skeleton)
    # A letter of a row label is about 0.075 inches wide.
    label_width = 0.25 + 0.075 * max(map(len, strips))
    shape = (high - low) / (slot * moments)
    strip_width = min((PAGE - label_width) / columns - _GAP, _MAX_STRIP_HEIGHT / shape)
    strip_height = strip_width * shape
    height = _TOP + len(strips) * (strip_height + _GAP)
    figure = Figure(figsize=(PAGE, height))
    top = height - _TOP
    for row, (label, motions) in enumerate(strips.items()):
        bottom = top - (row + 1) * (strip_height + _GAP) + _GAP
        middle = (bottom + strip_height / 2) / height
        figure.text(
            (label_width - 0.1) / PAGE, middle, label, ha="right", va="center", size=SIZE, color=INK
        )
        for column, motion in enumerate(motions):
            left = label_width + column * (strip_width + _GAP)
            box = (left / PAGE, bottom / height, strip_width / PAGE, strip_height / height)
            axes = figure.add_axes(box)
            axes.set(xlim=(0, slot * moments), ylim=(low, high))
            axes.set_aspect("equal")
            axes.set_axis_off()
            axes.set_facecolor("none")
            _draw_strip(axes, motion, truth, skeleton, slot)
    entries = {"left side": LEFT, "right side": RIGHT}
    write_key(figure, title, entries if truth is None else entries | {"truth": "#8F8F8F"})
    return figure


def _anchor(motion: np.ndarray, truth: np.ndarray | None) -> np.ndarray:
    """Return the horizontal coordinate at the centre of each frame's slot, (moments,)."""
    body = motion if truth is None else truth
    return np.median(body[..., 0], axis=-1)


def _slot_width(strips: Mapping[str, np.ndarray], truth: np.ndarray | None) -> float:
    """Return the width of a frame's slot, metres."""
    sideways = [
        np.quantile(
            [np.abs(motion[..., 0] - _anchor(motion, truth)[:, None]) for motion in row], 0.995
        )
        for row in strips.values()
    ]
    return 2.1 * float(min(max(sideways), WIDEST * sideways[0])) + 1e-9


def vertical_range(motions: np.ndarray, skeleton: Skeleton) -> tuple[float, float]:
    """Return the vertical range of motions (n, L, J, 2), with a margin and whole heads, metres."""
    low, high = float(motions[..., 1].min()), float(motions[..., 1].max())
    margin = 0.08 * (high - low) + 1e-9
    tops = [head.get_extents().y1 for motion in motions for head in head_circles(motion, skeleton)]
    return low - margin, max([high + margin, *tops])


def _draw_strip(
    axes: Axes, motion: np.ndarray, truth: np.ndarray | None, skeleton: Skeleton, slot: float
) -> None:
    from matplotlib.collections import LineCollection, PatchCollection

    moments = len(motion)
    shift = np.zeros((moments, 1, 2))
    shift[:, 0, 0] = slot * (np.arange(moments) + 0.5) - _anchor(motion, truth)
    draw_ground(axes)
    style: dict[str, Any] = {"capstyle": "round", "joinstyle": "round"}
    if truth is not None:
        bones = _bones(truth + shift, skeleton.bones)
        axes.add_collection(LineCollection(bones, colors=GREY, linewidths=2.0, **style))
        heads = head_circles(truth + shift, skeleton)
        axes.add_collection(PatchCollection(heads, facecolors=GREY, zorder=2))
    heads = head_circles(motion + shift, skeleton)
    axes.add_collection(PatchCollection(heads, facecolors=INK, zorder=2))
    sides = joint_sides(skeleton)
    # Limbs are drawn over the trunk.
    for side, colour in (("middle", INK), ("right", RIGHT), ("left", LEFT)):
        chosen = [bone for bone in skeleton.bones if sides[bone[0]] == side]
        lines = _bones(motion + shift, chosen)
        axes.add_collection(LineCollection(lines, colors=colour, linewidths=1.0, **style))


def _bones(frames: np.ndarray, bones: Sequence[tuple[int, int]]) -> list:
    return [pose[[joint, parent]] for pose in frames for joint, parent in bones]


def draw_ground(axes: Axes) -> None:
    """Draw a grey line at the lower edge of axes."""
    low = axes.get_ylim()[0]
    axes.plot(axes.get_xlim(), [low, low], color=GREY, linewidth=1.2, solid_capstyle="butt")


def head_joints(skeleton: Skeleton) -> list[int]:
    """Return the joints of the head; its centre is their mean."""
    return [joint for joint, name in enumerate(skeleton.canonical_names) if name in _HEAD]


def head_circles(poses: np.ndarray, skeleton: Skeleton) -> list[Circle]:
    """Return a circle at the head of each pose, (n, J, 2); none for skeletons without a head."""
    from matplotlib.patches import Circle

    head = head_joints(skeleton)
    if not head:
        return []
    child, parent = np.array(skeleton.bones).T
    lengths = np.linalg.norm(poses[:, child] - poses[:, parent], axis=-1)
    radius = _HEAD_RADIUS * lengths.sum(axis=-1).max()
    return [Circle(tuple(centre), radius) for centre in poses[:, head].mean(axis=1)]


def write_key(figure: Figure, title: str, entries: Mapping[str, str]) -> None:
    """Write the title and, right-aligned, a legend: coloured words."""
    width, height = figure.get_size_inches()
    top = 1 - 0.08 / height
    figure.text(0.08 / width, top, title, va="top", size=TITLE, color=INK, weight="bold")
    right = 1 - 0.08 / width
    for words, colour in reversed(list(entries.items())):
        text = figure.text(right, top, words, ha="right", va="top", size=SIZE, color=colour)
        text.set_parse_math(False)
        text.set_fontweight("bold")
        right -= (text.get_window_extent().width / figure.dpi + 0.14) / width
