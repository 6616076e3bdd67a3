"""Likelihood of images: Bernoulli for the mask, Gaussian for colours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probmotion.extras import nn, torch
from probmotion.models.images.observation import ImageObservation

__all__ = ["ImageLikelihood"]

_MISTAKEN = 0.02  # share of pixels whose mask is wrong, inside and outside
_COLOUR_NOISE = 0.1  # standard deviation of colours
_INDEPENDENT = 0.05
"""Share of independent pixels of images 64 wide: errors of neighbouring pixels are similar."""
_WIDTH = 64


@dataclass(frozen=True, eq=False)
class ImageLikelihood:
    """Density of an observation given rendered images of S pixels; unknown pixels do not count.

    Parameters
    ----------
    mask : Tensor, (T, S, S)
        Observed coverage, 0 where unknown.
    known : Tensor of bool, (T, S, S)
        Pixels that are not unknown.
    rgb : Tensor, (T, S, S, 3), or None
        Colours times coverage.
    softness : float
        Factor of the share of mistaken pixels and of the noise of colours; above 1, the density is
        flatter and has fewer modes.
    """

    mask: torch.Tensor
    known: torch.Tensor
    rgb: torch.Tensor | None
    softness: float = 1.0

    @classmethod
    def of(
        cls, observed: ImageObservation, size: int, dtype: torch.dtype, softness: float = 1.0
    ) -> ImageLikelihood:
        """Return the likelihood of images of ``size`` pixels, a divisor of the observation's."""
        if observed.size % size:
            raise ValueError(f"size must divide the observation's {observed.size}, got {size}")
        pool = nn.AvgPool2d(observed.size // size)
        known = np.isfinite(observed.mask)
        mask = np.where(known, observed.mask, 0.0)
        rgb = None
        if observed.rgb is not None:
            colours = np.nan_to_num(observed.rgb) * mask[..., None]
            rgb = pool(torch.as_tensor(colours, dtype=dtype).movedim(-1, 1)).movedim(1, -1)
        whole = pool(torch.as_tensor(known, dtype=dtype)) == 1
        return cls(pool(torch.as_tensor(mask, dtype=dtype)) * whole, whole, rgb, softness)

    @property
    def size(self) -> int:
        """Width S of the images."""
        return self.mask.shape[-1]

    def log_density(self, images: torch.Tensor) -> torch.Tensor:
        """Return log p(observed | rendered) but for a constant, ``(B, T, S, S, 4) → (B,)``."""
        covered = self._covered(images)
        terms = self.mask * covered.log() + (1 - self.mask) * torch.log1p(-covered)
        total = (terms * self.known).flatten(1).sum(dim=1)
        if self.rgb is not None:
            squares = ((images[..., :3] - self.rgb) ** 2).sum(dim=-1) * self._inside
            total = total - 0.5 * squares.flatten(1).sum(dim=1) / self._colour_noise**2
        return self._weight * total

    def curvature(
        self, images: torch.Tensor, derivatives: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the gradient (D,) and Fisher information (D, D) in D directions.

        Parameters
        ----------
        images : Tensor, (T, S, S, 4)
            Images at a point.
        derivatives : Tensor, (D, T, S, S, 4)
            Their derivatives in each direction.
        """
        covered = self._covered(images)
        slope = (1 - 2 * self._mistaken) * derivatives[..., 3] * self.known
        deviation = (covered * (1 - covered)).sqrt()
        rows = [(slope / deviation).flatten(1)]
        residuals = [((self.mask - covered) / deviation).flatten()]
        if self.rgb is not None:
            inside = self._inside[..., None] / self._colour_noise
            rows.append((derivatives[..., :3] * inside).flatten(1))
            residuals.append(((self.rgb - images[..., :3]) * inside).flatten())
        row, residual = torch.cat(rows, dim=1), torch.cat(residuals)
        return self._weight * (row @ residual), self._weight * (row @ row.T)

    @property
    def _mistaken(self) -> float:
        return min(_MISTAKEN * self.softness, 0.25)

    @property
    def _colour_noise(self) -> float:
        return _COLOUR_NOISE * self.softness

    @property
    def _weight(self) -> float:
        return _INDEPENDENT * (_WIDTH / self.size) ** 2

    @property
    def _inside(self) -> torch.Tensor:
        return self.known & (self.mask > 0.5)

    def _covered(self, images: torch.Tensor) -> torch.Tensor:
        # Blending at corners can exceed the range slightly.
        return self._mistaken + (1 - 2 * self._mistaken) * images[..., 3].clamp(0.0, 1.0)
