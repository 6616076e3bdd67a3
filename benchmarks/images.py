"""Speed and memory of reconstructions from images, as ``name: value`` lines.

Renderings are of the category ``quadruped`` at 128 pixels, forward and backward with respect to all
vertices and colours; ``mitsuba_*`` are those of the second renderer with 8 samples a pixel.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from lift import peak_gib
from made_bodies import Bodies

from probmotion.models.images.category import Category
from probmotion.models.images.encoder import encoder_input
from probmotion.models.images.encoder_training import encoder_of
from probmotion.models.images.made_images import make_images
from probmotion.models.images.mitsuba_renderer import MitsubaRenderer
from probmotion.models.images.observation import ImageObservation
from probmotion.models.images.rasterizer import Rasterizer, Renderer
from probmotion.models.images.surface_prior import SurfacePrior
from probmotion.reconstruction import reconstruct

SIZE, TANGENT = 128, 0.15
RENDERED, RECONSTRUCTED, ENCODED = 20, 5, 20


def seconds_of(function: Callable[[], object], times: int) -> float:
    """Return the mean seconds of a call, after one to compile."""
    function()
    start = time.perf_counter()
    for _ in range(times):
        function()
    return (time.perf_counter() - start) / times


def main() -> None:
    """Print every measurement."""
    category = Category.load("quadruped")
    prior = SurfacePrior(category, np.array([TANGENT]))
    rng = np.random.default_rng(0)
    made = make_images(prior, rng, RECONSTRUCTED, SIZE)
    theta = torch.as_tensor(made.theta[:1], dtype=torch.float32)
    triangles = category.surface.triangles
    vertices = prior.vertices(theta)[:, 0].detach()
    colours = prior.parameters(theta).albedo.detach()

    def rendered(renderer: Renderer) -> None:
        places, shades = vertices.clone().requires_grad_(), colours.clone().requires_grad_()
        image = renderer.render(places, triangles, shades, TANGENT, SIZE)
        image.square().sum().backward()

    seconds = seconds_of(lambda: rendered(Rasterizer()), RENDERED)
    print(f"renders_per_second_128: {1 / seconds:.4g}", flush=True)
    seconds = seconds_of(lambda: rendered(MitsubaRenderer(8)), RENDERED)
    print(f"mitsuba_renders_per_second_128: {1 / seconds:.4g}", flush=True)
    network = encoder_of(category)

    def encode() -> None:
        with torch.no_grad():
            network(encoder_input(made.mask[:1], made.rgb[:1]))

    print(f"encoder_milliseconds: {1000 * seconds_of(encode, ENCODED):.4g}", flush=True)
    observed = [
        ImageObservation(mask[None], rgb[None], None, np.array([TANGENT]), np.eye(3)[None])
        for mask, rgb in zip(made.mask, made.rgb, strict=True)
    ]
    start = time.perf_counter()
    for each in observed:
        reconstruct(each, category)
    print(f"reconstruct_seconds: {(time.perf_counter() - start) / RECONSTRUCTED:.4g}", flush=True)
    clip = replace(Bodies("quadruped", None, "validation", 1).clip(0).observation, features=None)
    start = time.perf_counter()
    reconstruct(clip, category)
    print(f"clip_seconds: {time.perf_counter() - start:.4g}")
    print(f"peak_gib: {peak_gib():.2f}")


if __name__ == "__main__":
    main()
