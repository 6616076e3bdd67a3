"""Motion on SMPL's 22 body joints, with rotations, from the joints of ``person14``."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from probmotion.motion.inverse_kinematics import rigid_motion
from probmotion.motion.kinematics import best_rotations, forward_kinematics
from probmotion.motion.motion import Motion
from probmotion.motion.retargeting import counterpart
from probmotion.motion.skeleton import Skeleton

__all__ = ["smpl_motion"]

_SMPL, _PERSON = Skeleton.preset("smpl22"), Skeleton.preset("person14")
_SPINE = (0.25, 0.5, 0.625)  # of the way from pelvis to neck
_HEAD = 0.2  # height of the head's joint above the neck, of the trunk's length
_FOOT = 1 / 3  # distance from ankle to ball of the foot, of the shin's length
_SOLE = np.array([0.0, -0.4, 0.9]) / np.hypot(0.4, 0.9)  # its direction in the T-pose
# Joints that have the rotations of person14; and joints whose children are fitted to others.
_SIDES = ("left", "right")
_OBSERVED = (
    "pelvis",
    *(f"{side}_{part}" for side in _SIDES for part in ("shoulder", "elbow", "hip", "knee")),
)
_LIMBS = {"elbow": "shoulder", "wrist": "elbow", "knee": "hip", "ankle": "knee"}
_FITTED = {
    "spine1": ("neck", "left_shoulder", "right_shoulder"),
    "left_collar": ("left_shoulder",),
    "right_collar": ("right_shoulder",),
}


def smpl_motion(motion: Motion) -> Motion:
    """Return a person's motion on ``smpl22``, with rotations relative to a T-pose.

    The rest pose has Y up, its face towards +Z and its left side at +X, as SMPL's; its bones have
    the person's lengths. Pelvis, arms and legs have the rotations of
    :func:`~probmotion.motion.inverse_kinematics.rigid_motion` on ``person14``. These joints do not
    show how the spine bends, the head nods or the feet turn. Therefore:

    - ``spine1``, ``spine2`` and ``spine3`` are 25, 50 and 62.5 % of the way from pelvis to neck in
      the rest pose. The trunk is one rigid piece above ``spine1``, which has the rotation that
      best fits neck and shoulders.
    - Collars are midway between neck and shoulder in the rest pose, and point to the shoulder.
    - Neck, head, ankles, feet and wrists have no rotation. The ball of the foot is at a third of
      the shin's length from the ankle.

    Parameters
    ----------
    motion : Motion
        Motion with the joints of ``person14``; others are not used. If it has all 22 joints, it is
        retargeted to them by name instead.

    Returns
    -------
    Motion
        Positions are forward kinematics of the rotations, so that those of ``person14`` differ
        slightly from the given ones.

    Raises
    ------
    ValueError
        If a joint of ``person14`` has no counterpart.
    """
    names = zip(_SMPL.joint_names, _SMPL.canonical_names, strict=True)
    if all(counterpart(motion.skeleton, *name) is not None for name in names):
        return motion.retarget(_SMPL)
    person = replace(motion.retarget(_PERSON), rotations=None, rest_offsets=None)
    rigid = rigid_motion(person)
    assert rigid.rotations is not None
    assert rigid.rest_offsets is not None
    root = rigid.positions[:, :1]
    joints, given = forward_kinematics(rigid.skeleton, rigid.rotations, root, rigid.rest_offsets)
    rest = _rest_pose(rigid.rest_offsets)
    offsets = np.zeros_like(rest)
    positions = np.repeat(root, _SMPL.n_joints, axis=1)
    world = np.zeros((motion.frames, _SMPL.n_joints, 3, 3))
    for joint in _SMPL.topological_order:
        name, parent = _SMPL.joint_names[joint], _SMPL.parents[joint]
        above = world[:, parent]
        if parent >= 0:
            offsets[joint] = rest[joint] - rest[parent]
            positions[:, joint] = positions[:, parent] + above @ offsets[joint]
        if name in _OBSERVED:
            world[:, joint] = given[:, _PERSON.index(name)]
        elif name in _FITTED:
            ends = _FITTED[name]
            bones = joints[:, [_PERSON.index(end) for end in ends]] - positions[:, joint, None]
            vectors = rest[[_SMPL.index(end) for end in ends]] - rest[joint]
            world[:, joint] = best_rotations(vectors, bones, above)
        else:
            world[:, joint] = above
    above = world[:, list(_SMPL.parents)]
    above[:, _SMPL.roots[0]] = np.eye(3)
    rotations = np.swapaxes(above, -1, -2) @ world
    return replace(
        motion, positions=positions, skeleton=_SMPL, rotations=rotations, rest_offsets=offsets
    )


def _rest_pose(offsets: np.ndarray) -> np.ndarray:
    """Return the T-pose (22, 3), pelvis at 0, from the offsets of ``person14`` and other joints."""
    own = dict(zip(_PERSON.joint_names, offsets, strict=False))
    trunk = own["neck"]
    height, shin = (float(np.linalg.norm(own[name])) for name in ("neck", "left_ankle"))
    place = {f"spine{number}": part * trunk for number, part in enumerate(_SPINE, start=1)}
    place |= {"pelvis": np.zeros(3), "neck": trunk}
    place["head"] = trunk + np.array([0.0, _HEAD * height, 0.0])
    for side in _SIDES:
        place[f"{side}_collar"] = trunk + own[f"{side}_shoulder"] / 2
        place[f"{side}_shoulder"] = trunk + own[f"{side}_shoulder"]
        place[f"{side}_hip"] = own[f"{side}_hip"]
        for part, parent in _LIMBS.items():
            place[f"{side}_{part}"] = place[f"{side}_{parent}"] + own[f"{side}_{part}"]
        place[f"{side}_foot"] = place[f"{side}_ankle"] + _FOOT * shin * _SOLE
    return np.stack([place[name] for name in _SMPL.joint_names])
