"""Compiled log densities of pose pairs: terms of the prior and likelihoods of single views."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from probmotion.extras import NO_ALLOCATION, numba
from probmotion.interaction.geometry.nearest_kernels import (
    INTERACTION,
    Prepared,
    annotation_graph_distance,
    distances_to,
    nearest_candidate,
    prepare_projection,
)
from probmotion.models.pose_pairs.joint_limits_frames import (
    Vector,
    between,
    cross,
    dot,
    row_of,
    unit,
)
from probmotion.models.pose_pairs.joint_limits_kernels import (
    Corrections,
    LimitArrays,
    check_person,
    corrections,
)
from probmotion.models.pose_pairs.pair_moves import Body, log_root_positions
from probmotion.models.pose_pairs.penetration_kernels import total_depth

__all__ = [
    "Physics", "ViewAnnotations", "Workspace", "image_axes", "log_annotations", "log_lengths",
    "log_measure", "log_penetration", "log_prior", "log_prior_terms", "log_surrogate", "log_view",
    "log_views", "project_to_view", "workspace", "write_image", "write_limit_terms",
]  # fmt: skip


class Physics(NamedTuple):
    """Parameters of eq. 2: joint limits and penetration."""

    trees: np.ndarray
    limits: LimitArrays
    bones: np.ndarray
    radii: np.ndarray
    pairs: np.ndarray
    penetration_weight: float
    position_noise: float
    max_invalid: int


class ViewAnnotations(NamedTuple):
    """Parameters of eqs. 6 to 9: views, nearby annotations and the distance to them.

    ``vectors`` (V, 3); ``near`` (V, N) int64, the annotations close to each view.
    """

    vectors: np.ndarray
    near: np.ndarray
    prepared: Prepared
    noise: float


class Workspace(NamedTuple):
    """Arrays that compiled functions overwrite, in place of new ones."""

    pose: np.ndarray  # (J, 3), a proposal
    parts: np.ndarray  # (2 + 2 K,), terms of its log prior
    bones: Corrections  # of K people
    spheres: np.ndarray  # (bones, 4), of capsules
    image: np.ndarray  # (2, J)
    errors: np.ndarray  # (2, J)
    edges: np.ndarray  # (n_edges,)


@numba.njit(cache=True, nogil=True)
def workspace(body: Body, physics: Physics, n_edges: int) -> Workspace:
    """Return arrays for a prior, and for graphs of annotations of at most ``n_edges`` edges."""
    n_joints = len(body.parents)
    return Workspace(
        np.empty((n_joints, 3)),
        np.empty(2 + 2 * len(body.roots)),
        corrections(len(body.roots)),
        np.empty((len(physics.bones), 4)),
        np.empty((2, n_joints)),
        np.empty((2, n_joints)),
        np.empty(n_edges),
    )


@numba.njit(**NO_ALLOCATION)
def log_prior_terms(
    pose: np.ndarray, body: Body, physics: Physics, parts: np.ndarray, work: Workspace
) -> None:
    """Write the terms of the log prior of K people to ``parts`` (2 + 2 K,).

    The terms are those of :func:`log_measure` and :func:`log_penetration`, the joint-limit term of
    each person (eq. 2), and the number of invalid angles of each person.
    """
    parts[0] = log_measure(pose, body)
    parts[1] = log_penetration(pose, physics, work)
    for person in range(len(body.roots)):
        write_limit_terms(pose, person, physics, parts, work)


@numba.njit(**NO_ALLOCATION)
def log_prior(parts: np.ndarray, physics: Physics) -> float:
    """Return the log prior, up to a constant, from the terms of :func:`log_prior_terms`."""
    people = len(parts) // 2 - 1
    if parts[2 + people :].sum() > physics.max_invalid:
        return -np.inf
    return parts[: 2 + people].sum()


@numba.njit(cache=True, nogil=True)
def log_view(
    pose: np.ndarray, view: int, body: Body, views: ViewAnnotations, lower_bound: float
) -> float:
    """Return log L(Θ_v; v) of the pose Θ_v in a view v: −d²/2σ_l² (eq. 9).

    d is the distance to the nearest annotation. Values below ``lower_bound`` are returned as −∞.
    """
    distance, nearest = nearest_candidate(
        project_to_view(pose, view, body, views),
        views.near[view],
        views.prepared,
        views.noise * np.sqrt(-2.0 * lower_bound),
    )
    return -0.5 * (distance / views.noise) ** 2 if nearest >= 0 else -np.inf


@numba.njit(cache=True, nogil=True)
def log_views(pose: np.ndarray, body: Body, views: ViewAnnotations) -> np.ndarray:
    """Return log L(Θ_v; v) of every view, (V,)."""
    logs = np.empty(len(views.vectors))
    for view in range(len(logs)):
        logs[view] = log_view(pose, view, body, views, -np.inf)
    return logs


@numba.njit(cache=True, nogil=True)
def log_annotations(
    pose: np.ndarray, view: int, body: Body, views: ViewAnnotations, logs: np.ndarray
) -> None:
    """Write −d²/2σ_l² of the annotations of a view to ``logs`` (N,); the maximum is log L_v."""
    image = project_to_view(pose, view, body, views)
    distances_to(prepare_projection(image, views.prepared), views.near[view], views.prepared, logs)
    for position in range(len(logs)):
        logs[position] = -0.5 * (logs[position] / views.noise) ** 2


@numba.njit(**NO_ALLOCATION)
def log_surrogate(
    pose: np.ndarray,
    view: int,
    annotation: int,
    body: Body,
    views: ViewAnnotations,
    work: Workspace,
) -> float:
    """Return −d²/2σ_l² of one annotation, with d on its graph only (ten times faster)."""
    if views.prepared.measure != INTERACTION:
        return _log_annotation(pose, view, annotation, body, views)
    right, up, _ = image_axes(pose, view, body, views)
    # Neither the rotation nor differences of joints depend on the middle.
    write_image(pose, right, up, work.image)
    distance = annotation_graph_distance(
        work.image, annotation, views.prepared, work.errors, work.edges
    )
    return -0.5 * (distance / views.noise) ** 2


# By default, options are those of the caller, which allocates no arrays.
@numba.njit(cache=True, nogil=True, _nrt=True)
def _log_annotation(
    pose: np.ndarray, view: int, annotation: int, body: Body, views: ViewAnnotations
) -> float:
    """Return −d²/2σ_l² of one annotation; distances without a graph have no cheaper surrogate."""
    prepared = prepare_projection(project_to_view(pose, view, body, views), views.prepared)
    distances = np.empty(1)
    distances_to(prepared, np.array([annotation]), views.prepared, distances)
    return -0.5 * (distances[0] / views.noise) ** 2


@numba.njit(**NO_ALLOCATION)
def log_measure(pose: np.ndarray, body: Body) -> float:
    """Return the log density of normal log lengths and root positions, 0 at the seed."""
    squares = log_lengths(pose, body)[1]
    return log_root_positions(pose, body) - 0.5 * squares / body.bone_noise**2


@numba.njit(**NO_ALLOCATION)
def log_lengths(pose: np.ndarray, body: Body) -> tuple[float, float]:
    """Return Σ log(l/l₀) and Σ log²(l/l₀) over bones of length l, l₀ in the seed."""
    total, squares = 0.0, 0.0
    for joint in range(len(pose)):
        parent = body.parents[joint]
        if parent >= 0:
            bone, seed_bone = between(pose, parent, joint), between(body.seed, parent, joint)
            change = 0.5 * np.log(dot(bone, bone) / dot(seed_bone, seed_bone))
            total += change
            squares += change**2
    return total, squares


@numba.njit(**NO_ALLOCATION)
def log_penetration(pose: np.ndarray, physics: Physics, work: Workspace) -> float:
    """Return −w ρ²/2σ_p² with penetration depth ρ, weight w and position noise σ_p (eq. 2)."""
    depth = total_depth(pose, physics.bones, physics.radii, physics.pairs, work.spheres)
    return -0.5 * physics.penetration_weight * (depth / physics.position_noise) ** 2


@numba.njit(**NO_ALLOCATION)
def write_limit_terms(
    pose: np.ndarray, person: int, physics: Physics, parts: np.ndarray, work: Workspace
) -> None:
    """Write a person's −‖X − X̂‖²/2σ_p², X̂ the projected pose, and number of invalid angles."""
    valid, shifts = work.bones.valid, work.bones.shifts
    check_person(pose, person, physics.trees[person], physics.limits, True, work.bones)
    square, n_invalid = 0.0, 0
    for joint in range(valid.shape[1]):
        n_invalid += not valid[person, joint]
        for i in range(3):
            square += shifts[person, joint, i] ** 2
    parts[2 + person] = -0.5 * square / physics.position_noise**2
    parts[2 + len(physics.trees) + person] = n_invalid


@numba.njit(cache=True, nogil=True)
def project_to_view(pose: np.ndarray, view: int, body: Body, views: ViewAnnotations) -> np.ndarray:
    """Project a pose to a view orthographically, (J, 2), metres.

    Equals :func:`~probmotion.interaction.annotations.views.project_to_views` up to a rotation in
    the image plane, which the alignment with annotations removes.
    """
    right, up, _ = image_axes(pose, view, body, views)
    image = np.empty((2, len(pose)))
    write_image(pose, right, up, image)
    return np.ascontiguousarray(image.T)


@numba.njit(**NO_ALLOCATION)
def write_image(pose: np.ndarray, right: Vector, up: Vector, image: np.ndarray) -> None:
    """Write the coordinates of the joints along two axes to ``image`` (2, J)."""
    for joint in range(len(pose)):
        position = row_of(pose, joint)
        image[0, joint], image[1, joint] = dot(position, right), dot(position, up)


@numba.njit(**NO_ALLOCATION)
def image_axes(
    pose: np.ndarray, view: int, body: Body, views: ViewAnnotations
) -> tuple[Vector, Vector, Vector]:
    """Return two axes of the image plane of a view, and the direction towards the viewer."""
    i, j, k = _local_frame(pose, body)
    a, b, c = views.vectors[view]
    x, y, z = (
        a * i[0] + b * j[0] + c * k[0],
        a * i[1] + b * j[1] + c * k[1],
        a * i[2] + b * j[2] + c * k[2],
    )
    towards = unit((x, y, z))
    x, y, z = abs(towards[0]), abs(towards[1]), abs(towards[2])
    across = (0.0, 1.0, 0.0) if y <= z else (0.0, 0.0, 1.0)
    if x <= y and x <= z:
        across = (1.0, 0.0, 0.0)
    right = unit(cross(across, towards))
    return right, cross(towards, right), towards


@numba.njit(**NO_ALLOCATION)
def _local_frame(pose: np.ndarray, body: Body) -> tuple[Vector, Vector, Vector]:
    """Return i, j, k of :func:`~probmotion.interaction.annotations.local_frames.local_frames`."""
    x, y, z = 0.0, 0.0, 0.0
    for person in range(len(body.roots)):
        along = unit(between(pose, body.roots[person], body.chests[person]))
        x, y, z = x + along[0], y + along[1], z + along[2]
    i = unit(between(pose, body.roots[0], body.roots[1]))
    j = unit((x, y, z))
    return i, j, cross(i, j)
