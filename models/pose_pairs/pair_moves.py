"""Compiled Metropolis proposals for pose pairs.

The base measure is a product: uniform bone directions, normal log lengths and normal root
positions, as in ``PoseChart.log_measure`` without the roots' frames. Proposals rotate bones or
change a log length or position; they preserve this measure's volume, so no Jacobian is needed.
"""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np

from probmotion.extras import NO_ALLOCATION, numba
from probmotion.models.pose_pairs.joint_limits_frames import (
    Frame,
    Vector,
    between,
    from_frame,
    length_of,
    overwrite,
    row_of,
)

__all__ = [
    "APPROACH", "HINGE", "SHIFT", "SLIDE", "STRETCH", "SWING", "TURN", "Body", "log_root_positions",
    "moves_of", "propose", "resample_placement",
]  # fmt: skip

SWING, SLIDE, STRETCH, CRANK, HINGE, TURN, SHIFT, APPROACH = range(8)
"""Kinds of moves, all but the last by :func:`propose`."""
_APPROACHES = 20
"""Number of moves of the last kind for all people, and for each person half of them. They change
the likelihood most."""
_PLACEMENTS, _TRUNKS = 13, 7
"""Numbers of moves of each kind that place a person, and that rotate a bone of the local frame.
Most distances depend on them, so that their steps are small."""
_UNIFORM_ANGLES = 0.3
"""Probability of a uniform angle for cranks and hinges."""


class Body(NamedTuple):
    """Skeleton and seed pose of two or more people.

    ``parents`` (J,), −1 for roots; ``below[j, k]``: whether joint k is joint j or a descendant;
    ``roots``, ``chests`` (K,): joints; ``framing`` (J,): whether the local frame depends on the
    joint or on a descendant; ``person`` (J,): 0 to K − 1; ``seed`` (J, 3), metres. The noises are
    standard deviations of log bone lengths and of root positions, metres.
    """

    parents: np.ndarray
    below: np.ndarray
    roots: np.ndarray
    chests: np.ndarray
    framing: np.ndarray
    person: np.ndarray
    seed: np.ndarray
    bone_noise: float
    root_noise: float


def moves_of(body: Body) -> np.ndarray:
    """Return all moves, (n_moves, 3): kind, joint or root, and second joint or −1.

    The second joint is a crank's only child or a hinge's sibling. A move of the last kind is of the
    person of a root, or of all people if it is −1.
    """
    joints = range(len(body.parents))
    bones = np.flatnonzero(body.parents >= 0).tolist()
    children = [np.flatnonzero(body.parents == joint).tolist() for joint in joints]
    moves = [(STRETCH, joint, -1) for joint in bones]
    for kind in (SWING, SLIDE):
        for joint in bones:
            moves += [(kind, joint, -1)] * (_TRUNKS if body.framing[joint] else 1)
    moves += [(CRANK, joint, children[joint][0]) for joint in bones if len(children[joint]) == 1]
    moves += [(HINGE, *pair) for siblings in children for pair in combinations(siblings, 2)]
    moves += [(kind, root, -1) for kind in (TURN, SHIFT) for root in body.roots] * _PLACEMENTS
    moves += [(APPROACH, -1, -1)] * _APPROACHES
    moves += [(APPROACH, root, -1) for root in body.roots for _ in range(_APPROACHES // 2)]
    return np.array(moves, dtype=np.int64)


@numba.njit(**NO_ALLOCATION)
def propose(
    pose: np.ndarray,
    move: np.ndarray,
    size: float,
    body: Body,
    rng: np.random.Generator,
    proposed: np.ndarray,
    depth: bool = False,
) -> None:
    """Write the proposal of one move; ``size`` is its scale in radians, metres or log length.

    With ``depth``, shifts are along z, and turns, swings and slides about axes perpendicular to z.
    """
    kind, joint, other = move
    overwrite(proposed, pose)
    parent, below = body.parents[joint], body.below[joint]
    x = size * rng.standard_normal()
    y = size * rng.standard_normal()
    z = size * rng.standard_normal()
    if depth and kind == SHIFT:
        x, y = 0.0, 0.0
    elif depth:
        z = 0.0
    if kind == TURN:
        _turn_about(proposed, below, _middle(pose, below), _rotation((x, y, z)))
        return
    if kind == SHIFT:
        _shift(proposed, below, (x, y, z))
        return
    bone = between(pose, parent, joint)
    if kind == SWING:
        _turn_about(proposed, below, row_of(pose, parent), _rotation((x, y, z)))
    elif kind == STRETCH:
        ratio = np.exp(x)
        _shift(proposed, below, _change(bone, (ratio * bone[0], ratio * bone[1], ratio * bone[2])))
    elif kind == SLIDE:
        _shift(proposed, below, _change(bone, from_frame(_rotation((x, y, z)), bone)))
    else:
        angle = x
        if rng.random() < _UNIFORM_ANGLES:
            angle = np.pi * (2.0 * rng.random() - 1.0)
        # Rotation about the line between two joints preserves both bone lengths.
        x, y, z = between(pose, parent if kind == CRANK else joint, other)
        length = length_of((x, y, z))
        if length == 0:
            return
        angle /= length
        change = _change(bone, from_frame(_rotation((angle * x, angle * y, angle * z)), bone))
        if kind == HINGE:
            _shift(proposed, below, change)
            _shift(proposed, body.below[other], change)
        else:
            for i in range(3):
                proposed[joint, i] += change[i]


@numba.njit(cache=True, nogil=True)
def resample_placement(
    pose: np.ndarray, parts: np.ndarray, body: Body, rng: np.random.Generator
) -> None:
    """Metropolis update of the pair's rigid placement, on which only the root density depends."""
    n_roots = len(body.roots)
    middle, start, new = np.zeros(3), np.zeros(3), np.empty(3)
    for root in body.roots:
        middle += pose[root] / n_roots
        start += body.seed[root] / n_roots
    for i in range(3):
        new[i] = start[i] + body.root_noise / np.sqrt(n_roots) * rng.standard_normal()
    turn = _random_rotation(rng)
    # The centre is drawn from its conditional; only relative root positions affect acceptance.
    before, after = 0.0, 0.0
    for root in body.roots:
        x, y, z = pose[root] - middle
        rotated = from_frame(turn, (x, y, z))
        for i in range(3):
            relative = body.seed[root, i] - start[i]
            before += (pose[root, i] - middle[i] - relative) ** 2
            after += (rotated[i] - relative) ** 2
    log_ratio = 0.5 * (before - after) / body.root_noise**2
    if -rng.standard_exponential() < log_ratio:
        parts[0] -= log_root_positions(pose, body)
        x, y, z = middle
        _turn_about(pose, np.ones(len(pose), dtype=np.bool_), (x, y, z), turn)
        pose += new - middle
        parts[0] += log_root_positions(pose, body)


@numba.njit(**NO_ALLOCATION)
def _middle(pose: np.ndarray, chosen: np.ndarray) -> Vector:
    """Return the mean position of the chosen joints."""
    n_joints, x, y, z = 0, 0.0, 0.0, 0.0
    for k in range(len(pose)):
        if chosen[k]:
            x, y, z = x + pose[k, 0], y + pose[k, 1], z + pose[k, 2]
            n_joints += 1
    return (x / n_joints, y / n_joints, z / n_joints)


@numba.njit(**NO_ALLOCATION)
def _change(old: Vector, new: Vector) -> Vector:
    return (new[0] - old[0], new[1] - old[1], new[2] - old[2])


@numba.njit(**NO_ALLOCATION)
def _shift(pose: np.ndarray, chosen: np.ndarray, change: Vector) -> None:
    for k in range(len(pose)):
        if chosen[k]:
            for i in range(3):
                pose[k, i] += change[i]


@numba.njit(**NO_ALLOCATION)
def _turn_about(pose: np.ndarray, chosen: np.ndarray, centre: Vector, turn: Frame) -> None:
    for k in range(len(pose)):
        if chosen[k]:
            turned = from_frame(turn, _change(centre, row_of(pose, k)))
            for i in range(3):
                pose[k, i] = centre[i] + turned[i]


@numba.njit(**NO_ALLOCATION)
def _rotation(vector: Vector) -> Frame:
    """Return the matrix of a rotation vector."""
    angle = length_of(vector)
    half = 0.5 * angle
    scale = np.sin(half) / angle if angle > 1e-12 else 0.5
    return _matrix(np.cos(half), scale * vector[0], scale * vector[1], scale * vector[2])


@numba.njit(**NO_ALLOCATION)
def _random_rotation(rng: np.random.Generator) -> Frame:
    w, x = rng.standard_normal(), rng.standard_normal()
    y, z = rng.standard_normal(), rng.standard_normal()
    size = np.sqrt(w * w + x * x + y * y + z * z)
    return _matrix(w / size, x / size, y / size, z / size)


@numba.njit(**NO_ALLOCATION)
def _matrix(w: float, x: float, y: float, z: float) -> Frame:
    """Return the matrix of a unit quaternion."""
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )


@numba.njit(**NO_ALLOCATION)
def log_root_positions(pose: np.ndarray, body: Body) -> float:
    """Return the log density of the root positions, 0 at the seed."""
    total = 0.0
    for root in body.roots:
        for i in range(3):
            total += (pose[root, i] - body.seed[root, i]) ** 2
    return -0.5 * total / body.root_noise**2
