"""Encoder of images: its input, its mixture density, and the category that it belongs to."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import norm

from probmotion.models.images.category import Category
from probmotion.models.images.encoder import QUARTERS, Estimates, encoder_input, quarter_of
from probmotion.models.images.encoder_training import EncoderTrainee, encoder_of, mixture_loss
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


def test_categories_are_read_as_written(category, tmp_path) -> None:
    category.save(tmp_path / "dog.npz")
    again = Category.load(tmp_path / "dog.npz")
    assert again.digest == category.digest
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
