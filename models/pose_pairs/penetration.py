"""Penetration depth of skeletons with bone radii (Yin et al. 2018, eq. 2).

Each bone is a capsule: the points within its radius (``skeleton.radii``) of the segment from joint
to parent.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import combinations
from math import prod
from typing import NamedTuple

import numpy as np

from probmotion.models.pose_pairs.penetration_kernels import depths_of_pairs, total_depths
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_finite, check_shape

__all__ = ["Capsules", "capsules_of", "penetrating_bones", "penetration_depth"]


class Capsules(NamedTuple):
    """Arrays for compiled code.

    ``bones`` (B, 2), joints; ``radii`` (B,), metres; ``pairs`` (P, 2), indices of the bones tested.
    """

    bones: np.ndarray
    radii: np.ndarray
    pairs: np.ndarray


def capsules_of(skeleton: Skeleton) -> Capsules:
    """Return a skeleton's capsules and the pairs tested for penetration.

    Tested are all pairs of bones of different trees and, within a tree, bones that neither share a
    joint nor have a common neighbour: neighbouring capsules overlap at rest, and their folding is
    subject to the joint limits.
    """
    if skeleton.radii is None:
        raise ValueError("skeleton must have radii, one per joint, got none")
    # Skeletons compare equal regardless of radii, so a skeleton cannot be the cache key.
    return _capsules(skeleton.bones, skeleton.radii)


def penetration_depth(positions: np.ndarray, skeleton: Skeleton) -> np.ndarray:
    """Return the total penetration depth ρ = Σ max(0, r_a + r_b − d_ab), metres.

    d_ab is the distance of the segments of bones a and b; pairs as in :func:`capsules_of`.

    Parameters
    ----------
    positions : ndarray, (…, J, 3)
        Metres.
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
    """Return the penetrating bones of a pose (J, 3), deepest first.

    Each is (joint, joint, depth in metres), named by end joints; the depths sum to
    :func:`penetration_depth`.
    """
    capsules = capsules_of(skeleton)
    given = np.ascontiguousarray(pose, dtype=np.float64)
    check_shape("pose", given, (skeleton.n_joints, 3))
    check_finite("pose", given)
    depths = depths_of_pairs(given, *capsules)
    found = []
    for pair in np.argsort(-depths, kind="stable")[: np.count_nonzero(depths)]:
        first, second = (skeleton.joint_names[j] for j in capsules.bones[capsules.pairs[pair], 0])
        found.append((first, second, float(depths[pair])))
    return found


@lru_cache(maxsize=64)
def _capsules(bones: tuple[tuple[int, int], ...], radii: tuple[float, ...]) -> Capsules:
    all_pairs = combinations(range(len(bones)), 2)
    touching = {pair: bool(set(bones[pair[0]]) & set(bones[pair[1]])) for pair in all_pairs}
    beside: list[set[int]] = [set() for _ in bones]
    for (first, second), shared in touching.items():
        if shared:
            beside[first].add(second)
            beside[second].add(first)
    apart = [
        pair
        for pair, shared in touching.items()
        if not (shared or beside[pair[0]] & beside[pair[1]])
    ]
    return Capsules(
        bones=np.array(bones, dtype=np.int64).reshape(-1, 2),
        radii=np.array([radii[joint] for joint, _ in bones]),
        pairs=np.array(apart, dtype=np.int64).reshape(-1, 2),
    )
