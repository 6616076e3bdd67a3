"""Inverse kinematics: rigid bones and joint rotations with twist from joint positions."""

from __future__ import annotations

import warnings
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from probmotion.motion._bone_fits import (
    Distances,
    fade,
    nearest_rigid,
    stance_targets,
    twisted,
)
from probmotion.motion.kinematics import (
    best_rotations,
    forward_kinematics,
    mean_shape,
)
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton
from probmotion.motion.t_pose import person_joints, t_pose_directions

__all__ = ["rigid_motion"]

_EXACT = 1e-6  # metres; larger than the rounding of positions in float32 files
_SHORT = 1e-6  # metres; shorter bones have no direction
_LOOSE = 0.01  # metres; children that move further against their siblings get their own joint
_CERTAIN = 2.0  # size of children across their line, of their worst error, that defines a rotation
_MOST = 0.05  # metres; displacement of 5 % of the positions that causes a warning
_BENT = (0.15, 0.4)  # sine of the angle of a limb: straight, and bent enough to show its plane
_CLEAR = 0.3  # distance of a child from the line, of its length, that shows the twist
_FRAMES = 300  # number of frames from which the rest pose is estimated


def rigid_motion(motion: Motion) -> Motion:
    """Return the motion of rigid bones closest to joint positions, with rotations.

    Bones have their median length. Each joint has one rotation relative to its parent: its swing
    aligns the bone below; its twist about the bone follows from the joint's children (Kabsch 1976)
    or, for upper arms and thighs, from the plane of the bent elbow or knee. Elsewhere the twist is
    minimal. Twists are smooth over time. The rest pose of people is a T-pose; of other bodies, the
    first frame with mean angles between siblings.

    A child that moves by more than 1 cm against its siblings, such as the neck relative to the hips
    of ``person14``, is given a joint of its own at the position of its parent
    (``pelvis_to_neck``). Positions of feet that touch the floor, at low speed close to their lowest
    level, are moved to within 1 cm of that level, unless all bones are rigid already.

    Parameters
    ----------
    motion : Motion
        Motion with J joints. If its rotations reproduce its positions to 1e-6 m, it is returned
        unchanged.

    Returns
    -------
    Motion
        Motion with rotations and rest offsets that reproduce its positions. The first J joints are
        those of ``motion``.

    Warns
    -----
    UserWarning
        If more than 5 % of the positions are displaced by more than 5 cm.
    """
    skeleton, positions = motion.skeleton, motion.positions
    roots = list(skeleton.roots)
    if motion.rotations is not None and motion.rest_offsets is not None:
        again, _ = forward_kinematics(
            skeleton, motion.rotations, positions[:, roots], motion.rest_offsets
        )
        if np.abs(again - positions).max() <= _EXACT:
            return motion
    lengths = np.zeros(skeleton.n_joints)
    for joint, parent in skeleton.bones:
        bone = positions[:, joint] - positions[:, parent]
        lengths[joint] = np.median(np.linalg.norm(bone, axis=-1))
    hubs, loose = _hubs(positions, skeleton, lengths)
    distances = _distances(skeleton, lengths, hubs, loose)
    rigid = positions
    if np.abs(distances.deviations(positions)).max(initial=0.0) > _EXACT:
        targets, weights = stance_targets(positions, skeleton, motion.fps)
        rigid = nearest_rigid(targets, distances, weights)
    some = slice(None, None, -(-motion.frames // _FRAMES))
    offsets = _rest_offsets(rigid[some], skeleton, lengths, hubs)
    rig, hubs, offsets = _with_own_joints(skeleton, hubs, offsets, loose)
    rotations = _rotations(rigid, rig, hubs, offsets, motion.fps)
    fitted, _ = forward_kinematics(rig, rotations, rigid[:, roots], offsets)
    errors = np.linalg.norm(fitted[:, : skeleton.n_joints] - positions, axis=-1)
    middle, high = np.quantile(errors, (0.5, 0.95))
    if high > _MOST:
        warnings.warn(
            f"rigid bones are {100 * middle:.2g} cm from the joints in the median and "
            f"{100 * high:.2g} cm at the 95 % point; save as .npz to keep the positions",
            stacklevel=2,
        )
    return replace(
        motion, positions=fitted, skeleton=rig, rotations=rotations, rest_offsets=offsets
    )


class _Hub(NamedTuple):
    """Joints below a joint, through joints at its own position: those that move rigidly, and all.

    ``shape`` (k, 3) is the mean arrangement of the k rigid ones, metres; if it is ``wide``, it
    determines the rotation of the joint.
    """

    core: tuple[int, ...]
    below: tuple[int, ...]
    shape: np.ndarray
    wide: bool


def _hubs(
    positions: np.ndarray, skeleton: Skeleton, lengths: np.ndarray
) -> tuple[dict[int, _Hub], list[int]]:
    """Return the hubs by joint, and the joints that move against their siblings."""
    hubs, loose = {}, []
    for joint in range(skeleton.n_joints):
        below = _below(skeleton, lengths, joint)
        if not below:
            continue
        # Pairs of left and right, such as hips, define the rotation of their parent.
        paired = {j for pair in skeleton.mirrored_pairs if {*pair} <= {*below} for j in pair}
        core = list(below)
        while True:
            bones = positions[:, core] - positions[:, joint, None]
            shape = _of_lengths(mean_shape(bones), lengths[core])
            rest = np.broadcast_to(np.eye(3), (len(bones), 3, 3))
            turned = np.einsum("lij,cj->lci", best_rotations(shape, bones, rest), shape)
            bones = _of_lengths(bones, lengths[core])
            distances = np.linalg.norm(turned - bones, axis=-1)
            errors = np.quantile(distances, 0.95, axis=0)
            moving = [at for at, j in enumerate(core) if j not in paired and errors[at] > _LOOSE]
            if not moving or len(core) == 1:
                break
            # Of two, the one with fewer joints below, such as the thumb of a hand.
            sizes = [
                -_descendants(skeleton, core[at]) if len(core) == 2 else errors[at] for at in moving
            ]
            core.pop(moving[int(np.argmax(sizes))])
        across = np.linalg.svd(shape, compute_uv=False)[1:2].sum()
        wide = across > _CERTAIN * distances.max() + _SHORT
        hubs[joint] = _Hub(tuple(core), tuple(below), shape, bool(wide))
        rigid = {j for j, error in zip(core, errors, strict=True) if error <= _LOOSE}
        loose += [j for j in below if skeleton.parents[j] == joint and j not in rigid]
    return hubs, loose


def _descendants(skeleton: Skeleton, joint: int) -> int:
    return sum(joint in skeleton.ancestors(other) for other in range(skeleton.n_joints))


def _below(skeleton: Skeleton, lengths: np.ndarray, joint: int) -> list[int]:
    """Return the nearest joints below a joint that are not at its own position."""
    found = []
    for child, parent in skeleton.bones:
        if parent == joint:
            own = lengths[child] > _SHORT
            found += [child] if own else _below(skeleton, lengths, child)
    return found


def _distances(
    skeleton: Skeleton,
    lengths: np.ndarray,
    hubs: dict[int, _Hub],
    loose: list[int],
) -> Distances:
    """Return the lengths of bones, and the distances between siblings that move rigidly."""
    pairs = [(j, parent, lengths[j]) for j, parent in skeleton.bones if lengths[j] > _SHORT]
    for joint, hub in hubs.items():
        rigid = [
            (j, hub.shape[at])
            for at, j in enumerate(hub.core)
            if skeleton.parents[j] == joint and j not in loose
        ]
        for (a, first), (b, second) in combinations(rigid, 2):
            pairs.append((a, b, float(np.linalg.norm(first - second))))
    columns = [np.array([pair[at] for pair in pairs]) for at in range(3)]
    return Distances(columns[0].astype(int), columns[1].astype(int), columns[2].astype(float))


def _rest_offsets(
    positions: np.ndarray, skeleton: Skeleton, lengths: np.ndarray, hubs: dict[int, _Hub]
) -> np.ndarray:
    """Return the rest pose: a T-pose for people, otherwise close to the first frame, (J, 3)."""
    people = [person_joints(skeleton, root) for root in skeleton.roots]
    offsets = np.zeros((skeleton.n_joints, 3))
    for joint, hub in hubs.items():
        person = next((names for names in people if joint in names.values()), None)
        bones = [(j, joint) for j in hub.below]
        if person is None:
            wanted = positions[0, list(hub.below)] - positions[0, joint]
        else:
            wanted = t_pose_directions(positions, skeleton, person, bones)
        wanted = _of_lengths(wanted, lengths[list(hub.below)])
        offsets[list(hub.below)] = wanted
        if len(hub.core) > 1:
            core = [hub.below.index(j) for j in hub.core]
            turn = best_rotations(hub.shape, wanted[None, core], np.eye(3)[None])[0]
            offsets[list(hub.core)] = hub.shape @ turn.T
    return offsets


def _with_own_joints(
    skeleton: Skeleton, hubs: dict[int, _Hub], offsets: np.ndarray, loose: list[int]
) -> tuple[Skeleton, dict[int, _Hub], np.ndarray]:
    """Return skeleton, hubs and rest pose with a joint inserted above each loose one."""
    names, parents = list(skeleton.joint_names), list(skeleton.parents)
    hubs = dict(hubs)
    for joint in loose:
        parent = skeleton.parents[joint]
        bare = skeleton.joint_names[joint].rpartition(":")[2]
        name = f"{skeleton.joint_names[parent]}_to_{bare}"
        while name in names:
            name += "_"
        parents[joint] = len(names)
        hubs[len(names)] = _Hub((joint,), (joint,), offsets[joint, None], wide=False)
        names.append(name)
        parents.append(parent)
    radii = (
        None if skeleton.radii is None else [*skeleton.radii, *(skeleton.radii[j] for j in loose)]
    )
    offsets = np.concatenate([offsets, np.zeros((len(loose), 3))])
    return Skeleton(names, parents, radii), hubs, offsets


def _rotations(
    positions: np.ndarray,
    rig: Skeleton,
    hubs: dict[int, _Hub],
    offsets: np.ndarray,
    fps: float,
) -> np.ndarray:
    """Return local rotations (L, J, 3, 3); each bone starts at the fitted end of its parent."""
    frames = len(positions)
    hinges = _hinges(rig)
    identity = np.broadcast_to(np.eye(3), (frames, 3, 3))
    rotations = np.tile(np.eye(3), (frames, rig.n_joints, 1, 1))
    world, fitted = rotations.copy(), np.zeros((frames, rig.n_joints, 3))
    for joint in rig.topological_order:
        parent = rig.parents[joint]
        above = identity if parent < 0 else world[:, parent]
        if parent < 0:
            fitted[:, joint] = positions[:, joint]
        else:
            fitted[:, joint] = fitted[:, parent] + above @ offsets[joint]
        if joint in hubs:
            hub, rest = hubs[joint], offsets[list(hubs[joint].core)]
            # In the parent's frame, in which the rest pose is not rotated.
            bones = (positions[:, list(hub.below)] - fitted[:, joint, None]) @ above
            core = bones[:, [hub.below.index(j) for j in hub.core]]
            if hub.wide:
                rotations[:, joint] = best_rotations(rest, core, identity)
            else:
                axis = np.linalg.svd(rest)[2][0]
                axis = axis * (1.0 if axis @ rest[0] > 0 else -1.0)
                direction = _of_lengths(np.einsum("k,lki->li", rest @ axis, core), np.ones(1))
                if joint in hinges:
                    middle, end, normal = hinges[joint]
                    lower = (positions[:, end] - positions[:, middle])[:, None] @ above
                    clue = _bend(direction, lower[:, 0], normal)
                else:
                    clue = _sibling(axis, direction, offsets[list(hub.below)], bones)
                rotations[:, joint] = twisted(axis, direction, *clue, fps)
        world[:, joint] = above @ rotations[:, joint]
    return rotations


def _hinges(rig: Skeleton) -> dict[int, tuple[int, int, np.ndarray]]:
    """Return hinge, end of the limb and hinge axis in the T-pose by the joint above the hinge."""
    hinges = {}
    for root in rig.roots:
        names = person_joints(rig, root)
        for side, sign in (("left", 1.0), ("right", -1.0)):
            for middle, end, axis in (
                ("elbow", "wrist", (0.0, -sign, 0.0)),
                ("knee", "ankle", (1.0, 0.0, 0.0)),
            ):
                limb = names.get(f"{side}_{middle}"), names.get(f"{side}_{end}")
                if limb[0] is not None and limb[1] is not None:
                    hinges[rig.parents[limb[0]]] = (limb[0], limb[1], np.array(axis))
    return hinges


def _bend(
    direction: np.ndarray, lower: np.ndarray, normal: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the hinge axis of a limb, its weight, 0 for straight limbs, and its rest vector."""
    observed = np.cross(direction, lower)
    sines = np.linalg.norm(observed, axis=-1) / np.maximum(np.linalg.norm(lower, axis=-1), _SHORT)
    return observed, fade(sines, *_BENT), normal


def _sibling(
    axis: np.ndarray, direction: np.ndarray, rest: np.ndarray, bones: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the vectors to the child farthest from the axis, their weights and the rest vector."""
    across = np.linalg.norm(np.cross(rest, axis), axis=-1)
    child = int(across.argmax())
    size = max(float(np.linalg.norm(rest, axis=-1).max()), _SHORT)
    sines = np.linalg.norm(np.cross(bones[:, child], direction), axis=-1) / size
    weight = min(across[child] / size / _CLEAR, 1.0) ** 2
    return bones[:, child], weight * fade(sines, 0.0, _CLEAR), rest[child]


def _of_lengths(vectors: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Return vectors (…, k, 3) scaled to lengths (k,); zero vectors point upwards."""
    sizes = np.linalg.norm(vectors, axis=-1, keepdims=True)
    units = np.where(sizes > 0, vectors / np.where(sizes > 0, sizes, 1.0), [0.0, 1.0, 0.0])
    return units * lengths[:, None]
