"""Learning of surface, colours and features: errors of made categories, symmetry, bad input."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("numba", reason="numba is not installed")
pytest.importorskip("skimage", reason="scikit-image is not installed")
from probmotion.extras import torch
from probmotion.models.images import category as module
from probmotion.models.images.category import Category, folded
from probmotion.models.images.category_training import _Shared, learn_surface
from probmotion.models.images.made_images import make_category, make_clips, with_made_features
from probmotion.models.images.surface import rest_surface
from probmotion.models.images.surface_prior import SurfacePrior
from probmotion.models.latent.turn_code import TurnCode


@pytest.fixture(scope="module")
def case():
    """A category, a made one with features, 40 images of that and their θ."""
    body, rng = Category.load("quadruped").body, np.random.default_rng(0)
    turns = 0.15 * rng.standard_normal((4, 1, len(body.bones), 3))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "rest_surface", lambda body: rest_surface(body, 250))
        category = Category.of_capsules("animal", body, TurnCode(0 * turns[0], turns, 10.0))
    true = with_made_features(make_category(category, rng), 3)
    return category, true, *make_clips(true, rng, 40, 1, 64)


@pytest.fixture(scope="module")
def learnt(case):
    category, _, images, theta = case
    return learn_surface(category, images, theta, steps=100)


def errors(category, true):
    """Return the mean distance of centred vertices, and the mean error of the albedo."""
    centred = [c.surface.vertices - c.surface.vertices.mean(axis=0) for c in (category, true)]
    distance = np.linalg.norm(centred[0] - centred[1], axis=-1).mean()
    return np.array([distance, np.abs(category.albedo - true.albedo).mean()])


def test_errors_of_surface_and_albedo_fall(case, learnt):
    """With true poses, 40 images remove more than a third and a half of the errors."""
    category, true, _, _ = case
    assert (errors(learnt, true) / errors(category, true) < [0.66, 0.5]).all()


def test_only_the_means_change(case, learnt):
    category = case[0]
    for name in ("body", "shapes", "albedos", "code", "length_spread"):
        assert getattr(learnt, name) is getattr(category, name)
    for name in ("triangles", "joints", "weights"):
        assert getattr(learnt.surface, name) is getattr(category.surface, name)


def test_features_of_vertices_and_their_noise_are_found(case, learnt):
    """Errors are less than a quarter of the features' spread, and those of the noise 20 %."""
    _, true, _, _ = case
    errors = np.sqrt(((learnt.features - true.features) ** 2).mean(axis=0))
    assert (errors < 0.25 * true.features.std(axis=0)).all()
    np.testing.assert_allclose(learnt.feature_noise, true.feature_noise, rtol=0.2)


def test_unknown_features_do_not_count(case):
    """What is NaN in half of each image is found nevertheless; a channel of zeros is no error."""
    category, true, images, theta = case
    size = images[0].size
    changed = []
    for k, image in enumerate(images):
        features = image.features * np.array([1, 0, 1], dtype=np.float32)
        features[:, :, np.arange(size) % 2 == k % 2] = np.nan
        changed.append(replace(image, features=features))
    found = learn_surface(category, changed, theta, steps=1)
    pairs = zip(found.features.T, true.features.T, strict=True)
    correlations = [np.corrcoef(*pair)[0, 1] for pair in pairs if pair[0].any()]
    assert len(correlations) == 2
    assert min(correlations) > 0.9
    assert not found.features[:, 1].any()
    hidden = [replace(image, features=image.features * np.nan) for image in changed]
    with pytest.raises(ValueError, match="images must have features inside their masks"):
        learn_surface(category, hidden, theta, steps=1)


def test_features_remain_if_the_images_have_none(case):
    _, true, images, theta = case
    without = [replace(image, features=None) for image in images[:2]]
    found = learn_surface(true, without, theta[:2], steps=1)
    assert found.features is true.features
    assert found.feature_noise is true.feature_noise


def test_symmetric_surfaces_remain_symmetric(case, learnt):
    before, after = case[0].surface.vertices, learnt.surface.vertices
    flip = np.array([-1.0, 1.0, 1.0])
    other = np.abs((before * flip)[:, None] - before).sum(axis=-1).argmin(axis=1)
    np.testing.assert_allclose(after[other], after * flip, atol=1e-6)
    np.testing.assert_allclose(learnt.albedo[other], learnt.albedo, atol=1e-6)
    np.testing.assert_allclose(learnt.features[other], learnt.features, atol=1e-6)
    np.testing.assert_array_equal(folded(after)[:, 1:], after[:, 1:])
    assert folded(after)[:, 0].min() >= 0
    lopsided = after + 0.01 * np.eye(3)[0] * after[:, 1:2]
    assert folded(lopsided) is lopsided


def test_mean_codes_of_shape_and_colour_become_part_of_the_means(case):
    """Without shared changes, nothing else does."""
    category, _, _, theta = case
    shared = _Shared(category)
    own = torch.tensor(theta)
    learnt = shared.learnt(own, torch.zeros(sum(shared.counts), dtype=own.dtype))
    layout = SurfacePrior(category, np.ones(1)).layout
    shift = np.tensordot(theta[:, layout.shape].mean(axis=0), category.shapes, axes=1)
    tint = np.tensordot(theta[:, layout.albedo].mean(axis=0), category.albedos, axes=1)
    moved, coat = category.surface.vertices + shift, np.clip(category.albedo + tint, 0, 1)
    np.testing.assert_allclose(learnt.surface.vertices, moved, atol=1e-6)
    np.testing.assert_allclose(learnt.albedo, coat, atol=1e-6)


def test_results_do_not_depend_on_chance(case):
    category, _, images, theta = case
    first, again = (learn_surface(category, images[:3], theta[:3], steps=2) for _ in range(2))
    assert first.digest == again.digest != category.digest


def test_bad_input(case):
    category, _, images, theta = case
    clip = replace(
        images[0],
        mask=np.repeat(images[0].mask, 2, axis=0),
        rgb=None,
        features=None,
        tangent=np.repeat(images[0].tangent, 2),
        rotation=np.repeat(images[0].rotation, 2, axis=0),
    )
    for arguments, words in (
        (([], theta[:0]), "images must be observations of one image each, got no observations"),
        (([clip], theta[:1]), r"images must be observations of one image each, got \[2\]"),
        (
            ([images[0], replace(images[1], features=None)], theta[:2]),
            "images must all have the same number of features, or all have none, got 0 and 3",
        ),
        ((images[:2], theta[:3]), "theta must have shape"),
        ((images[:1], theta[:1] * np.nan), "theta must be finite"),
    ):
        with pytest.raises(ValueError, match=words):
            learn_surface(category, *arguments)
