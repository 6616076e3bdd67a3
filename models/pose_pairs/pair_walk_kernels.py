"""Compiled Metropolis walk over pose pairs and views."""

from __future__ import annotations

import numpy as np

from probmotion.extras import numba
from probmotion.interaction.geometry.graph_kernels import max_edges
from probmotion.models.pose_pairs.pair_densities import (
    Physics,
    Vector,
    ViewAnnotations,
    image_axes,
    log_annotations,
    log_measure,
    log_penetration,
    log_prior,
    log_surrogate,
    log_view,
    write_limit_terms,
)
from probmotion.models.pose_pairs.pair_moves import (
    APPROACH,
    SHIFT,
    TURN,
    Body,
    propose,
    resample_placement,
)

__all__ = ["approach", "walk"]

_SURROGATE_STEPS = 40
"""Surrogate steps per proposal, for an acceptance rate of about two thirds."""
_VIEW_PROPOSALS = 6
"""View proposals per walk."""


@numba.njit(cache=True, nogil=True)
def walk(
    pose: np.ndarray,
    parts: np.ndarray,
    view: int,
    power: float,
    n_steps: int,
    moves: np.ndarray,
    sizes: np.ndarray,
    tried: np.ndarray,
    taken: np.ndarray,
    body: Body,
    physics: Physics,
    views: ViewAnnotations,
    rng: np.random.Generator,
) -> tuple[int, float]:
    """Sample pose and view v from prior · L_v^power by Metropolis; return v and log L_v.

    Blocks of steps target a surrogate of L_v, the graph distance to one annotation, and are
    accepted or rejected as a whole (surrogate transitions, Liu 2001). The annotation is an
    auxiliary variable, drawn given the pose with probability ∝ likelihood^power.

    Updates in place: ``pose`` (J, 3), metres; ``parts`` (2 + 2 K,) of :func:`log_prior_terms`; and
    the counters of surrogate steps ``tried`` and ``taken`` (moves,).
    """
    logs, new_logs = np.empty(views.near.shape[1]), np.empty(views.near.shape[1])
    new_pose, new_parts = np.empty_like(pose), np.empty_like(parts)
    if power > 0:
        log_annotations(pose, view, body, views, logs)
    for done in range(0, n_steps, _SURROGATE_STEPS):
        new_pose[:], new_parts[:] = pose, parts
        chosen = _draw_index(power * logs, rng) if power > 0 else 0
        log_gain = _surrogate_walk(
            new_pose, new_parts, view, views.near[view, chosen], power,
            min(_SURROGATE_STEPS, n_steps - done), moves, sizes, tried, taken, body, physics,
            views, rng,
        )  # fmt: skip
        if power > 0:
            log_annotations(new_pose, view, body, views, new_logs)
            ratio = power * (new_logs[chosen] - logs[chosen] - log_gain)
            ratio += _log_sum_over_best(power * logs) - _log_sum_over_best(power * new_logs)
            if not -rng.standard_exponential() < ratio:
                continue
            logs[:] = new_logs
        pose[:], parts[:] = new_pose, new_parts
    resample_placement(pose, parts, body, rng)
    if power == 0:
        view = int(rng.random() * len(views.vectors))
        return view, log_view(pose, view, body, views, -np.inf)
    log_l = logs.max()
    for _ in range(_VIEW_PROPOSALS):
        # Draw the acceptance threshold first, to terminate the evaluation early.
        other = int(rng.random() * len(views.vectors))
        lower_bound = log_l - rng.standard_exponential() / power
        other_log_l = log_view(pose, other, body, views, lower_bound)
        if other_log_l >= lower_bound:
            view, log_l = other, other_log_l
    return view, log_l


@numba.njit(cache=True, nogil=True)
def _surrogate_walk(
    pose: np.ndarray,
    parts: np.ndarray,
    view: int,
    annotation: int,
    power: float,
    n_steps: int,
    moves: np.ndarray,
    sizes: np.ndarray,
    tried: np.ndarray,
    taken: np.ndarray,
    body: Body,
    physics: Physics,
    views: ViewAnnotations,
    rng: np.random.Generator,
) -> float:
    """Take Metropolis steps on prior · surrogate^power; return the change of the log surrogate.

    At power 0, the annotation only serves the moves.
    """
    proposed, new_parts = np.empty_like(pose), np.empty_like(parts)
    errors, terms = np.empty((2, len(pose))), np.empty(max_edges(len(pose), views.prepared.graph))
    start = log_surrogate(pose, view, annotation, body, views, errors, terms) if power > 0 else 0.0
    current = start
    for _ in range(n_steps):
        number = int(rng.random() * len(moves))
        kind, joint = moves[number, 0], moves[number, 1]
        tried[number] += 1
        log_volume = 0.0
        if kind == APPROACH:
            ratio = np.exp(sizes[number] * rng.standard_normal())
            log_volume = approach(pose, joint, ratio, view, annotation, body, views, proposed)
            if log_volume == -np.inf:
                continue
        else:
            propose(pose, moves[number], sizes[number], body, rng, proposed)
        new_parts[:] = parts
        # Delayed acceptance: evaluate cheap terms first (Christen and Fox 2005).
        new_parts[0] = log_measure(proposed, body)
        new = 0.0
        if power > 0:
            new = log_surrogate(proposed, view, annotation, body, views, errors, terms)
        log_ratio = new_parts[0] - parts[0] + power * (new - current) + log_volume
        if not -rng.standard_exponential() < log_ratio:
            continue
        lower_bound = log_prior(parts, physics) - parts[0] - rng.standard_exponential()
        new_parts[1] = 0.0
        if kind == APPROACH and joint < 0:
            for person in range(len(body.roots)):
                write_limit_terms(proposed, person, physics, new_parts)
        elif kind != TURN and kind != SHIFT:
            write_limit_terms(proposed, body.person[joint], physics, new_parts)
        # Penetration only decreases the density, so joint limits, which reject more often, may
        # suffice to reject.
        if not log_prior(new_parts, physics) - new_parts[0] >= lower_bound:
            continue
        new_parts[1] = log_penetration(proposed, physics)
        if not log_prior(new_parts, physics) - new_parts[0] >= lower_bound:
            continue
        pose[:], parts[:], current = proposed, new_parts, new
        taken[number] += 1
    return current - start


@numba.njit(cache=True, nogil=True)
def approach(
    pose: np.ndarray,
    root: int,
    ratio: float,
    view: int,
    annotation: int,
    body: Body,
    views: ViewAnnotations,
    proposed: np.ndarray,
) -> float:
    """Move bones towards or away from those of an annotation; return the log ratio of volumes.

    The angle of each bone of a person, or of all people if ``root`` is −1, to the annotation's bone
    is multiplied by ``ratio``. That bone has the length of the pose's and is on the same side of
    the image plane, or in it if it is too long. The inverse move has the ratio 1/``ratio``; −∞ if
    there is none, because a bone would change sides. The annotation is rotated in the image to fit
    the joints that define the local frame. Their bones stay, so that view and rotation do.
    """
    right, up, towards = image_axes(pose, view, body, views)
    joints, n_joints = views.prepared.joints[annotation], len(pose)
    image, middle, target = np.empty((2, n_joints)), np.zeros(2), np.zeros(2)
    for joint in range(n_joints):
        image[0, joint] = _component(pose[joint], right)
        image[1, joint] = _component(pose[joint], up)
        if body.framing[joint]:
            for axis in range(2):
                middle[axis] += image[axis, joint] / body.framing.sum()
                target[axis] += joints[axis, joint] / body.framing.sum()
    along, across = 0.0, 0.0
    for joint in range(n_joints):
        if body.framing[joint]:
            x, y = image[0, joint] - middle[0], image[1, joint] - middle[1]
            u, v = joints[0, joint] - target[0], joints[1, joint] - target[1]
            along += u * x + v * y
            across += u * y - v * x
    size = np.sqrt(along * along + across * across)
    if size == 0:
        return -np.inf
    cosine, sine = along / size, across / size
    log_volume = 0.0
    proposed[:] = pose
    for joint in range(n_joints):
        parent = body.parents[joint]
        if body.framing[joint] or parent < 0:
            continue
        bone = pose[joint] - pose[parent]
        if root < 0 or body.below[root, joint]:
            x = image[0, joint] - image[0, parent]
            y = image[1, joint] - image[1, parent]
            z = _component(bone, towards)
            u, v = joints[0, joint] - joints[0, parent], joints[1, joint] - joints[1, parent]
            length = np.sqrt((bone**2).sum())
            goal = _lifted(cosine * u - sine * v, sine * u + cosine * v, z, length)
            (x, y, new_z), log_area = _scaled_angle((x, y, z), goal, ratio)
            if log_area == -np.inf or (new_z > 0) != (z > 0):
                return -np.inf
            log_volume += log_area
            for axis in range(3):
                bone[axis] = x * right[axis] + y * up[axis] + new_z * towards[axis]
        proposed[joint] = proposed[parent] + bone
    return log_volume


@numba.njit(cache=True, nogil=True)
def _component(vector: np.ndarray, axis: Vector) -> float:
    return vector[0] * axis[0] + vector[1] * axis[1] + vector[2] * axis[2]


@numba.njit(cache=True, nogil=True)
def _lifted(x: float, y: float, side: float, length: float) -> Vector:
    """Return the direction of a bone of a length with an image, on the side of a depth."""
    x, y = x / length, y / length
    square = x * x + y * y
    if square >= 1.0:
        return x / np.sqrt(square), y / np.sqrt(square), 0.0
    return x, y, np.copysign(np.sqrt(1.0 - square), side)


@numba.njit(cache=True, nogil=True)
def _scaled_angle(vector: Vector, goal: Vector, ratio: float) -> tuple[Vector, float]:
    """Return a vector with its angle to a direction scaled, and the log ratio of solid angles."""
    length = np.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)
    x, y, z = vector[0] / length, vector[1] / length, vector[2] / length
    cosine = x * goal[0] + y * goal[1] + z * goal[2]
    x, y, z = x - cosine * goal[0], y - cosine * goal[1], z - cosine * goal[2]
    sine = np.sqrt(x * x + y * y + z * z)
    angle = ratio * np.arctan2(sine, cosine)
    if sine < 1e-12 or angle >= np.pi:
        return vector, -np.inf
    along, across = length * np.cos(angle), length * np.sin(angle) / sine
    new = (
        along * goal[0] + across * x,
        along * goal[1] + across * y,
        along * goal[2] + across * z,
    )
    return new, np.log(ratio * np.sin(angle) / sine)


@numba.njit(cache=True, nogil=True)
def _draw_index(logs: np.ndarray, rng: np.random.Generator) -> int:
    """Draw an index in proportion to exp(logs)."""
    total = np.cumsum(np.exp(logs - logs.max()))
    return min(int(np.searchsorted(total, rng.random() * total[-1], side="right")), len(logs) - 1)


@numba.njit(cache=True, nogil=True)
def _log_sum_over_best(logs: np.ndarray) -> float:
    """Return log Σ exp(logs) − max logs."""
    return np.log(np.exp(logs - logs.max()).sum())
