"""Skeletons that play in a browser: draws of several samplers, row under row, to be turned.

All is in one piece of HTML, which asks nothing of the network.
"""

from __future__ import annotations

import html
import json
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from probmotion.files import written_whole
from probmotion.motion.skeleton import Skeleton
from probmotion.plots.colours import GREY, INK, LEFT, RIGHT
from probmotion.validation import check_count, check_finite, check_positive, check_shape

__all__ = ["Playing", "play_skeletons", "playing_figure"]

_MARGIN = 150
"""Pixels beside the rows, for their labels."""
_PLACE = 210
"""Pixels that the larger side of a motion's place has."""
_CONTROLS = 420
"""Pixels that button, slider and key need."""
_TILT = 0.3
"""How far a view may be raised, radians, before it leaves the height of its place."""


@dataclass(frozen=True)
class Playing:
    """Skeletons that play.

    Parameters
    ----------
    html : str
        A page of its own.
    width, height : int
        What it takes, pixels.
    """

    html: str
    width: int
    height: int

    def _repr_html_(self) -> str:
        """Return the page in a frame, where nothing of a notebook can disturb it, nor it that."""
        return (
            f'<iframe srcdoc="{html.escape(self.html)}" sandbox="allow-scripts" '
            f'title="Skeletons that play" width="{self.width}" height="{self.height}" '
            'style="border: 0; max-width: 100%"></iframe>'
        )


def play_skeletons(
    rows: Mapping[str, np.ndarray],
    skeleton: Skeleton,
    path: str | Path | None = None,
    *,
    fps: float,
    draws: int = 4,
    title: str = "",
) -> Playing:
    """Return skeletons that play in a browser, and write them as an HTML page.

    Drag a figure, or press the arrow keys on it, to turn all; the space bar stops and goes on; the
    slider goes to a frame. The body's left is blue and its right red. Each body stays in the middle
    of its place, and all are at the same scale.

    Parameters
    ----------
    rows : mapping of str to ndarray, (n, L, J, 3)
        Motions in metres by label, from the top down, all of one length; the first ``draws`` of
        each are shown. The first row sets the scale; what leaves its place is cut off.
    skeleton : Skeleton
        The J joints.
    path : str or Path, optional
        Where to write, ``.html``; nowhere by default.
    fps : float
        Frames per second to play at.
    draws : int
        Motions per row.
    title : str
        Above the skeletons.

    Raises
    ------
    ValueError
        If there is no row, a row is empty or of another length, a shape does not fit the skeleton,
        a value is not finite, ``fps`` is not positive, or the path does not end in ``.html``.
    OSError
        If the folder cannot be written to.
    """
    figure = playing_figure(rows, skeleton, fps=fps, draws=draws, title=title)
    page = (
        '<!DOCTYPE html>\n<html lang="en">\n<head><meta charset="utf-8">'
        f"<title>{html.escape(title or 'Skeletons that play')}</title></head>\n"
        f'<body style="margin: 8px">\n{figure}\n</body>\n</html>\n'
    )
    if path is not None:
        path = Path(path)
        if path.suffix.lower() != ".html":
            raise ValueError(f"path must be a name that ends in .html, got {str(path)!r}")
        with written_whole(path) as unfinished:
            unfinished.write_text(page, encoding="utf-8")
    layout = _layout(_shown(rows, skeleton, draws))
    width = max(layout["width"], _CONTROLS) + 30
    return Playing(page, width, layout["height"] + (90 if title else 60))


def playing_figure(
    rows: Mapping[str, np.ndarray],
    skeleton: Skeleton,
    *,
    fps: float,
    draws: int = 4,
    title: str = "",
) -> str:
    """Return the ``<figure>`` of :func:`play_skeletons`, to stand in a page beside others.

    It brings its script, and has neither global names nor ids.
    """
    check_positive("fps", fps)
    shown = _shown(rows, skeleton, draws)
    layout = _layout(shown)
    first = next(iter(shown.values()))
    data = layout | {
        "fps": float(fps),
        "frames": first.shape[1],
        "joints": skeleton.n_joints,
        "bones": _sided_bones(skeleton),
        "colours": {"left": LEFT, "right": RIGHT, "middle": INK},
        "floor": GREY,
        "ink": INK,
        "rows": [
            {"label": label.split("\n"), "motions": _millimetres(motions)}
            for label, motions in shown.items()
        ],
    }
    script = files("probmotion.plots").joinpath("animation.js").read_text(encoding="utf-8")
    # No label can end the script.
    numbers = json.dumps(data, separators=(",", ":")).replace("<", r"\u003c")
    words = ", ".join(
        f"{len(motions)} of {' '.join(label.split())}" for label, motions in shown.items()
    )
    caption = f'<div style="font-size: 17px">{html.escape(title)}</div>' if title else ""
    return f"""\
<figure style="margin: 0; font-family: sans-serif; color: {INK}">
{caption}
<canvas role="img" tabindex="0" width="{data["width"]}" height="{data["height"]}"
 style="width: {data["width"]}px; height: auto; max-width: 100%; cursor: grab; touch-action: none"
 aria-label="{html.escape(f"Skeletons that move: {words}. The arrow keys turn them.")}"
>To be seen, they need a browser that runs scripts.</canvas>
<div style="display: flex; gap: 12px; align-items: center;
 max-width: {max(data["width"], _CONTROLS)}px">
<button type="button" style="width: 5em">Play</button>
<input type="range" min="0" max="{data["frames"] - 1}" value="0" aria-label="Frame"
 style="flex: 1">
<span><b style="color: {LEFT}">left side</b> <b style="color: {RIGHT}">right side</b></span>
</div>
<script>({script})(document.currentScript.parentElement, {numbers});</script>
</figure>"""


def _shown(rows: Mapping[str, np.ndarray], skeleton: Skeleton, draws: int) -> dict[str, np.ndarray]:
    """The first motions of each row, the body's middle at the horizontal origin."""
    check_count("draws", draws)
    if not rows:
        raise ValueError("rows must contain at least one label with motions, got none")
    shown: dict[str, np.ndarray] = {}
    frames: int | str = "L"
    for label, motions in rows.items():
        check_shape(f"rows[{label!r}]", motions, ("n", frames, skeleton.n_joints, 3))
        if 0 in motions.shape[:2]:
            raise ValueError(
                f"rows[{label!r}] has shape {tuple(motions.shape)}, expected at least one motion "
                "of at least one frame"
            )
        check_finite(f"rows[{label!r}]", np.asarray(motions))
        frames = motions.shape[1]
        bodies = np.asarray(motions, dtype=np.float64)[:draws]
        middle = bodies[:, :, list(skeleton.roots)].mean(axis=2, keepdims=True)
        shown[label] = bodies - middle * np.array([1.0, 0.0, 1.0])
    return shown


def _layout(shown: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Sizes in pixels, and what of the world is seen: the first row sets the scale."""
    first = next(iter(shown.values()))
    reach = 1.05 * float(np.quantile(np.hypot(first[..., 0], first[..., 2]), 0.999)) + 1e-9
    low, high = float(first[..., 1].min()), float(first[..., 1].max())
    across = 2.1 * reach
    up = 1.05 * (high - low) + 2 * reach * np.sin(_TILT)
    scale = _PLACE / max(across, up)
    place = {"width": round(scale * across), "height": round(scale * up)}
    columns = max(len(motions) for motions in shown.values())
    return {
        "scale": round(scale, 2),
        "place": place,
        "margin": _MARGIN,
        "width": _MARGIN + columns * place["width"],
        "height": len(shown) * place["height"],
        "low": round(low, 3),
        "middle": round((low + high) / 2, 3),
        "reach": round(reach, 3),
    }


def _sided_bones(skeleton: Skeleton) -> list[tuple[int, int, str]]:
    sides = dict.fromkeys(range(skeleton.n_joints), "middle")
    for left, right in skeleton.mirrored_pairs:
        sides[left], sides[right] = "left", "right"
    return [(joint, parent, sides[joint]) for joint, parent in skeleton.bones]


def _millimetres(motions: np.ndarray) -> list[list[int]]:
    """Whole millimetres of each motion, (L J 3) in a row."""
    return np.rint(1000 * motions).astype(int).reshape(len(motions), -1).tolist()
