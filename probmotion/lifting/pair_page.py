"""Page of lifted pairs: the motion, keypoints, a map of frames, and a command to start from one.

It is self-contained.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from html import escape
from importlib.resources import files
from pathlib import Path

import numpy as np

from probmotion.comparison.results.stored_problems import StoredProblem
from probmotion.geometry.cameras import Cameras
from probmotion.interaction.geometry.pose_distances import pose_distances
from probmotion.motion.motion import Motion
from probmotion.plots.animation import animated_page, animation_html
from probmotion.plots.coverage import classical_scaling
from probmotion.plots.motion_data import Shown

__all__ = ["pair_page"]

_DRAWS = 3  # shown beside the mean
_FRAMES = 900  # most frames of the animation
_DOTS = 200  # most frames of the map
_STYLE = """
body { margin: 0 auto; max-width: 75rem; padding: 1rem; }
h1 { font-size: 1.4rem; } h2 { font-size: 1.1rem; margin: .8rem 0 .3rem; }
.sides { display: grid; gap: 1rem; grid-template-columns: repeat(auto-fit, minmax(20rem, 1fr)); }
.picture canvas { display: block; width: 100%; aspect-ratio: 4 / 3; border: 1px solid var(--rule); }
.map { display: block; width: 100%; border: 1px solid var(--rule); cursor: pointer; }
.map circle { stroke: none; r: 2; }
.map .shown { stroke: var(--uncertain); stroke-width: 2; r: 4; }
.picture pre { overflow-x: auto; background: var(--raised); padding: .5rem; font-size: .85rem; }
"""
_START = """\
import probmotion as pm
from probmotion.interaction.annotations import Annotations
from probmotion.models.pose_pairs.pair_posterior import pair_posterior

pair = pm.load({motion!r}).positions[FRAME]
annotations = Annotations.load({annotations!r})
draws = pm.sample(pair_posterior(pair, annotations), "mh")"""
_REFUSED = "# Frame FRAME has too many joint angles beyond the limits: choose another one."


def pair_page(
    motion: Motion,
    sd: np.ndarray,
    draws: np.ndarray,
    keypoints: np.ndarray,
    seeds: np.ndarray,
    sentences: Sequence[str],
    folder: Path,
) -> str:
    """Return the page as HTML.

    Parameters
    ----------
    motion : Motion
        Posterior mean on ``pair17``, in the axes of the camera.
    sd : ndarray, (L, J, 3)
        Posterior standard deviations, metres.
    draws : ndarray, (n, L, J, 3)
        Posterior draws, metres.
    keypoints : ndarray, (L, J, 2)
        Keypoints in the same axes, metres; NaN where missing.
    seeds : ndarray of bool, (L,)
        Frames from which sampling can start.
    sentences : sequence of str
        Summary.
    folder : Path
        Folder of ``pairs.npz`` and ``annotations.npz`` in the command.
    """
    name = motion.name or "pairs"
    step = max(1, -(-motion.frames // _FRAMES))
    camera = Cameras(
        np.diag([1.0, -1.0, -1.0])[None], np.zeros((1, 3)), np.ones(1), np.zeros((1, 2))
    )
    problem = StoredProblem(
        motion.skeleton, motion.fps, True, camera=camera, keypoints=keypoints * [1.0, -1.0]
    )
    rows = {"lift": np.concatenate([motion.positions[None], draws[:_DRAWS]])}
    captions = {"lift": "mean and three draws; joints coloured by their standard deviation"}
    shown = Shown(problem, rows, step, overlaid=True, sds={"lift": sd})
    animation = animation_html(name, shown, captions)
    folder = folder.resolve()
    paths = {
        "motion": (folder / "pairs.npz").as_posix(),
        "annotations": (folder / "annotations.npz").as_posix(),
    }
    # Split before paths are inserted, which may contain FRAME: the page joins parts by the number.
    commands = {
        "start": [part.format(**paths) for part in _START.split("FRAME")],
        "refused": _REFUSED.split("FRAME"),
    }
    numbers = {
        "step": step,
        "commands": commands,
        "seeds": seeds.astype(int).tolist(),
    }
    # Escape "<", so that no text can end the script element.
    content = json.dumps(numbers, separators=(",", ":")).replace("<", r"\u003c")
    summary = "".join(f"<p>{escape(sentence)}</p>" for sentence in sentences)
    title = f"{name}: two people lifted from one camera"
    body = f"""\
<h1>{escape(title)}</h1>
{summary}
<div class="sides">
{animation}
<div class="picture">
<h2>Keypoints</h2>
<canvas role="img" aria-label="Keypoints of the frame">This picture requires JavaScript.</canvas>
<h2>Map of frames</h2>
{_map(motion.positions, step)}
<p class="quiet">Similar pairs are close to each other. Click to show one, or use the slider of the
animation. Pale: early frames; dark: late ones.</p>
<h2>Sample pose-pairs around this frame</h2>
<pre><code></code></pre>
<button type="button" data-does="copy">Copy</button>
<script type="application/json">{content}</script>
</div>
</div>"""
    functions = {
        ".picture": _text("probmotion.plots", "picture.js"),
        ".map": _text("probmotion.plots", "map.js"),
        "[data-does=copy]": _text("probmotion.report", "copy.js"),
    }
    return animated_page(title, body, _STYLE, functions)


def _map(positions: np.ndarray, step: int) -> str:
    """Return frames, embedded by interaction distance (Yin et al. 2018, figure 5), as SVG."""
    frames = np.arange(len(positions[::step]))
    frames = frames[:: -(-len(frames) // _DOTS)]
    poses = positions[frames * step]
    points = classical_scaling(pose_distances(poses, poses, "interaction"))
    points -= 0.5 * (points.min(axis=0) + points.max(axis=0))
    points *= np.min([190, 140] / np.maximum(np.ptp(points, axis=0), 1e-9))
    dots = [
        f'<circle data-frame="{frame}" cx="{x:.1f}" cy="{y:.1f}" style="fill: color-mix(in oklab, '
        f'var(--ink) {100 * frame / max(frames[-1], 1):.0f}%, var(--rule))"/>'
        for frame, (x, y) in zip(frames, points, strict=True)
    ]
    return (
        '<svg class="map" viewBox="-100 -75 200 150" role="img" '
        'aria-label="Map of frames; the slider shows the same frames">'
        f"{''.join(dots)}</svg>"
    )


def _text(package: str, name: str) -> str:
    return files(package).joinpath(name).read_text(encoding="utf-8")
