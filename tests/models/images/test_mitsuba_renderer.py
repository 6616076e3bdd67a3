"""Ray-traced images against the outline of a sphere, and their gradients against differences."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

torch = pytest.importorskip("torch")
mi = pytest.importorskip("mitsuba", reason="mitsuba is not installed")
from probmotion.models.images import MitsubaRenderer, mitsuba_renderer  # noqa: E402

try:
    LLVM = mitsuba_renderer._llvm()
except ImportError:
    LLVM = ""
needs_llvm = pytest.mark.skipif(not LLVM, reason="LLVM 16 or later is not installed")

TANGENT, SIZE = 0.25, 64


def sphere(centre, radius, subdivisions):
    """Return vertices (V, 3) and triangles (T, 3) of a sphere: a subdivided octahedron."""
    points = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]], float)
    triangles = np.array(
        [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
    )
    for _ in range(subdivisions):
        edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]], axis=-1)
        unique, middle = np.unique(edges.reshape(-1, 2), axis=0, return_inverse=True)
        middle = middle.reshape(-1, 3) + len(points)
        points = np.concatenate([points, points[unique].sum(axis=1)])
        points /= np.linalg.norm(points, axis=1, keepdims=True)
        corners = [np.stack([triangles[:, k], middle[:, k], middle[:, k - 1]], 1) for k in range(3)]
        triangles = np.concatenate([*corners, middle])
    return radius * points + centre, triangles


def tensor(array):
    return torch.tensor(np.asarray(array)[None])


def outline(centre, radius):
    """Return the area and centre, pixels, of the ellipse that is the image of a sphere."""
    # Rays (x, y, 1) touch the sphere where their angle to the centre is its angular radius.
    conic = np.outer(centre, centre) - (centre @ centre - radius**2) * np.eye(3)
    middle = -np.linalg.solve(conic[:2, :2], conic[:2, 2])
    value = conic[2, 2] + conic[:2, 2] @ middle
    area = np.pi * abs(value) / np.sqrt(np.linalg.det(conic[:2, :2]))
    return area * (SIZE / 2 / TANGENT) ** 2, SIZE / 2 * (1 + middle / TANGENT)


@needs_llvm
def test_coverage_of_a_sphere_is_an_ellipse():
    centre, radius = np.array([0.35, -0.2, 4.0]), 0.5
    vertices, triangles = sphere(centre, radius, 5)
    colours = np.tile([0.2, 0.5, 0.8], (len(vertices), 1))
    image = MitsubaRenderer().render(
        tensor(vertices), triangles, tensor(colours), TANGENT, SIZE
    ).numpy()[0]  # fmt: skip
    coverage = image[..., 3]
    area, middle = outline(centre, radius)
    assert coverage.sum() == pytest.approx(area, rel=2e-3)
    places = np.arange(SIZE) + 0.5
    found = np.array([coverage.sum(0) @ places, coverage.sum(1) @ places]) / coverage.sum()
    np.testing.assert_allclose(found, middle, atol=0.02)
    np.testing.assert_allclose(image[..., :3], coverage[..., None] * [0.2, 0.5, 0.8], atol=1e-6)


@pytest.fixture(scope="module")
def scene():
    """Return two spheres, one in front of the other, which the image's border cuts."""
    first, triangles = sphere([0.4, 0.0, 4.0], 0.8, 3)
    second, _ = sphere([-0.1, 0.1, 2.5], 0.25, 3)
    vertices = np.concatenate([first, second])
    colours = 0.5 + 0.4 * np.sin(4 * vertices + [0, 1, 2])
    return vertices, np.concatenate([triangles, triangles + len(first)]), colours


def bend(vertices):
    """Return motions like those of a body that turns its upper half forward."""
    return np.maximum(vertices[:, 1:2], 0) ** 2 * [0.5, -0.3, -1.0]


DIRECTIONS = {
    "x": lambda vertices: np.tile([1.0, 0, 0], (len(vertices), 1)),
    "y": lambda vertices: np.tile([0, 1.0, 0], (len(vertices), 1)),
    "z": lambda vertices: np.tile([0, 0, 1.0], (len(vertices), 1)),
    "scale": lambda vertices: vertices - vertices.mean(axis=0),
    "bend": bend,
    "colours": lambda vertices: np.cos(3 * vertices),
}
CHANNELS = {"colours": slice(3), "coverage": slice(3, 4)}


@needs_llvm
@pytest.mark.parametrize(
    ("name", "seen"),
    # Coverage does not depend on colours.
    [pair for pair in product(DIRECTIONS, CHANNELS) if pair != ("colours", "coverage")],
)
def test_gradients_agree_with_differences(scene, name, seen):
    vertices, triangles, colours = scene
    direction = DIRECTIONS[name](vertices)
    # Smooth functionals of the image; the derivative of a single one may be close to 0.
    weights = np.zeros((6, 1, SIZE, SIZE, 4))
    noise = np.random.default_rng(0).normal(size=weights[..., CHANNELS[seen]].shape)
    weights[..., CHANNELS[seen]] = gaussian_filter(noise, [0, 0, 5, 5, 0])

    def image(samples, step=0.0):
        both = [vertices, colours]
        both[name == "colours"] = both[name == "colours"] + step * direction
        parts = [tensor(each).requires_grad_() for each in both]
        return MitsubaRenderer(samples).render(parts[0], triangles, parts[1], TANGENT, SIZE), parts

    rendered, parts = image(16)
    along = [
        torch.autograd.grad(rendered, parts, torch.tensor(each), retain_graph=True)
        for each in weights
    ]
    slopes = [float((each[name == "colours"] * tensor(direction)).sum()) for each in along]
    difference = (image(512, 0.01)[0] - image(512, -0.01)[0]).detach().numpy() / 0.02
    expected = (weights * difference).sum(axis=(1, 2, 3, 4))
    assert np.linalg.norm(slopes - expected) <= 0.05 * np.linalg.norm(expected)


@needs_llvm
def test_images_are_reproducible_and_independent_of_their_batch(scene):
    vertices, triangles, colours = scene
    both = torch.cat([tensor(vertices), tensor(vertices) + 0.1])
    images = [
        MitsubaRenderer(4).render(
            each, triangles, tensor(colours).expand(each.shape), TANGENT, SIZE
        )
        for each in (both, both[:1], both[1:])
    ]
    assert torch.equal(images[0], torch.cat(images[1:]))
    assert images[0].dtype == torch.float64


@needs_llvm
def test_channels_are_those_of_separate_images(scene):
    vertices, triangles, colours = scene
    channels = np.concatenate([colours, np.cos(3 * vertices[:, :2])], axis=1)
    weights = torch.tensor(np.random.default_rng(1).normal(size=(SIZE, SIZE, 6)))

    def drawn(columns):
        parts = [tensor(each).requires_grad_() for each in (vertices, channels)]
        image = MitsubaRenderer(4).render(
            parts[0], triangles, parts[1][..., columns], TANGENT, SIZE
        )
        return image, parts

    image, parts = drawn(range(5))
    assert image.shape == (1, SIZE, SIZE, 6)
    gradients = torch.autograd.grad(image, parts, weights[None])
    expected = [torch.zeros_like(part) for part in parts]
    for columns in ([0, 1, 2], [3], [4]):
        alone, parts = drawn(columns)
        assert torch.equal(alone[..., :-1], image[..., columns])
        assert torch.equal(alone[..., -1], image[..., -1])
        # Coverage counts once.
        slopes = torch.cat([weights[..., columns], weights[..., 5:] * (columns[0] == 0)], dim=-1)
        for total, part in zip(
            expected, torch.autograd.grad(alone, parts, slopes[None]), strict=True
        ):
            total += part
    for gradient, total in zip(gradients, expected, strict=True):
        torch.testing.assert_close(gradient, total, rtol=1e-3, atol=1e-3)


@needs_llvm
@pytest.mark.parametrize(("depth", "covered"), [(-3.0, 0.0), (0.0, 1.0)], ids=["behind", "around"])
def test_a_mesh_without_visible_silhouette_has_no_gradient(depth, covered):
    vertices, triangles = sphere([0, 0, depth], 0.5, 2)
    parts = [tensor(each).requires_grad_() for each in (vertices, np.full(vertices.shape, 0.5))]
    image = MitsubaRenderer(4).render(parts[0], triangles, parts[1], TANGENT, 8)
    assert (image == torch.tensor([0.5, 0.5, 0.5, 1]) * covered).all()
    gradients = torch.autograd.grad(image.sum(), parts)
    assert gradients[0].abs().max() < 1e-4
    assert gradients[1].sum() == pytest.approx(3 * 64 * covered, rel=1e-5)


def test_missing_or_old_llvm_is_explained(monkeypatch, tmp_path):
    advice = r"install LLVM 16 or later \(Debian: libllvm19\) or set DRJIT_LIBLLVM_PATH$"
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    monkeypatch.setattr(mitsuba_renderer, "_LLVM_FOLDERS", (str(tmp_path),))
    with pytest.raises(ImportError, match=rf"^MitsubaRenderer needs LLVM; {advice}"):
        MitsubaRenderer()
    library = tmp_path / "libLLVM-15.so.1"
    library.write_bytes(b"")
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(library))
    with pytest.raises(
        ImportError, match=rf"^DRJIT_LIBLLVM_PATH is .*15.so.1', no LLVM .*{advice}"
    ):
        MitsubaRenderer()


def test_the_newest_llvm_that_loads_is_chosen(monkeypatch, tmp_path):
    for name in ("libLLVM-16.so.1", "libLLVM-9.so", "libLLVM.so.18.1", "libLLVM.so.20.1"):
        (tmp_path / name).write_bytes(b"")
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    monkeypatch.setattr(mitsuba_renderer, "_LLVM_FOLDERS", (str(tmp_path),))
    monkeypatch.setattr(mitsuba_renderer, "_is_recent", lambda path: ".20." not in path)
    assert mitsuba_renderer._llvm() == str(tmp_path / "libLLVM.so.18.1")


@needs_llvm
def test_the_variant_of_the_caller_is_restored():
    vertices, triangles = sphere([0, 0, 3], 0.5, 1)
    parts = [tensor(vertices).requires_grad_(), tensor(vertices)]
    mi.set_variant("scalar_rgb")
    try:
        MitsubaRenderer(1).render(parts[0], triangles, parts[1], TANGENT, 4).sum().backward()
        assert mi.variant() == "scalar_rgb"
    finally:
        mi.set_variant("llvm_ad_rgb")
