"""A quadruped of few vertices with random smooth motions."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from probmotion.models.latent.turn_code import TurnCode

if TYPE_CHECKING:
    from probmotion.models.images.category import Category

__all__ = ["small_quadruped"]


def small_quadruped() -> Category:
    """Return the category; skip the test without its libraries."""
    for library in ("torch", "numba", "skimage"):
        pytest.importorskip(library, reason=f"{library} is not installed")
    from probmotion.models.images.category import Category
    from probmotion.models.images.surface import rest_surface

    body, rng = Category.load("quadruped").body, np.random.default_rng(0)
    surface = rest_surface(body, 200)
    path = np.linspace(0, 1, 10)[:, None, None]
    ends = 0.12 * rng.normal(size=(2, 4, 1, len(body.bones), 3))
    turns = ends[0] * (1 - path) + ends[1] * path
    shapes = 0.02 * rng.normal(size=(3, 1, 3)) * surface.vertices[:, [1]]
    albedo = np.tile([0.6, 0.4, 0.2], (len(surface.vertices), 1))
    features = np.zeros((len(albedo), 0)), np.zeros(0)
    code = TurnCode(turns[0] / 2, turns, 10.0)
    light = 0.05 * np.ones((1, *albedo.shape))
    return Category("quadruped", body, surface, shapes, albedo, light, code, 0.06, *features)
