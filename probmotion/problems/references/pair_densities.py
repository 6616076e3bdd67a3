"""Compiled: how likely a pose-pair is, part by part, and in one view of the evidence."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from probmotion.interaction.geometry.nearest_kernels import (
    INTERACTION,
    Prepared,
    centred,
    distance_by_its_graph,
    distances_to,
    look,
    nearest_of,
)
from probmotion.models.pose_pairs.joint_limits_kernels import LimitArrays, project_poses
from probmotion.models.pose_pairs.penetration_kernels import total_depths
from probmotion.problems.references.pair_moves import Body, log_places

__all__ = [
    "Physics",
    "Sight",
    "judge",
    "log_annotations",
    "log_measure",
    "log_penetration",
    "log_prior",
    "log_sketch",
    "log_view",
    "log_views",
    "picture_of",
    "weigh",
]


_Vector = tuple[float, float, float]


class Physics(NamedTuple):
    """Eq. 2: joint limits, penetration and their numbers."""

    trees: np.ndarray
    limits: LimitArrays
    bones: np.ndarray
    radii: np.ndarray
    pairs: np.ndarray
    penetration_weight: float
    position_noise: float
    max_invalid: int


class Sight(NamedTuple):
    """Eqs. 6 to 9: views, the annotations near each, and how they are compared."""

    vectors: np.ndarray
    """(V, 3), V at least 1."""
    near: np.ndarray
    """(V, N) int64."""
    prepared: Prepared
    measure: int
    graph: int
    epsilon: float
    noise: float


@numba.njit(cache=True, nogil=True)
def weigh(pose: np.ndarray, body: Body, physics: Physics, parts: np.ndarray) -> None:
    """Write what a pose's log prior is made of: ``parts`` (2 + 2 K,).

    First the normal log lengths and places, then penetration, then each person's distance to the
    joint limits (eq. 2), then each person's invalid angles, a count.
    """
    parts[0] = log_measure(pose, body)
    parts[1] = log_penetration(pose, physics)
    for person in range(len(body.roots)):
        judge(pose, person, physics, parts)


@numba.njit(cache=True, nogil=True)
def log_prior(parts: np.ndarray, physics: Physics) -> float:
    """Return the log prior, up to a constant, of parts that :func:`weigh` wrote."""
    people = len(parts) // 2 - 1
    if parts[2 + people :].sum() > physics.max_invalid:
        return -np.inf
    return parts[: 2 + people].sum()


@numba.njit(cache=True, nogil=True)
def log_view(
    pose: np.ndarray, view: int, body: Body, sight: Sight, least: float = -np.inf
) -> float:
    """Return log L(Θ_v; v) of one view: −d²/2σ_l² of the nearest annotation (eq. 9).

    −∞ where it is below ``least``, which is sooner known.
    """
    distance, nearest = nearest_of(
        picture_of(pose, view, body, sight),
        sight.near[view],
        sight.prepared,
        sight.measure,
        sight.graph,
        sight.epsilon,
        sight.noise * np.sqrt(-2.0 * least),
    )
    return -0.5 * (distance / sight.noise) ** 2 if nearest >= 0 else -np.inf


@numba.njit(cache=True, nogil=True)
def log_views(pose: np.ndarray, body: Body, sight: Sight) -> np.ndarray:
    """Return log L(Θ_v; v) of every view, (V,)."""
    found = np.empty(len(sight.vectors))
    for view in range(len(found)):
        found[view] = log_view(pose, view, body, sight)
    return found


@numba.njit(cache=True, nogil=True)
def log_annotations(
    pose: np.ndarray, view: int, body: Body, sight: Sight, found: np.ndarray
) -> None:
    """Write −d²/2σ_l² to every annotation near a view: ``found`` (N,); its maximum is log L_v."""
    picture = picture_of(pose, view, body, sight)
    seen = look(picture, sight.prepared, sight.measure, sight.graph, sight.epsilon)
    distances_to(*seen, sight.near[view], sight.prepared, sight.measure, found)
    for position in range(len(found)):
        found[position] = -0.5 * (found[position] / sight.noise) ** 2


@numba.njit(cache=True, nogil=True)
def log_sketch(
    pose: np.ndarray,
    view: int,
    annotation: int,
    body: Body,
    sight: Sight,
    apart: np.ndarray,
    terms: np.ndarray,
) -> float:
    """Return −d²/2σ_l² to one annotation, by its own graph alone: near it, for a tenth of the time.

    ``apart`` (2, J) and ``terms`` (edges,) are room to work in.
    """
    picture = picture_of(pose, view, body, sight)
    if sight.measure == INTERACTION:
        distance = distance_by_its_graph(centred(picture), annotation, sight.prepared, apart, terms)
    else:
        # These distances have no graph: nothing is cheaper.
        seen = look(picture, sight.prepared, sight.measure, sight.graph, sight.epsilon)
        one, found = np.array([annotation]), np.empty(1)
        distances_to(*seen, one, sight.prepared, sight.measure, found)
        distance = found[0]
    return -0.5 * (distance / sight.noise) ** 2


@numba.njit(cache=True, nogil=True)
def log_measure(pose: np.ndarray, body: Body) -> float:
    """Return the log density of normal log lengths and places of roots, 0 at the seed."""
    lengths = 0.0
    for joint in range(len(pose)):
        parent = body.parents[joint]
        if parent >= 0:
            here, there = 0.0, 0.0
            for i in range(3):
                here += (pose[joint, i] - pose[parent, i]) ** 2
                there += (body.seed[joint, i] - body.seed[parent, i]) ** 2
            lengths += (0.5 * np.log(here / there)) ** 2
    return log_places(pose, body) - 0.5 * lengths / body.bone_noise**2


@numba.njit(cache=True, nogil=True)
def log_penetration(pose: np.ndarray, physics: Physics) -> float:
    """Return −w ρ²/2σ_p², ρ how deep bones stand in one another (eq. 2)."""
    poses = pose.reshape(1, len(pose), 3)
    depth = total_depths(poses, physics.bones, physics.radii, physics.pairs)[0]
    return -0.5 * physics.penetration_weight * (depth / physics.position_noise) ** 2


@numba.njit(cache=True, nogil=True)
def judge(pose: np.ndarray, person: int, physics: Physics, parts: np.ndarray) -> None:
    """Write a person's part of ‖X − X̂‖² and the number of invalid angles."""
    poses = pose.reshape(1, len(pose), 3)
    valid, nearest = project_poses(poses, physics.trees[person : person + 1], physics.limits)
    apart = 0.0
    for joint in range(len(pose)):
        for i in range(3):
            apart += (pose[joint, i] - nearest[0, joint, i]) ** 2
    parts[2 + person] = -0.5 * apart / physics.position_noise**2
    parts[2 + len(physics.trees) + person] = valid.size - valid.sum()


@numba.njit(cache=True, nogil=True)
def picture_of(pose: np.ndarray, view: int, body: Body, sight: Sight) -> np.ndarray:
    """Return a pose as seen in a view, (J, 2), metres.

    An orthographic picture, as :func:`~probmotion.interaction.annotations.views.project_to_views`
    takes it, in which anything across the view may be up: annotations are turned to fit.
    """
    i, j, k = _local_frame(pose, body)
    a, b, c = sight.vectors[view]
    towards = _unit(
        (
            a * i[0] + b * j[0] + c * k[0],
            a * i[1] + b * j[1] + c * k[1],
            a * i[2] + b * j[2] + c * k[2],
        )
    )
    x, y, z = abs(towards[0]), abs(towards[1]), abs(towards[2])
    if x <= y and x <= z:
        across = (1.0, 0.0, 0.0)
    elif y <= z:
        across = (0.0, 1.0, 0.0)
    else:
        across = (0.0, 0.0, 1.0)
    right = _unit(_cross(across, towards))
    up = _cross(towards, right)
    picture = np.empty((len(pose), 2))
    for joint in range(len(pose)):
        x, y, z = pose[joint, 0], pose[joint, 1], pose[joint, 2]
        picture[joint, 0] = right[0] * x + right[1] * y + right[2] * z
        picture[joint, 1] = up[0] * x + up[1] * y + up[2] * z
    return picture


@numba.njit(cache=True, nogil=True)
def _local_frame(pose: np.ndarray, body: Body) -> tuple[_Vector, _Vector, _Vector]:
    """Return i, j and k of
    :func:`~probmotion.interaction.annotations.local_frames.local_frames`."""
    x, y, z = 0.0, 0.0, 0.0
    for person in range(len(body.roots)):
        along = _unit(_between(pose, body.roots[person], body.chests[person]))
        x, y, z = x + along[0], y + along[1], z + along[2]
    i = _unit(_between(pose, body.roots[0], body.roots[1]))
    j = _unit((x, y, z))
    return i, j, _cross(i, j)


# Numbers in tuples: arrays of three would take longer to make than to fill.
@numba.njit(cache=True, nogil=True)
def _between(pose: np.ndarray, start: int, end: int) -> _Vector:
    return (
        pose[end, 0] - pose[start, 0],
        pose[end, 1] - pose[start, 1],
        pose[end, 2] - pose[start, 2],
    )


@numba.njit(cache=True, nogil=True)
def _unit(v: _Vector) -> _Vector:
    size = max(np.sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2), 1e-300)
    return (v[0] / size, v[1] / size, v[2] / size)


@numba.njit(cache=True, nogil=True)
def _cross(a: _Vector, b: _Vector) -> _Vector:
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )
