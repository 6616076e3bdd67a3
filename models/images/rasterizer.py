"""Differentiable rasterisation of triangle meshes with antialiased silhouettes.

A z-buffer finds the visible triangle of every pixel. Where a silhouette edge passes between the
centres of two neighbouring pixels, their values are blended by the position of the crossing, as in
Laine et al., *Modular primitives for high-performance differentiable rendering* (2020). Images are
therefore continuous in the positions of the vertices but for rare events at corners, and their
gradient includes moving silhouettes.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from probmotion.extras import numba, torch
from probmotion.validation import check_count, check_positive, check_shape

__all__ = ["Rasterizer", "Renderer"]

_SAME_SURFACE = 4.0
"""Maximum distance of the pixel inside a silhouette behind it, pixels at that depth. Something
farther away is another limb, seen past one that is thinner than a pixel."""


class Renderer(Protocol):
    """Renderer of triangle meshes."""

    def render(
        self,
        vertices: torch.Tensor,
        triangles: np.ndarray,
        colours: torch.Tensor,
        tangent: float,
        size: int,
    ) -> torch.Tensor:
        """Return images (B, size, size, C + 1): colours times coverage, and coverage.

        Differentiable with respect to vertices and colours.

        Parameters
        ----------
        vertices : Tensor, (B, V, 3)
            Camera coordinates of a closed mesh, metres: x right, y down, z forward.
        triangles : ndarray, (T, 3)
            Vertices of each triangle, counterclockwise from outside.
        colours : Tensor, (B, V, C)
            C ≥ 1 values of each vertex, such as the radiance of red, green and blue.
        tangent : float
            Tangent of half the field of view.
        size : int
            Width and height of the images, pixels.
        """


class Rasterizer:
    """Renderer on the processor, deterministic; exact to a fraction of a pixel but for thin limbs.

    Values of pixels that several silhouettes cross may leave the range of those around them.
    """

    def render(
        self,
        vertices: torch.Tensor,
        triangles: np.ndarray,
        colours: torch.Tensor,
        tangent: float,
        size: int,
    ) -> torch.Tensor:
        """Return images (B, size, size, C + 1), as :meth:`Renderer.render`.

        Triangles with a vertex behind the camera are not drawn.
        """
        check_shape("vertices", vertices, ("B", "V", 3))
        check_shape("colours", colours, (*vertices.shape[:2], "C"))
        check_count("channels of colours", colours.shape[2])
        check_positive("tangent", tangent)
        check_count("size", size)
        depth = vertices[..., 2]
        inverse = torch.where(depth > 0, 1 / depth.clamp(min=1e-6), torch.zeros_like(depth))
        scale = (0.5 * size / tangent) * inverse[..., None]
        screen = 0.5 * size + vertices[..., :2] * scale
        faces = np.ascontiguousarray(triangles, dtype=np.int64)
        return _Rasterize.apply(screen, inverse, colours, faces, tangent, size)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        context: Any,
        screen: torch.Tensor,
        inverse: torch.Tensor,
        colours: torch.Tensor,
        triangles: np.ndarray,
        tangent: float,
        size: int,
    ) -> torch.Tensor:
        inputs = [part.detach().double().numpy() for part in (screen, inverse, colours)]
        inputs = [np.ascontiguousarray(part) for part in inputs]
        # A pixel at depth z covers 2 tangent z / size metres.
        tolerance = _SAME_SURFACE * 2 * tangent / size
        edges = _edges(triangles)
        n, _, channels = inputs[2].shape
        plain, nearness = np.zeros((n, size, size, channels + 1)), np.zeros((n, size, size))
        faces = np.full((n, size, size), -1, dtype=np.int64)
        areas = _areas(inputs[0], inputs[1], triangles)
        # After Ctrl-C, compiled functions that return several arrays raise SystemError.
        _visible(plain, faces, nearness, *inputs, triangles, areas)
        image = plain.copy()
        silhouettes = _silhouettes(areas > 0, triangles, edges)
        lines = _lines(inputs[0], silhouettes, edges, size)
        most = int((lines[..., 1] - lines[..., 0]).sum())
        places, values = np.empty((most, 7), dtype=np.int64), np.empty((most, 3))
        count = _crossings(
            places, values, nearness, *inputs[:2], edges, silhouettes, lines, tolerance
        )
        crossings = places[:count], values[:count]
        _blend(image, plain, *inputs[1:], edges, *crossings)
        context.state = (*inputs, triangles, areas, edges, plain, faces, *crossings)
        context.dtype = screen.dtype
        return torch.from_numpy(image).to(screen.dtype)

    @staticmethod
    def backward(context: Any, *gradients: torch.Tensor) -> Any:
        screen, inverse, colours, triangles, areas, edges, plain, faces, *crossings = context.state
        gradient = np.ascontiguousarray(gradients[0].detach().double().numpy())
        inputs = screen, inverse, colours
        parts = [np.zeros_like(part) for part in inputs]
        of_plain = gradient.copy()
        _blend_back(gradient, of_plain, *parts, plain, *inputs, edges, *crossings)
        _visible_back(of_plain, *parts, *inputs, triangles, areas, faces)
        tensors = [torch.from_numpy(part).to(context.dtype) for part in parts]
        return (*tensors, None, None, None)


def _edges(triangles: np.ndarray) -> np.ndarray:
    """Return the edges (E, 4) of a closed mesh: their vertices and their two triangles."""
    ends = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=-1).reshape(-1, 2)
    owner = np.repeat(np.arange(len(triangles)), 3)
    forward = ends[:, 0] < ends[:, 1]
    key = np.sort(ends, axis=1)
    first = np.lexsort((key[forward][:, 1], key[forward][:, 0]))
    second = np.lexsort((key[~forward][:, 1], key[~forward][:, 0]))
    one, other = key[forward][first], key[~forward][second]
    if one.shape != other.shape or (one != other).any() or (one[1:] == one[:-1]).all(axis=1).any():
        raise ValueError(
            "triangles must be a closed mesh in which every edge belongs to two triangles of the "
            f"same orientation, got {len(triangles)} triangles with an open or repeated edge"
        )
    sides = np.stack([owner[forward][first], owner[~forward][second]], axis=1)
    return np.concatenate([one, sides], axis=1)


def _areas(screen: np.ndarray, inverse: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return twice the areas of triangles on the screen (B, T), 0 where the outside is not seen.

    Triangles with a vertex behind the camera are not seen, either.
    """
    x, y = (screen[:, triangles, axis] for axis in range(2))
    # Counterclockwise from outside is clockwise in an image whose y axis points down.
    areas = (x[..., 2] - x[..., 0]) * (y[..., 1] - y[..., 0]) - (x[..., 1] - x[..., 0]) * (
        y[..., 2] - y[..., 0]
    )
    return np.where((inverse[:, triangles] > 0).all(axis=-1) & (areas > 1e-9), areas, 0.0)


def _silhouettes(seen: np.ndarray, triangles: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return the silhouette edges (S, 3): image, edge, and third vertex of the visible triangle."""
    one, other = seen[:, edges[:, 2]], seen[:, edges[:, 3]]
    image, edge = np.nonzero(one != other)
    inner = np.where(one[image, edge], edges[edge, 2], edges[edge, 3])
    third = triangles[inner].sum(axis=1) - edges[edge, :2].sum(axis=1)
    return np.stack([image, edge, third], axis=1)


def _lines(screen: np.ndarray, silhouettes: np.ndarray, edges: np.ndarray, size: int) -> np.ndarray:
    """Return the first row and column whose centres silhouettes cross, and the ends, (S, 2, 2)."""
    ends = screen[silhouettes[:, :1], edges[silhouettes[:, 1], :2], ::-1]  # (S, 2 ends, y and x)
    limits = np.stack([ends.min(axis=1), ends.max(axis=1)], axis=-1)
    lines: np.ndarray = np.ceil(limits.clip(0.0, size) - 0.5).astype(np.int64)
    return lines


@numba.njit(cache=True)
def _visible(
    image: np.ndarray,
    faces: np.ndarray,
    nearness: np.ndarray,
    screen: np.ndarray,
    inverse: np.ndarray,
    colours: np.ndarray,
    triangles: np.ndarray,
    areas: np.ndarray,
) -> None:
    """Fill images without antialiasing, the visible triangles (of −1, for none), and 1 / depth."""
    size, channels = nearness.shape[1], colours.shape[2]
    for i in range(len(screen)):
        for t in range(len(triangles)):
            area = areas[i, t]
            if area == 0:
                continue
            a, b, c = triangles[t]
            xa, ya = screen[i, a]
            xb, yb = screen[i, b]
            xc, yc = screen[i, c]
            left = max(int(np.ceil(max(min(xa, xb, xc), 0.0) - 0.5)), 0)
            right = min(int(np.floor(min(max(xa, xb, xc), size + 1.0) - 0.5)), size - 1)
            top = max(int(np.ceil(max(min(ya, yb, yc), 0.0) - 0.5)), 0)
            bottom = min(int(np.floor(min(max(ya, yb, yc), size + 1.0) - 0.5)), size - 1)
            for row in range(top, bottom + 1):
                y = row + 0.5
                for column in range(left, right + 1):
                    x = column + 0.5
                    u = ((xc - x) * (yb - y) - (xb - x) * (yc - y)) / area
                    v = ((xa - x) * (yc - y) - (xc - x) * (ya - y)) / area
                    w = 1.0 - u - v
                    if u < 0 or v < 0 or w < 0:
                        continue
                    near = u * inverse[i, a] + v * inverse[i, b] + w * inverse[i, c]
                    if near > nearness[i, row, column]:
                        nearness[i, row, column] = near
                        faces[i, row, column] = t
                        for k in range(channels):
                            image[i, row, column, k] = (
                                u * inverse[i, a] * colours[i, a, k]
                                + v * inverse[i, b] * colours[i, b, k]
                                + w * inverse[i, c] * colours[i, c, k]
                            ) / near
                        image[i, row, column, channels] = 1.0


@numba.njit(cache=True)
def _visible_back(
    gradient: np.ndarray,
    moved: np.ndarray,
    of_inverse: np.ndarray,
    of_colours: np.ndarray,
    screen: np.ndarray,
    inverse: np.ndarray,
    colours: np.ndarray,
    triangles: np.ndarray,
    areas: np.ndarray,
    faces: np.ndarray,
) -> None:
    """Add the gradients of the visible colours with respect to vertices and their colours."""
    weight, slope, change = np.empty(3), np.empty((3, 2)), np.empty(3)
    for i in range(len(screen)):
        for row in range(faces.shape[1]):
            for column in range(faces.shape[2]):
                t = faces[i, row, column]
                if t < 0:
                    continue
                triangle = triangles[t]
                area = areas[i, t]
                for k in range(3):
                    after, last = triangle[(k + 1) % 3], triangle[(k + 2) % 3]
                    dx = screen[i, last, 0] - screen[i, after, 0]
                    dy = screen[i, last, 1] - screen[i, after, 1]
                    # ∇ of the barycentric coordinate of vertex k
                    slope[k, 0], slope[k, 1] = dy / area, -dx / area
                    weight[k] = (
                        (column + 0.5 - screen[i, after, 0]) * dy
                        - (row + 0.5 - screen[i, after, 1]) * dx
                    ) / area
                near = 0.0
                for k in range(3):
                    near += weight[k] * inverse[i, triangle[k]]
                change[:] = 0.0
                for q in range(colours.shape[2]):
                    # Derivatives of Σ b z⁻¹ c / Σ b z⁻¹
                    g, mean = gradient[i, row, column, q], 0.0
                    for k in range(3):
                        mean += weight[k] * inverse[i, triangle[k]] * colours[i, triangle[k], q]
                    for k in range(3):
                        j = triangle[k]
                        change[k] += g * (colours[i, j, q] - mean / near)
                        of_colours[i, j, q] += g * weight[k] * inverse[i, j] / near
                for k in range(3):
                    j = triangle[k]
                    of_inverse[i, j] += change[k] * weight[k] / near
                    for m in range(3):
                        # Moving vertex m by δ changes b_k by −b_m ∇b_k δ.
                        factor = -change[k] * inverse[i, j] / near * weight[m]
                        moved[i, triangle[m], 0] += factor * slope[k, 0]
                        moved[i, triangle[m], 1] += factor * slope[k, 1]


@numba.njit(cache=True)
def _crossing(
    nearness: np.ndarray,
    screen: np.ndarray,
    inverse: np.ndarray,
    edge: np.ndarray,
    inside: int,
    axis: int,
    line: int,
    tolerance: float,
) -> tuple[int, int, float, float]:
    """Return pixels inside and outside the silhouette, how far the edge is from the first, and s.

    The edge crosses the centre line of a row (``axis`` 0) or column (1) at the fraction s of its
    length. The distance is −1 where the edge is not visible.
    """
    p, q = screen[edge[0]], screen[edge[1]]
    s = (line + 0.5 - p[1 - axis]) / (q[1 - axis] - p[1 - axis])
    at = p[axis] + s * (q[axis] - p[axis])
    before = int(np.floor(at - 0.5))
    size = len(nearness)
    if before < 0 or before + 1 >= size:
        return 0, 0, -1.0, s
    across = q[axis] - p[axis], q[1 - axis] - p[1 - axis]
    third = screen[inside]
    side = (third[axis] - p[axis]) - across[0] / across[1] * (third[1 - axis] - p[1 - axis])
    inner, outer = (before, before + 1) if side < 0 else (before + 1, before)
    edge_near = (1 - s) * inverse[edge[0]] + s * inverse[edge[1]]
    if axis == 0:
        inner_near, outer_near = nearness[line, inner], nearness[line, outer]
    else:
        inner_near, outer_near = nearness[inner, line], nearness[outer, line]
    # Something in front of the edge hides it; in a gap the pixel inside is not of its surface.
    if outer_near >= edge_near or inner_near < (1 - tolerance) * edge_near:
        return 0, 0, -1.0, s
    return inner, outer, abs(at - (inner + 0.5)), s


@numba.njit(cache=True)
def _crossings(
    places: np.ndarray,
    values: np.ndarray,
    nearness: np.ndarray,
    screen: np.ndarray,
    inverse: np.ndarray,
    edges: np.ndarray,
    silhouettes: np.ndarray,
    lines: np.ndarray,
    tolerance: float,
) -> int:
    """Find where visible silhouettes pass between neighbouring pixels; return the number N.

    The first N rows are filled. ``places`` (most, 7): image, edge, axis, row and column of the
    pixel inside and of the one outside; ``values`` (most, 3): the distance t from the former, the
    fraction s of the edge, and the share of rows or columns in the blending of this edge.
    """
    count = 0
    for n in range(len(silhouettes)):
        i, e, inside = silhouettes[n]
        p, q = screen[i, edges[e, 0]], screen[i, edges[e, 1]]
        length = (q[0] - p[0]) ** 2 + (q[1] - p[1]) ** 2
        for axis in range(2):
            for line in range(lines[n, axis, 0], lines[n, axis, 1]):
                inner, outer, t, s = _crossing(
                    nearness[i], screen[i], inverse[i], edges[e], inside, axis, line, tolerance
                )
                if t < 0:
                    continue
                places[count, 0], places[count, 1], places[count, 2] = i, e, axis
                places[count, 3 + axis], places[count, 4 - axis] = line, inner
                places[count, 5 + axis], places[count, 6 - axis] = line, outer
                values[count, 0], values[count, 1] = t, s
                values[count, 2] = (q[1 - axis] - p[1 - axis]) ** 2 / length
                count += 1
    return count


@numba.njit(cache=True)
def _blend(
    image: np.ndarray,
    plain: np.ndarray,
    inverse: np.ndarray,
    colours: np.ndarray,
    edges: np.ndarray,
    places: np.ndarray,
    values: np.ndarray,
) -> None:
    """Blend the pixels on either side of visible silhouettes.

    An edge in the inner half covers part of the pixel inside, in the outer half part of the one
    outside, with the colour of the edge.
    """
    channels = colours.shape[2]
    for n in range(len(places)):
        i, e, _, y, x, v, u = places[n]
        t, s, share = values[n]
        one, two = edges[e, 0], edges[e, 1]
        near0, near1 = (1 - s) * inverse[i, one], s * inverse[i, two]
        for k in range(channels + 1):
            if t < 0.5:
                change = plain[i, v, u, k] - plain[i, y, x, k]
                image[i, y, x, k] += share * (0.5 - t) * change
                continue
            colour = 1.0
            if k < channels:
                colour = near0 * colours[i, one, k] + near1 * colours[i, two, k]
                colour /= near0 + near1
            image[i, v, u, k] += share * (t - 0.5) * (colour - plain[i, v, u, k])


@numba.njit(cache=True)
def _blend_back(
    gradient: np.ndarray,
    of_plain: np.ndarray,
    moved: np.ndarray,
    of_inverse: np.ndarray,
    of_colours: np.ndarray,
    plain: np.ndarray,
    screen: np.ndarray,
    inverse: np.ndarray,
    colours: np.ndarray,
    edges: np.ndarray,
    places: np.ndarray,
    values: np.ndarray,
) -> None:
    """Add the gradients of :func:`_blend` with respect to unblended pixels and vertices."""
    channels = colours.shape[2]
    for n in range(len(places)):
        i, e, axis, y, x, v, u = places[n]
        t, s, share = values[n]
        one, two = edges[e, 0], edges[e, 1]
        p, q = screen[i, one], screen[i, two]
        along, rise = q[axis] - p[axis], q[1 - axis] - p[1 - axis]
        length = along**2 + rise**2
        of_t, of_s, of_share = 0.0, 0.0, 0.0
        near0, near1 = (1 - s) * inverse[i, one], s * inverse[i, two]
        near = near0 + near1
        for k in range(channels + 1):
            if t < 0.5:
                g = gradient[i, y, x, k]
                change = plain[i, v, u, k] - plain[i, y, x, k]
                of_t -= g * share * change
                of_share += g * (0.5 - t) * change
                of_plain[i, v, u, k] += g * share * (0.5 - t)
                of_plain[i, y, x, k] -= g * share * (0.5 - t)
                continue
            g = gradient[i, v, u, k]
            colour = 1.0
            if k < channels:
                c0, c1 = colours[i, one, k], colours[i, two, k]
                colour = (near0 * c0 + near1 * c1) / near
                factor = g * share * (t - 0.5)
                of_colours[i, one, k] += factor * near0 / near
                of_colours[i, two, k] += factor * near1 / near
                of_inverse[i, one] += factor * (1 - s) * (c0 - colour) / near
                of_inverse[i, two] += factor * s * (c1 - colour) / near
                slope = inverse[i, two] * (c1 - colour) - inverse[i, one] * (c0 - colour)
                of_s += factor * slope / near
            change = colour - plain[i, v, u, k]
            of_t += g * share * change
            of_share += g * (t - 0.5) * change
            of_plain[i, v, u, k] -= g * share * (t - 0.5)
        # The crossing is at p + s (q − p), s = (line − p⊥) / (q⊥ − p⊥).
        towards = of_t if (u > x if axis == 0 else v > y) else -of_t
        of_s += towards * along
        of_along = towards * s - of_share * 2 * share * along / length
        of_rise = of_share * 2 * rise * (1 - share) / length - of_s * s / rise
        moved[i, one, axis] += towards - of_along
        moved[i, two, axis] += of_along
        moved[i, one, 1 - axis] += -of_s / rise - of_rise
        moved[i, two, 1 - axis] += of_rise
