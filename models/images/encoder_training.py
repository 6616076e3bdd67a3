"""Training of the encoder on made images of draws of the prior."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from probmotion import seeds
from probmotion.extras import nn, torch
from probmotion.models.images.category import Category
from probmotion.models.images.encoder import (
    SIZE,
    EncoderNetwork,
    Estimates,
    encoder_input,
    quarter_of,
)
from probmotion.models.images.made_images import make_images
from probmotion.models.images.surface_prior import SurfacePrior
from probmotion.models.training.checkpoints import (
    MODEL,
    CheckpointError,
    load_checkpoint,
    load_weights,
    valid_settings,
)

__all__ = ["KIND", "TANGENTS", "EncoderTrainee", "encoder_of", "load_encoder", "mixture_loss"]

KIND = "image-encoder"
TANGENTS = (0.05, 0.35)
"""Range of the tangents of half the crops' fields of view."""
_GREY = 0.2  # share of inputs without colours
_VALIDATED = 256


class EncoderTrainee:
    """Trainee for :func:`~probmotion.models.training.trainer.train`.

    The loss is the negative log density of the true parameters under the network's mixture.

    Parameters
    ----------
    category : Category
        Kind of body; its draws are rendered.
    seed : int
        Seed of the initial weights and of the validation images.
    """

    kind = KIND

    def __init__(self, category: Category, seed: int = 0) -> None:
        self.category = category
        dim = SurfacePrior(category, np.ones(1)).dim
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seeds.integer(seed, "weights"))
            self.network = EncoderNetwork(dim)
        self.settings: Mapping[str, Any] = {"category": category.digest, "dim": dim, "seed": seed}
        self._validation = self._batch(seeds.generator(seed, "validation"), _VALIDATED)

    def training_loss(
        self, network: nn.Module, rng: np.random.Generator, batch: int, device: torch.device
    ) -> torch.Tensor:
        """Return the loss of new images."""
        images, theta = self._batch(rng, batch)
        return mixture_loss(network(images.to(device)), theta, self._view)

    def validation_loss(self, network: nn.Module, device: torch.device) -> float:
        """Return the loss of the validation images."""
        network.eval()
        with torch.no_grad():
            images, theta = self._validation
            loss = float(mixture_loss(network(images.to(device)), theta, self._view))
        network.train()
        return loss

    @property
    def _view(self) -> int:
        return SurfacePrior(self.category, np.ones(1)).layout.view.start

    def _batch(self, rng: np.random.Generator, n: int) -> tuple[torch.Tensor, np.ndarray]:
        tangent = np.exp(rng.uniform(*np.log(TANGENTS)))
        made = make_images(SurfacePrior(self.category, np.array([tangent])), rng, n, SIZE)
        images = encoder_input(made.mask, made.rgb)
        grey = torch.as_tensor(rng.random(n) < _GREY)
        blank = encoder_input(made.mask, None)
        return torch.where(grey[:, None, None, None], blank, images), made.theta


def mixture_loss(estimates: Estimates, theta: np.ndarray, view: int) -> torch.Tensor:
    """Return the mean negative log density of θ (B, dim), whose view begins at ``view``."""
    quarter, angle = quarter_of(np.arctan2(theta[:, view], theta[:, view + 1]))
    rows = torch.arange(len(theta))
    others = np.delete(theta, [view, view + 1], axis=1)
    target = torch.as_tensor(
        np.concatenate([angle[:, None], others], axis=1), dtype=torch.float32
    ).to(estimates.means.device)
    chosen = torch.as_tensor(quarter)
    mean, log_spread = estimates.means[rows, chosen], estimates.log_spreads[rows, chosen]
    density = -0.5 * ((target - mean) * torch.exp(-log_spread)) ** 2 - log_spread
    density = density.sum(dim=1) - 0.5 * target.shape[1] * math.log(2 * math.pi)
    return -(estimates.log_weights[rows, chosen] + density).mean()


def encoder_of(category: Category) -> EncoderNetwork:
    """Load the encoder beside a category's file: with its name, or that of a training run.

    Raises ``FileNotFoundError`` if there is none, and as :func:`load_encoder`.
    """
    if category.source is not None:
        for path in (category.source.with_suffix(".safetensors"), category.source.parent / MODEL):
            if path.is_file():
                return load_encoder(path, category)
    raise FileNotFoundError(
        f"category {category.name} must have an encoder beside its file, got none; run probmotion "
        "train images"
    )


def load_encoder(path: str | Path, category: Category) -> EncoderNetwork:
    """Load an encoder of a category from a checkpoint file or run folder.

    Raises ``CheckpointError`` for a damaged file, another kind of network, or an encoder of another
    category.
    """
    checkpoint = load_checkpoint(path, KIND)
    with valid_settings(path, "image encoder"):
        stored = checkpoint.settings["network"]
        network = EncoderNetwork(int(stored["dim"]))
    if stored.get("category") != category.digest:
        raise CheckpointError(
            f"encoder must be of the category {category.name}, got one of another; run "
            "probmotion train images again"
        )
    load_weights(network, checkpoint.tensors)
    return network.eval().requires_grad_(False)
