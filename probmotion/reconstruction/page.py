"""Page of a reconstruction: images, other views, and draws in motion. It is self-contained."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files

import numpy as np
from PIL import Image

from probmotion.extras import skimage, torch
from probmotion.lifting.checks import Check
from probmotion.models.images.observation import ImageObservation
from probmotion.models.images.surface_prior import SurfacePrior
from probmotion.plots.animation import animated_page
from probmotion.reconstruction.moving_surface import albedos, surface_frames

__all__ = ["reconstruction_page"]

_IMAGES = 4  # most images of a clip
_HALF = 0.55  # half of the image, of the larger side of the body in views from other sides
_VIEWS, _VIEW_SIZE = 6, 192  # views from around the body, and their pixels
_UNITS = 32000  # of 16-bit integers, for the largest coordinate
_STYLE = """
body { margin: 0 auto; max-width: 60rem; padding: 1rem; }
h1 { font-size: 1.4rem; } h2 { font-size: 1.1rem; margin: 1.6rem 0 .5rem; }
.bad { border-left: .4rem solid var(--failed); padding-left: .8rem; }
.good { border-left: .4rem solid var(--seen); padding-left: .8rem; }
.images { display: grid; gap: .5rem; grid-template-columns: repeat(3, minmax(0, 14rem)); }
.views { display: grid; gap: .5rem; grid-template-columns: repeat(auto-fit, minmax(6rem, 1fr)); }
figure { margin: 0; position: relative; }
figure img, figure svg { display: block; width: 100%; }
figure img { border: 1px solid var(--rule); border-radius: .3rem; background: var(--raised); }
figure svg { position: absolute; top: 0; left: 0; padding: 1px; }
figure path { fill: none; stroke: #ff2f92; stroke-width: 2px; vector-effect: non-scaling-stroke; }
figcaption { font-size: .85rem; color: var(--quiet); }
.surface [data-draw] { min-width: 2.6rem; }
.surface canvas {
  display: block; width: 100%; aspect-ratio: 2; cursor: grab; touch-action: pan-y;
  border: 1px solid var(--rule); border-radius: .3rem; background: var(--raised);
}
@media (max-width: 30rem) { .surface [data-draw] { min-width: 2.6rem; }
.surface canvas { aspect-ratio: 1; } td, th { font-size: .85rem; } }
table { border-collapse: collapse; }
td, th { padding: .15rem .8rem .15rem 0; text-align: left; }
td:nth-child(n + 2) { font-variant-numeric: tabular-nums; }
td:last-child { overflow-wrap: anywhere; }
"""


def reconstruction_page(
    observation: ImageObservation,
    prior: SurfacePrior,
    theta: np.ndarray,
    shown: Mapping[str, np.ndarray],
    checks: Sequence[Check],
    sentences: Sequence[str],
) -> str:
    """Return the page as HTML.

    Parameters
    ----------
    observation : ImageObservation
        The T images.
    prior : SurfacePrior
    theta : ndarray, (dim,)
        Most probable mode.
    shown : mapping of str to ndarray, (dim,)
        Draws to play, by caption.
    checks : sequence of Check
    sentences : sequence of str
        Summary.
    """
    count = observation.images
    name = prior.category.name
    title = f"{name[:1].upper()}{name[1:]} from {'one image' if count == 1 else f'{count} images'}"
    mark = "good" if all(check.passed for check in checks) else "bad"
    summary = "".join(f"<p>{escape(sentence)}</p>" for sentence in sentences)
    body = f"""\
<h1>{escape(title)}</h1>
<div class="{mark}">{summary}</div>
<h2>Image, outline of the most probable body, and mask</h2>
{_images(observation, prior, theta)}
<h2>The most probable body from other sides</h2>
<div class="views">{_views(prior, theta)}</div>
<h2>Posterior draws in motion</h2>
{_surface(prior, shown)}
{_table(checks)}"""
    return animated_page(title, body, _STYLE, {".surface": _text("surface.js")})


def _images(observation: ImageObservation, prior: SurfacePrior, theta: np.ndarray) -> str:
    """Return the rows of image, outline and mask of evenly spaced images."""
    size = observation.size
    rendered = _rendered(prior, theta, size)
    chosen = np.unique(np.linspace(0, observation.images - 1, _IMAGES).round().astype(int))
    rows = []
    for frame in chosen:
        mask = observation.mask[frame]
        known = np.isfinite(mask)[..., None]
        grey = np.repeat(mask[..., None], 3, axis=-1)
        grey_image = _png(np.concatenate([grey, known], axis=-1))
        image = grey_image
        if observation.rgb is not None:
            image = _png(np.concatenate([observation.rgb[frame], known], axis=-1))
        name = f"image {frame + 1}" if observation.images > 1 else "image"
        outline = _outline(rendered[frame, ..., 3])
        rows.append(
            f'<div class="images">{_figure(image, name)}'
            f"{_figure(image, f'{name} and outline', outline)}{_figure(grey_image, 'mask')}</div>"
        )
    return "\n".join(rows)


def _views(prior: SurfacePrior, theta: np.ndarray) -> str:
    """Return figures of the body from around it, in the first image."""
    yaw = float(prior.yaw(theta))
    figures = []
    for turn in range(_VIEWS):
        turned = prior.facing(theta, yaw + turn * 2 * np.pi / _VIEWS)
        image = _rendered(prior, _framed(prior, turned) if turn else theta, _VIEW_SIZE)[0]
        covered = np.clip(image[..., 3:], 0.0, 1.0)
        colours = image[..., :3] / np.maximum(covered, 1e-3)
        name = f"turned by {turn * 360 // _VIEWS}°" if turn else "as in the image"
        figures.append(_figure(_png(np.concatenate([colours, covered], axis=-1)), name))
    return "".join(figures)


def _framed(prior: SurfacePrior, theta: np.ndarray) -> np.ndarray:
    """Return θ (dim,) with the body moved into the middle of the first image, as large as fits."""
    for _ in range(2):  # its perspective changes a little
        with torch.no_grad():
            vertices = prior.vertices(torch.as_tensor(theta[None]))[0, 0].numpy()
        points = vertices[:, :2] / (vertices[:, 2:] * prior.tangent[0])
        low, high = points.min(axis=0), points.max(axis=0)
        half = np.array([_HALF * (high - low).max()])
        theta = prior.moved(theta[None], -0.5 * (low + high)[None], half)[0]
    return theta


def _surface(prior: SurfacePrior, shown: Mapping[str, np.ndarray]) -> str:
    """Return the canvas, its controls and data."""
    theta = np.stack(list(shown.values()))
    vertices = surface_frames(prior, theta)  # (n, L, V, 3)
    first = vertices[:, :1]
    ends = first.min(axis=2, keepdims=True), first.max(axis=2, keepdims=True)
    vertices = vertices - 0.5 * (ends[0] + ends[1])
    unit = float(np.abs(vertices).max()) / _UNITS
    data = {
        "fps": prior.fps,
        "frames": prior.frames,
        "unit": unit,
        "reach": float(np.linalg.norm(vertices, axis=-1).max()),
        "triangles": _base64(prior.category.surface.triangles, "<u2"),
        "vertices": [_base64(draw / unit, "<i2") for draw in vertices],
        "colours": [_base64(255 * draw, "u1") for draw in albedos(prior, theta)],
    }
    buttons = "".join(
        f'<button type="button" data-draw="{at}" aria-pressed="{str(at == 0).lower()}" '
        f'title="{escape(caption)}" data-caption="{escape(caption)}">{at + 1}</button>'
        for at, caption in enumerate(shown)
    )
    numbers = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return f"""\
<div class="surface">
<div class="controls">
<button type="button" data-does="play">Play</button>
{buttons}
<output></output>
</div>
<canvas role="img" tabindex="0" aria-label="Surface of a draw in motion; drag or press arrow keys \
to turn it.">This animation requires JavaScript.</canvas>
<p class="quiet">Drag to turn the body; the view starts as that of the camera. Frames after the \
last image are draws of the motion.</p>
<script type="application/json">{numbers}</script>
</div>"""


def _table(checks: Sequence[Check]) -> str:
    rows = "\n".join(
        f"<tr><td>{escape(check.name)}</td><td>{check.value:.3g}</td><td>{check.limit:.3g}</td>"
        f"<td>{'passed' if check.passed else escape(check.problem)}</td></tr>"
        for check in checks
    )
    heads = "<tr><th>check</th><th>value</th><th>at most</th><th>result</th></tr>"
    return f"<h2>Checks</h2>\n<table>\n{heads}\n{rows}\n</table>"


def _rendered(prior: SurfacePrior, theta: np.ndarray, size: int) -> np.ndarray:
    """Return the images (T, size, size, 4) of θ (dim,)."""
    with torch.no_grad():
        rows = torch.as_tensor(theta[None], dtype=torch.float32)
        images: np.ndarray = prior.render(rows, size)[0].numpy()
    return images


def _outline(coverage: np.ndarray) -> str:
    """Return the outline of a coverage (S, S) as SVG."""
    size = len(coverage)
    parts = []
    # A border closes the outlines. Pixel centres are at .5.
    for line in skimage.measure.find_contours(np.pad(coverage, 1), 0.5):
        points = " ".join(f"{column - 0.5:.1f},{row - 0.5:.1f}" for row, column in line)
        parts.append(f"M{points}z")
    path = f'<path d="{"".join(parts)}"/>'
    return f'<svg viewBox="0 0 {size} {size}" aria-hidden="true">{path}</svg>'


def _figure(png: bytes, caption: str, over: str = "") -> str:
    source = f"data:image/png;base64,{base64.b64encode(png).decode('ascii')}"
    return (
        f'<figure><img src="{source}" alt="{escape(caption)}">{over}'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def _png(shares: np.ndarray) -> bytes:
    """Return an image (H, W, 4) of shares of the full value, 0 where NaN, as a PNG file."""
    pixels = np.round(255 * np.clip(np.nan_to_num(shares), 0.0, 1.0)).astype(np.uint8)
    encoded = io.BytesIO()
    Image.fromarray(pixels).save(encoded, "png")
    return encoded.getvalue()


def _base64(values: np.ndarray, dtype: str) -> str:
    content = np.round(values).astype(dtype).tobytes()
    return base64.b64encode(content).decode("ascii")


def _text(name: str) -> str:
    return files("probmotion.reconstruction").joinpath(name).read_text(encoding="utf-8")
