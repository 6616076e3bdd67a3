"""Compiled: the walk over one person's bones that checks each and corrects it.

Joints are in the order of ``person17``. A frame is a 3 × 3 array whose columns are a body's left,
up and forward axes; for bones of the right side the left axis is turned about, so that one table
serves both sides and a mirrored pose is judged as its mirror image.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from probmotion.models.joint_limits_frames import (
    cell_of,
    from_frame,
    in_frame,
    least_rotation,
    line_frame,
    normalise,
    product,
)
from probmotion.skeleton import Skeleton

__all__ = ["PARTS", "LimitArrays", "local_directions", "project_poses"]

PARTS = ("hip", "knee", "ankle", "chest", "shoulder", "elbow", "wrist", "neck", "head")
"""Bones that have a table, by the joint they end in; the two sides share one."""
HIP, KNEE, ANKLE, CHEST, SHOULDER, ELBOW, WRIST, NECK, HEAD = range(9)

# Joints of `person17`, and the last joint of what hangs from the spine.
PELVIS, SPINE, CHEST_JOINT, NECK_JOINT, HEAD_JOINT = range(5)
LEFT_SHOULDER, RIGHT_SHOULDER, LEFT_HIP, RIGHT_HIP = 5, 8, 11, 14
LAST_OF_TRUNK = 10
N_JOINTS = 17
_PARENTS = np.array(Skeleton.preset("person17").parents)

MIRROR = np.array([-1.0, 1.0, 1.0])
_BISECTIONS = 12


class LimitArrays(NamedTuple):
    """What the compiled walk reads of a table of limits.

    ``allowed`` (parts, bins, cells) bool; ``bin_rings`` and ``cell_rings`` (rings, 2): how many
    cells each ring has and the index of its first; ``centres`` (cells, 3); ``rest`` (parts, 3);
    ``tilt``: sine of the largest sideways tilt of the spine against the hips.
    """

    allowed: np.ndarray
    bin_rings: np.ndarray
    cell_rings: np.ndarray
    centres: np.ndarray
    rest: np.ndarray
    tilt: float


@numba.njit(cache=True)
def _set_and_turn(directions: np.ndarray, joint: int, new: np.ndarray, last: int) -> None:
    """Give a bone a new direction; bones up to ``last``, which hang from it, turn along."""
    turn, old = np.empty((3, 3)), np.empty(3)
    if not directions[joint].any():
        directions[joint] = new
        return
    least_rotation(directions[joint], new, turn)
    directions[joint] = new
    for below in range(joint + 1, last + 1):
        old[:] = directions[below]
        for i in range(3):
            directions[below, i] = turn[i, 0] * old[0] + turn[i, 1] * old[1] + turn[i, 2] * old[2]
        normalise(directions[below])


@numba.njit(cache=True)
def _nearest_allowed(
    u: np.ndarray, allowed: np.ndarray, rings: np.ndarray, centres: np.ndarray
) -> None:
    """Move ``u`` to where the way to the nearest allowed cell's centre enters allowed cells."""
    best, closest = 0, -2.0
    for cell in range(len(centres)):
        if allowed[cell]:
            c = u[0] * centres[cell, 0] + u[1] * centres[cell, 1] + u[2] * centres[cell, 2]
            if c > closest:
                best, closest = cell, c
    outside, inside = 0.0, 1.0
    between = np.empty(3)
    for _ in range(_BISECTIONS):
        t = 0.5 * (outside + inside)
        for i in range(3):
            between[i] = (1.0 - t) * u[i] + t * centres[best, i]
        if normalise(between) and allowed[cell_of(between, rings)]:
            inside = t
        else:
            outside = t
    for i in range(3):
        between[i] = (1.0 - inside) * u[i] + inside * centres[best, i]
    normalise(between)
    u[:] = between


@numba.njit(cache=True)
def _check(
    part: int,
    joint: int,
    last: int,
    frame: np.ndarray,
    limits: LimitArrays,
    correct: bool,
    directions: np.ndarray,
    valid: np.ndarray,
    local: np.ndarray,
) -> None:
    """Judge one bone in ``frame``, given ``local[joint, 0]``; correct it where asked.

    A bone without length is valid, and stands in its mean direction for what hangs from it.
    """
    u = local[joint, 1]
    if not directions[joint].any():
        new = np.empty(3)
        valid[joint] = True
        u[:] = limits.rest[part]
        from_frame(frame, u, new)
        _set_and_turn(directions, joint, new, last)
        return
    in_frame(frame, directions[joint], u)
    row = limits.allowed[part, cell_of(local[joint, 0], limits.bin_rings)]
    valid[joint] = row[cell_of(u, limits.cell_rings)]
    if correct and not valid[joint]:
        _nearest_allowed(u, row, limits.cell_rings, limits.centres)
        new = np.empty(3)
        from_frame(frame, u, new)
        _set_and_turn(directions, joint, new, last)


@numba.njit(cache=True)
def _walk_person(
    limits: LimitArrays,
    correct: bool,
    directions: np.ndarray,
    valid: np.ndarray,
    local: np.ndarray,
) -> None:
    """Judge the 16 bones, each parent before its children, correcting ``directions`` in place.

    ``local`` (17, 2, 3) gets each bone's condition and direction. The frame in which a bone is
    judged depends on bones that are already right, and no correction changes a frame that was
    used before it; therefore the result is valid throughout.
    """
    pelvis, trunk, sided = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    swing, below, new = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    up = np.array([0.0, 1.0, 0.0])
    line_frame(directions[LEFT_HIP], directions[RIGHT_HIP], directions[SPINE], pelvis)

    # The frame holds the spine in its left-up plane: what is left to judge is one angle.
    u = local[SPINE, 1]
    local[SPINE, 0] = up
    if not directions[SPINE].any():
        directions[SPINE] = pelvis[:, 1]
    in_frame(pelvis, directions[SPINE], u)
    valid[SPINE] = abs(u[0]) <= limits.tilt
    if correct and not valid[SPINE]:
        # A hair inside, so that rounding does not undo it.
        u[0] = np.copysign(limits.tilt * (1.0 - 1e-9), u[0])
        u[1] = np.sqrt(1.0 - u[0] * u[0])
        u[2] = 0.0
        from_frame(pelvis, u, new)
        _set_and_turn(directions, SPINE, new, LAST_OF_TRUNK)

    # In that frame the hips are mirror images of each other: one is judged, both are moved.
    local[LEFT_HIP, 0] = up
    _check(HIP, LEFT_HIP, LEFT_HIP + 2, pelvis, limits, correct, directions, valid, local)
    valid[RIGHT_HIP] = valid[LEFT_HIP]
    local[RIGHT_HIP] = local[LEFT_HIP]
    if correct and not valid[LEFT_HIP]:
        from_frame(pelvis, local[LEFT_HIP, 1] * MIRROR, new)
        _set_and_turn(directions, RIGHT_HIP, new, RIGHT_HIP + 2)
    for side in range(2):
        hip = LEFT_HIP if side == 0 else RIGHT_HIP
        sided[:] = pelvis
        if side == 1:
            sided[:, 0] *= -1.0
        local[hip + 1, 0] = local[hip, 1]
        _limb(KNEE, hip, sided, limits, correct, directions, valid, local)

    least_rotation(up, local[SPINE, 1], swing)
    product(pelvis, swing, trunk)
    local[CHEST_JOINT, 0] = up
    _check(CHEST, CHEST_JOINT, LAST_OF_TRUNK, trunk, limits, correct, directions, valid, local)
    least_rotation(limits.rest[CHEST], local[CHEST_JOINT, 1], swing)
    product(trunk, swing, below)
    for side in range(2):
        shoulder = LEFT_SHOULDER if side == 0 else RIGHT_SHOULDER
        sided[:] = below
        local[shoulder, 0] = local[CHEST_JOINT, 1]
        if side == 1:
            sided[:, 0] *= -1.0
            local[shoulder, 0, 0] *= -1.0
        _check(SHOULDER, shoulder, shoulder + 2, sided, limits, correct, directions, valid, local)

    # The line of the shoulders tells how the trunk is twisted, which its bones do not.
    line_frame(
        directions[LEFT_SHOULDER], directions[RIGHT_SHOULDER], directions[CHEST_JOINT], trunk
    )
    local[NECK_JOINT, 0] = local[CHEST_JOINT, 1]
    _check(NECK, NECK_JOINT, HEAD_JOINT, trunk, limits, correct, directions, valid, local)
    least_rotation(limits.rest[NECK], local[NECK_JOINT, 1], swing)
    product(trunk, swing, below)
    local[HEAD_JOINT, 0] = local[NECK_JOINT, 1]
    _check(HEAD, HEAD_JOINT, HEAD_JOINT, below, limits, correct, directions, valid, local)
    for side in range(2):
        shoulder = LEFT_SHOULDER if side == 0 else RIGHT_SHOULDER
        sided[:] = trunk
        if side == 1:
            sided[:, 0] *= -1.0
        in_frame(sided, directions[shoulder], local[shoulder + 1, 0])
        _limb(ELBOW, shoulder, sided, limits, correct, directions, valid, local)


@numba.njit(cache=True)
def _limb(
    part: int,
    joint: int,
    frame: np.ndarray,
    limits: LimitArrays,
    correct: bool,
    directions: np.ndarray,
    valid: np.ndarray,
    local: np.ndarray,
) -> None:
    """Judge the two bones that hang from ``joint``: thigh and shin, or upper arm and forearm."""
    swing, below = np.empty((3, 3)), np.empty((3, 3))
    _check(part, joint + 1, joint + 2, frame, limits, correct, directions, valid, local)
    least_rotation(limits.rest[part], local[joint + 1, 1], swing)
    product(frame, swing, below)
    local[joint + 2, 0] = local[joint + 1, 1]
    _check(part + 1, joint + 2, joint + 2, below, limits, correct, directions, valid, local)


@numba.njit(cache=True)
def _directions(pose: np.ndarray, tree: np.ndarray, directions: np.ndarray) -> None:
    """Write each bone's unit vector; that of a bone without length is 0."""
    for joint in range(1, N_JOINTS):
        for i in range(3):
            directions[joint, i] = pose[tree[joint], i] - pose[tree[_PARENTS[joint]], i]
        if not normalise(directions[joint]):
            directions[joint] = 0.0


@numba.njit(cache=True)
def project_poses(
    poses: np.ndarray, trees: np.ndarray, limits: LimitArrays
) -> tuple[np.ndarray, np.ndarray]:
    """Return which joints' bones are valid, (n, J), and the nearest valid poses, (n, J, 3).

    ``trees`` (K, 17) are the joints of each person in the order of ``person17``.
    """
    n = len(poses)
    nearest = poses.copy()
    valid = np.ones(poses.shape[:2], dtype=np.bool_)
    directions, before = np.zeros((N_JOINTS, 3)), np.zeros((N_JOINTS, 3))
    judged, local = np.ones(N_JOINTS, dtype=np.bool_), np.zeros((N_JOINTS, 2, 3))
    for pose in range(n):
        for tree in trees:
            _directions(poses[pose], tree, directions)
            before[:] = directions
            _walk_person(limits, True, directions, judged, local)
            if judged.all():
                continue
            for joint in range(1, N_JOINTS):
                here, above = tree[joint], tree[_PARENTS[joint]]
                valid[pose, here] = judged[joint]
                length = 0.0
                for i in range(3):
                    length += (poses[pose, here, i] - poses[pose, above, i]) ** 2
                # What a bone adds is its turning alone, so that what is not turned is not rounded.
                for i in range(3):
                    turned = np.sqrt(length) * (directions[joint, i] - before[joint, i])
                    moved = nearest[pose, above, i] - poses[pose, above, i]
                    nearest[pose, here, i] = poses[pose, here, i] + moved + turned
    return valid, nearest


@numba.njit(cache=True)
def local_directions(poses: np.ndarray, limits: LimitArrays) -> np.ndarray:
    """Return each bone's condition and direction in its frame, (n, 17, 2, 3), uncorrected."""
    local = np.zeros((len(poses), N_JOINTS, 2, 3))
    directions, judged = np.zeros((N_JOINTS, 3)), np.ones(N_JOINTS, dtype=np.bool_)
    tree = np.arange(N_JOINTS)
    for pose in range(len(poses)):
        _directions(poses[pose], tree, directions)
        _walk_person(limits, False, directions, judged, local[pose])
    return local
