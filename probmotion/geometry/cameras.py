"""Perspective and orthographic cameras, in batches of V views.

Axes follow OpenCV: x right, y down, z forward. A world point X has camera coordinates R X + t.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probmotion.arrays import Array, array_namespace, constant, to_numpy
from probmotion.validation import check_count, check_finite, check_positive, check_shape

__all__ = ["Cameras"]


@dataclass(frozen=True, eq=False)
class Cameras:
    """Batch of V cameras, either all perspective or all orthographic.

    Parameters
    ----------
    rotation : ndarray, (V, 3, 3)
        Rotations R from world to camera axes.
    translation : ndarray, (V, 3)
        Camera coordinates t of the world origin, metres.
    focal : ndarray, (V,)
        Focal length. Perspective: image units per unit of x/z. Orthographic: image units per metre.
    centre : ndarray, (V, 2), optional
        Principal point, image units; the origin by default.
    orthographic : bool
        Whether the projection is orthographic.

    Raises
    ------
    ValueError
        If shapes disagree, a value is not finite, a focal length is not positive, or a rotation is
        not orthonormal with determinant 1 (to 1e-6).
    """

    rotation: np.ndarray
    translation: np.ndarray
    focal: np.ndarray
    centre: np.ndarray | None = None
    orthographic: bool = True

    def __post_init__(self) -> None:
        rotation, translation, focal = (
            np.asarray(value, dtype=np.float64)
            for value in (self.rotation, self.translation, self.focal)
        )
        check_shape("rotation", rotation, ("V", 3, 3))
        n_views = len(rotation)
        if n_views == 0:
            raise ValueError("rotation must contain at least one camera, got none")
        centre = np.zeros((n_views, 2)) if self.centre is None else self.centre
        centre = np.asarray(centre, dtype=np.float64)
        check_shape("translation", translation, (n_views, 3))
        check_shape("focal", focal, (n_views,))
        check_shape("centre", centre, (n_views, 2))
        check_finite("rotation", rotation)
        check_finite("translation", translation)
        check_finite("centre", centre)
        for value in focal:
            check_positive("focal", float(value))
        deviation = np.abs(rotation @ np.swapaxes(rotation, -1, -2) - np.eye(3)).max()
        if deviation > 1e-6:
            raise ValueError(
                f"rotation must be orthonormal to 1e-6, got a deviation of {deviation:.2g}"
            )
        if (np.linalg.det(rotation) < 0).any():
            raise ValueError("rotation must have determinant 1, got a reflection")
        fields = {"rotation": rotation, "translation": translation, "focal": focal}
        for name, value in (fields | {"centre": centre}).items():
            object.__setattr__(self, name, value)

    @classmethod
    def ring(
        cls,
        n_views: int,
        *,
        elevation: float = 0.0,
        distance: float = 7.0,
        start: float = 0.0,
        perspective: bool = False,
    ) -> Cameras:
        """Return cameras evenly spaced around the vertical axis, facing the origin.

        Parameters
        ----------
        n_views : int
            Number of cameras V.
        elevation : float
            Elevation above the horizon, radians.
        distance : float
            Distance from the origin, metres; also the focal length of perspective cameras, so that
            the scale at the origin is one image unit per metre (*MAS*, appendix C).
        start : float
            Azimuth of the first camera, radians; 0 is the +Z axis.
        perspective : bool
            Whether the cameras are perspective instead of orthographic.
        """
        check_count("n_views", n_views)
        azimuth = start + 2 * np.pi * np.arange(n_views) / n_views
        return cls.around(
            azimuth, np.full(n_views, elevation), distance=distance, perspective=perspective
        )

    @classmethod
    def around(
        cls,
        azimuth: np.ndarray,
        elevation: np.ndarray,
        *,
        distance: float = 7.0,
        perspective: bool = False,
    ) -> Cameras:
        """Return cameras at azimuths and elevations (V,), radians, facing the origin."""
        check_positive("distance", distance)
        azimuth = np.atleast_1d(np.asarray(azimuth, dtype=np.float64))
        elevation = np.broadcast_to(np.asarray(elevation, dtype=np.float64), azimuth.shape)
        check_finite("azimuth", azimuth)
        check_finite("elevation", elevation)
        ca, sa, ce, se = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
        zero = np.zeros_like(ca)
        right = np.stack([ca, zero, -sa], axis=-1)
        down = np.stack([se * sa, -ce, se * ca], axis=-1)
        forward = np.stack([-ce * sa, -se, -ce * ca], axis=-1)
        n_views = len(azimuth)
        return cls(
            rotation=np.stack([right, down, forward], axis=-2),
            translation=np.tile([0.0, 0.0, distance], (n_views, 1)),
            focal=np.full(n_views, distance if perspective else 1.0),
            orthographic=not perspective,
        )

    @property
    def n_views(self) -> int:
        """Number of cameras V."""
        return len(self.focal)

    @property
    def azimuth(self) -> np.ndarray:
        """Azimuth of each camera's position relative to its viewing target, radians, (V,)."""
        forward = self.rotation[:, 2]
        return np.arctan2(-forward[:, 0], -forward[:, 2])

    @property
    def elevation(self) -> np.ndarray:
        """Elevation of each camera above the horizon, radians, (V,)."""
        return np.arcsin(np.clip(-self.rotation[:, 2, 1], -1.0, 1.0))

    @property
    def image_axes(self) -> np.ndarray:
        """Matrices P (V, 2, 3): world directions of the image axes times the focal length.

        For orthographic cameras ``project(X) = P X + offset``.
        """
        return self.focal[:, None, None] * self.rotation[:, :2]

    @property
    def offset(self) -> np.ndarray:
        """Image of the world origin under orthographic projection, (V, 2)."""
        return self.focal[:, None] * self.translation[:, :2] + self.centre

    def view(self, index: int) -> Cameras:
        """Return one camera as a batch of one."""
        return self.views([index])

    def views(self, indices: list[int]) -> Cameras:
        """Return some of the cameras."""
        assert self.centre is not None
        rotation, translation = self.rotation[indices], self.translation[indices]
        focal, centre = self.focal[indices], self.centre[indices]
        return Cameras(rotation, translation, focal, centre, self.orthographic)

    def as_orthographic(self) -> Cameras:
        """Return orthographic cameras with the same scale at the depth of the world origin."""
        if self.orthographic:
            return self
        focal = self.focal / self.translation[:, 2]
        return Cameras(self.rotation, self.translation, focal, self.centre, orthographic=True)

    def depth(self, points: Array) -> Array:
        """Return depths along the cameras' z axes: ``(…, L, J, 3) → (…, V, L, J)``, metres."""
        xp = array_namespace(points)
        along = xp.matmul(constant(self.rotation[:, 2], points), _columns(points))
        depth = along + constant(self.translation[:, 2:], points)
        return xp.reshape(depth, (*points.shape[:-3], self.n_views, *points.shape[-3:-1]))

    def project(self, points: Array) -> Array:
        """Return image points: ``(…, L, J, 3) → (…, V, L, J, 2)``, image units.

        Raises
        ------
        ValueError
            If a point is not in front of a perspective camera. Not checked under JAX tracing.
        """
        check_shape("points", points, ("…", "L", "J", 3))
        xp = array_namespace(points)
        # Coordinates before points, (…, V, 2, L J): NumPy is slow along axes of two entries.
        image = xp.matmul(constant(self.image_axes.reshape(-1, 3), points), _columns(points))
        image = xp.reshape(image, (*points.shape[:-3], self.n_views, 2, image.shape[-1]))
        shift = self.focal[:, None] * self.translation[:, :2]
        image = image + constant(shift[..., None], points)
        if not self.orthographic:
            depth = self.depth(points)
            self._check_in_front(depth)
            image = image / xp.reshape(depth, (*image.shape[:-2], 1, image.shape[-1]))
        assert self.centre is not None
        if self.centre.any():
            image = image + constant(self.centre[..., None], points)
        shape = (*points.shape[:-3], self.n_views, *points.shape[-3:-1], 2)
        return xp.reshape(xp.matrix_transpose(image), shape)

    def _check_in_front(self, depth: Array) -> None:
        if type(depth).__name__.endswith("Tracer"):
            return
        depth = to_numpy(depth)
        if depth.size and depth.min() <= 0:
            view = int(np.argwhere(depth <= 0)[0][-3])
            raise ValueError(
                f"points must be in front of every camera, got depth {depth.min():.3g} m in "
                f"camera {view}; move the cameras away or centre the motion"
            )


def _columns(points: Array) -> Array:
    """Return the points as columns, ``(…, L, J, 3) → (…, 3, L J)``."""
    xp = array_namespace(points)
    *batch, L, J, _ = points.shape
    return xp.matrix_transpose(xp.reshape(points, (*batch, L * J, 3)))
