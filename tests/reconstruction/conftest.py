"""Reconstructions of made images, with draws about the truth."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion.lifting.checks import Check
from tests.models.images.bodies import small_quadruped

FRAMES, SIZE = 10, 64
CHECKS = (Check("mask", 0.1, 0.2, "the mask is unlike the body's"),)


@pytest.fixture(scope="session")
def category():
    return small_quadruped()


@pytest.fixture(scope="session")
def make_result(category):
    """Function that returns a reconstruction of a number of images."""
    from probmotion.models.images.made_images import make_images
    from probmotion.models.images.observation import ImageObservation
    from probmotion.models.images.surface_prior import SurfacePrior
    from probmotion.reconstruction import Reconstruction

    def made(images):
        rng = np.random.default_rng(images)
        single = SurfacePrior(category, np.array([0.15]))
        first = make_images(single, rng, 1, SIZE)
        prior = SurfacePrior(category, np.full(images, 0.15))
        theta = 0.3 * rng.normal(size=prior.dim)
        theta[: single.dim] = first.theta[0]
        mask, rgb = np.tile(first.mask, (images, 1, 1)), np.tile(first.rgb, (images, 1, 1, 1))
        rotation = np.tile(np.eye(3), (images, 1, 1))
        observation = ImageObservation(mask, rgb, None, prior.tangent, rotation)
        draws = theta + 0.2 * rng.normal(size=(12, prior.dim))
        # Three of the twelve draws face the other way.
        yaw = prior.layout.view.start
        draws[:3, yaw] = -draws[:3, yaw]
        return Reconstruction(observation, prior, theta, draws, CHECKS)

    return made


@pytest.fixture(scope="session")
def result(make_result):
    return make_result(1)
