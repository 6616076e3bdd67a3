"""Penetration: how deep the bones of rigged characters stand in one another.

Every bone is a capsule: the points within its radius (``skeleton.radii``) of the segment from
joint to parent.
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
    """What compiled code reads: ``bones`` (B, 2) joints, ``radii`` (B,) metres, ``pairs`` (P, 2).

    ``pairs`` are indices of bones that may not stand in each other.
    """

    bones: np.ndarray
    radii: np.ndarray
    pairs: np.ndarray


def capsules_of(skeleton: Skeleton) -> Capsules:
    """Return a skeleton's capsules and the pairs of them that may not stand in each other.

    These are all pairs of different trees and, within a tree, bones that neither share a joint nor
    are joined by one other bone: an upper arm cannot be drawn out of the chest it hangs at, nor a
    thigh out of the spine's lower end, and how far those fold is the joint limits' to say.

    Raises
    ------
    ValueError
        If the skeleton has no radii.
    """
    if skeleton.radii is None:
        raise ValueError(
            f"skeleton of {skeleton.n_joints} joints has no radii, expected one per joint"
        )
    # A skeleton's equality leaves radii out, so that it cannot be the key itself.
    return _capsules(skeleton.bones, skeleton.radii)


def penetration_depth(positions: np.ndarray, skeleton: Skeleton) -> np.ndarray:
    """Return ρ, the sum over pairs of bones of how deep they stand in each other, metres.

    ρ = Σ max(0, r_a + r_b − distance of the two segments); pairs as in :func:`capsules_of`.

    Parameters
    ----------
    positions : ndarray, (…, J, 3)
        Metres.
    skeleton : Skeleton
        With radii.

    Returns
    -------
    ndarray, (…)

    Raises
    ------
    ValueError
        If the skeleton has no radii, the shape does not fit it or a value is not finite.

    References
    ----------
    Yin, Huang, Ho et al. (2018), "A Sampling Approach to Generating Closely Interacting 3D
    Pose-Pairs from 2D Annotations", eq. 2.
    """
    capsules = capsules_of(skeleton)
    given = _checked(positions, ("…", skeleton.n_joints, 3))
    flat = np.ascontiguousarray(given.reshape(prod(given.shape[:-2]), *given.shape[-2:]))
    return total_depths(flat, *capsules).reshape(given.shape[:-2])


def penetrating_bones(pose: np.ndarray, skeleton: Skeleton) -> list[tuple[str, str, float]]:
    """Return the bones that stand in each other, deepest first.

    Each is (joint, joint, depth in metres), a bone called by the joint it ends in; the depths add
    up to :func:`penetration_depth`. ``pose`` is (J, 3), metres.

    Raises
    ------
    ValueError
        As :func:`penetration_depth`.
    """
    capsules = capsules_of(skeleton)
    given = np.ascontiguousarray(_checked(pose, (skeleton.n_joints, 3)))
    depths = depths_of_pairs(given, *capsules)
    found = []
    for pair in np.argsort(-depths, kind="stable")[: np.count_nonzero(depths)]:
        first, second = (skeleton.joint_names[j] for j in capsules.bones[capsules.pairs[pair], 0])
        found.append((first, second, float(depths[pair])))
    return found


def _checked(positions: np.ndarray, shape: tuple[int | str, ...]) -> np.ndarray:
    given = np.asarray(positions, dtype=np.float64)
    check_shape("positions" if shape[0] == "…" else "pose", given, shape)
    check_finite("positions" if shape[0] == "…" else "pose", given)
    return given


@lru_cache(maxsize=64)
def _capsules(bones: tuple[tuple[int, int], ...], radii: tuple[float, ...]) -> Capsules:
    touching = {pair: bool(set(bones[pair[0]]) & set(bones[pair[1]])) for pair in _pairs(bones)}
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


def _pairs(bones: tuple[tuple[int, int], ...]) -> list[tuple[int, int]]:
    return list(combinations(range(len(bones)), 2))
