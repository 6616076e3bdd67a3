"""Observed keypoints or joints, linearised about motions: perspective cameras, Student-t noise.

Entries have K rows, the image coordinates of all views or the coordinates of a joint. Student-t
noise of scale σ is Gaussian noise of variance σ²/w with w ~ Gamma(ν/2, rate ν/2) per row.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import gammainc, gammaincinv

from probmotion.geometry.cameras import Cameras
from probmotion.posteriors.likelihoods import Joints3D, Keypoints2D
from probmotion.samplers.conditional.coupling import Quadratic
from probmotion.samplers.diffusion.guidance import LinearisedObservations
from probmotion.seeds import NormalStreams

__all__ = ["Linearised", "Observations"]

_TRUNCATED = 1e-4  # largest relative change of a density by the truncation of w
_NEAREST = 0.1  # smallest depth of a joint, in depths of the centre


class Linearised(NamedTuple):
    """Residual y − π(x), (B, L, J, K), and Jacobian of π at x, (…, K, 3), normalised units."""

    residual: np.ndarray
    axes: np.ndarray

    def quadratic(self, precision: np.ndarray, at: np.ndarray) -> Quadratic:
        """Return the log likelihood linearised about ``at``; ``precision`` is (…, L, J, K)."""
        information = self.axes.swapaxes(-1, -2) @ (precision[..., None] * self.axes)
        return Quadratic(information, self.slope(precision) + (information @ at[..., None])[..., 0])

    def slope(self, precision: np.ndarray) -> np.ndarray:
        """Return the gradient of the log likelihood, (B, L, J, 3)."""
        weighted = (precision * self.residual)[..., None]
        slope: np.ndarray = (self.axes.swapaxes(-1, -2) @ weighted)[..., 0]
        return slope


class Observations:
    """Likelihood of keypoints or joints as a function of motions in normalised units.

    Parameters
    ----------
    likelihood : Keypoints2D or Joints3D
        Observations; perspective cameras and Student-t noise are supported.
    scale : float
        Metres per normalised unit.
    centre : ndarray, (3,)
        Mean position of the motions, normalised units.

    Raises
    ------
    ValueError
        If the centre is behind a perspective camera.

    Attributes
    ----------
    precision : ndarray, (L, J, K)
        1 / scale² of the noise of each row; 0 where occluded.
    largest_weight : float
        Upper limit of w, 1 for Gaussian noise. The limit changes the density of an entry by less
        than 0.01 %.
    """

    def __init__(
        self, likelihood: Keypoints2D | Joints3D, scale: float, centre: np.ndarray
    ) -> None:
        self._scale = scale
        self._cameras: Cameras | None = None
        self._freedom = likelihood.degrees_of_freedom
        precision = likelihood.entries.precision
        if isinstance(likelihood, Joints3D):
            self._target, self._axes = likelihood.joints, scale * np.eye(3)
            self.precision = np.repeat(precision[..., None], 3, axis=-1)
        else:
            cameras, seen = likelihood.cameras, likelihood.keypoints
            if cameras.orthographic:
                seen = seen - cameras.offset[:, None, None]
            else:
                self._cameras = cameras
                point = scale * centre[None, None]
                cameras.project(point)  # raises an error if it is behind a camera
                self._nearest = _NEAREST * cameras.depth(point)[:, 0, 0]
            self._target = _rows(seen)
            self._axes = scale * cameras.image_axes.reshape(-1, 3)
            self.precision = _rows(np.repeat(precision[..., None], 2, axis=-1))
        self.largest_weight = 1.0
        if self._freedom is not None:
            self._shape = 0.5 * (self._freedom + 1)
            quantile = gammaincinv(self._shape, 1 - _TRUNCATED)
            self.largest_weight = float(quantile / (0.5 * self._freedom))

    @property
    def linear(self) -> bool:
        """Whether π is linear."""
        return self._cameras is None

    def linearise(self, x: np.ndarray) -> Linearised:
        """Return π about motions x, (B, L, J, 3).

        Depths below a tenth of the centre's are raised to it.
        """
        if self._cameras is None:
            return Linearised(self._target - x @ self._axes.T, self._axes)
        cameras, shape = self._cameras, x.shape[:-1]
        depth = self._depth(x)[..., None]
        plane = (self._scale * x[..., None, None, :]) @ cameras.rotation[:, :2].swapaxes(-1, -2)
        image = (plane[..., 0, :] + cameras.translation[:, :2]) / depth
        residual = self._target - (cameras.focal[:, None] * image + cameras.centre).reshape(
            *shape, -1
        )
        # The smallest depth does not change with x.
        free = (depth > self._nearest[:, None])[..., None]
        turned = cameras.rotation[:, :2] - free * image[..., None] * cameras.rotation[:, None, 2]
        axes = (self._scale * cameras.focal[:, None, None]) * turned / depth[..., None]
        return Linearised(residual, axes.reshape(*shape, -1, 3))

    def about(self, x: np.ndarray) -> LinearisedObservations:
        """Return the observations linearised about motions x, with Gaussian noise."""
        local = self.linearise(x)
        target = local.residual[..., None] + local.axes @ x[..., None]
        return LinearisedObservations(local.axes, target, self.precision)

    def in_front(self, x: np.ndarray) -> np.ndarray:
        """Return whether joints are in front of the cameras that see them, (B, L, J)."""
        if self._cameras is None:
            return np.ones(x.shape[:-1], dtype=bool)
        seen = self.precision[..., ::2] > 0
        in_front: np.ndarray = ((self._depth(x) > self._nearest) | ~seen).all(axis=-1)
        return in_front

    def _depth(self, x: np.ndarray) -> np.ndarray:
        """Return the depths in all views, at least the smallest depth, (B, L, J, V), metres."""
        assert self._cameras is not None
        depth = np.moveaxis(self._cameras.depth(self._scale * x), -3, -1)
        return np.maximum(depth, self._nearest)

    def weights(self, residual: np.ndarray, streams: NormalStreams) -> np.ndarray:
        """Return a draw of w given residuals, (B, L, J, K); 1 for Gaussian noise."""
        if self._freedom is None:
            return np.ones_like(self.precision)
        rate = 0.5 * (self._freedom + self.precision * residual**2)
        below = gammainc(self._shape, rate * self.largest_weight)
        uniform = streams.uniform(*residual.shape[1:])
        weights: np.ndarray = gammaincinv(self._shape, uniform * below) / rate
        return weights


def _rows(entries: np.ndarray) -> np.ndarray:
    """Return the rows of entries of V views: ``(V, L, J, 2) → (L, J, 2V)``."""
    moved = np.moveaxis(entries, 0, -2)
    return moved.reshape(*moved.shape[:-2], -1)
