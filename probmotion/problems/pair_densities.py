"""Compiled: how likely a pose-pair is, part by part, and in one view of the evidence."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from probmotion.interaction.nearest_kernels import Prepared, nearest_of
from probmotion.models.joint_limits_kernels import LimitArrays, project_poses
from probmotion.models.penetration_kernels import total_depths
from probmotion.problems.pair_moves import Body, log_places

__all__ = [
    "Physics",
    "Sight",
    "choose_view",
    "judge",
    "log_measure",
    "log_penetration",
    "log_prior",
    "log_view",
    "picture_of",
    "weigh",
]


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
def log_view(pose: np.ndarray, view: int, body: Body, sight: Sight) -> float:
    """Return log L(Θ_v; v) of one view: −d²/2σ_l² of the nearest annotation (eq. 9)."""
    distance, _ = nearest_of(
        picture_of(pose, view, body, sight),
        sight.near[view],
        sight.prepared,
        sight.measure,
        sight.graph,
        sight.epsilon,
        np.inf,
    )
    return -0.5 * (distance / sight.noise) ** 2


@numba.njit(cache=True, nogil=True)
def choose_view(
    pose: np.ndarray, power: float, body: Body, sight: Sight, rng: np.random.Generator
) -> tuple[int, float, float]:
    """Return a view drawn in proportion to L_v^power, its log L_v, and log L of all views."""
    n_views = len(sight.vectors)
    logs = np.empty(n_views)
    for view in range(n_views):
        logs[view] = log_view(pose, view, body, sight)
    most = logs.max()
    total = np.cumsum(np.exp(power * (logs - most)))
    view = min(int(np.searchsorted(total, rng.random() * total[-1], side="right")), n_views - 1)
    return view, logs[view], most + np.log(np.exp(logs - most).mean())


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
    apart = ((poses - nearest) ** 2).sum()
    parts[2 + person] = -0.5 * apart / physics.position_noise**2
    parts[2 + len(physics.trees) + person] = valid.size - valid.sum()


@numba.njit(cache=True, nogil=True)
def picture_of(pose: np.ndarray, view: int, body: Body, sight: Sight) -> np.ndarray:
    """Return a pose as seen in a view, (J, 2), metres."""
    frame, picture = np.empty((3, 3)), np.empty((len(pose), 2))
    _local_frame(pose, body, frame)
    _project(pose, frame, sight.vectors[view], picture)
    return picture


@numba.njit(cache=True, nogil=True)
def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / max(np.sqrt((vector**2).sum()), 1e-300)


@numba.njit(cache=True, nogil=True)
def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    found = np.empty(3)
    found[0] = a[1] * b[2] - a[2] * b[1]
    found[1] = a[2] * b[0] - a[0] * b[2]
    found[2] = a[0] * b[1] - a[1] * b[0]
    return found


@numba.njit(cache=True, nogil=True)
def _local_frame(pose: np.ndarray, body: Body, frame: np.ndarray) -> None:
    """Write i, j and k of :func:`~probmotion.interaction.local_frames.local_frames` as columns."""
    up = np.zeros(3)
    for person in range(len(body.roots)):
        up += _unit(pose[body.chests[person]] - pose[body.roots[person]])
    frame[:, 0] = _unit(pose[body.roots[1]] - pose[body.roots[0]])
    frame[:, 1] = _unit(up)
    frame[:, 2] = _cross(frame[:, 0], frame[:, 1])


@numba.njit(cache=True, nogil=True)
def _project(pose: np.ndarray, frame: np.ndarray, vector: np.ndarray, picture: np.ndarray) -> None:
    """Write the orthographic picture, as :func:`~probmotion.interaction.views.project_to_views`.

    Up is anything across the view here: annotations are turned to fit.
    """
    towards = np.zeros(3)
    for i in range(3):
        for k in range(3):
            towards[i] += frame[i, k] * vector[k]
    towards = _unit(towards)
    other = np.zeros(3)
    other[np.abs(towards).argmin()] = 1.0
    right = _unit(_cross(other, towards))
    up = _cross(towards, right)
    for joint in range(len(pose)):
        x, y = 0.0, 0.0
        for i in range(3):
            x += right[i] * pose[joint, i]
            y += up[i] * pose[joint, i]
        picture[joint, 0], picture[joint, 1] = x, y
