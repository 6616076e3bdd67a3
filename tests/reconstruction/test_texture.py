"""Textures of reconstructions: reflectance where an image shows the surface, else that of θ."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("numba", reason="numba is not installed")
pytest.importorskip("skimage", reason="scikit-image is not installed")
from probmotion.extras import torch
from probmotion.models.images.category import vertex_normals
from probmotion.models.images.observation import ImageObservation
from probmotion.models.images.surface_prior import SurfacePrior
from probmotion.reconstruction.moving_surface import albedos, skinned_mesh
from probmotion.reconstruction.texture import textured

SIZE = 128
LEVEL = 0.6 / 255  # error of rounding to 8 bits


def sampled(texture, places):
    """Return the colours (N, 3) that a viewer shows at texture coordinates (N, 2)."""
    height, width = texture.image.shape[:2]
    at = places * [width, height] - 0.5
    low = np.floor(at).astype(int)
    share = at - low
    colours = np.zeros((len(at), 3))
    for right in (0, 1):
        for down in (0, 1):
            column = np.clip(low[:, 0] + right, 0, width - 1)
            row = np.clip(low[:, 1] + down, 0, height - 1)
            weight = np.abs(1 - right - share[:, 0]) * np.abs(1 - down - share[:, 1])
            colours += weight[:, None] * texture.image[row, column] / 255
    return colours


def in_triangles(mesh, weights):
    """Return the colours of points (T, 3) with barycentric coordinates (T, 3) or (3,)."""
    corners = mesh.texture.coordinates[mesh.triangles]
    return sampled(mesh.texture, (corners * np.reshape(weights, (-1, 3, 1))).sum(axis=1))


class View:
    """Images of a body with another coat than that of θ, and which triangles they show."""

    def __init__(self, category, images):
        vertices = category.surface.vertices
        size = np.ptp(vertices, axis=0).max()
        coat = 0.35 + 0.25 * np.sin(9 * vertices / size + [0, 1, 2])
        tilt = np.radians(25)  # of the axes of the last crop
        turn = [[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]]
        rotation = np.stack([np.eye(3), np.array(turn)])[-images:]
        tangent = np.full(images, 0.15)
        self.prior = SurfacePrior(category, tangent, rotation=rotation)
        painted = replace(category, albedo=coat, albedos=0 * category.albedos)
        theta = 0.3 * np.random.default_rng(5).normal(size=self.prior.dim)
        theta[self.prior.layout.view.start + 7 :] = 0.0  # in the middle of every crop
        theta[self.prior.layout.view.start + 6] = 1.5  # the body fits into the image
        self.theta = self.prior.facing(theta, 1.5)
        rows = torch.as_tensor(self.theta[None])
        rendered = SurfacePrior(painted, tangent, rotation=rotation).render(rows, SIZE)[0].numpy()
        mask = np.clip(rendered[..., 3], 0, 1)
        rgb = np.clip(rendered[..., :3] / np.maximum(rendered[..., 3:], 1e-3), 0, 1)
        self.observation = ImageObservation(mask, rgb, None, tangent, rotation)
        self.triangles = category.surface.triangles
        self.coat = coat[self.triangles].mean(axis=1)
        self.expected = albedos(self.prior, self.theta[None])[0][self.triangles].mean(axis=1)
        posed = [
            replace(category.surface, vertices=v.numpy()) for v in self.prior.vertices(rows)[0]
        ]
        self.cosine = np.stack([cosines(surface) for surface in posed])
        self.hidden = np.stack([occluded(surface) for surface in posed])
        self.seen = ((self.cosine > 0.6) & ~self.hidden).any(axis=0)
        middle = np.stack([surface.vertices[self.triangles].mean(axis=1) for surface in posed])
        self.columns = SIZE / 2 * (1 + middle[..., 0] / (middle[..., 2] * tangent[:, None]))

    def centres(self, observation):
        """Return the colours in the middle of the triangles."""
        mesh = skinned_mesh(self.prior, self.theta)
        mesh = textured(mesh, observation, self.prior, self.theta)
        return in_triangles(mesh, np.full(3, 1 / 3))


def cosines(surface):
    """Return the cosine of the angle between normal and camera in the middle of triangles, (T,)."""
    middle = surface.vertices[surface.triangles].mean(axis=1)
    normals = vertex_normals(surface)[surface.triangles].mean(axis=1)
    lengths = np.linalg.norm(middle, axis=1) * np.linalg.norm(normals, axis=1)
    return -(middle * normals).sum(axis=1) / lengths


def occluded(surface):
    """Return whether another triangle is between the camera and the middle of each, (T,)."""
    a, b, c = np.moveaxis(surface.vertices[surface.triangles], 1, 0)
    ends = (a + b + c) / 3
    # ends · s = u a + v b + w c with u, v, w ≥ 0: s is where the ray meets the plane.
    volume = (a * np.cross(b, c)).sum(axis=1)
    parts = [ends @ np.cross(p, q).T / volume for p, q in ((b, c), (c, a), (a, b))]
    total = sum(parts)
    crossed = np.all([part > 0 for part in parts], axis=0) & (total > 1 + 1e-3)
    return crossed.any(axis=1)


@pytest.fixture(scope="module", params=[1, 2])
def view(category, request):
    return View(category, request.param)


def test_texels_that_images_show_have_the_reflectance_of_the_body(view):
    colours = view.centres(view.observation)
    errors = np.abs(colours - view.coat).max(axis=1)[view.seen]
    assert view.seen.sum() > 80
    # Texels close to outlines mix it with the reflectance of θ.
    assert np.quantile(errors, 0.9) < 0.03
    differences = np.abs(view.expected - view.coat).max(axis=1)[view.seen]
    assert np.median(differences) > 0.15


def test_texels_that_face_away_have_the_reflectance_of_theta(view):
    away = (view.cosine < 0).all(axis=0)
    assert away.sum() > 150
    colours = view.centres(view.observation)
    np.testing.assert_allclose(colours[away], view.expected[away], atol=LEVEL)


@pytest.mark.parametrize("view", [1], indirect=True)
def test_texels_behind_a_limb_have_the_reflectance_of_theta(view):
    behind = view.hidden[0] & (view.cosine[0] > 0.6)
    assert behind.sum() > 10
    errors = np.abs(view.centres(view.observation) - view.expected).max(axis=1)[behind]
    # The others are beside pixels that show their surface.
    assert np.quantile(errors, 0.75) < LEVEL


def test_backgrounds_are_not_on_the_body(view):
    """They shine through the pixels of the outline, which masks count as the body's."""
    observed = view.observation
    share = observed.mask[..., None]
    mask = np.clip(4 * observed.mask - 1.5, 0, 1)
    black, blue = (
        view.centres(replace(observed, mask=mask, rgb=share * observed.rgb + (1 - share) * behind))
        for behind in ([0, 0, 0], [0, 0, 1])
    )
    np.testing.assert_allclose(blue, black, atol=0.03)


def test_unknown_pixels_and_those_outside_the_mask_are_not_used(view):
    observed, half = view.observation, SIZE // 2
    for value in (np.nan, 0.0):
        mask = np.array(observed.mask)
        mask[..., :half] = value
        colours = view.centres(replace(observed, mask=mask))
        left = (view.columns < half - 1).all(axis=0)
        assert (left & view.seen).sum() > 20
        np.testing.assert_allclose(colours[left], view.expected[left], atol=LEVEL)
        right = (view.columns > half + 1).all(axis=0)
        np.testing.assert_allclose(colours[right], view.centres(observed)[right], atol=LEVEL)


def test_without_colours_triangles_interpolate_the_reflectance_of_theta(category, view):
    rng = np.random.default_rng(0)
    coat = rng.uniform(0.3, 0.7, size=category.albedo.shape)  # neighbours differ
    category = replace(category, albedo=coat, albedos=0 * category.albedos)
    prior = SurfacePrior(category, view.prior.tangent)
    mesh = skinned_mesh(prior, view.theta)
    painted = textured(mesh, replace(view.observation, rgb=None), prior, view.theta)
    anywhere = rng.dirichlet(np.ones(3), len(mesh.triangles))
    for weights in (*np.eye(3), *(0.5 * (1 - np.eye(3))), anywhere):
        expected = (coat[mesh.triangles] * np.reshape(weights, (-1, 3, 1))).sum(axis=1)
        np.testing.assert_allclose(in_triangles(painted, weights), expected, atol=LEVEL)
    # Each triangle keeps its place, and moves as before.
    for name in ("vertices", "normals", "joints", "weights"):
        values = getattr(mesh, name)[mesh.triangles]
        np.testing.assert_array_equal(getattr(painted, name)[painted.triangles], values)
