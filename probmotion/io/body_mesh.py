"""Simple body surface of a skeleton: a tapered capsule around every bone, with skinning weights."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from probmotion.motion.rest_poses import is_four_legged
from probmotion.motion.skeleton import Skeleton
from probmotion.motion.t_pose import person_joints

__all__ = ["BodyMesh", "Part", "Texture", "body_mesh", "body_parts"]

_AROUND = 14  # vertices of a ring
_CAP, _TUBE = 3, 7  # rings of a cap and of the tube
_BLENDED = 0.25  # part of a bone at either end that moves with the neighbouring bone too
_BALL = 0.05  # metres; radius of a body without bones
_SHORT = 0.005  # metres; shorter bones have no surface
_LONG = 0.25  # of a person's height; a bone of this length to the neck is the whole trunk

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
# Parts beyond the last joint of a limb, by its canonical name: start and end relative to it (of the
# left side) along left, up and forward in the T-pose, and radii at both, metres.
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
# The same of a dog, and the ribs below its spine.
_DOG_RADII = {
    "tail": (0.05, 0.03), "trunk": (0.09, 0.085), "chest": (0.085, 0.085), "neck": (0.085, 0.075),
    "head": (0.075, 0.058), "nose": (0.065, 0.03), "eye": (0.02, 0.015),
    "shoulder": (0.06, 0.065), "elbow": (0.06, 0.036), "wrist": (0.034, 0.022),
    "front_paw": (0.03, 0.022), "hip": (0.075, 0.08), "knee": (0.085, 0.045),
    "ankle": (0.04, 0.024), "back_paw": (0.028, 0.022),
}  # fmt: skip
_DOG_ENDS = {
    "tail": ((0.0, 0.0, 0.0), (0.0, -0.18, -0.17), 0.026, 0.018),
    "head": ((0.0, -0.005, 0.03), (0.0, -0.05, 0.17), 0.062, 0.03),
    "front_paw": ((0.0, 0.0, 0.0), (0.0, -0.008, 0.045), 0.025, 0.023),
    "back_paw": ((0.0, 0.0, 0.0), (0.0, -0.008, 0.045), 0.025, 0.023),
    "chest": ((0.0, -0.05, 0.03), (0.0, -0.12, 0.33), 0.095, 0.12),
}


class _Build(NamedTuple):
    """Thickness of a body of a certain height; by canonical name of a bone's lower joint."""

    height: float  # metres from the lowest to the highest joint
    radii: Mapping[str, tuple[float, float]]
    flat: Mapping[str, tuple[float, float]]  # width and depth of the trunk, of its radius
    pelvis: float  # metres; radius of the capsule between the hips
    ends: Mapping[str, tuple[tuple[float, ...], tuple[float, ...], float, float]]


_PERSON = _Build(
    1.45,
    _RADII,
    dict.fromkeys(("trunk", "lower_spine", "spine", "chest", "neck"), (1.3, 0.85)),
    0.095,
    _ENDS,
)
_DOG = _Build(
    0.66, _DOG_RADII, dict.fromkeys(("trunk", "chest", "neck"), (0.9, 1.1)), 0.08, _DOG_ENDS
)


class _Figure(NamedTuple):
    """Joints of a person or animal by canonical name, its build, size and axes."""

    joints: dict[str, int]
    build: _Build
    size: float  # relative to that of the build
    axes: np.ndarray  # (3, 3), rows left, up and forward


class Texture(NamedTuple):
    """Image that is laid on N vertices: the reflectance of the surface."""

    image: np.ndarray  # (H, W, 3), red, green and blue, uint8, sRGB
    coordinates: np.ndarray  # (N, 2), right and down, 0 to 1 from edge to edge of the image


class BodyMesh(NamedTuple):
    """Triangles in the rest pose, and up to four joints that move each of the N vertices."""

    vertices: np.ndarray  # (N, 3), metres
    normals: np.ndarray  # (N, 3)
    triangles: np.ndarray  # (T, 3)
    joints: np.ndarray  # (N, 4), 0 where the weight is 0
    weights: np.ndarray  # (N, 4), sums 1
    texture: Texture | None = None


class Part(NamedTuple):
    """Capsule that moves with a joint, and at its ends partly with those before and after."""

    owner: int
    before: int  # -1 without
    after: int  # the lower joint of the bone, -1 if the capsule is not a bone
    start: np.ndarray
    end: np.ndarray
    radii: tuple[float, float]
    flat: tuple[float, float] = (1.0, 1.0)  # radii along the first two axes, of ``radii``

    @property
    def axes(self) -> np.ndarray:
        """Unit vectors across the capsule, the first close to x, and along it, (3, 3) rows."""
        axis = (self.end - self.start) / np.linalg.norm(self.end - self.start)
        side = np.eye(3)[0 if abs(axis[0]) < 0.8 else 2]
        side = side - axis * (side @ axis)
        side /= np.linalg.norm(side)
        return np.stack([side, np.cross(axis, side), axis])


def body_mesh(skeleton: Skeleton, rest: np.ndarray) -> BodyMesh:
    """Return the surface of a skeleton in its rest pose, given joint positions (J, 3) in metres."""
    parts = body_parts(skeleton, rest)
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


def body_parts(skeleton: Skeleton, rest: np.ndarray) -> list[Part]:
    """Return the capsules of a skeleton in its rest pose, given joint positions (J, 3) in metres.

    Every bone has a capsule. Those of people and four-legged animals have their usual thickness, as
    have pelvis, hands, feet, head, tail and ribs, where no bone represents them.
    """
    figures = [
        figure for root in skeleton.roots if (figure := _figure(skeleton, rest, root)) is not None
    ]
    parts = []
    for joint, parent in skeleton.bones:
        length = float(np.linalg.norm(rest[joint] - rest[parent]))
        if length < _SHORT:
            continue
        figure = next((one for one in figures if joint in one.joints.values()), None)
        radii, flat = _thickness(figure, joint, length)
        before = skeleton.parents[parent]
        parts.append(Part(parent, before, joint, rest[parent], rest[joint], radii, flat))
    for figure in figures:
        parts += _further_parts(skeleton, rest, figure)
    for root in skeleton.roots:
        if root not in {part.owner for part in parts} and root not in skeleton.parents:  # a ball
            top = rest[root] + [0.0, 1e-3, 0.0]
            parts.append(Part(root, -1, -1, rest[root], top, (_BALL, _BALL)))
    return parts


def _thickness(
    figure: _Figure | None, joint: int, length: float
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the radii of the bone above a joint at both ends, and its relative width and depth."""
    radius = float(np.clip(0.13 * length, 0.006, 0.05))
    if figure is None:
        return (radius, radius), (1.0, 1.0)
    part = next(_part(name) for name, at in figure.joints.items() if at == joint)
    part = "trunk" if part == "neck" and length > _LONG * figure.size else part
    first, last = figure.build.radii.get(part, (radius / figure.size, radius / figure.size))
    return (figure.size * first, figure.size * last), figure.build.flat.get(part, (1.0, 1.0))


def _figure(skeleton: Skeleton, rest: np.ndarray, root: int) -> _Figure | None:
    """Return the person or four-legged animal below a root, if it is one."""
    joints, build, axes = person_joints(skeleton, root), _PERSON, np.eye(3)
    if not joints:
        below = [root, *(j for j in range(skeleton.n_joints) if root in skeleton.ancestors(j))]
        body = skeleton.subset(below)
        joints, build = dict(zip(body.canonical_names, below, strict=True)), _DOG
        girdles = [f"{side}_{part}" for part in ("hip", "shoulder") for side in ("left", "right")]
        if not is_four_legged(body) or not set(girdles) <= set(joints):
            return None
        hips, shoulders = rest[[joints[name] for name in girdles]].reshape(2, 2, 3)
        left = hips[0] + shoulders[0] - hips[1] - shoulders[1]
        up = np.cross(shoulders.sum(axis=0) - hips.sum(axis=0), left)
        if not up.any():  # flat
            return None
        axes = np.stack([_unit(left), _unit(up), _unit(np.cross(left, up))])
    height = float(np.ptp(rest[list(joints.values()), 1]))
    return _Figure(joints, build, height / build.height, axes)


def _further_parts(skeleton: Skeleton, rest: np.ndarray, figure: _Figure) -> list[Part]:
    """Return pelvis, hands, feet, head, tail and ribs, where no bone represents them."""
    joints, build, size, axes = figure
    left, right = (rest[joints[f"{side}_hip"]] for side in ("left", "right"))
    hips = (0.8 * left + 0.2 * right, 0.2 * left + 0.8 * right)
    above = set(skeleton.ancestors(joints["right_hip"]))
    owner = next(joint for joint in skeleton.ancestors(joints["left_hip"]) if joint in above)
    parts = [Part(owner, -1, -1, *hips, (size * build.pelvis, size * build.pelvis))]
    for name, joint in joints.items():
        part, last = _part(name), joint not in skeleton.parents
        # Ribs hang from a chest with joints above, other parts from the last joint of a limb.
        extra = [build.ends[part]] if part in build.ends and last != (part == "chest") else []
        if build is _PERSON and name == "neck" and not _HEADS & set(joints):
            extra += _NECK
        mirror = np.array([-1.0 if name.startswith("right_") else 1.0, 1.0, 1.0])
        for start, end, first, second in extra:
            if part == "wrist":  # a hand continues its forearm
                along = _unit(rest[joint] - rest[skeleton.parents[joint]])
                ends = [rest[joint] + size * at[0] * along for at in (start, end)]
            else:
                ends = [rest[joint] + size * mirror * np.array(at) @ axes for at in (start, end)]
            parts.append(Part(joint, -1, -1, ends[0], ends[1], (size * first, size * second)))
    return parts


def _part(name: str) -> str:
    return name.removeprefix("left_").removeprefix("right_")


def _unit(vector: np.ndarray) -> np.ndarray:
    return np.asarray(vector / np.linalg.norm(vector))


def _capsule(part: Part) -> np.ndarray:
    """Return the vertices of a capsule: its first pole, rings along the axis, its last pole."""
    length = np.linalg.norm(part.end - part.start)
    side, other, axis = part.axes
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


def _weights(part: Part, points: np.ndarray) -> np.ndarray:
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
