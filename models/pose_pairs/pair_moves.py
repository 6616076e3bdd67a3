"""Compiled Metropolis proposals for pose pairs.

The base measure is a product: uniform bone directions, normal log lengths and normal root
positions, as in ``PoseChart.log_measure`` without the roots' frames. Proposals rotate bones or
change a log length or position; they preserve this measure's volume, so no Jacobian is needed.
"""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np

from probmotion.extras import numba

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


@numba.njit(cache=True, nogil=True)
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
    proposed[:] = pose
    parent = body.parents[joint]
    turn, vector, centre = np.empty((3, 3)), np.empty(3), np.zeros(3)
    for i in range(3):
        vector[i] = size * rng.standard_normal()
    if depth and kind == SHIFT:
        vector[:2] = 0.0
    elif depth:
        vector[2] = 0.0
    if kind in (TURN, SWING):
        if kind == SWING:
            centre[:] = pose[parent]
        else:
            n_joints = 0
            for k in range(len(pose)):
                if body.below[joint, k]:
                    for i in range(3):
                        centre[i] += pose[k, i]
                    n_joints += 1
            centre /= n_joints
        _rotation(vector, turn)
        _turn_about(proposed, body.below[joint], centre, turn)
    elif kind in (SHIFT, STRETCH, SLIDE):
        if kind == STRETCH:
            factor = np.exp(vector[0]) - 1.0
            for i in range(3):
                vector[i] = factor * (pose[joint, i] - pose[parent, i])
        elif kind == SLIDE:
            _rotation(vector, turn)
            for i in range(3):
                vector[i] = -(pose[joint, i] - pose[parent, i])
                for m in range(3):
                    vector[i] += turn[i, m] * (pose[joint, m] - pose[parent, m])
        for k in range(len(pose)):
            if body.below[joint, k]:
                for i in range(3):
                    proposed[k, i] += vector[i]
    else:
        angle = vector[0]
        if rng.random() < _UNIFORM_ANGLES:
            angle = np.pi * (2.0 * rng.random() - 1.0)
        # Rotation about the line between two joints preserves both bone lengths.
        axis = pose[other] - pose[parent if kind == CRANK else joint]
        length = np.sqrt((axis**2).sum())
        if length == 0:
            return
        _rotation(axis * (angle / length), turn)
        rotated = np.zeros(len(pose), dtype=np.bool_)
        rotated[joint] = True
        _turn_about(proposed, rotated, pose[parent], turn)
        if kind == HINGE:
            vector[:] = proposed[joint] - pose[joint]
            for k in range(len(pose)):
                if body.below[joint, k] or body.below[other, k]:
                    for i in range(3):
                        proposed[k, i] = pose[k, i] + vector[i]


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
    turn = np.empty((3, 3))
    _random_rotation(rng, turn)
    # The centre is drawn from its conditional; only relative root positions affect acceptance.
    before, after = 0.0, 0.0
    for root in body.roots:
        for i in range(3):
            rotated = 0.0
            for m in range(3):
                rotated += turn[i, m] * (pose[root, m] - middle[m])
            relative = body.seed[root, i] - start[i]
            before += (pose[root, i] - middle[i] - relative) ** 2
            after += (rotated - relative) ** 2
    log_ratio = 0.5 * (before - after) / body.root_noise**2
    if -rng.standard_exponential() < log_ratio:
        parts[0] -= log_root_positions(pose, body)
        _turn_about(pose, np.ones(len(pose), dtype=np.bool_), middle, turn)
        pose += new - middle
        parts[0] += log_root_positions(pose, body)


@numba.njit(cache=True, nogil=True)
def _turn_about(pose: np.ndarray, chosen: np.ndarray, centre: np.ndarray, turn: np.ndarray) -> None:
    for k in range(len(pose)):
        if chosen[k]:
            x, y, z = pose[k, 0] - centre[0], pose[k, 1] - centre[1], pose[k, 2] - centre[2]
            for i in range(3):
                pose[k, i] = centre[i] + turn[i, 0] * x + turn[i, 1] * y + turn[i, 2] * z


@numba.njit(cache=True, nogil=True)
def _rotation(vector: np.ndarray, turn: np.ndarray) -> None:
    """Write the matrix of a rotation vector."""
    angle = np.sqrt((vector**2).sum())
    half = 0.5 * angle
    scale = np.sin(half) / angle if angle > 1e-12 else 0.5
    _write_rotation(np.cos(half), scale * vector[0], scale * vector[1], scale * vector[2], turn)


@numba.njit(cache=True, nogil=True)
def _random_rotation(rng: np.random.Generator, turn: np.ndarray) -> None:
    w, x = rng.standard_normal(), rng.standard_normal()
    y, z = rng.standard_normal(), rng.standard_normal()
    size = np.sqrt(w * w + x * x + y * y + z * z)
    _write_rotation(w / size, x / size, y / size, z / size, turn)


@numba.njit(cache=True, nogil=True)
def _write_rotation(w: float, x: float, y: float, z: float, R: np.ndarray) -> None:
    # Row assignments would increase compile time by three seconds.
    R[0, 0], R[0, 1], R[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    R[1, 0], R[1, 1], R[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    R[2, 0], R[2, 1], R[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)


@numba.njit(cache=True, nogil=True)
def log_root_positions(pose: np.ndarray, body: Body) -> float:
    """Return the log density of the root positions, 0 at the seed."""
    total = 0.0
    for root in body.roots:
        for i in range(3):
            total += (pose[root, i] - body.seed[root, i]) ** 2
    return -0.5 * total / body.root_noise**2
