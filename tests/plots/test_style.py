"""Styles of samplers: fixed, different and legible."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from probmotion.plots.style import MARKERS, SamplerStyle, sampler_style
from probmotion.posteriors.sampling import sampler_names

# Matrices of Machado, Oliveira and Fernandes (2009) for full deficiency, on linear RGB.
VISION = {
    "normal": np.eye(3),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216],
         [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413],
         [-0.011820, 0.042940, 0.968881]]
    ),
}  # fmt: skip
TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
NAMES = [name for name in sampler_names() if "." not in name]


def linear(colour):
    rgb = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    return np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)


def lab(rgb):
    x, y, z = np.cbrt(np.maximum(TO_XYZ @ np.clip(rgb, 0, 1) / TO_XYZ.sum(axis=1), 1e-9))
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("vision", VISION)
def test_colours_of_registered_samplers_are_distinguishable(vision):
    seen = [lab(VISION[vision] @ linear(sampler_style(name).colour)) for name in NAMES]
    assert len(seen) >= 9
    assert min(np.linalg.norm(a - b) for a, b in itertools.combinations(seen, 2)) > 20


def test_registered_samplers_have_different_markers_and_contrast_with_white():
    styles = [sampler_style(name) for name in NAMES]
    assert len({style.marker for style in styles}) == len(NAMES)
    for style in styles:
        luminance = TO_XYZ[1] @ linear(style.colour)
        assert 1.05 / (luminance + 0.05) >= 3


def test_variants_share_the_colour_and_other_names_are_new():
    for name in ("mas.paper", "mas-a", "mas (5 views)"):
        assert sampler_style(name).colour == sampler_style("mas").colour
        assert sampler_style(name).marker != sampler_style("mas").marker
    registered = {sampler_style(name) for name in NAMES}
    others = [sampler_style(f"mine{k}") for k in range(300)]
    assert not registered & set(others)
    assert len(set(others)) > 50
    assert {style.marker for style in others} == set(MARKERS)
    # Python's hash of a string differs between processes.
    assert sampler_style("mine0") == SamplerStyle("#146E55", "D")
