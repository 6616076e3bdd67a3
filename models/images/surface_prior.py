"""`SurfacePrior`: prior over pose, shape, colours and motion of a body in front of a camera."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from probmotion.arrays import Array, to_numpy
from probmotion.extras import torch
from probmotion.models.images.category import Category
from probmotion.models.images.image_likelihood import ImageLikelihood
from probmotion.models.images.observation import ImageObservation, check_rotations
from probmotion.models.images.posing import shaded
from probmotion.models.images.rasterizer import Rasterizer, Renderer
from probmotion.models.latent.standard_normal import StandardNormalPrior
from probmotion.seeds import RandomNumbers
from probmotion.validation import check_positive, check_shape

__all__ = ["SurfaceParameters", "SurfacePrior"]

_ROWS = 32  # number of θ rendered at once
_SIZE = 64  # pixels; larger observations are averaged

# Mean and standard deviation of the pose relative to the camera. Angles in radians; the body's
# centre in units of half the crop; log of half the crop's width at the body's distance in metres.
_PITCH, _ROLL = (0.15, 0.2), (0.0, 0.08)
_X, _Y, _LOG_WIDTH = (0.0, 0.11), (-0.12, 0.11), (math.log(0.58), 0.18)
# Standard deviations of the changes from one image of a clip to the next.
_CHANGES = (0.15, 0.04, 0.04, 0.06, 0.06, 0.03)  # of yaw, pitch, roll, x, y and log width
_POSE_ERROR = 0.15  # of a bone's rotation that is estimated from one image, radians
_MIRRORED_ERROR = 0.05  # of a bone's rotation in a mirrored pose
_LIGHT, _LIGHT_SPREAD = (0.0, -0.5, -0.4), 0.35
_AMBIENT = (0.55, 0.12)
_SAME_AXES = 1e-9
# Rotation from a body that faces the camera to the camera's axes.
_FLIP = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))


class SurfaceParameters(NamedTuple):
    """What B rows of θ stand for.

    ``turns`` (B, L, bones, 3): rotation vectors, radians; ``log_lengths`` (B, G);
    ``rest_vertices`` and ``albedo`` (B, V, 3); ``light`` (B, 3) and ``ambient`` (B,) as for
    :func:`~probmotion.models.images.posing.shaded`; ``rotation`` (B, T, 3, 3) from the body's to
    the first camera's axes, and ``translation`` (B, T, 3) of the root in these, metres.
    """

    turns: torch.Tensor
    log_lengths: torch.Tensor
    rest_vertices: torch.Tensor
    albedo: torch.Tensor
    light: torch.Tensor
    ambient: torch.Tensor
    rotation: torch.Tensor
    translation: torch.Tensor


@dataclass(frozen=True)
class _Layout:
    """Slices of θ."""

    code: slice
    lengths: slice
    shape: slice
    albedo: slice
    light: slice
    view: slice

    @classmethod
    def of(cls, *sizes: int) -> _Layout:
        ends = np.cumsum((0, *sizes))
        return cls(*(slice(int(a), int(b)) for a, b in pairwise(ends)))


class SurfacePrior(StandardNormalPrior):
    """Prior of one body of a category in one image, or in the T images of a clip.

    θ ~ N(0, I) has the motion code z, the bone lengths, the shape, the colours, the light and the
    body's pose relative to the camera, in this order. The direction in which the body faces is that
    of two coordinates and thus uniform. Motions have the axes of the first image's camera with Y up
    and Z towards it; the body keeps its place after the last image.

    Parameters
    ----------
    category : Category
        Kind of body.
    tangent : ndarray, (T,)
        Tangent of half the field of view of each crop.
    renderer : Renderer, optional
        Renderer of the images; a :class:`~probmotion.models.images.rasterizer.Rasterizer` by
        default.
    rotation : ndarray, (T, 3, 3), optional
        From common axes, as those of the image, to those of each crop; equal by default.

    Raises
    ------
    ValueError
        If there are more images than frames of the motion code, or shapes disagree.
    """

    def __init__(
        self,
        category: Category,
        tangent: np.ndarray,
        renderer: Renderer | None = None,
        *,
        rotation: np.ndarray | None = None,
    ) -> None:
        self.category = category
        self.renderer = Rasterizer() if renderer is None else renderer
        self.tangent = np.atleast_1d(np.asarray(tangent, dtype=np.float64))
        check_shape("tangent", self.tangent, ("T",))
        for value in self.tangent:
            check_positive("tangent", float(value))
        body, code = category.body, category.code
        category.check_images(len(self.tangent))
        self.skeleton, self.frames, self.fps = body.skeleton, code.frames, code.fps
        self.images = len(self.tangent)
        self.turned = np.tile(np.eye(3), (self.images, 1, 1))
        """From the axes of the first crop to those of each, (T, 3, 3)."""
        if rotation is not None:
            rotation = np.asarray(rotation, dtype=np.float64)
            check_shape("rotation", rotation, (self.images, 3, 3))
            check_rotations("rotation", rotation)
            self.turned = rotation @ rotation[0].T
        self.layout = _Layout.of(
            code.dim,
            body.n_groups,
            len(category.shapes),
            len(category.albedos),
            4,
            7 + 6 * (self.images - 1),
        )
        self._middle = category.surface.vertices.mean(axis=0)

    @property
    def dim(self) -> int:
        """Length of θ."""
        return self.layout.view.stop

    def motion(self, theta: Array) -> Array:
        """Return the joints at θ, ``(…, dim) → (…, L, J, 3)``, metres, Y up."""
        check_shape("theta", theta, ("…", self.dim))
        rows = torch.as_tensor(theta).reshape(-1, self.dim)
        with torch.set_grad_enabled(isinstance(theta, torch.Tensor) and torch.is_grad_enabled()):
            p = self.parameters(rows)
            held = [min(t, self.images - 1) for t in range(self.frames)]
            joints = self.category.body.positions(
                p.turns, p.rotation[:, held], p.translation[:, held], p.log_lengths
            )
            joints = joints * torch.tensor([1.0, -1.0, -1.0], dtype=joints.dtype)
        joints = joints.reshape(*theta.shape[:-1], *joints.shape[1:])
        return joints if isinstance(theta, torch.Tensor) else joints.numpy()

    def vertices(self, theta: torch.Tensor) -> torch.Tensor:
        """Return the surface in each image's camera axes, ``(B, dim) → (B, T, V, 3)``, metres."""
        return self._seen(self._posed(self.parameters(theta)))

    def render(self, theta: torch.Tensor, size: int, features: bool = False) -> torch.Tensor:
        """Return the images, ``(B, dim) → (B, T, size, size, 4)``.

        The channels are colours times coverage, and coverage. With ``features``, the category's
        features times coverage are between them, (B, T, size, size, 4 + F).
        """
        p = self.parameters(theta)
        vertices = self._posed(p)
        seen = self._seen(vertices)
        triangles = self.category.surface.triangles
        images = []
        for t, tangent in enumerate(self.tangent):
            colours = shaded(vertices[:, t], triangles, p.albedo, p.light, p.ambient)
            colours = self._with_features(colours) if features else colours
            image = self.renderer.render(seen[:, t], triangles, colours, float(tangent), size)
            images.append(image)
        return torch.stack(images, dim=1)

    def check_observations(self, likelihood: ImageObservation) -> None:
        """Raise ``ValueError`` if the images are not those of the prior's cameras."""
        tangent = getattr(likelihood, "tangent", None)
        if tangent is None or not np.array_equal(tangent, self.tangent):
            raise ValueError(
                f"likelihood must be of images with the prior's tangent, {self.tangent}, got "
                f"{tangent}"
            )
        turned = likelihood.rotation @ likelihood.rotation[0].T
        difference = float(np.abs(turned - self.turned).max())
        if difference > _SAME_AXES:
            raise ValueError(
                "likelihood must be of images with the prior's rotation, got a difference of "
                f"{difference:.2g} between the axes of two crops; give rotation to SurfacePrior"
            )
        self.category.check_features(likelihood.features)

    def log_likelihood(self, theta: Array, likelihood: ImageObservation) -> Array:
        """Return log p(images | θ) but for a constant: ``(…, dim) → (…)``."""
        check_shape("theta", theta, ("…", self.dim))
        rows = torch.as_tensor(theta).reshape(-1, self.dim)
        with torch.set_grad_enabled(isinstance(theta, torch.Tensor) and torch.is_grad_enabled()):
            size = min(likelihood.size, _SIZE)
            density = ImageLikelihood.of(likelihood, size, rows.dtype, self.category.feature_noise)
            features = likelihood.features is not None
            parts = [
                density.log_density(self.render(part, size, features)) for part in rows.split(_ROWS)
            ]
        values = torch.cat(parts).reshape(theta.shape[:-1])
        return values if isinstance(theta, torch.Tensor) else to_numpy(values)

    def complete(
        self, rng: RandomNumbers, theta: np.ndarray, likelihood: ImageObservation | None
    ) -> np.ndarray:
        """Return :meth:`motion`; θ has all unknowns."""
        return to_numpy(self.motion(theta))

    def yaw(self, theta: np.ndarray) -> np.ndarray:
        """Return the directions (…) in which bodies (…, dim) face in the first image, radians.

        0 is towards the camera, and π/2 towards the right of the image.
        """
        start = self.layout.view.start
        yaw: np.ndarray = np.arctan2(theta[..., start], theta[..., start + 1])
        return yaw

    def facing(self, theta: np.ndarray, yaw: np.ndarray | float) -> np.ndarray:
        """Return θ (…, dim) with the body facing in another direction in the first image.

        ``yaw`` (…) is that of :meth:`yaw`.
        """
        turned = np.array(theta)
        start = self.layout.view.start
        # The length of the two coordinates is that of their root mean square.
        turned[..., start] = math.sqrt(2) * np.sin(yaw)
        turned[..., start + 1] = math.sqrt(2) * np.cos(yaw)
        return turned

    def moved(self, theta: np.ndarray, shift: np.ndarray, divisor: np.ndarray) -> np.ndarray:
        """Return θ (n, dim) of one image with the body shifted in the crop and then made smaller.

        ``shift`` (n, 2) is in units of half the crop; sizes are divided by ``divisor`` (n,).
        """
        moved = np.array(theta)
        x, y, width = (self.layout.view.start + k for k in (4, 5, 6))
        for axis, (column, (mean, spread)) in enumerate(((x, _X), (y, _Y))):
            centre = mean + spread * moved[:, column] + shift[:, axis]
            moved[:, column] = (centre / divisor - mean) / spread
        moved[:, width] += np.log(divisor) / _LOG_WIDTH[1]
        return moved

    def followed(self, theta: np.ndarray) -> np.ndarray:
        """Return θ (dim,) of the clip from estimates of each image alone (T, dim of one image).

        Motion codes become one by least squares of the poses, and bodies, colours and lights their
        mean. The view follows the estimates by at most a standard deviation per image.
        """
        at = self.layout
        turns = self.category.code.turns(theta[:, at.code])[None, :, 0]
        z = self._closest_codes(turns, _POSE_ERROR)[0]
        view = theta[:, at.view.start :]
        alone = SurfacePrior(self.category, self.tangent[:1]).parameters(torch.as_tensor(theta))
        common = self.turned.swapaxes(1, 2) @ alone.rotation[:, 0].numpy() @ np.array(_FLIP)
        roll, pitch, yaw = Rotation.from_matrix(common).as_euler("ZXY").T
        places = view[:, 4:] * (_X[1], _Y[1], _LOG_WIDTH[1])
        places[:, 2] -= np.log(self.tangent)
        path = np.column_stack([np.unwrap(-yaw), pitch, roll, places])
        reached, changes = path[0], np.zeros((self.images - 1, len(_CHANGES)))
        for change, estimate in zip(changes, path[1:], strict=True):
            change[:] = np.clip((estimate - reached) / _CHANGES, -1.0, 1.0)
            reached = reached + change * _CHANGES
        body = theta[:, at.lengths.start : at.view.start].mean(axis=0)
        return np.concatenate([z, body, view[0], changes.ravel()])

    def mirrored(self, theta: np.ndarray) -> np.ndarray:
        """Return θ (n, dim) of one image with bodies mirrored in depth, left and right exchanged.

        Seen from far away, bodies of a symmetric skeleton keep their silhouettes, but for poses
        that the code does not have: codes are those of the closest ones, by regularised least
        squares.
        """
        code, at, rig = self.category.code, self.layout, self.category.body.rig
        order = [rig.mirrored_order[rig.index(name)] for name in self.category.body.bones]
        other = [self.category.body.bones.index(rig.joint_names[joint]) for joint in order]
        mirrored = np.array(theta)
        turns = code.turns(theta[:, at.code])[:, : self.images, other] * [1.0, -1.0, -1.0]
        mirrored[:, at.code] = self._closest_codes(turns, _MIRRORED_ERROR)
        view = mirrored[:, at.view]
        view[:, 1] *= -1.0
        view[:, 2] = -2 * _PITCH[0] / _PITCH[1] - view[:, 2]
        return mirrored

    def _closest_codes(self, turns: np.ndarray, error: float) -> np.ndarray:
        """Return the codes (n, K) of bone rotations (n, T, B, 3) with errors of a size, radians."""
        code = self.category.code
        mean = code.turns(np.zeros(code.dim))[: self.images]
        basis = code.turns(np.eye(code.dim))[:, : self.images] - mean
        rows = basis.reshape(code.dim, -1) / error
        posed = (turns - mean).reshape(len(turns), -1) / error
        z: np.ndarray = np.linalg.solve(rows @ rows.T + np.eye(code.dim), rows @ posed.T).T
        return z

    def middle(self, theta: np.ndarray) -> np.ndarray:
        """Return the middle of the body in the first image, ``(n, dim) → (n, 3)``, camera axes."""
        x, y, log_width = (
            mean + spread * theta[:, self.layout.view.start + k]
            for k, (mean, spread) in zip((4, 5, 6), (_X, _Y, _LOG_WIDTH), strict=True)
        )
        width = np.exp(log_width)
        return np.stack([x * width, y * width, width / self.tangent[0]], axis=1)

    def parameters(self, theta: torch.Tensor) -> SurfaceParameters:
        """Return what θ stands for, ``(B, dim)``."""
        category, at = self.category, self.layout

        def constant(values: np.ndarray) -> torch.Tensor:
            return torch.as_tensor(values, dtype=theta.dtype)

        shapes = theta[:, at.shape] @ constant(category.shapes).flatten(1)
        albedos = theta[:, at.albedo] @ constant(category.albedos).flatten(1)
        vertices, light = constant(category.surface.vertices), theta[:, at.light]
        rotation, translation = self._views(theta[:, at.view])
        return SurfaceParameters(
            turns=category.code.turns(theta[:, at.code]),
            log_lengths=category.length_spread * theta[:, at.lengths],
            rest_vertices=vertices + shapes.unflatten(-1, vertices.shape),
            albedo=constant(category.albedo) + albedos.unflatten(-1, vertices.shape),
            light=constant(np.array(_LIGHT)) + _LIGHT_SPREAD * light[:, :3],
            ambient=_AMBIENT[0] + _AMBIENT[1] * light[:, 3],
            rotation=rotation,
            translation=translation,
        )

    def _views(self, view: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the rotations (B, T, 3, 3) from body to first camera, and roots (B, T, 3)."""
        first, later = view[:, :7], view[:, 7:].unflatten(-1, (self.images - 1, 6))
        changes = later * torch.tensor(_CHANGES, dtype=view.dtype)
        start = torch.stack(
            [
                torch.atan2(first[:, 0], first[:, 1]),
                _PITCH[0] + _PITCH[1] * first[:, 2],
                _ROLL[0] + _ROLL[1] * first[:, 3],
                _X[0] + _X[1] * first[:, 4],
                _Y[0] + _Y[1] * first[:, 5],
                _LOG_WIDTH[0] + _LOG_WIDTH[1] * first[:, 6],
            ],
            dim=-1,
        )
        path = torch.cat([start[:, None], changes], dim=1).cumsum(dim=1)
        yaw, pitch, roll, x, y, log_width = path.unbind(-1)
        flip = torch.tensor(_FLIP, dtype=view.dtype)
        rotation = _about(2, roll) @ _about(0, pitch) @ flip @ _about(1, yaw)
        tangent = torch.as_tensor(self.tangent, dtype=view.dtype)
        # Without a change, the body keeps its distance when the crop becomes wider.
        width = log_width.exp() * (tangent / tangent[..., :1])
        middle = torch.stack([x * width, y * width, width / tangent], dim=-1)
        turned = torch.as_tensor(self.turned, dtype=view.dtype)
        middle = (turned.mT @ middle[..., None])[..., 0]
        offset = torch.as_tensor(self._middle, dtype=view.dtype)
        return rotation, middle - rotation @ offset

    def _posed(self, p: SurfaceParameters) -> torch.Tensor:
        """Return the surface in each image in the axes of the first camera, (B, T, V, 3)."""
        return self.category.skin.posed(
            p.rest_vertices, p.turns[:, : self.images], p.rotation, p.translation, p.log_lengths
        )

    def _seen(self, vertices: torch.Tensor) -> torch.Tensor:
        """Return vertices (B, T, V, 3) in the axes of each camera."""
        return vertices @ torch.as_tensor(self.turned, dtype=vertices.dtype).mT

    def _with_features(self, colours: torch.Tensor) -> torch.Tensor:
        """Return colours (B, V, 3) and the category's features, (B, V, 3 + F)."""
        features = torch.as_tensor(self.category.features, dtype=colours.dtype)
        return torch.cat([colours, features.expand(len(colours), -1, -1)], dim=-1)


def _about(axis: int, angle: torch.Tensor) -> torch.Tensor:
    """Return rotations about a coordinate axis, (…, 3, 3)."""
    cos, sin = torch.cos(angle), torch.sin(angle)
    zero, one = torch.zeros_like(cos), torch.ones_like(cos)
    rows = {
        0: [[one, zero, zero], [zero, cos, -sin], [zero, sin, cos]],
        1: [[cos, zero, sin], [zero, one, zero], [-sin, zero, cos]],
        2: [[cos, -sin, zero], [sin, cos, zero], [zero, zero, one]],
    }[axis]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
