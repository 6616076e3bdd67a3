"""Network that estimates the parameters of a body in an image, one Gaussian per facing direction.

One silhouette leaves open where a body faces. Directions are divided into quarter turns; the
network estimates the probability of each, and of the parameters given each of them: the four view
hypotheses of *Ponymation* (section 3.3), as a mixture of Gaussians.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from probmotion.extras import nn, torch

__all__ = [
    "QUARTERS",
    "SIZE",
    "EncoderNetwork",
    "Estimates",
    "encoder_input",
    "parameters_of",
    "quarter_of",
]

QUARTERS = 4
"""Number of facing directions, at quarter turns from the camera."""
SIZE = 64
"""Width and height of the input, pixels."""
_CHANNELS = (32, 64, 128, 128)


class Estimates(NamedTuple):
    """Mixture of B images: log weights (B, 4), means and log standard deviations (B, 4, dim − 1).

    The first of the dim − 1 parameters is the angle from the middle of the quarter in units of a
    radian; it replaces the two coordinates of the facing direction, which are the first of the
    view. The others are those of θ.
    """

    log_weights: torch.Tensor
    means: torch.Tensor
    log_spreads: torch.Tensor


class EncoderNetwork(nn.Module):
    """Convolutions and a perceptron.

    Parameters
    ----------
    dim : int
        Length of θ of one image.
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.dim = dim
        layers: list[nn.Module] = []
        previous = 5
        for channels in _CHANNELS:
            layers += [
                nn.Conv2d(previous, channels, 3, stride=2, padding=1),
                nn.GroupNorm(8, channels),
                nn.SiLU(),
            ]
            previous = channels
        self.convolutions = nn.Sequential(*layers)
        cells = (SIZE // 2 ** len(_CHANNELS)) ** 2
        self.shared = nn.Sequential(
            nn.Linear(previous * cells, 384), nn.SiLU(), nn.Linear(384, 384), nn.SiLU()
        )
        self.weights = nn.Linear(384, QUARTERS)
        self.estimates = nn.Linear(384, QUARTERS * 2 * (dim - 1))

    def forward(self, images: torch.Tensor) -> Estimates:
        """Return the estimates of images (B, 5, 64, 64) of :func:`encoder_input`."""
        hidden = self.shared(self.convolutions(images).flatten(1))
        means, logs = self.estimates(hidden).unflatten(1, (QUARTERS, 2, self.dim - 1)).unbind(2)
        return Estimates(torch.log_softmax(self.weights(hidden), dim=1), means, logs.clamp(-5, 1))


def encoder_input(mask: np.ndarray, rgb: np.ndarray | None) -> torch.Tensor:
    """Return the network's input (B, 5, 64, 64): the mask, what is known of it, and colours.

    ``mask`` (B, S, S) and ``rgb`` (B, S, S, 3) are those of an
    :class:`~probmotion.models.images.observation.ImageObservation`; S is a multiple of 64. Without
    colours, the body is grey.
    """
    known = ~np.isnan(mask)
    covered = np.where(known, mask, 0.0)
    colours = np.full((*mask.shape, 3), 0.4) if rgb is None else np.nan_to_num(rgb)
    channels = np.concatenate(
        [covered[..., None], known[..., None], colours * covered[..., None]], axis=-1
    )
    images = torch.as_tensor(channels.astype(np.float32)).movedim(-1, 1)
    if images.shape[-1] % SIZE:
        raise ValueError(f"mask must have a multiple of {SIZE} pixels a side, got {mask.shape[-1]}")
    return nn.functional.avg_pool2d(images, images.shape[-1] // SIZE)


def parameters_of(values: torch.Tensor, quarter: torch.Tensor, view: int) -> torch.Tensor:
    """Return θ (B, dim) of one image from values (B, dim − 1) of estimates given the quarters (B,).

    θ has its first coordinate of the view at ``view``.
    """
    yaw = quarter.to(values.dtype) * (math.pi / 2) + values[:, 0]
    # The root mean square length of the two coordinates.
    direction = math.sqrt(2) * torch.stack([torch.sin(yaw), torch.cos(yaw)], dim=1)
    return torch.cat([values[:, 1 : view + 1], direction, values[:, view + 1 :]], dim=1)


def quarter_of(yaw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the quarter of each direction and the angle from its middle, radians."""
    quarter = np.round(yaw / (math.pi / 2)).astype(int)
    return quarter % QUARTERS, yaw - quarter * math.pi / 2
