"""Pinhole camera in a world whose axes are right, up and backwards, with the camera at 0."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["LevelCamera"]

_NEAREST = 0.3  # depth below which a point is not projected, metres


@dataclass(frozen=True)
class LevelCamera:
    """Pinhole camera without roll.

    Parameters
    ----------
    focal : float
        Focal length, pixels.
    centre : tuple of float
        Principal point (x, y), pixels.
    pitch : float
        Angle of the optical axis above the horizon, radians.
    """

    focal: float
    centre: tuple[float, float]
    pitch: float = 0.0

    @property
    def axes(self) -> np.ndarray:
        """Rows: directions of the image's right, of its up, and of depth, (3, 3)."""
        c, s = np.cos(self.pitch), np.sin(self.pitch)
        return np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, s, -c]])

    def normalised(self, keypoints: np.ndarray) -> np.ndarray:
        """Return (right, up) at depth 1: ``(…, 2) → (…, 2)``, from pixels with y down."""
        offset: np.ndarray = (keypoints - self.centre) / self.focal * [1.0, -1.0]
        return offset

    def depth(self, positions: np.ndarray) -> np.ndarray:
        """Return the depth of positions, at least 30 cm: ``(…, 3) → (…)``, metres."""
        depth: np.ndarray = np.maximum(positions @ self.axes[2], _NEAREST)
        return depth

    def project(self, positions: np.ndarray) -> np.ndarray:
        """Return normalised projections: ``(…, 3) → (…, 2)``."""
        projected: np.ndarray = positions @ self.axes[:2].T / self.depth(positions)[..., None]
        return projected

    def pixels(self, positions: np.ndarray) -> np.ndarray:
        """Return projections in pixels with y down: ``(…, 3) → (…, 2)``."""
        pixels: np.ndarray = self.project(positions) * [self.focal, -self.focal] + self.centre
        return pixels

    def points(self, normalised: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Return the points at depths along rays: ``(…, 2), (…) → (…, 3)``."""
        ones = np.ones((*normalised.shape[:-1], 1))
        rays: np.ndarray = np.concatenate([normalised, ones], axis=-1) @ self.axes
        return rays * depth[..., None]

    def linearised(
        self, positions: np.ndarray, normalised: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return A and t of the linearisation A X = t of projections at ``positions``.

        Both sides are multiplied by the depth d, so that a keypoint's noise σ in pixels has the
        standard deviation σ d / focal.

        Returns
        -------
        matrix : ndarray, (…, 2, 3)
        target : ndarray, (…, 2)
            Metres.
        """
        predicted = self.project(positions)
        right, up, forward = self.axes
        rows = (right - predicted[..., :1] * forward, up - predicted[..., 1:] * forward)
        target = (normalised - predicted) * self.depth(positions)[..., None]
        return np.stack(rows, axis=-2), target
