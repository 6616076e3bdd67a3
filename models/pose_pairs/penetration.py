"""Penetration depth of skeletons with bone radii (Yin et al. 2018, eq. 2).

Each bone is a capsule around the segment from joint to parent, with the radius of the joint
(``skeleton.radii``).
"""

from __future__ import annotations

from functools import lru_cache
from math import prod
from typing import NamedTuple

import numpy as np

from probmotion.models.pose_pairs.penetration_kernels import capsule_depth, total_depths
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_finite, check_shape

__all__ = ["Capsules", "capsules_of", "penetrating_bones", "penetration_depth"]


class Capsules(NamedTuple):
    """Arrays of capsules for compiled code."""

    bones: np.ndarray  # (B, 2), joints
    radii: np.ndarray  # (B,), metres
    pairs: np.ndarray  # (P, 2), indices of the bones tested


def capsules_of(skeleton: Skeleton) -> Capsules:
    """Return a skeleton's capsules and the pairs tested for penetration.

    These are all pairs of bones of different trees and, within a tree, pairs that neither share a
    joint nor have a common neighbour. Neighbouring capsules overlap at rest, and the joint limits
    restrict how far they fold.
    """
    if skeleton.radii is None:
        raise ValueError("skeleton must have radii, one per joint, got none")
    # Skeletons compare equal regardless of radii, so a skeleton cannot be the cache key.
    return _capsules(skeleton.bones, skeleton.radii)


def penetration_depth(positions: np.ndarray, skeleton: Skeleton) -> np.ndarray:
    """Return the total penetration depth ρ = Σ max(0, r_a + r_b − d_ab), metres.

    d_ab is the distance between the segments of bones a and b; pairs as in :func:`capsules_of`.

    Parameters
    ----------
    positions : ndarray, (…, J, 3)
        Joint positions, metres.
    skeleton : Skeleton
        Skeleton with radii.

    Returns
    -------
    ndarray, (…)
    """
    capsules = capsules_of(skeleton)
    given = np.asarray(positions, dtype=np.float64)
    check_shape("positions", given, ("…", skeleton.n_joints, 3))
    check_finite("positions", given)
    flat = np.ascontiguousarray(given.reshape(prod(given.shape[:-2]), *given.shape[-2:]))
    return total_depths(flat, *capsules).reshape(given.shape[:-2])


def penetrating_bones(pose: np.ndarray, skeleton: Skeleton) -> list[tuple[str, str, float]]:
    """Return the penetrating pairs of bones of a pose (J, 3), deepest first.

    Each entry is (bone, bone, depth in metres). Bones are named by their end joint. The depths sum
    to :func:`penetration_depth`.
    """
    bones, radii, pairs = capsules_of(skeleton)
    given = np.ascontiguousarray(pose, dtype=np.float64)
    check_shape("pose", given, (skeleton.n_joints, 3))
    check_finite("pose", given)
    depths = np.array([capsule_depth(given, bones, radii, a, b) for a, b in pairs])
    deepest = np.argsort(-depths, kind="stable")[: np.count_nonzero(depths)]
    ends = bones[pairs[deepest], 0]
    names = skeleton.joint_names
    return [(names[a], names[b], float(d)) for (a, b), d in zip(ends, depths[deepest], strict=True)]


@lru_cache(maxsize=64)
def _capsules(bones: tuple[tuple[int, int], ...], radii: tuple[float, ...]) -> Capsules:
    ends = np.array(bones, dtype=np.int64).reshape(-1, 2)
    touching = (ends[:, None, :, None] == ends[None, :, None, :]).any(axis=(-2, -1))
    # A bone touches itself, so the product marks bones that touch or have a common neighbour.
    tested = ~(touching @ touching)
    return Capsules(
        bones=ends,
        radii=np.array([radii[joint] for joint, _ in bones]),
        pairs=np.argwhere(np.triu(tested)),
    )
