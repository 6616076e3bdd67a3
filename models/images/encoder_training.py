"""Training of the encoder on made images of draws of the prior."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
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
    parameters_of,
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
_SILHOUETTE, _RENDERED = 100.0, 32  # weight of the IoU in the loss, nats, and pixels of silhouettes
_VALIDATED = 256


class EncoderTrainee:
    """Trainee for :func:`~probmotion.models.training.trainer.train`.

    The loss is the negative log density of the true parameters under the network's mixture. For a
    network that has learnt this, it has 100 (1 − IoU) in addition, of the observed silhouette and
    that of the mean given the true quarter turn; from the beginning, this slows down learning.

    Parameters
    ----------
    category : Category
        Kind of body; its draws are rendered.
    seed : int
        Seed of the initial weights and of the validation images.
    learnt : EncoderNetwork, optional
        Network of this category that is trained further, for silhouettes, too.
    """

    kind = KIND

    def __init__(
        self, category: Category, seed: int = 0, learnt: EncoderNetwork | None = None
    ) -> None:
        # The network sees no features.
        without = category.features[:, :0]
        self.category = replace(category, features=without, feature_noise=np.zeros(0))
        dim = SurfacePrior(category, np.ones(1)).dim
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seeds.integer(seed, "weights"))
            self.network = EncoderNetwork(dim)
        self.settings: Mapping[str, Any] = {"category": category.digest, "dim": dim, "seed": seed}
        self._silhouettes = learnt is not None
        if learnt is not None:
            self.network.load_state_dict(learnt.state_dict())
            self.settings = {**self.settings, "silhouettes": _SILHOUETTE}
        self._validation = self._batch(seeds.generator(seed, "validation"), _VALIDATED)[:2]

    def training_loss(
        self, network: nn.Module, rng: np.random.Generator, batch: int, device: torch.device
    ) -> torch.Tensor:
        """Return the loss of new images."""
        images, theta, prior = self._batch(rng, batch)
        estimates = network(images.to(device))
        loss = mixture_loss(estimates, theta, self._view)
        if self._silhouettes:
            loss = loss + _SILHOUETTE * (1 - _mean_overlap(estimates, images, theta, prior))
        return loss

    def validation_loss(self, network: nn.Module, device: torch.device) -> float:
        """Return the negative log density of the parameters of the validation images."""
        network.eval()
        with torch.no_grad():
            images, theta = self._validation
            loss = float(mixture_loss(network(images.to(device)), theta, self._view))
        network.train()
        return loss

    @property
    def _view(self) -> int:
        return SurfacePrior(self.category, np.ones(1)).layout.view.start

    def _batch(
        self, rng: np.random.Generator, n: int
    ) -> tuple[torch.Tensor, np.ndarray, SurfacePrior]:
        tangent = np.exp(rng.uniform(*np.log(TANGENTS)))
        prior = SurfacePrior(self.category, np.array([tangent]))
        made = make_images(prior, rng, n, SIZE)
        images = encoder_input(made.mask, made.rgb)
        grey = torch.as_tensor(rng.random(n) < _GREY)
        blank = encoder_input(made.mask, None)
        return torch.where(grey[:, None, None, None], blank, images), made.theta, prior


def _mean_overlap(
    estimates: Estimates, images: torch.Tensor, theta: np.ndarray, prior: SurfacePrior
) -> torch.Tensor:
    """Return the mean IoU of the masks of images and the silhouettes of means."""
    view = prior.layout.view.start
    quarter, _ = quarter_of(np.arctan2(theta[:, view], theta[:, view + 1]))
    means = estimates.means[torch.arange(len(theta)), torch.as_tensor(quarter)].cpu()
    rendered = prior.render(parameters_of(means, torch.as_tensor(quarter), view), _RENDERED)
    mask, known = nn.functional.avg_pool2d(images[:, :2], SIZE // _RENDERED).unbind(1)
    covered = rendered[:, 0, ..., -1].clamp(0.0, 1.0) * known
    both = (covered * mask).sum(dim=(1, 2))
    return (both / (covered + mask - covered * mask).sum(dim=(1, 2))).mean()


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
    with valid_settings(path, KIND):
        stored = checkpoint.settings["network"]
        network = EncoderNetwork(int(stored["dim"]))
    if stored.get("category") != category.digest:
        raise CheckpointError(
            f"encoder must be of the category {category.name}, got one of another; run "
            "probmotion train images again"
        )
    load_weights(network, checkpoint.tensors, KIND)
    return network.eval().requires_grad_(False)
