"""Pinhole cameras without roll in a world with y up.

By default, the world's axes are the camera's right, up and backwards, with the camera at 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probmotion.geometry.cameras import Cameras
from probmotion.models.mixture.conditioning import rotation

__all__ = ["LevelCamera", "LevelCameras"]

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
    heading : float
        Rotation about the vertical, radians; 0 looks along -z.
    position : tuple of float
        Position (x, y, z), metres.
    """

    focal: float
    centre: tuple[float, float]
    pitch: float = 0.0
    heading: float = 0.0
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def axes(self) -> np.ndarray:
        """Rows: directions of the image's right, of its up, and of depth, (3, 3)."""
        c, s = np.cos(self.pitch), np.sin(self.pitch)
        axes = np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, s, -c]])
        turned: np.ndarray = axes @ rotation(self.heading).T
        return turned

    def pinhole(self) -> Cameras:
        """Return the camera as a batch of one."""
        right, up, forward = self.axes
        axes = np.stack([right, -up, forward])[None]
        focal, centre = np.array([self.focal]), np.array([self.centre])
        return Cameras(axes, -axes @ self.position, focal, centre, orthographic=False)

    def normalised(self, keypoints: np.ndarray) -> np.ndarray:
        """Return (right, up) at depth 1: ``(…, 2) → (…, 2)``, from pixels with y down."""
        offset: np.ndarray = (keypoints - self.centre) / self.focal * [1.0, -1.0]
        return offset

    def depth(self, positions: np.ndarray) -> np.ndarray:
        """Return the depth of positions, at least 30 cm: ``(…, 3) → (…)``, metres."""
        depth: np.ndarray = np.maximum((positions - self.position) @ self.axes[2], _NEAREST)
        return depth

    def project(self, positions: np.ndarray) -> np.ndarray:
        """Return normalised projections: ``(…, 3) → (…, 2)``."""
        plane = (positions - self.position) @ self.axes[:2].T
        projected: np.ndarray = plane / self.depth(positions)[..., None]
        return projected

    def pixels(self, positions: np.ndarray) -> np.ndarray:
        """Return projections in pixels with y down: ``(…, 3) → (…, 2)``."""
        pixels: np.ndarray = self.project(positions) * [self.focal, -self.focal] + self.centre
        return pixels

    def points(self, normalised: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Return the points at depths along rays: ``(…, 2), (…) → (…, 3)``."""
        ones = np.ones((*normalised.shape[:-1], 1))
        rays: np.ndarray = np.concatenate([normalised, ones], axis=-1) @ self.axes
        return rays * depth[..., None] + self.position

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
        matrix = np.stack(rows, axis=-2)
        return matrix, target + matrix @ np.array(self.position)

    def along_depth(self, sizes: np.ndarray) -> np.ndarray:
        """Return vectors of given sizes along the optical axis: ``(…) → (…, 3)``."""
        vectors: np.ndarray = sizes[..., None] * self.axes[2]
        return vectors


@dataclass(frozen=True)
class LevelCameras:
    """V cameras in one world; arrays of observations have the views as their first axis.

    Parameters
    ----------
    views : tuple of LevelCamera
    """

    views: tuple[LevelCamera, ...]

    @property
    def focal(self) -> np.ndarray:
        """Focal lengths, (V, 1, 1), pixels."""
        return np.array([view.focal for view in self.views])[:, None, None]

    def depth(self, positions: np.ndarray) -> np.ndarray:
        """Return depths: ``(L, J, 3) → (V, L, J)``, metres."""
        return np.stack([view.depth(positions) for view in self.views])

    def project(self, positions: np.ndarray) -> np.ndarray:
        """Return normalised projections: ``(L, J, 3) → (V, L, J, 2)``."""
        return np.stack([view.project(positions) for view in self.views])

    def linearised(
        self, positions: np.ndarray, normalised: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return A, (V, L, J, 2, 3), and t, (V, L, J, 2), of all views."""
        pairs = zip(self.views, normalised, strict=True)
        parts = [view.linearised(positions, each) for view, each in pairs]
        return np.stack([matrix for matrix, _ in parts]), np.stack([target for _, target in parts])

    def along_depth(self, sizes: np.ndarray) -> np.ndarray:
        """Return sums of vectors along the views' optical axes: ``(V, L, J) → (L, J, 3)``."""
        parts = [view.along_depth(each) for view, each in zip(self.views, sizes, strict=True)]
        total: np.ndarray = np.sum(parts, axis=0)
        return total
