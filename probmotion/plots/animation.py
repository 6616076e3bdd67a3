"""Browser animations of skeletons, with a canvas per row of motions and synchronised playback.

The HTML pages are self-contained.
"""

from __future__ import annotations

import html
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np

from probmotion.comparison.results.stored_problems import StoredProblem
from probmotion.files import written_whole
from probmotion.motion.skeleton import Skeleton
from probmotion.plots.motion_data import Shown, motion_numbers
from probmotion.plots.skeletons import checked_rows
from probmotion.plots.style import LEFT, RIGHT
from probmotion.validation import check_positive

__all__ = ["Animation", "animate_skeletons", "animated_page", "animation_html"]

# Nothing is loaded from the network, and no form is sent.
_CONTENT_POLICY = (
    '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; img-src data:; '
    "style-src 'unsafe-inline'; script-src 'unsafe-inline'; base-uri 'none'; "
    "form-action 'none'\">"
)

# Width of the cell of a motion and minimum width of the page, pixels.
_PLACE, _CONTROLS = 180, 420
_LEFT_ON_DARK, _RIGHT_ON_DARK = "#5BB3E8", "#F58A4B"


@dataclass(frozen=True)
class Animation:
    """HTML page of animated skeletons, displayed by Jupyter in an iframe.

    Parameters
    ----------
    html : str
        HTML page.
    width, height : int
        Size of the page in pixels.
    """

    html: str
    width: int
    height: int

    def _repr_html_(self) -> str:
        """Return the page in an iframe, which isolates it from the notebook."""
        return (
            f'<iframe srcdoc="{html.escape(self.html)}" sandbox="allow-scripts" '
            f'title="Animated skeletons" width="{self.width}" height="{self.height}" '
            'style="border: 0; max-width: 100%"></iframe>'
        )


def animate_skeletons(
    rows: Mapping[str, np.ndarray],
    skeleton: Skeleton,
    path: str | Path | None = None,
    *,
    fps: float,
    draws: int = 4,
    title: str = "",
) -> Animation:
    """Return an HTML animation of skeletons.

    Dragging or the arrow keys rotate all skeletons, the space bar pauses and resumes playback, and
    the slider selects a frame. The left side of the body is blue, the right side is red. Bodies are
    centred in their cells and have the same scale.

    Parameters
    ----------
    rows : mapping of str to ndarray, (n, L, J, 3)
        Motions in metres, by label of the row, from top to bottom. All motions have equal length.
        The first row determines the scale; larger motions are clipped.
    skeleton : Skeleton
        Skeleton of the J joints.
    path : str or Path, optional
        HTML file to write.
    fps : float
        Frames per second.
    draws : int
        Number of motions to show per row, starting with the first.
    title : str
        Title above the skeletons.

    Raises
    ------
    ValueError
        If there are no rows, a row is empty, lengths differ, a shape does not match the skeleton, a
        value is not finite, ``fps`` is not positive, or the path does not end in ``.html``.
    OSError
        If the folder cannot be written to.
    """
    check_positive("fps", fps)
    chosen = checked_rows(rows, skeleton, draws)
    frames = [motions.shape[1] for motions in chosen.values()]
    if len(set(frames)) > 1:
        raise ValueError(f"rows must have motions of equal length, got {frames} frames")
    shown = Shown(StoredProblem(skeleton, fps), chosen, turned=False)
    captions = {label: label for label in chosen}
    heading = f"<h1>{html.escape(title)}</h1>\n" if title else ""
    name = title or "Animated skeletons"
    style = "h1 { font-size: 1.1rem; margin: 0; }\n.cards { grid-template-columns: 1fr; }\n"
    body = heading + animation_html(title or "the skeletons", shown, captions)
    page = animated_page(name, body, style)
    if path is not None:
        path = Path(path)
        if path.suffix.lower() != ".html":
            raise ValueError(f"path must end in .html, got {str(path)!r}")
        with written_whole(path) as unfinished:
            unfinished.write_text(page, encoding="utf-8")
    data = motion_numbers(shown)
    width = max(_PLACE * data["columns"], _CONTROLS)
    height = len(chosen) * (width * data["up"] / (data["columns"] * data["across"]) + 50)
    return Animation(page, width + 30, round(height) + (190 if title else 160))


def animated_page(
    title: str, body: str, style: str = "", functions: Mapping[str, str] | None = None
) -> str:
    """Return an HTML page whose animations play.

    Parameters
    ----------
    title : str
        Title, plain text.
    body : str
        HTML, with animations of :func:`animation_html`.
    style : str
        Further style sheet.
    functions : mapping of str to str, optional
        Further JavaScript functions, by the CSS selector of the elements that they are called with.
    """
    functions = {".animation": _text("animation.js"), **(functions or {})}
    scripts = "".join(
        f'document.querySelectorAll("{selector}").forEach({function});\n'
        for selector, function in functions.items()
    )
    return f"""\
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
{_CONTENT_POLICY}
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{html.escape(title)}</title>
<style>
{_style()}{style}</style>
</head>
<body>
{body}
<script>
{scripts}</script>
</body>
</html>
"""


def animation_html(
    name: str,
    shown: Shown,
    captions: Mapping[str, str],
    *,
    further_cards: Sequence[str] = (),
    attributes: str = 'aria-label="Animated skeletons"',
) -> str:
    """Return the controls, canvases and data of an animation as HTML without ids.

    ``captions`` maps row labels to captions, ``further_cards`` are HTML cards without motions, and
    ``attributes`` are HTML attributes of the group of canvases.
    """
    data = motion_numbers(shown)
    problem = shown.problem
    # Escape "<", so that no text can end the script element.
    numbers = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", r"\u003c")
    ratio = f"{data['columns'] * data['across']:.3f} / {data['up']:.3f}"
    kind = "skeletons" if shown.frames == 1 else "animated skeletons"
    with_truth = "" if problem.truth is None else ", the truth in grey behind each"
    cards = []
    for label in shown.rows:
        description = f"{captions[label]}, on {name}, as {kind}{with_truth}."
        cards.append(
            f'<figure><canvas role="img" style="aspect-ratio: {ratio}" '
            f'aria-label="{html.escape(description)}">This animation requires JavaScript.</canvas>'
            f"<figcaption>{html.escape(captions[label])}</figcaption></figure>"
        )
    still, without_camera = data["frames"] == 1, problem.camera is None
    return f"""\
<div class="animation">
<div class="controls"{_hidden(still and without_camera and problem.truth is None)}>
<button type="button" data-does="play"{_hidden(still)}>Play</button>
<input type="range" min="0" max="{data["frames"] - 1}" value="0" step="1" \
aria-label="Frame of {html.escape(name)}"{_hidden(still)}>
<output{_hidden(still)}></output>
<button type="button" data-does="camera" aria-pressed="false"{_hidden(without_camera)}>\
Camera’s view</button>
<label{_hidden(problem.truth is None)}><input type="checkbox" data-does="truth" checked> \
truth</label>
</div>
<ul class="key quiet">{_key(shown, data["largestSd"])}</ul>
<div class="cards" role="group" tabindex="0" {attributes}>
{chr(10).join([*cards, *further_cards])}
</div>
<script type="application/json">{numbers}</script>
</div>"""


def _style() -> str:
    """Return the style sheet of animations, including the colours of left and right."""
    return (
        f"{_text('animation.css')}:root {{ --left: {LEFT}; --right: {RIGHT}; }}\n"
        "@media screen and (prefers-color-scheme: dark) "
        f"{{ :root {{ --left: {_LEFT_ON_DARK}; --right: {_RIGHT_ON_DARK}; }} }}\n"
    )


def _text(name: str) -> str:
    return files("probmotion.plots").joinpath(name).read_text(encoding="utf-8")


def _hidden(hidden: bool) -> str:
    return " hidden" if hidden else ""


def _key(shown: Shown, largest_sd: float) -> str:
    problem = shown.problem
    entries = [("left", "left side"), ("right", "right side")]
    entries = entries if problem.skeleton.mirrored_pairs and not shown.overlaid else []
    if problem.truth is not None:
        entries.append(("ghost", "truth"))
    items = [
        f'<li><span style="background: var(--{colour})"></span>{words}</li>'
        for colour, words in entries
    ]
    if shown.overlaid and max(map(len, shown.rows.values())) > 1:
        items.append(
            f'<li>posterior sd of joints: 0 <span class="sd"></span>{largest_sd / 10:g} cm</li>'
        )
        items.append('<li><span class="others"></span>other draws</li>')
    if problem.joints is not None:
        items.append('<li><span class="ring"></span>observed noisy 3D joints</li>')
    if problem.keypoints is not None:
        items.append('<li><span class="ring"></span>observed keypoints, in the camera’s view</li>')
    return "".join(items)
