"""Likelihood of images: Bernoulli for the mask, Gaussian for colours and image features."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probmotion.extras import nn, torch
from probmotion.models.images.observation import ImageObservation
from probmotion.validation import check_shape

__all__ = ["ImageLikelihood"]

_MISTAKEN = 0.02  # share of pixels whose mask is wrong, inside and outside
_COLOUR_NOISE = 0.1  # standard deviation of colours
_INDEPENDENT = 0.05
"""Share of independent pixels of images 64 wide: errors of neighbouring pixels are similar."""
_WIDTH = 64


@dataclass(frozen=True, eq=False)
class ImageLikelihood:
    """Density of an observation given rendered images of S pixels; unknown pixels do not count.

    Images have the channels of :meth:`SurfacePrior.render`: three colours, F features and
    coverage, C = 4 + F.

    Parameters
    ----------
    mask : Tensor, (T, S, S)
        Observed coverage, 0 where unknown.
    known : Tensor of bool, (T, S, S)
        Pixels that are not unknown.
    rgb : Tensor, (T, S, S, 3), or None
        Colours times coverage.
    features : Tensor, (T, S, S, F)
        Features times coverage, NaN where unknown; F = 0 without.
    feature_noise : Tensor, (F,)
        Standard deviations of the features.
    softness : float
        Factor of the share of mistaken pixels and of the noise of colours and features; above 1,
        the density is flatter and has fewer modes.
    """

    mask: torch.Tensor
    known: torch.Tensor
    rgb: torch.Tensor | None
    features: torch.Tensor
    feature_noise: torch.Tensor
    softness: float = 1.0

    @classmethod
    def of(
        cls,
        observed: ImageObservation,
        size: int,
        dtype: torch.dtype,
        feature_noise: np.ndarray,
        softness: float = 1.0,
    ) -> ImageLikelihood:
        """Return the likelihood of images of ``size`` pixels, a divisor of the observation's.

        ``feature_noise`` (F,) is that of the category; unused if the observation has no features.
        """
        if observed.size % size:
            raise ValueError(f"size must divide the observation's {observed.size}, got {size}")
        known = np.isfinite(observed.mask)
        mask = np.where(known, observed.mask, 0.0)
        features = observed.features
        if features is None:
            features, feature_noise = np.zeros((*mask.shape, 0)), np.zeros(0)
        check_shape("feature_noise", feature_noise, features.shape[3:])

        def pooled(values: np.ndarray) -> torch.Tensor:
            channels = torch.as_tensor(values, dtype=dtype).movedim(-1, 1)
            means = nn.functional.avg_pool2d(
                channels.flatten(0, 1)[:, None], values.shape[1] // size
            )
            return means[:, 0].unflatten(0, channels.shape[:2]).movedim(1, -1)

        whole = pooled(known[..., None])[..., 0] == 1
        covered = mask[..., None]
        return cls(
            pooled(covered)[..., 0] * whole,
            whole,
            None if observed.rgb is None else pooled(np.nan_to_num(observed.rgb) * covered),
            pooled(features * covered),
            torch.as_tensor(feature_noise, dtype=dtype),
            softness,
        )

    @property
    def size(self) -> int:
        """Width S of the images."""
        return self.mask.shape[-1]

    @property
    def weight(self) -> float:
        """Share of the pixels that count as independent."""
        return _INDEPENDENT * (_WIDTH / self.size) ** 2

    @property
    def described(self) -> torch.Tensor:
        """Whether a feature counts, inside the mask and where it is known, (T, S, S, F)."""
        return self._inside[..., None] & self.features.isfinite()

    def log_density(self, images: torch.Tensor) -> torch.Tensor:
        """Return log p(observed | rendered) but for a constant, ``(B, T, S, S, C) → (B,)``."""
        covered = self._covered(images)
        terms = self.mask * covered.log() + (1 - self.mask) * torch.log1p(-covered)
        total = (terms * self.known).flatten(1).sum(dim=1)
        if self.rgb is not None:
            squares = ((images[..., :3] - self.rgb) ** 2).sum(dim=-1) * self._inside
            total = total - 0.5 * squares.flatten(1).sum(dim=1) / self._colour_noise**2
        total = total - 0.5 * (self._feature_errors(images) ** 2).flatten(1).sum(dim=1)
        return self.weight * total

    def curvature(
        self, images: torch.Tensor, derivatives: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the gradient (D,) and Fisher information (D, D) in D directions.

        Parameters
        ----------
        images : Tensor, (T, S, S, C)
            Images at a point.
        derivatives : Tensor, (D, T, S, S, C)
            Their derivatives in each direction.
        """
        covered = self._covered(images)
        slope = (1 - 2 * self._mistaken) * derivatives[..., -1] * self.known
        deviation = (covered * (1 - covered)).sqrt()
        rows = [(slope / deviation).flatten(1)]
        residuals = [((self.mask - covered) / deviation).flatten()]
        if self.rgb is not None:
            inside = self._inside[..., None] / self._colour_noise
            rows.append((derivatives[..., :3] * inside).flatten(1))
            residuals.append(((self.rgb - images[..., :3]) * inside).flatten())
        scale = self.described / (self.softness * self.feature_noise)
        rows.append((derivatives[..., 3:-1] * scale).flatten(1))
        residuals.append(self._feature_errors(images).flatten())
        row, residual = torch.cat(rows, dim=1), torch.cat(residuals)
        return self.weight * (row @ residual), self.weight * (row @ row.T)

    @property
    def _mistaken(self) -> float:
        return min(_MISTAKEN * self.softness, 0.25)

    @property
    def _colour_noise(self) -> float:
        return _COLOUR_NOISE * self.softness

    @property
    def _inside(self) -> torch.Tensor:
        return self.known & (self.mask > 0.5)

    def _covered(self, images: torch.Tensor) -> torch.Tensor:
        # Blending at corners can exceed the range slightly.
        return self._mistaken + (1 - 2 * self._mistaken) * images[..., -1].clamp(0.0, 1.0)

    def _feature_errors(self, images: torch.Tensor) -> torch.Tensor:
        """Return errors of features in standard deviations, 0 where they do not count."""
        errors = torch.where(self.described, self.features - images[..., 3:-1], 0.0)
        return errors / (self.softness * self.feature_noise)
