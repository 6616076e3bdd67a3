"""Rasterised images: analytic areas, gradients against finite differences, occlusion."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from probmotion.models.images.rasterizer import Rasterizer
from tests.models.images.meshes import icosphere

SIZE, TANGENT = 96, 0.2
CENTRE = (0.13, -0.07, 4.0)


def ball(radius: float = 0.5, centre: tuple[float, float, float] = CENTRE) -> torch.Tensor:
    vertices, _ = icosphere(3)
    return torch.tensor(radius * vertices + np.array(centre))[None]


def colours_of(vertices: torch.Tensor) -> torch.Tensor:
    """Return three colours and two features of both signs, (B, V, 5)."""
    return torch.cat([0.5 + 0.4 * torch.sin(3 * vertices), torch.cos(4 * vertices[..., :2])], -1)


def draw(vertices: torch.Tensor, colours: torch.Tensor | None = None) -> torch.Tensor:
    colours = torch.ones_like(vertices) if colours is None else colours
    return Rasterizer().render(vertices, icosphere(3)[1], colours, TANGENT, SIZE)


@pytest.mark.parametrize("radius", [0.1, 0.2, 0.5])
def test_area_of_a_ball_is_that_of_its_perspective_image(radius: float) -> None:
    """The rays that touch a ball on the axis form a cone of tangent r / sqrt(d² − r²)."""
    centre = (0.0, 0.0, 4.0)
    area = math.pi * (SIZE / (2 * TANGENT)) ** 2 * radius**2 / (16 - radius**2)
    coverage = draw(ball(radius, centre))[0, ..., 3]
    vertices, triangles = icosphere(3)
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    inscribed = ((np.cross(a, b) * c).sum() / 6 / (4 / 3 * math.pi)) ** (2 / 3)
    assert float(coverage.sum()) == pytest.approx(inscribed * area, rel=0.01)
    assert float(coverage.min()) >= 0.0


def test_images_change_continuously() -> None:
    """A step of a hundredth of a pixel changes no pixel by more than a tenth."""
    pixel = 2 * TANGENT * 4.0 / SIZE
    step = torch.tensor([1.0, 0.4, 0.0]) * 0.01 * pixel
    moved = torch.cat([ball() + k * step for k in range(200)])
    images = draw(moved)[..., 3]
    assert float((images[1:] - images[:-1]).abs().max()) < 0.1


RANDOM = torch.tensor(np.random.default_rng(3).standard_normal((1, 642, 3)))
WEIGHT = torch.tensor(
    gaussian_filter(np.random.default_rng(0).standard_normal((SIZE, SIZE, 6)), (5, 5, 0))
)
MOVES = {
    "right": lambda x: torch.tensor([1.0, 0.0, 0.0]).expand_as(x),
    "down": lambda x: torch.tensor([0.0, 1.0, 0.0]).expand_as(x),
    "crumple": lambda x: 0.3 * RANDOM,
    "scale": lambda x: x - torch.tensor(CENTRE),
    "bend": lambda x: torch.stack([torch.sin(4 * x[..., 1]), 0 * x[..., 0], 0 * x[..., 0]], -1),
}


def loss(move: str, t: float) -> tuple[float, float]:
    """Return a smooth function of the image of a ball moved by t, and its derivative."""
    direction = MOVES[move](ball()).double()
    vertices = (ball() + t * direction).requires_grad_()
    value = (draw(vertices, colours_of(ball())) * WEIGHT).sum()
    value.backward()
    assert vertices.grad is not None
    return value.item(), float((vertices.grad * direction).sum())


@pytest.mark.parametrize("move", MOVES)
def test_gradients_agree_with_finite_differences(move: str) -> None:
    difference = (loss(move, 1e-6)[0] - loss(move, -1e-6)[0]) / 2e-6
    assert loss(move, 0.0)[1] == pytest.approx(difference, rel=1e-3)


@pytest.mark.parametrize("move", ["right", "bend"])
def test_gradients_add_up_to_changes_over_a_pixel(move: str) -> None:
    """Pixels change sides of silhouettes on the way: no part of the change may be missing."""
    times = np.linspace(0.0, 0.02, 201)
    values, slopes = np.array([loss(move, float(t)) for t in times]).T
    assert slopes.mean() == pytest.approx((values[-1] - values[0]) / 0.02, rel=0.05)


def test_gradients_of_colours_are_exact() -> None:
    colours = colours_of(ball()).requires_grad_()
    weight = torch.tensor(np.random.default_rng(1).standard_normal((SIZE, SIZE, 6)))
    (draw(ball(), colours) * weight).sum().backward()
    direction = torch.tensor(np.random.default_rng(2).standard_normal(colours.shape))
    with torch.no_grad():
        other = (draw(ball(), colours + direction) * weight).sum()
        change = other - (draw(ball(), colours) * weight).sum()
    assert colours.grad is not None
    assert float((colours.grad * direction).sum()) == pytest.approx(float(change), rel=1e-6)


def test_channels_do_not_depend_on_each_other() -> None:
    """Images of several channels, and their gradients, are those of each channel alone."""
    places, weight = ball().requires_grad_(), WEIGHT
    together = draw(places, colours_of(ball()))
    apart = [draw(places, channel) for channel in colours_of(ball()).split(1, dim=-1)]
    for k, image in enumerate(apart):
        torch.testing.assert_close(together[..., [k, 5]], image, rtol=0, atol=0)
    pairs = [image[..., 0] * weight[..., k] for k, image in enumerate(apart)]
    pairs.append(apart[0][..., 1] * weight[..., 5])
    gradients = [
        torch.autograd.grad(value.sum(), places)[0] for value in (together * weight, sum(pairs))
    ]
    torch.testing.assert_close(*gradients, rtol=1e-9, atol=1e-9)


def test_the_nearer_of_two_bodies_is_seen() -> None:
    vertices, triangles = icosphere(3)
    near, far = ball(0.2, (0.0, 0.0, 3.0)), ball(0.5, (0.0, 0.0, 5.0))
    both = torch.cat([far, near], dim=1)
    faces = np.concatenate([triangles, triangles + len(vertices)])
    colours = torch.cat([torch.zeros_like(far), torch.ones_like(near)], dim=1)
    image = Rasterizer().render(both, faces, colours, TANGENT, SIZE)[0]
    alone = Rasterizer().render(near, triangles, torch.ones_like(near), TANGENT, SIZE)[0]
    torch.testing.assert_close(image[..., 0], alone[..., 0], rtol=0, atol=1e-9)
    middle = SIZE // 2
    assert image[middle, middle].tolist() == pytest.approx([1.0, 1.0, 1.0, 1.0])


def test_bodies_of_a_batch_are_independent() -> None:
    batch = torch.cat([ball(), ball(0.3), ball(0.1)])
    separate = torch.cat([draw(row[None]) for row in batch])
    torch.testing.assert_close(draw(batch), separate, rtol=0, atol=0)


def test_triangles_that_reach_behind_the_camera_are_not_drawn() -> None:
    """The only triangle in front of the camera shows its inside, then its outside."""
    corners = [[-0.3, -0.3, 2.0], [0.3, -0.3, 2.0], [0.0, 0.4, 2.0], [0.1, 0.0, -1.0]]
    vertices = torch.tensor(corners, dtype=torch.float64)[None]
    triangles = np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]])
    for side, area in ((triangles, 0.0), (triangles[:, ::-1], 0.21)):
        image = Rasterizer().render(vertices, side, torch.ones_like(vertices), TANGENT, SIZE)
        pixel = 2 * TANGENT * 2.0 / SIZE
        assert float(image[..., 3].sum()) * pixel**2 == pytest.approx(area, rel=0.05)


def test_a_body_behind_the_camera_is_not_seen() -> None:
    assert float(draw(ball(0.5, (0.0, 0.0, -4.0))).sum()) == 0.0


@pytest.mark.parametrize("shape", [(1, 642, 0), (1, 641, 3), (642, 3)])
def test_colours_are_those_of_the_vertices(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="colours"):
        draw(ball(), torch.zeros(shape))


def test_open_meshes_are_refused() -> None:
    vertices, triangles = icosphere(1)
    points = torch.tensor(vertices)[None]
    with pytest.raises(ValueError, match="closed mesh"):
        Rasterizer().render(points, triangles[1:], torch.ones_like(points), TANGENT, SIZE)
