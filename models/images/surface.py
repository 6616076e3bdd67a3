"""Rest surface of a category: smooth union of capsules around the bones, as a skinned mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probmotion.extras import skimage
from probmotion.io.body_mesh import body_parts
from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.models.bodies.body_states import trunk_joints
from probmotion.models.images._capsule_union import CapsuleUnion
from probmotion.models.images._remeshing import border_of, remeshed
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count, check_finite, check_shape

__all__ = ["Surface", "rest_surface"]

# Of the largest extent of the rest pose:
_STEP = 0.012  # step of the grid of marching cubes
_THIN = 0.02  # smallest radius of a capsule
_SOFT = 0.008  # length over which capsules, and the movements of bones, blend
_INFLUENCES = 4  # bones that move a vertex
_SMALL = 1e-3  # weights below are set to 0
_SUM = 1e-4  # deviation of the sum of weights from 1
_TOLERANCE = 0.1  # relative deviation from the requested number of vertices
_FLIP = np.array([-1.0, 1.0, 1.0])


@dataclass(frozen=True, eq=False)
class Surface:
    """Closed triangle mesh in the rest pose, and up to four bones that move each vertex.

    Parameters
    ----------
    vertices : ndarray, (V, 3)
        Positions in the rest pose, root at the origin, metres.
    triangles : ndarray of int, (T, 3)
        Vertices counterclockwise from outside; every edge has two triangles.
    joints : ndarray of int, (V, 4)
        Lower joints of the bones that move a vertex, 0 where the weight is 0.
    weights : ndarray, (V, 4)
        Weights of these bones, descending, sums 1.

    Raises
    ------
    ValueError
        If a shape or value is other than these.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    joints: np.ndarray
    weights: np.ndarray

    def __post_init__(self) -> None:
        check_shape("vertices", self.vertices, ("V", 3))
        check_finite("vertices", self.vertices)
        check_shape("triangles", self.triangles, ("T", 3))
        count = len(self.vertices)
        if not np.isin(self.triangles, range(count)).all():
            raise ValueError(f"triangles must be of vertices 0 to {count - 1}, got others")
        check_shape("joints", self.joints, (count, _INFLUENCES))
        check_shape("weights", self.weights, (count, _INFLUENCES))
        check_finite("weights", self.weights)
        if self.weights.min() < 0 or np.abs(self.weights.sum(axis=1) - 1).max() > _SUM:
            raise ValueError("weights must be at least 0 with sums 1, got others")


def rest_surface(body: ArticulatedBody, vertices: int = 700) -> Surface:
    """Return the surface of a body in its rest pose.

    The capsules are those of :func:`probmotion.io.body_mesh.body_parts`. Their smooth union is
    triangulated by marching cubes (Lewiner et al. 2003) and remeshed. The mesh of a symmetric rest
    pose is symmetric. The weight of a bone is its share in the smooth union.

    Parameters
    ----------
    body : ArticulatedBody
        Skeleton and rest pose.
    vertices : int
        Approximate number of vertices, 200 to several thousand.

    Returns
    -------
    Surface
        The same for the same arguments.

    Raises
    ------
    ValueError
        If the surface cannot have about that number of vertices.
    ModuleNotFoundError
        If scikit-image is not installed.
    """
    check_count("vertices", vertices, 200)
    skeleton, rest = body.skeleton, body.rest_positions
    extent = float(np.ptp(rest, axis=0).max())
    thin = _THIN * extent
    parts = [
        part._replace(radii=(max(part.radii[0], thin), max(part.radii[1], thin)))
        for part in body_parts(skeleton, rest)
    ]
    union = CapsuleUnion(parts, _SOFT * extent)
    order = np.array(skeleton.mirrored_order)
    half = body.symmetric and np.allclose(rest[order] * _FLIP, rest, atol=1e-6)
    points, triangles = _isosurface(union, _STEP * extent, half)
    points, triangles = remeshed(points, triangles, vertices, union)
    joints, weights = _skinning(union, skeleton, points)
    if half:
        kept = ~border_of(triangles, len(points))
        other = np.where(kept, len(points) + np.cumsum(kept) - 1, np.arange(len(points)))
        points = np.concatenate([points, points[kept] * _FLIP])
        triangles = np.concatenate([triangles, other[triangles][:, ::-1]])
        joints = np.concatenate([joints, order[joints[kept]]])
        weights = np.concatenate([weights, weights[kept]])
    if abs(len(points) - vertices) > _TOLERANCE * vertices:
        raise ValueError(
            f"vertices must be close to a number that the surface can have, got {vertices} for a "
            f"surface of {len(points)}"
        )
    return Surface(points, triangles, np.where(weights > 0, joints, 0), weights)


def _isosurface(union: CapsuleUnion, step: float, half: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return points and triangles of a union, of its half x ≥ 0 with a border at 0 if ``half``."""
    margin = 3 * step + union.softness * np.log(len(union.parts))
    reach = [max(part.radii) * max(1.0, *part.flat) + margin for part in union.parts]
    ends = np.array([[part.start, part.end] for part in union.parts])
    low = (ends.min(axis=1) - np.array(reach)[:, None]).min(axis=0)
    high = (ends.max(axis=1) + np.array(reach)[:, None]).max(axis=0)
    low[0] = 0.0 if half else low[0]
    axes = [np.arange(a, b + step, step) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    values = union.values(grid.reshape(-1, 3)).reshape(grid.shape[:3])
    # A node at the surface would be a vertex of several triangles without area.
    values = np.where(np.abs(values) < 1e-3 * step, 1e-3 * step, values)
    points, triangles, _, _ = skimage.measure.marching_cubes(
        values, 0.0, gradient_direction="descent"
    )
    return low + step * points.astype(np.float64), triangles.astype(np.int64)


def _skinning(
    union: CapsuleUnion, skeleton: Skeleton, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the bones that move points (N, 3), by lower joint, and their weights, (N, 4) each."""
    moving = np.zeros((len(union.parts), skeleton.n_joints))
    for at, part in enumerate(union.parts):
        # Hands move with the bone above, a pelvis with those below that do not turn separately.
        below = [child for child, parent in skeleton.bones if parent == part.owner]
        below = [child for child in below if child not in trunk_joints(skeleton)] or [part.owner]
        lower = below if part.after < 0 else [part.after]
        moving[at, lower] = 1 / len(lower)
    shares = union.at(points).shares @ moving
    order = np.argsort(-shares, axis=-1, kind="stable")
    joints = order[:, :_INFLUENCES]
    weights = np.take_along_axis(shares, joints, axis=-1)
    if skeleton.n_joints > _INFLUENCES:
        # Without a jump where bones change ranks.
        weights = weights - np.take_along_axis(shares, order[:, [_INFLUENCES]], axis=-1)
    weights = np.where(weights < _SMALL, 0.0, weights)
    return joints, weights / weights.sum(axis=-1, keepdims=True)
