"""Linear-blend skinning of a surface by the bones of an articulated body, and its shading."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from probmotion.extras import torch
from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.models.images.surface import Surface

__all__ = ["Skin", "shaded"]


class Skin:
    """Surface that moves with a body; vertices along a bone stretch with its length.

    Parameters
    ----------
    body : ArticulatedBody
        Skeleton in its rest pose.
    surface : Surface
        Surface in the same pose.
    """

    def __init__(self, body: ArticulatedBody, surface: Surface) -> None:
        self.body, self.surface = body, surface
        n_joints, rows = body.skeleton.n_joints, np.arange(len(surface.vertices))[:, None]
        rest = body.rest_positions
        parents = np.maximum(body.skeleton.parents, 0)
        self._starts = rest[parents]
        self._bones = rest - self._starts
        weights = np.zeros((len(surface.vertices), n_joints))
        np.add.at(weights, (rows, surface.joints), surface.weights)
        offsets = surface.vertices[:, None] - self._starts
        squared = np.maximum((self._bones**2).sum(axis=-1), 1e-12)
        along = np.clip((offsets * self._bones).sum(axis=-1) / squared, 0.0, 1.0)
        above = np.zeros((n_joints, n_joints))  # bones between the root and a bone's upper end
        for joint in range(n_joints):
            above[joint, list(body.skeleton.ancestors(joint))[:-1]] = 1.0
        self._weights, self._above, self._stretch = (
            weights,
            above,
            weights @ above + weights * along,
        )

    def posed(
        self,
        rest_vertices: torch.Tensor,
        turns: torch.Tensor,
        rotation: torch.Tensor,
        translation: torch.Tensor,
        log_lengths: torch.Tensor,
    ) -> torch.Tensor:
        """Return the vertices (B, L, V, 3), metres.

        Parameters
        ----------
        rest_vertices : Tensor, (B, V, 3)
            Vertices in the rest pose.
        turns, rotation, translation, log_lengths
            Tensors of one batch size B as for :meth:`ArticulatedBody.positions`.
        """
        starts, rotations = self.body.bone_frames(turns, rotation, translation, log_lengths)
        constants = (self._starts, self._bones, self._weights, self._above, self._stretch)
        rest_starts, bones, weights, above, stretch = (
            torch.as_tensor(part, dtype=turns.dtype) for part in constants
        )
        groups = list(self.body.length_groups)
        longer = torch.expm1(log_lengths[:, groups])[:, :, None] * bones  # (B, J, 3)
        # The surface of the rest pose with these lengths, which the bones then move.
        rest_starts, rest_vertices = rest_starts + above @ longer, rest_vertices + stretch @ longer
        moved = starts - (rotations @ rest_starts[:, None, :, :, None])[..., 0]
        blended = weights @ rotations.flatten(-2)  # (B, L, V, 9)
        blended = blended.unflatten(-1, (3, 3))
        return (blended @ rest_vertices[:, None, :, :, None])[..., 0] + weights @ moved

    @cached_property
    def triangles(self) -> np.ndarray:
        """Triangles of the surface, (T, 3)."""
        return self.surface.triangles


def shaded(
    vertices: torch.Tensor,
    triangles: np.ndarray,
    albedo: torch.Tensor,
    light: torch.Tensor,
    ambient: torch.Tensor,
) -> torch.Tensor:
    """Return the radiance of the vertices of a diffuse surface, (B, V, 3).

    Albedo times (ambient + max(0, n · l)), with a directional light l, as in *Ponymation*
    (section 3.1).

    Parameters
    ----------
    vertices, albedo : Tensor, (B, V, 3)
        Positions, and reflectance of red, green and blue.
    triangles : ndarray, (T, 3)
        Counterclockwise from outside.
    light : Tensor, (B, 3)
        Direction towards the light times its strength, in the axes of the vertices.
    ambient : Tensor, (B,)
        Strength of the ambient light.
    """
    corners = vertices[:, torch.as_tensor(triangles)]  # (B, T, 3, 3)
    faces = torch.linalg.cross(
        corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0]
    )
    normals = torch.zeros_like(vertices)
    for corner in range(3):
        normals = normals.index_add(1, torch.as_tensor(triangles[:, corner]), faces)
    normals = normals / normals.norm(dim=-1, keepdim=True).clamp(min=1e-12)
    received = ambient[:, None] + (normals @ light[:, :, None])[..., 0].clamp(min=0)
    return albedo * received[..., None]
