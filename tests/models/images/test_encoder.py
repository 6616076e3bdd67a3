"""Encoder of images: its input, its mixture density, and the category that it belongs to."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.stats import norm

from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.models.images import encoder_training
from probmotion.models.images.category import Category
from probmotion.models.images.encoder import QUARTERS, Estimates, encoder_input, quarter_of
from probmotion.models.images.encoder_training import EncoderTrainee, encoder_of, mixture_loss
from probmotion.models.images.made_images import MadeImages, make_images, with_made_features
from probmotion.models.images.surface_prior import SurfacePrior
from probmotion.models.training.checkpoints import CheckpointError
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.trainer import train

pytest.importorskip("torch")


def test_quarters_and_angles_add_up_to_the_direction() -> None:
    yaw = np.linspace(-math.pi, math.pi, 101)
    quarter, angle = quarter_of(yaw)
    assert set(quarter) == set(range(QUARTERS))
    assert np.abs(angle).max() <= math.pi / 4 + 1e-12
    turns = (quarter * math.pi / 2 + angle - yaw) / (2 * math.pi)
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-12)


def test_loss_is_the_density_of_the_mixture() -> None:
    """That of the true quarter times a product of normal densities."""
    rng = np.random.default_rng(0)
    theta, view = rng.standard_normal((3, 9)), 2
    means, logs = rng.standard_normal((2, 3, QUARTERS, 8))
    weights = rng.dirichlet(np.ones(QUARTERS), 3)
    estimates = Estimates(*(torch.as_tensor(part) for part in (np.log(weights), means, logs)))
    expected = 0.0
    for row in range(3):
        quarter, angle = quarter_of(np.arctan2(theta[row, view], theta[row, view + 1]))
        values = np.array([angle, *np.delete(theta[row], [view, view + 1])])
        density = norm(means[row, quarter], np.exp(logs[row, quarter])).logpdf(values).sum()
        expected -= (density + math.log(weights[row, quarter])) / 3
    assert mixture_loss(estimates, theta, view).item() == pytest.approx(expected, rel=1e-5)


def test_means_are_rendered_given_the_true_quarter(category) -> None:
    """The truth covers the mask; the mean of another quarter does not matter."""
    trainee = EncoderTrainee(category)
    images, theta, prior = trainee._batch(np.random.default_rng(1), 6)
    view = prior.layout.view.start
    quarter, angle = quarter_of(np.arctan2(theta[:, view], theta[:, view + 1]))
    others = np.delete(theta, [view, view + 1], axis=1)
    true = torch.as_tensor(np.column_stack([angle, others]), dtype=torch.float32)
    means = torch.zeros(6, QUARTERS, prior.dim - 1)
    means[torch.arange(6), torch.as_tensor(quarter)] = true
    means.requires_grad_(True)
    spread = torch.zeros_like(means)
    right = Estimates(spread, means, spread)
    overlap = encoder_training._mean_overlap(right, images, theta, prior)
    assert overlap > 0.7  # masks have errors, and edges of 32 pixels are soft
    overlap.backward()
    changed = means.grad.abs().sum(dim=(0, 2))
    assert (changed[np.unique(quarter)] > 0).all()
    wrong = Estimates(spread, means.detach().roll(1, dims=0), spread)
    assert encoder_training._mean_overlap(wrong, images, theta, prior) < 0.6


def test_input_is_what_is_known_of_mask_and_colours() -> None:
    mask, rgb = np.zeros((1, 128, 128)), np.full((1, 128, 128, 3), 0.5)
    mask[:, 40:80, 40:80] = 1.0
    mask[:, :, 100:], rgb[:, :, 100:] = np.nan, np.nan
    images = encoder_input(mask, rgb)[0]
    assert images.shape == (5, 64, 64)
    assert images[0].sum() == 20 * 20
    assert images[1].sum() == 64 * 50
    assert images[2:].sum() == 3 * 0.5 * 20 * 20
    with pytest.raises(ValueError, match="multiple of 64"):
        encoder_input(mask[:, :100, :100], None)


@pytest.fixture(scope="module")
def trained(category, tmp_path_factory):
    """Folder of a category and its encoder after few steps, and its validation losses."""
    folder = tmp_path_factory.mktemp("trained")
    category.save(folder / "category.npz")
    loaded = Category.load(folder / "category.npz")
    settings = TrainingSettings(steps=30, batch=16, learning_rate=2e-3, checkpoint_every=10)
    result = train(EncoderTrainee(loaded), settings, folder, device="cpu", progress=False)
    return folder, [entry["validation_loss"] for entry in result.history]


def test_training_lowers_the_loss_and_the_encoder_lies_beside_its_category(trained) -> None:
    folder, losses = trained
    assert losses[-1] < losses[0]
    category = Category.load(folder / "category.npz")
    network = encoder_of(category)
    assert network.dim == SurfacePrior(category, np.ones(1)).dim


def test_encoders_of_other_categories_are_refused(trained, tmp_path) -> None:
    folder, _ = trained
    category = Category.load(folder / "category.npz")
    with pytest.raises(CheckpointError, match="of another"):
        encoder_of(replace(category, albedo=0.9 * category.albedo))
    category.save(tmp_path / "alone.npz")
    with pytest.raises(FileNotFoundError, match="train images"):
        encoder_of(Category.load(tmp_path / "alone.npz"))


def test_the_encoder_is_trained_without_features(category, monkeypatch) -> None:
    """They are not even rendered, but the encoder belongs to the category with them."""
    made = []

    def recorded(*args: Any) -> MadeImages:
        made.append(make_images(*args))
        return made[-1]

    monkeypatch.setattr(encoder_training, "_VALIDATED", 4)
    monkeypatch.setattr(encoder_training, "make_images", recorded)
    plain, described = EncoderTrainee(category), EncoderTrainee(with_made_features(category, 3))
    assert [each.features for each in made] == [None, None]
    for one, other in zip(plain._validation, described._validation, strict=True):
        np.testing.assert_array_equal(one, other)
    assert described.settings["category"] == with_made_features(category, 3).digest
    assert described.settings["category"] != plain.settings["category"]


def test_categories_are_read_as_written(category, tmp_path) -> None:
    category = with_made_features(category, 3)
    category.save(tmp_path / "dog.npz")
    again = Category.load(tmp_path / "dog.npz")
    assert again.digest == category.digest
    np.testing.assert_allclose(again.features, category.features, atol=1e-6)
    np.testing.assert_array_equal(again.feature_noise, category.feature_noise)
    theta = np.random.default_rng(0).standard_normal((2, SurfacePrior(category, np.ones(1)).dim))
    np.testing.assert_allclose(
        SurfacePrior(again, np.ones(1)).motion(theta),
        SurfacePrior(category, np.ones(1)).motion(theta),
        atol=1e-5,
    )
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(ValueError, match=r"written by Category\.save"):
        Category.load(tmp_path / "other.npz")
    with pytest.raises(FileNotFoundError, match="quadruped"):
        Category.load("unicorn")


CHANGES: dict[str, Callable[[Category], dict[str, Any]]] = {
    "rest": lambda c: {"body": ArticulatedBody(c.body.skeleton, 1.1 * c.body.rest)},
    "vertices": lambda c: {"surface": replace(c.surface, vertices=1.1 * c.surface.vertices)},
    "triangles": lambda c: {"surface": replace(c.surface, triangles=c.surface.triangles[::-1])},
    "joints": lambda c: {"surface": replace(c.surface, joints=c.surface.joints[:, ::-1])},
    "weights": lambda c: {"surface": replace(c.surface, weights=c.surface.weights[:, ::-1])},
    "shapes": lambda c: {"shapes": -c.shapes},
    "albedo": lambda c: {"albedo": 0.9 * c.albedo},
    "albedos": lambda c: {"albedos": -c.albedos},
    "mean": lambda c: {"code": replace(c.code, mean=-c.code.mean)},
    "basis": lambda c: {"code": replace(c.code, basis=-c.code.basis)},
    "fps": lambda c: {"code": replace(c.code, fps=20.0)},
    "length_spread": lambda c: {"length_spread": 0.07},
    "features": lambda c: {"features": -c.features},
    "feature_noise": lambda c: {"feature_noise": 2 * c.feature_noise},
}


@pytest.mark.parametrize("change", CHANGES)
def test_encoders_belong_to_all_that_a_category_is(category, change: str) -> None:
    """Its digest changes with everything but its name and card."""
    before = with_made_features(category, 3)
    assert replace(before, **CHANGES[change](before)).digest != before.digest
    assert replace(before, name="cat", card={"a": 1}).digest == before.digest


def test_wrong_features_are_refused(category, tmp_path) -> None:
    described = with_made_features(category, 3)
    for noise, words in (
        (np.ones(2), r"feature_noise must have shape \(3\), got \(2,\)"),
        (np.array([1, 0, 1.0]), "feature_noise must be above 0, got 0"),
        (np.array([1, np.nan, 1]), "feature_noise must be finite"),
    ):
        with pytest.raises(ValueError, match=words):
            replace(described, feature_noise=noise)
    described.save(tmp_path / "dog.npz")
    arrays = dict(np.load(tmp_path / "dog.npz"))
    older = str(arrays.pop("settings")).replace('"format": 2', '"format": 1')
    del arrays["feature_noise"]
    np.savez(tmp_path / "older.npz", settings=older, **arrays)
    with pytest.raises(ValueError, match=r"written by Category\.save: format 1 instead of 2"):
        Category.load(tmp_path / "older.npz")
