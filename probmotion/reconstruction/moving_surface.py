"""Motion of the surface of a body, frame by frame or as a mesh that bones move.

Axes are those of motions: right in the image, up, and towards the camera.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from probmotion.extras import torch
from probmotion.io.body_mesh import BodyMesh
from probmotion.models.images.category import vertex_normals
from probmotion.models.images.surface_prior import SurfacePrior
from probmotion.motion.motion import Motion

__all__ = ["FLIP", "albedos", "rig_motion", "skinned_mesh", "surface_frames"]

FLIP = np.array([1.0, -1.0, -1.0])
"""From the axes of the camera to those of motions."""


def rig_motion(prior: SurfacePrior, theta: np.ndarray) -> Motion:
    """Return the motion at θ (dim,) of the rig of the category's body, with rotations."""
    p = prior.parameters(torch.as_tensor(theta[None]))
    held = _held(prior)
    return prior.category.body.rig_motion(
        p.turns[0].numpy(),
        FLIP[:, None] * p.rotation[0, held].numpy(),
        FLIP * p.translation[0, held].numpy(),
        p.log_lengths[0].numpy(),
        prior.fps,
    )


def surface_frames(prior: SurfacePrior, theta: np.ndarray) -> np.ndarray:
    """Return the surface in all L frames, ``(n, dim) → (n, L, V, 3)``, metres."""
    p = prior.parameters(torch.as_tensor(theta))
    held = _held(prior)
    vertices: np.ndarray = prior.category.skin.posed(
        p.rest_vertices, p.turns, p.rotation[:, held], p.translation[:, held], p.log_lengths
    ).numpy()
    return vertices * FLIP


def skinned_mesh(prior: SurfacePrior, theta: np.ndarray) -> BodyMesh:
    """Return the surface at θ (dim,) in the rest pose of :func:`rig_motion`.

    Vertices have moved along bones that are longer or shorter than those of the category.
    """
    category = prior.category
    body, surface = category.body, category.surface
    p = prior.parameters(torch.as_tensor(theta[None]))
    still = torch.zeros_like(p.turns[:, :1])
    upright, origin = torch.eye(3, dtype=still.dtype)[None, None], still[:, :, 0]
    vertices = category.skin.posed(p.rest_vertices, still, upright, origin, p.log_lengths)
    vertices = vertices[0, 0].numpy()
    joints = np.array(body.rig_joints)[surface.joints]
    # Several bones may be of one joint of the rig, which must be named once.
    same = joints[:, :, None] == joints[:, None]
    first = same.argmax(axis=2) == np.arange(joints.shape[1])
    weights = np.where(first, (same * surface.weights[:, None]).sum(axis=2), 0.0)
    return BodyMesh(
        vertices,
        vertex_normals(replace(surface, vertices=vertices)),
        surface.triangles,
        np.where(weights > 0, joints, 0),
        weights,
    )


def albedos(prior: SurfacePrior, theta: np.ndarray) -> np.ndarray:
    """Return the reflectance of red, green and blue, ``(n, dim) → (n, V, 3)``, 0 to 1."""
    values: np.ndarray = prior.parameters(torch.as_tensor(theta)).albedo.numpy()
    return np.clip(values, 0.0, 1.0)


def _held(prior: SurfacePrior) -> list[int]:
    """Return the image whose pose relative to the camera each frame has."""
    return [min(frame, prior.images - 1) for frame in range(prior.frames)]
