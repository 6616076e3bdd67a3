"""Simple body surface of a skeleton: a tapered capsule around every bone, with skinning weights."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from probmotion.motion.skeleton import Skeleton
from probmotion.motion.t_pose import person_joints

__all__ = ["BodyMesh", "body_mesh"]

_AROUND = 14  # vertices of a ring
_CAP, _TUBE = 3, 7  # rings of a cap and of the tube
_BLENDED = 0.25  # part of a bone at either end that moves with the neighbouring bone too
_HEIGHT = 1.45  # metres from the lowest to the highest joint of the radii below
_BALL = 0.05  # metres; radius of a body without bones
_SHORT = 0.005  # metres; shorter bones have no surface
_TRUNK = (1.3, 0.85)  # width and depth of the trunk, of its radius
_LONG = 0.25  # metres; a bone of this length to the neck is the whole trunk

# Radii at both ends of a person's bone in metres, by the canonical name of its lower joint.
_RADII = {
    "hip_joint": (0.09, 0.09), "hip": (0.09, 0.085), "knee": (0.085, 0.058),
    "ankle": (0.058, 0.04), "heel": (0.035, 0.035), "foot": (0.042, 0.04), "toe": (0.04, 0.028),
    "big_toe": (0.042, 0.028), "small_toe": (0.04, 0.025), "collar": (0.07, 0.07),
    "shoulder": (0.07, 0.058), "elbow": (0.055, 0.042), "wrist": (0.042, 0.03),
    "palm": (0.032, 0.03), "hand": (0.032, 0.03), "fingers": (0.03, 0.024),
    "finger_tips": (0.022, 0.015), "thumb": (0.016, 0.014), "thumb_tip": (0.014, 0.01),
    "lower_spine": (0.11, 0.115), "spine": (0.115, 0.12), "chest": (0.12, 0.125),
    "neck": (0.115, 0.075), "lower_neck": (0.1, 0.06), "upper_neck": (0.06, 0.055),
    "trunk": (0.12, 0.105), "head": (0.06, 0.08), "head_top": (0.095, 0.08), "nose": (0.05, 0.03),
    "eye": (0.015, 0.012), "ear": (0.015, 0.012),
}  # fmt: skip
_FLAT = frozenset(("trunk", "lower_spine", "spine", "chest", "neck"))
_PELVIS = 0.095  # metres; radius of the capsule between the hips
# Parts below the last joint of a limb, by its canonical name: start and end relative to it in the
# T-pose (of the left side), and radii at both, metres.
_ENDS = {
    "wrist": ((0.02, 0.0, 0.0), (0.13, 0.0, 0.0), 0.032, 0.022),
    "ankle": ((0.0, -0.03, -0.02), (0.0, -0.045, 0.14), 0.042, 0.032),
    "head": ((0.0, 0.03, 0.01), (0.0, 0.1, 0.01), 0.09, 0.085),
}
_NECK = (
    ((0.0, 0.0, 0.0), (0.0, 0.09, 0.01), 0.055, 0.05),
    ((0.0, 0.15, 0.03), (0.0, 0.21, 0.03), 0.09, 0.085),
)
_HEADS = frozenset(("head", "head_top", "nose", "upper_neck"))


class BodyMesh(NamedTuple):
    """Triangles in the rest pose, and up to four joints that move each of the N vertices."""

    vertices: np.ndarray  # (N, 3), metres
    normals: np.ndarray  # (N, 3)
    triangles: np.ndarray  # (T, 3)
    joints: np.ndarray  # (N, 4), 0 where the weight is 0
    weights: np.ndarray  # (N, 4), sums 1


class _Part(NamedTuple):
    """Capsule that moves with a joint, and at its ends partly with those before and after."""

    owner: int
    before: int
    after: int
    start: np.ndarray
    end: np.ndarray
    radii: tuple[float, float]
    flat: tuple[float, float] = (1.0, 1.0)


def body_mesh(skeleton: Skeleton, rest: np.ndarray) -> BodyMesh:
    """Return the surface of a skeleton in its rest pose, given joint positions (J, 3) in metres."""
    parts = _parts(skeleton, rest)
    vertices, triangles, joints, weights, count = [], [], [], [], 0
    ring = _triangles()
    for part in parts:
        points = _capsule(part)
        vertices.append(points)
        triangles.append(ring + count)
        count += len(points)
        influences = _weights(part, points)
        joints.append(np.where(influences > 0, [part.owner, part.before, part.after, 0], 0))
        weights.append(influences)
    points, faces = np.concatenate(vertices), np.concatenate(triangles)
    return BodyMesh(
        points, _normals(points, faces), faces, np.concatenate(joints), np.concatenate(weights)
    )


def _parts(skeleton: Skeleton, rest: np.ndarray) -> list[_Part]:
    people = [person_joints(skeleton, root) for root in skeleton.roots]
    parts = []
    for joint, parent in skeleton.bones:
        length = float(np.linalg.norm(rest[joint] - rest[parent]))
        if length < _SHORT:
            continue
        person = next((names for names in people if joint in names.values()), {})
        part = next((_part(name) for name, at in person.items() if at == joint), "")
        part = "trunk" if part == "neck" and length > _LONG * _size(rest, person) else part
        radius = float(np.clip(0.13 * length, 0.006, 0.05))
        radii = _scaled(_RADII.get(part), _size(rest, person)) or (radius, radius)
        flat = _TRUNK if part in _FLAT else (1.0, 1.0)
        before = skeleton.parents[parent]
        parts.append(_Part(parent, before, joint, rest[parent], rest[joint], radii, flat))
    for person in people:
        parts += _further_parts(skeleton, rest, person)
    for root in skeleton.roots:
        if root not in {part.owner for part in parts} and root not in skeleton.parents:  # a ball
            top = rest[root] + [0.0, 1e-3, 0.0]
            parts.append(_Part(root, -1, -1, rest[root], top, (_BALL, _BALL)))
    return parts


def _further_parts(skeleton: Skeleton, rest: np.ndarray, person: dict[str, int]) -> list[_Part]:
    """Return pelvis, hands, feet and head of a person, where no bone represents them."""
    if not person:
        return []
    size = _size(rest, person)
    left, right = (rest[person[f"{side}_hip"]] for side in ("left", "right"))
    hips = (0.8 * left + 0.2 * right, 0.2 * left + 0.8 * right)
    above = set(skeleton.ancestors(person["right_hip"]))
    owner = next(joint for joint in skeleton.ancestors(person["left_hip"]) if joint in above)
    parts = [_Part(owner, -1, -1, *hips, (size * _PELVIS, size * _PELVIS))]
    for name, joint in person.items():
        extra = (
            [_ENDS[_part(name)]] if _part(name) in _ENDS and joint not in skeleton.parents else []
        )
        if name == "neck" and not _HEADS & set(person):
            extra += _NECK
        mirror = np.array([-1.0 if name.startswith("right_") else 1.0, 1.0, 1.0])
        for start, end, first, last in extra:
            ends = [rest[joint] + size * mirror * np.array(at) for at in (start, end)]
            parts.append(_Part(joint, -1, -1, ends[0], ends[1], (size * first, size * last)))
    return parts


def _part(name: str) -> str:
    return name.removeprefix("left_").removeprefix("right_")


def _size(rest: np.ndarray, person: dict[str, int]) -> float:
    """Return the height of a person relative to that of the radii."""
    return float(np.ptp(rest[list(person.values()), 1])) / _HEIGHT if person else 1.0


def _scaled(radii: tuple[float, float] | None, size: float) -> tuple[float, float] | None:
    return None if radii is None else (size * radii[0], size * radii[1])


def _capsule(part: _Part) -> np.ndarray:
    """Return the vertices of a capsule: its first pole, rings along the axis, its last pole."""
    length = np.linalg.norm(part.end - part.start)
    axis = (part.end - part.start) / length
    # The width of the trunk is along x.
    side = np.eye(3)[0 if abs(axis[0]) < 0.8 else 2]
    side = side - axis * (side @ axis)
    side /= np.linalg.norm(side)
    other = np.cross(axis, side)
    first, last = part.radii
    tilt = np.linspace(0.0, np.pi / 2, _CAP + 2)[1:-1]
    along = np.concatenate(
        [-first * np.cos(tilt), np.linspace(0.0, length, _TUBE), length + last * np.sin(tilt)]
    )
    radius = np.concatenate(
        [first * np.sin(tilt), np.linspace(first, last, _TUBE), last * np.cos(tilt)]
    )
    turn = np.linspace(0.0, 2 * np.pi, _AROUND, endpoint=False)
    circle = (
        part.flat[0] * np.cos(turn)[:, None] * side + part.flat[1] * np.sin(turn)[:, None] * other
    )
    rings = along[:, None, None] * axis + radius[:, None, None] * circle
    poles = np.array([[-first], [length + last]]) * axis
    points = np.concatenate([poles[:1], rings.reshape(-1, 3), poles[1:]])
    return np.asarray(part.start + points)


def _triangles() -> np.ndarray:
    """Return the triangles of a capsule, counterclockwise from outside."""
    rings = 2 * _CAP + _TUBE
    at = 1 + np.arange(rings * _AROUND).reshape(rings, _AROUND)
    step = np.roll(at, -1, axis=1)
    a, b, c, d = at[:-1], step[:-1], step[1:], at[1:]
    last = np.full(_AROUND, rings * _AROUND + 1)
    faces = [
        np.stack([np.zeros(_AROUND, dtype=int), step[0], at[0]], axis=-1),
        np.stack([a, b, d], axis=-1).reshape(-1, 3),
        np.stack([b, c, d], axis=-1).reshape(-1, 3),
        np.stack([at[-1], step[-1], last], axis=-1),
    ]
    return np.concatenate(faces)


def _weights(part: _Part, points: np.ndarray) -> np.ndarray:
    """Return the weights (N, 4) of owner, joint before, joint after and none."""
    bone = part.end - part.start
    along = np.clip((points - part.start) @ bone / (bone @ bone), 0.0, 1.0)
    near = np.clip(1 - np.stack([along, 1 - along], axis=-1) / _BLENDED, 0.0, 1.0)
    shared = 0.5 * near**2 * (3 - 2 * near) * [part.before >= 0, part.after >= 0]
    shared = np.where(shared > 1e-3, shared, 0.0)
    owner = 1 - shared.sum(axis=-1, keepdims=True)
    return np.concatenate([owner, shared, np.zeros_like(owner)], axis=-1)


def _normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return unit normals of vertices, means of those of their triangles weighted by area."""
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    faces = np.cross(b - a, c - a)
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, triangles[:, corner], faces)
    return np.asarray(normals / np.linalg.norm(normals, axis=-1, keepdims=True))
