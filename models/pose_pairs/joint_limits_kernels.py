"""Compiled traversal of a person's bones that checks and corrects joint limits.

Joints are in the order of ``person17``. The columns of a frame are the body's left, up and forward
axes. The left axis is reversed for bones of the right side, so that both sides share one table.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from probmotion.extras import NO_ALLOCATION, numba
from probmotion.models.pose_pairs.joint_limits_frames import (
    NO_LENGTH,
    Frame,
    Vector,
    between,
    cell_of,
    dot,
    from_frame,
    in_frame,
    least_rotation,
    length_of,
    line_frame,
    overwrite,
    product,
    row_of,
    unit,
)  # fmt: skip
from probmotion.motion.skeleton import Skeleton

__all__ = [
    "PARTS", "Corrections", "LimitArrays", "check_person", "corrections", "local_directions",
    "project_poses",
]  # fmt: skip

PARTS = ("hip", "knee", "ankle", "chest", "shoulder", "elbow", "wrist", "neck", "head")
"""Bones with a table, by end joint; shared by both sides."""
# NumPy integers: Numba would compile a function again for each literal integer argument.
HIP, KNEE, ANKLE, CHEST, SHOULDER, ELBOW, WRIST, NECK, HEAD = np.arange(9)

# Joints of `person17`; LAST_OF_TRUNK is the last descendant of the spine.
SPINE, CHEST_JOINT, NECK_JOINT, HEAD_JOINT = np.arange(1, 5)
LEFT_SHOULDER, RIGHT_SHOULDER, LAST_OF_TRUNK, LEFT_HIP, RIGHT_HIP = np.array([5, 8, 10, 11, 14])
N_JOINTS = 17
_PARENTS = np.array(Skeleton.preset("person17").parents)

_UP = (0.0, 1.0, 0.0)  # up axis of every frame
_BISECTIONS = 12  # steps that locate the boundary of the allowed cells


class LimitArrays(NamedTuple):
    """Arrays of :class:`~.joint_limits.JointLimits`; rings and centres from ``sphere_rings``."""

    allowed: np.ndarray  # (parts, bins, cells), bool
    bin_rings: np.ndarray  # (rings, 2)
    cell_rings: np.ndarray  # (rings, 2)
    centres: np.ndarray  # (cells, 3)
    rest: np.ndarray  # (parts, 3)
    tilt: float  # sine of the maximum tilt of the spine


class Corrections(NamedTuple):
    """Bones of one person, by end joint, before and after a traversal.

    The next traversal, with equal limits, only checks bones whose ``checked`` or parent's direction
    has changed.
    """

    given: np.ndarray  # (17, 3), unit vectors
    directions: np.ndarray  # (17, 3), unit vectors after correction
    valid: np.ndarray  # (17,), bool
    local: np.ndarray  # (17, 2, 3), directions of the parent and the bone in the bone's frame
    checked: np.ndarray  # (17, 3), direction of the bone in its frame before correction
    shifts: np.ndarray  # (17, 3), displacements of the joints, metres


class Walk(NamedTuple):
    """Arguments of the traversal of one person."""

    limits: LimitArrays
    correct: bool  # whether invalid bones are corrected
    bones: Corrections


@numba.njit(**NO_ALLOCATION)
def _set_row(rows: np.ndarray, number: int, v: Vector) -> None:
    rows[number, 0], rows[number, 1], rows[number, 2] = v


@numba.njit(**NO_ALLOCATION)
def _mirrored(v: Vector) -> Vector:
    return (-v[0], v[1], v[2])


@numba.njit(**NO_ALLOCATION)
def _side_frame(frame: Frame, side: int) -> Frame:
    """Return the frame for bones of the left (0) or right (1) side."""
    left, up, forward = frame
    return frame if side == 0 else ((-left[0], -left[1], -left[2]), up, forward)


@numba.njit(**NO_ALLOCATION)
def _rotate_bone(directions: np.ndarray, joint: int, new: Vector, last: int) -> None:
    """Set the direction of a bone and rotate its descendants, up to joint ``last``."""
    old = row_of(directions, joint)
    _set_row(directions, joint, new)
    if old == NO_LENGTH:
        return
    turn = least_rotation(old, new)
    for below in range(joint + 1, last + 1):
        _set_row(directions, below, unit(from_frame(turn, row_of(directions, below))))


@numba.njit(**NO_ALLOCATION)
def _nearest_allowed(u: Vector, part: int, row: int, limits: LimitArrays) -> Vector:
    """Return the point at which the path from ``u`` to the nearest allowed centre becomes valid."""
    best, closest = 0, -2.0
    for cell in range(len(limits.centres)):
        if limits.allowed[part, row, cell]:
            c = dot(u, row_of(limits.centres, cell))
            if c > closest:
                best, closest = cell, c
    centre = row_of(limits.centres, best)
    outside, inside = 0.0, 1.0
    for _ in range(_BISECTIONS):
        middle = 0.5 * (outside + inside)
        direction = _interpolated(u, centre, middle)
        cell = cell_of(direction, limits.cell_rings)
        if direction != NO_LENGTH and limits.allowed[part, row, cell]:
            inside = middle
        else:
            outside = middle
    return _interpolated(u, centre, inside)


@numba.njit(**NO_ALLOCATION)
def _interpolated(a: Vector, b: Vector, fraction: float) -> Vector:
    """Return the normalised linear interpolation of two unit vectors."""
    return unit(
        (
            (1.0 - fraction) * a[0] + fraction * b[0],
            (1.0 - fraction) * a[1] + fraction * b[1],
            (1.0 - fraction) * a[2] + fraction * b[2],
        )
    )


@numba.njit(**NO_ALLOCATION)
def _check(part: int, joint: int, last: int, frame: Frame, condition: Vector, walk: Walk) -> Vector:
    """Check and correct a bone given its parent's direction; return its direction in ``frame``.

    A bone of length 0 is valid and gets its mean direction.
    """
    limits, correct, (_, directions, valid, local, checked, _) = walk
    direction = row_of(directions, joint)
    u = in_frame(frame, direction)
    if u != row_of(checked, joint) or condition != row_of(local[joint], 0):
        _set_row(checked, joint, u)
        _set_row(local[joint], 0, condition)
        valid[joint] = True
        if direction == NO_LENGTH:
            u = row_of(limits.rest, part)
        else:
            row = cell_of(condition, limits.bin_rings)
            valid[joint] = limits.allowed[part, row, cell_of(u, limits.cell_rings)]
            if correct and not valid[joint]:
                u = _nearest_allowed(u, part, row, limits)
        _set_row(local[joint], 1, u)
    u = row_of(local[joint], 1)
    if direction == NO_LENGTH or (correct and not valid[joint]):
        _rotate_bone(directions, joint, from_frame(frame, u), last)
    return u


@numba.njit(**NO_ALLOCATION)
def _walk_person(walk: Walk) -> None:
    """Check the 16 bones, parents first, correcting ``directions`` in place.

    ``local`` receives the directions of each parent and bone. Frames depend only on bones already
    corrected, and corrections do not change frames already used, so the result is valid.
    """
    limits, correct, (_, directions, valid, local, _, _) = walk
    pelvis = line_frame(
        row_of(directions, LEFT_HIP), row_of(directions, RIGHT_HIP), row_of(directions, SPINE)
    )
    spine = _check_spine(pelvis, walk)

    # In the pelvis frame the hips are mirror images: check one, correct both.
    hip = _check(HIP, LEFT_HIP, LEFT_HIP + 2, pelvis, _UP, walk)
    valid[RIGHT_HIP] = valid[LEFT_HIP]
    for i in range(2):
        _set_row(local[RIGHT_HIP], i, row_of(local[LEFT_HIP], i))
    if correct and not valid[LEFT_HIP]:
        _rotate_bone(directions, RIGHT_HIP, from_frame(pelvis, _mirrored(hip)), RIGHT_HIP + 2)
    for side in range(2):
        joint = LEFT_HIP if side == 0 else RIGHT_HIP
        _limb(KNEE, joint, _side_frame(pelvis, side), hip, walk)

    trunk = product(pelvis, least_rotation(_UP, spine))
    chest = _check(CHEST, CHEST_JOINT, LAST_OF_TRUNK, trunk, _UP, walk)
    below = product(trunk, least_rotation(row_of(limits.rest, CHEST), chest))
    for side in range(2):
        joint = LEFT_SHOULDER if side == 0 else RIGHT_SHOULDER
        condition = chest if side == 0 else _mirrored(chest)
        _check(SHOULDER, joint, joint + 2, _side_frame(below, side), condition, walk)

    # The line of the shoulders determines the twist of the trunk.
    trunk = line_frame(
        row_of(directions, LEFT_SHOULDER),
        row_of(directions, RIGHT_SHOULDER),
        row_of(directions, CHEST_JOINT),
    )
    neck = _check(NECK, NECK_JOINT, HEAD_JOINT, trunk, chest, walk)
    below = product(trunk, least_rotation(row_of(limits.rest, NECK), neck))
    _check(HEAD, HEAD_JOINT, HEAD_JOINT, below, neck, walk)
    for side in range(2):
        joint = LEFT_SHOULDER if side == 0 else RIGHT_SHOULDER
        sided = _side_frame(trunk, side)
        _limb(ELBOW, joint, sided, in_frame(sided, row_of(directions, joint)), walk)


@numba.njit(**NO_ALLOCATION)
def _check_spine(pelvis: Frame, walk: Walk) -> Vector:
    """Check the tilt of the spine in the left-up plane of the pelvis and return its direction."""
    limits, correct, (_, directions, valid, local, _, _) = walk
    if row_of(directions, SPINE) == NO_LENGTH:
        _set_row(directions, SPINE, pelvis[1])
    u = in_frame(pelvis, row_of(directions, SPINE))
    valid[SPINE] = abs(u[0]) <= limits.tilt
    if correct and not valid[SPINE]:
        # Stay slightly inside the limit despite rounding.
        tilt = np.copysign(limits.tilt * (1.0 - 1e-9), u[0])
        u = (tilt, np.sqrt(1.0 - tilt * tilt), 0.0)
        _rotate_bone(directions, SPINE, from_frame(pelvis, u), LAST_OF_TRUNK)
    _set_row(local[SPINE], 0, _UP)
    _set_row(local[SPINE], 1, u)
    return u


@numba.njit(**NO_ALLOCATION)
def _limb(part: int, joint: int, frame: Frame, condition: Vector, walk: Walk) -> None:
    """Check the two bones below ``joint``: thigh and shin, or upper arm and forearm."""
    first = _check(part, joint + 1, joint + 2, frame, condition, walk)
    below = product(frame, least_rotation(row_of(walk.limits.rest, part), first))
    _check(part + 1, joint + 2, joint + 2, below, first, walk)


@numba.njit(**NO_ALLOCATION)
def _directions(pose: np.ndarray, tree: np.ndarray, directions: np.ndarray) -> None:
    """Write the unit vector of each bone to ``directions``; 0 for bones of length 0."""
    for joint in range(1, N_JOINTS):
        bone = between(pose, tree[_PARENTS[joint]], tree[joint])
        _set_row(directions, joint, unit(bone))


@numba.njit(cache=True)
def project_poses(
    poses: np.ndarray, trees: np.ndarray, limits: LimitArrays
) -> tuple[np.ndarray, np.ndarray]:
    """Return a mask of joints with a valid bone, (n, J), and nearby valid poses, (n, J, 3).

    ``trees`` (K, 17) contains the joints of each person in the order of ``person17``.
    """
    nearest, valid = poses.copy(), np.ones(poses.shape[:2], dtype=np.bool_)
    bones = corrections(1)
    for pose in range(len(poses)):
        for tree in trees:
            check_person(poses[pose], 0, tree, limits, True, bones)
            for joint in range(1, N_JOINTS):
                valid[pose, tree[joint]] = bones.valid[0, joint]
                for i in range(3):
                    nearest[pose, tree[joint], i] += bones.shifts[0, joint, i]
    return valid, nearest


@numba.njit(**NO_ALLOCATION)
def check_person(
    pose: np.ndarray,
    person: int,
    tree: np.ndarray,
    limits: LimitArrays,
    correct: bool,
    bones: Corrections,
) -> None:
    """Write the bones of a person and the displacements to a nearby valid pose to ``bones``."""
    own = Corrections(
        bones.given[person],
        bones.directions[person],
        bones.valid[person],
        bones.local[person],
        bones.checked[person],
        bones.shifts[person],
    )
    given, directions, shifts = own.given, own.directions, own.shifts
    _directions(pose, tree, given)
    overwrite(directions, given)
    _walk_person(Walk(limits, correct, own))
    for joint in range(1, N_JOINTS):
        parent = _PARENTS[joint]
        length = length_of(between(pose, tree[parent], tree[joint]))
        # Only the change of direction counts, so that unchanged bones are not rounded.
        for i in range(3):
            rotated = length * (directions[joint, i] - given[joint, i])
            shifts[joint, i] = shifts[parent, i] + rotated


@numba.njit(cache=True)
def corrections(people: int) -> Corrections:
    """Return arrays for several people, (K, …), which :func:`check_person` overwrites."""
    vectors = np.zeros((4, people, N_JOINTS, 3))
    valid, local = np.ones((people, N_JOINTS), dtype=np.bool_), np.zeros((people, N_JOINTS, 2, 3))
    return Corrections(vectors[0], vectors[1], valid, local, vectors[2], vectors[3])


@numba.njit(cache=True)
def local_directions(poses: np.ndarray, limits: LimitArrays) -> np.ndarray:
    """Return the parent's and the bone's direction in each bone's frame, (n, 17, 2, 3)."""
    local, bones = np.empty((len(poses), N_JOINTS, 2, 3)), corrections(1)
    tree = np.arange(N_JOINTS)
    for pose in range(len(poses)):
        check_person(poses[pose], 0, tree, limits, False, bones)
        local[pose] = bones.local[0]
    return local
