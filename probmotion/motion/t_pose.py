"""Directions of a person's bones in the T-pose: +Y up, face towards +Z, left side at +X."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from probmotion.motion.rest_poses import is_four_legged
from probmotion.motion.skeleton import Skeleton

__all__ = ["FEET", "person_joints", "t_pose_directions"]

FEET = ("ankle", "heel", "foot", "toe", "big_toe", "small_toe", "front_paw", "back_paw")
"""Canonical names of joints close to the floor, without their side."""

_SOLE = (0.0, -0.35, 1.0)  # from the ankle to the ball of the foot
_HEEL = (0.0, -1.0, -0.6)
_THUMB = (1.0, 0.0, 1.0)  # of the left hand


def person_joints(skeleton: Skeleton, root: int) -> dict[str, int]:
    """Return joint indices by canonical name of the person below ``root``; empty if it is none.

    A person has two hips and two shoulders, and neither tail nor paws.
    """
    joints = [root, *(j for j in range(skeleton.n_joints) if root in skeleton.ancestors(j))]
    body = skeleton.subset(joints)
    names = dict(zip(body.canonical_names, joints, strict=True))
    sides = {f"{side}_{part}" for side in ("left", "right") for part in ("hip", "shoulder")}
    return {} if is_four_legged(body) or not sides <= set(names) else names


def t_pose_directions(
    positions: np.ndarray,
    skeleton: Skeleton,
    names: dict[str, int],
    bones: Sequence[tuple[int, int]],
) -> np.ndarray:
    """Return the vectors of bones in the T-pose, of any length.

    Limbs are straight. Bones of the trunk and head have their mean direction in the frame of the
    hips, if they lead to a hip, or of the shoulders, so that the trunk is upright. Left and right
    are symmetric.

    Parameters
    ----------
    positions : ndarray, (L, J, 3)
        Positions of the person's joints, metres.
    skeleton : Skeleton
        J joints.
    names : dict
        Result of :func:`person_joints`.
    bones : sequence of (int, int)
        Pairs (joint, ancestor); B bones.

    Returns
    -------
    ndarray, (B, 3)
        Vector from ancestor to joint.
    """
    canonical = {joint: name for name, joint in names.items()}
    hips, shoulders = (
        [positions[:, names[f"{side}_{part}"]] for side in ("left", "right")]
        for part in ("hip", "shoulder")
    )
    up = shoulders[0] + shoulders[1] - hips[0] - hips[1]
    pelvis, chest = (_frames(left - right, up) for left, right in (hips, shoulders))
    result = np.zeros((len(bones), 3))
    mirror = skeleton.mirrored_order
    for at, bone in enumerate(bones):
        joint, ancestor = bone
        name = canonical[joint]
        above = [canonical.get(a, "") for a in skeleton.ancestors(joint)]
        limb = next((n for n in above if n.endswith(("_hip", "_shoulder"))), "")
        sign = 1.0 if limb.startswith("left") else -1.0
        legs = [{hip, *skeleton.ancestors(hip)} for hip in (names["left_hip"], names["right_hip"])]
        leads_to_hip = joint in legs[0] | legs[1]
        if leads_to_hip or not limb:
            axes = pelvis if leads_to_hip else chest
            mirrored = mirror[joint], mirror[ancestor]
            mean = [_mean_in(axes, positions[:, a] - positions[:, b]) for a, b in (bone, mirrored)]
            result[at] = mean[0] + mean[1] * [-1.0, 1.0, 1.0]
        elif limb.endswith("_shoulder"):
            result[at] = np.array(_THUMB if "thumb" in name else (1.0, 0.0, 0.0)) * (sign, 1, 1)
        elif any(one.endswith("_ankle") for one in above):
            result[at] = _HEEL if name.endswith("heel") else _SOLE
        else:
            result[at] = (0.0, -1.0, 0.0)
    return result


def _mean_in(frames: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return the mean of vectors (L, 3) in frames (L, 3, 3)."""
    return np.einsum("lij,li->j", frames, vectors) / len(vectors)


def _frames(left: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return rotations (L, 3, 3) with columns left, up (orthogonalised) and forward."""
    x = _unit(left)
    z = _unit(np.cross(x, up))
    return np.stack([x, np.cross(z, x), z], axis=-1)


def _unit(vectors: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0, length, 1.0)
