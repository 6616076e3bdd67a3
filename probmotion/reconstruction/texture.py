"""Texture of a body's surface: the colours of the images without their shading.

A texel that an image shows has the observed colour divided by the light that it receives at θ;
where none does, it has the reflectance of θ.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from probmotion.extras import torch
from probmotion.io.body_mesh import BodyMesh, Texture
from probmotion.models.images.category import vertex_normals
from probmotion.models.images.observation import ImageObservation
from probmotion.models.images.posing import shaded
from probmotion.models.images.rasterizer import Rasterizer
from probmotion.models.images.surface_prior import SurfacePrior
from probmotion.reconstruction.moving_surface import albedos

__all__ = ["textured"]

_CELL = 16  # texels; side of a square that contains two triangles
_SIDE = _CELL - 3  # texels between corners; interpolation then never mixes two triangles
_GRAZING, _FACING = 0.25, 0.55  # cosines between which observed colours replace those of θ
_INSIDE = 0.9  # least share of the body in a pixel whose colour is used
_SAME_SURFACE = 4.0  # maximum distance in depth from what a pixel shows, pixels at that depth
_DARK = 0.1  # received light below which the observed colour says little about the reflectance


def textured(
    mesh: BodyMesh, observation: ImageObservation, prior: SurfacePrior, theta: np.ndarray
) -> BodyMesh:
    """Return a mesh of the category's surface with a texture.

    Every triangle has a part of the texture, and three vertices of its own. Texels that several
    images show have their mean.

    Parameters
    ----------
    mesh : BodyMesh
        Mesh with the vertices and triangles of the category's surface, in any pose.
    observation : ImageObservation
        Images; without colours, the texture has the reflectance of θ.
    prior : SurfacePrior
    theta : ndarray, (dim,)
        Surface, pose and light in the images.
    """
    texels, coordinates = _layout(mesh.triangles)
    colours = texels.interpolated(albedos(prior, theta[None])[0])
    if observation.rgb is not None:
        total, shares = np.zeros_like(colours), np.zeros((len(colours), 1))
        for frame in range(observation.images):
            reflectance, share = _observed(observation, prior, theta, frame, texels)
            total, shares = total + share * reflectance, shares + share
        seen = total / np.maximum(shares, 1e-9)
        colours += np.minimum(shares, 1.0) * (seen - colours)
    size = math.isqrt(len(colours))
    image = np.round(255 * np.clip(colours, 0.0, 1.0)).astype(np.uint8).reshape(size, size, 3)
    corners = mesh.triangles.reshape(-1)
    return BodyMesh(
        mesh.vertices[corners],
        mesh.normals[corners],
        np.arange(len(corners)).reshape(-1, 3),
        mesh.joints[corners],
        mesh.weights[corners],
        Texture(image, coordinates),
    )


class _Texels(NamedTuple):
    """Places of N texels on a surface."""

    corners: np.ndarray  # (N, 3), vertices of the texel's triangle
    weights: np.ndarray  # (N, 3), barycentric coordinates

    def interpolated(self, values: np.ndarray) -> np.ndarray:
        """Return values (V, K) of the vertices at the texels, (N, K)."""
        mixed: np.ndarray = np.einsum("nk,nkc->nc", self.weights, values[self.corners])
        return mixed


def _layout(triangles: np.ndarray) -> tuple[_Texels, np.ndarray]:
    """Return the texels of a square image, row by row, and the coordinates (3T, 2) of corners.

    The width is a power of two, which suits all viewers. Two triangles share a cell, with their
    right angles in opposite corners of it. Corners are at centres of texels, and the texels beyond
    the longest edge continue the triangle.
    """
    across = 1 << math.ceil(0.5 * math.log2(len(triangles) / 2))
    row, column = np.indices((across * _CELL, across * _CELL)).reshape(2, -1)
    y, x = row % _CELL, column % _CELL
    second = x + y >= _CELL
    x, y = (np.where(second, _CELL - 1 - along, along) for along in (x, y))
    number = 2 * (row // _CELL * across + column // _CELL) + second
    owner = np.minimum(number, len(triangles) - 1)  # cells may be left over
    texels = _Texels(triangles[owner], np.stack([_SIDE - x - y, x, y], axis=-1) / _SIDE)
    number = np.arange(len(triangles))[:, None, None]
    corners = np.array([[0, 0], [_SIDE, 0], [0, _SIDE]])
    corners = np.where(number % 2 == 1, _CELL - 1 - corners, corners)
    cells = np.concatenate([number // 2 % across, number // 2 // across], axis=-1)
    coordinates = (_CELL * cells + corners + 0.5) / (_CELL * across)
    return texels, coordinates.reshape(-1, 2)


def _observed(
    observation: ImageObservation,
    prior: SurfacePrior,
    theta: np.ndarray,
    frame: int,
    texels: _Texels,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the reflectance (N, 3) of texels in an image, and how well they are seen (N, 1).

    The second is 0 where a texel is hidden, seen from the side, or beyond the mask, and at most 1.
    """
    surface, rows = prior.category.surface, torch.as_tensor(theta[None])
    tangent, size = float(prior.tangent[frame]), observation.size
    with torch.no_grad():
        p, posed = prior.parameters(rows), prior.vertices(rows)[:, frame]
        lamp = p.light @ torch.as_tensor(prior.turned[frame].T)
        light = shaded(posed, surface.triangles, torch.ones_like(posed), lamp, p.ambient)
        image = Rasterizer().render(posed, surface.triangles, posed, tangent, size)[0].numpy()
    covered = image[..., 3] > 0
    depth = np.where(covered, image[..., 2] / np.where(covered, image[..., 3], 1.0), np.nan)
    vertices = posed[0].numpy()
    normals = vertex_normals(replace(surface, vertices=vertices))
    places = texels.interpolated(np.concatenate([vertices, normals, light[0].numpy()], axis=1))
    points, normals, received = np.split(places, 3, axis=1)
    lengths = np.linalg.norm(points, axis=1) * np.linalg.norm(normals, axis=1)
    cosine = -(points * normals).sum(axis=1, keepdims=True) / np.maximum(lengths, 1e-12)[:, None]
    facing = np.clip((cosine - _GRAZING) / (_FACING - _GRAZING), 0.0, 1.0)
    colours, shares = _sampled(observation, frame, depth, points, tangent)
    # Half of the four pixels suffice: thin limbs have few that show nothing else.
    share = np.minimum(2 * shares, 1.0) * facing * (received > _DARK)
    return colours / np.maximum(received, _DARK), share


def _sampled(
    observation: ImageObservation,
    frame: int,
    depth: np.ndarray,
    points: np.ndarray,
    tangent: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the colours (N, 3) of an image at points (N, 3), and the shares (N, 1) of pixels used.

    Of the four pixels around a point, those are used that show the surface at its depth.
    """
    assert observation.rgb is not None
    size, rgb = observation.size, observation.rgb[frame]
    mask = observation.mask[frame]
    usable = (mask >= _INSIDE) & np.isfinite(rgb).all(axis=-1)
    # Pixels beside the outline may show the background, too: they get the colour of the nearest
    # pixel that does not, if it is next to them.
    clean = usable & ~ndimage.binary_dilation(mask < 1 - _INSIDE)
    distance, nearest = ndimage.distance_transform_edt(~clean, return_indices=True)
    usable &= (distance < 2) & clean.any()
    rgb = np.where(usable[..., None], rgb[tuple(nearest)], 0.0)
    z = np.where(points[:, 2] > 0, points[:, 2], np.inf)
    pixels = 0.5 * size * (1 + points[:, :2] / (z * tangent)[:, None]) - 0.5  # column and row
    pixels = np.clip(pixels, -2.0, size + 1.0)
    tolerance = _SAME_SURFACE * 2 * tangent / size * z
    total, shares = np.zeros_like(points), np.zeros((len(points), 1))
    for step in product((0, 1), repeat=2):
        corner = np.floor(pixels).astype(int) + step
        inside = ((corner >= 0) & (corner < size)).all(axis=1)
        column, row = np.clip(corner, 0, size - 1).T
        used = inside & usable[row, column] & (np.abs(depth[row, column] - z) < tolerance)
        share = np.where(used, np.prod(1 - np.abs(pixels - corner), axis=1), 0.0)[:, None]
        total, shares = total + share * rgb[row, column], shares + share
    return total / np.maximum(shares, 1e-9), shares
