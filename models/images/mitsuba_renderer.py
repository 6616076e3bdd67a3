"""Differentiable ray tracing of triangle meshes with Mitsuba 3 on LLVM.

Images are means over rays through random places of each pixel. Their gradient is the sum of an
integral over the visible surface and one over its visible silhouettes (Li et al., *Differentiable
Monte Carlo ray tracing through edge sampling*, 2018), both estimated by sampling.
"""

from __future__ import annotations

import ctypes
import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from probmotion.extras import drjit as dr, mitsuba as mi, nn, torch
from probmotion.validation import check_count, check_finite, check_positive, check_shape

__all__ = ["MitsubaRenderer"]

_VARIANT = "llvm_ad_rgb"
_GOLDEN = (5**0.5 - 1) / 2
_SILHOUETTE = 2  # samples of the silhouettes per sample of a pixel and pixel of the image's width
_LLVM_FOLDERS = (
    "/usr/lib",
    "/usr/lib64",
    "/usr/lib/*-linux-gnu",
    "/usr/lib/llvm-*/lib",
    "/usr/local/lib",
    "/usr/local/opt/llvm*/lib",
    "/opt/homebrew/opt/llvm*/lib",
    f"{sys.prefix}/lib",
)


class MitsubaRenderer:
    """Renderer by ray tracing, with fixed random numbers: equal arguments give equal images.

    Images and gradients have sampling errors that decrease with the number of samples. The
    gradient does not include lines where parts of the mesh penetrate each other.

    Parameters
    ----------
    samples : int
        Number of samples per pixel.

    Raises
    ------
    ImportError
        If LLVM 16 or later is not installed.
    """

    def __init__(self, samples: int = 16) -> None:
        check_count("samples", samples)
        self.samples = samples
        _llvm()

    def render(
        self,
        vertices: torch.Tensor,
        triangles: np.ndarray,
        colours: torch.Tensor,
        tangent: float,
        size: int,
    ) -> torch.Tensor:
        """Return images (B, size, size, C + 1), as ``Renderer.render`` of the rasteriser's module.

        Rays are traced once for every three channels.
        """
        check_shape("vertices", vertices, ("B", "V", 3))
        check_finite("vertices", vertices.detach())
        check_shape("colours", colours, (*vertices.shape[:2], "C"))
        check_count("channels of colours", colours.shape[2])
        check_positive("tangent", tangent)
        check_count("size", size)
        with _variant():
            view = _View(triangles, tangent, size, self.samples)
        channels = colours.shape[2]
        padded = nn.functional.pad(colours, (0, -channels % 3))
        images = [_Render.apply(vertices, three, view) for three in padded.split(3, dim=2)]
        seen = torch.cat([image[..., :3] for image in images], dim=-1)[..., :channels]
        return torch.cat([seen, images[0][..., 3:]], dim=-1)


class _Render(torch.autograd.Function):
    @staticmethod
    def forward(
        context: Any, vertices: torch.Tensor, colours: torch.Tensor, view: _View
    ) -> torch.Tensor:
        context.view = view
        context.save_for_backward(vertices, colours)
        with _variant():
            images = [view.image(*_floats(each)) for each in zip(vertices, colours, strict=True)]
        return torch.from_numpy(np.stack(images)).to(vertices)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(context: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        vertices, colours = context.saved_tensors
        with _variant():
            parts = [
                context.view.gradients(*_floats(each))
                for each in zip(vertices, colours, gradient, strict=True)
            ]
        of_vertices, of_colours = (
            torch.from_numpy(np.stack(part).reshape(vertices.shape)).to(vertices)
            for part in zip(*parts, strict=True)
        )
        return of_vertices, of_colours.to(colours), None


@contextmanager
def _variant() -> Iterator[None]:
    """Use Mitsuba's variant for LLVM, and restore another one that the caller has set."""
    before = mi.variant()
    if before != _VARIANT:
        # Dr.Jit reads this when it first compiles.
        os.environ["DRJIT_LIBLLVM_PATH"] = _llvm()
        mi.set_variant(_VARIANT)
    try:
        yield
    finally:
        if before not in (None, _VARIANT):
            mi.set_variant(before)


def _floats(tensors: tuple[torch.Tensor, ...]) -> list[Any]:
    """Return tensors as flat arrays of Mitsuba."""
    return [mi.Float(each.detach().float().cpu().numpy().ravel()) for each in tensors]


class _View:
    """Images of a mesh with ``triangles`` by a camera at the origin."""

    def __init__(self, triangles: np.ndarray, tangent: float, size: int, samples: int) -> None:
        self._triangles = mi.UInt32(triangles.astype(np.uint32).ravel())
        # A constant would be compiled into the kernels, which are cached.
        self._tangent = dr.opaque(mi.Float, tangent)
        self._size, self._samples = size, samples

    def image(self, vertices: Any, colours: Any) -> np.ndarray:
        """Return the image (size, size, 4) of vertices and colours, (3 V,) each."""
        scene, _ = self._scene(vertices, colours)
        _, hit, colour = self._surface(scene)
        channels = [*colour, dr.select(hit, mi.Float(1), 0)]
        dr.eval(channels)  # in one kernel
        means = [
            np.array(dr.block_sum(channel, self._samples)) / self._samples for channel in channels
        ]
        return np.stack(means, axis=-1).reshape(self._size, self._size, 4)

    def gradients(self, vertices: Any, colours: Any, gradient: Any) -> tuple[np.ndarray, ...]:
        """Return the gradients (3 V,) of Σ image · gradient, with gradient (4 · size²,)."""
        dr.enable_grad(vertices, colours)
        scene, mesh = self._scene(vertices, colours)
        pixel, hit, colour = self._surface(scene)
        shades = [dr.gather(mi.Float, gradient, 4 * pixel + k, hit) for k in range(3)]
        dr.backward_from(dr.dot(mi.Color3f(*shades), colour) / self._samples)
        indices, weights = mesh.precompute_silhouette(mi.ScalarPoint3f(0))
        if dr.sum(weights)[0] > 0:  # else the camera is inside the mesh
            dr.backward_from(self._silhouettes(scene, mesh, indices, weights, gradient))
        return np.array(dr.grad(vertices)), np.array(dr.grad(colours))

    def _scene(self, vertices: Any, colours: Any) -> tuple[Any, Any]:
        mesh = mi.Mesh("mesh", dr.width(vertices) // 3, dr.width(self._triangles) // 3)
        mesh.add_attribute("vertex_color", 3, [0.0] * dr.width(colours))
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = vertices
        parameters["vertex_color"] = colours
        parameters["faces"] = self._triangles
        parameters.update()
        return mi.load_dict({"type": "scene", "mesh": mesh}), mesh

    def _surface(self, scene: Any) -> tuple[Any, Any, Any]:
        """Return the pixels of rays, whether they hit the mesh, and its colours there."""
        # A lattice in each pixel, randomly shifted
        number = dr.arange(mi.UInt32, self._size**2 * self._samples)
        pixel = number // self._samples
        number = mi.Float(number % self._samples)
        lattice = mi.Point2f(number / self._samples, number * _GOLDEN)
        shift = mi.Point2f(mi.sample_tea_float32(pixel, 0), mi.sample_tea_float32(pixel, 1))
        within = lattice + shift
        corner = mi.Point2f(pixel % self._size, pixel // self._size)
        place = (corner + within - dr.floor(within)) * (2 / self._size) - 1
        direction = mi.Vector3f(place.x * self._tangent, place.y * self._tangent, 1)
        ray = mi.Ray3f(mi.Point3f(0), dr.normalize(direction))
        found = scene.ray_intersect(ray, mi.RayFlags.All, True)
        hit = found.is_valid()
        colour = found.shape.eval_attribute_3("vertex_color", found, hit)
        return pixel, hit, dr.select(hit, colour, 0)

    def _silhouettes(self, scene: Any, mesh: Any, indices: Any, weights: Any, gradient: Any) -> Any:
        """Return terms whose sum has the gradient that is due to moving silhouettes."""
        n = _SILHOUETTE * self._size * self._samples
        with dr.suspend_grad():
            # Equidistant places along all silhouettes, one after the other
            place = (dr.arange(mi.Float, n) + 0.5) / n
            edges = mi.DiscreteDistribution(weights)
            number, along, probability = edges.sample_reuse_pmf(place)
            edge = dr.gather(mi.UInt32, indices, number)
            point = mesh.sample_precomputed_silhouette(mi.Point3f(0), edge, along)
            pixel, seen = self._pixel(point.p)
            seen &= point.pdf > 0
            towards = mi.SilhouetteSample3f(point)
            towards.d = -point.d
            back = towards.spawn_ray()
            back.maxt = dr.norm(back.o) * (1 - mi.math.ShadowEpsilon)
            seen &= ~scene.ray_test(back, seen)
            behind = scene.ray_intersect(point.spawn_ray(), mi.RayFlags.All, False, seen)
            hit = seen & behind.is_valid()
            front = dr.zeros(mi.SurfaceInteraction3f, n)
            front.p, front.prim_index, front.uv = point.p, point.prim_index, point.uv
            change = mesh.eval_attribute_3("vertex_color", front, seen)
            change -= dr.select(hit, mesh.eval_attribute_3("vertex_color", behind, hit), 0)
            slopes = [dr.gather(mi.Float, gradient, 4 * pixel + k, seen) for k in range(4)]
            gain = dr.dot(mi.Color3f(*slopes[:3]), change) + dr.select(hit, 0, slopes[3])
            # Area of the image that the silhouette uncovers per metre of its length and motion
            tangential = self._projected(point.p, point.silhouette_d)
            outside = self._projected(point.p, point.n)
            side = dr.sign(_cross(tangential, outside))
            gain *= side / (point.pdf * probability * n)
        velocity = self._projected(dr.detach(point.p), mesh.differential_motion(front, seen))
        return dr.select(seen, gain * _cross(tangential, velocity), 0)

    def _pixel(self, point: Any) -> tuple[Any, Any]:
        """Return the pixels of points, and whether they are in the image."""
        scale = self._size / (2 * self._tangent * point.z)
        x, y = (mi.Float(each * scale + self._size / 2) for each in (point.x, point.y))
        inside = (point.z > 0) & (x >= 0) & (x < self._size) & (y >= 0) & (y < self._size)
        return mi.UInt32(y) * self._size + mi.UInt32(x), inside

    def _projected(self, point: Any, motion: Any) -> Any:
        """Return the motion of points in the image, pixels, for a motion in space."""
        scale = self._size / (2 * self._tangent * point.z)
        slide = motion.z / point.z
        return mi.Vector2f(motion.x - point.x * slide, motion.y - point.y * slide) * scale


def _cross(a: Any, b: Any) -> Any:
    return a.x * b.y - a.y * b.x


def _llvm() -> str:
    """Return the path of LLVM's library: the one in DRJIT_LIBLLVM_PATH, or the newest."""
    advice = "install LLVM 16 or later (Debian: libllvm19) or set DRJIT_LIBLLVM_PATH"
    given = os.environ.get("DRJIT_LIBLLVM_PATH")
    if given:
        if not _is_recent(given):
            raise ImportError(f"DRJIT_LIBLLVM_PATH is {given!r}, no LLVM 16 or later; {advice}")
        return given
    libraries = {
        str(path): int(version[1]) if version else 0
        for folder in _LLVM_FOLDERS
        for path in Path("/").glob(f"{folder.lstrip('/')}/libLLVM[-.]*")
        for version in [re.search(r"^libLLVM\D*(\d+)", path.resolve().name)]
        if path.suffix == ".dylib" or ".so" in path.name
    }
    for library in sorted(libraries, key=lambda path: -libraries[path]):
        if _is_recent(library):
            return library
    raise ImportError(f"MitsubaRenderer needs LLVM; {advice}")


def _is_recent(path: str) -> bool:
    """Return whether a file is LLVM 16 or later; LLVM 14 and 15 crash in Dr.Jit's code."""
    try:
        return hasattr(ctypes.CDLL(path), "LLVMGetVersion")  # since 16
    except OSError:
        return False
