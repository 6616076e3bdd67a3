"""Local frames of pairs of people (Yin et al. 2018, eq. 3).

The columns of a frame are

    i = N(r₂ − r₁),   j = N(Σ_k N(B_k)),   k = i × j,   N(v) = v / ‖v‖,

with roots r and backbones B = chest − root. The frame is not orthogonal and k is not a unit vector.
"""

from __future__ import annotations

from collections.abc import Set
from functools import lru_cache

import numpy as np

from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_shape

__all__ = [
    "SMALLEST_SINE", "chest_joints", "cross", "joint_roots", "joints_named", "local_frames",
    "pair_frames", "unit", "valid_frames",
]  # fmt: skip

SMALLEST_SINE = 1e-6
"""Sine of the angle between i and j below which a frame is degenerate."""


def local_frames(roots: np.ndarray, backbones: np.ndarray) -> np.ndarray:
    """Return the local frames (eq. 3) with columns i, j, k, (…, 3, 3).

    ``roots`` and ``backbones`` are (…, K, 3) for K ≥ 2 people; the first two roots define i. A
    column is 0 if undefined (the roots coincide or the backbones cancel); see :func:`valid_frames`.
    """
    check_shape("roots", roots, ("…", "K", 3))
    check_shape("backbones", backbones, roots.shape)
    i = unit(roots[..., 1, :] - roots[..., 0, :])
    j = unit(unit(backbones).sum(axis=-2))
    return np.stack([i, j, cross(i, j)], axis=-1)


def pair_frames(positions: np.ndarray, skeleton: Skeleton) -> np.ndarray:
    """Return the local frame of each pose-pair, ``(…, J, 3) → (…, 3, 3)``.

    Raises
    ------
    ValueError
        If the skeleton has fewer than two trees, or a tree without exactly one chest.
    """
    positions = np.asarray(positions, dtype=np.float64)
    check_shape("positions", positions, ("…", skeleton.n_joints, 3))
    if len(skeleton.roots) < 2:
        raise ValueError(f"skeleton must have at least 2 people, got {len(skeleton.roots)}")
    roots = positions[..., list(skeleton.roots), :]
    return local_frames(roots, positions[..., list(chest_joints(skeleton)), :] - roots)


@lru_cache(maxsize=32)
def joint_roots(skeleton: Skeleton) -> tuple[int, ...]:
    """Return the root of each joint's tree."""
    return tuple((joint, *skeleton.ancestors(joint))[-1] for joint in range(skeleton.n_joints))


@lru_cache(maxsize=32)
def chest_joints(skeleton: Skeleton) -> tuple[int, ...]:
    """Return the chest joint of each tree, by canonical name, in the order of the roots."""
    chests = joints_named(skeleton, {"chest"})
    for root, joints in zip(skeleton.roots, chests, strict=True):
        if len(joints) != 1:
            raise ValueError(
                f"skeleton must have one chest per tree, got {len(joints)} in the tree of "
                f"{skeleton.joint_names[root]}"
            )
    return tuple(joint for (joint,) in chests)


def joints_named(skeleton: Skeleton, names: Set[str]) -> tuple[tuple[int, ...], ...]:
    """Return the joints of each tree with a canonical name in ``names``, in the order of roots."""
    expected = [j for j, n in enumerate(skeleton.canonical_names) if n.rpartition(":")[2] in names]
    roots = joint_roots(skeleton)
    return tuple(tuple(j for j in expected if roots[j] == root) for root in skeleton.roots)


def valid_frames(frames: np.ndarray) -> np.ndarray:
    """Return a mask of the non-degenerate frames, ``(…, 3, 3) → (…)``.

    A frame is degenerate if the roots coincide, the backbones cancel, i and j are parallel (up to
    :data:`SMALLEST_SINE`) or a value is not finite.
    """
    frames = np.asarray(frames, dtype=np.float64)
    check_shape("frames", frames, ("…", 3, 3))
    finite = np.isfinite(frames).all(axis=(-2, -1))
    # ‖k‖ = ‖i × j‖ is the sine of the angle between i and j.
    return finite & (np.linalg.norm(frames[..., 2], axis=-1) > SMALLEST_SINE)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Return normalised vectors (…, 3); zero vectors remain zero."""
    length = np.sqrt(np.einsum("...i,...i->...", vectors, vectors))
    return vectors / np.maximum(length, 1e-300)[..., np.newaxis]


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return a × b over the last axis; faster than ``numpy.cross`` for few vectors."""
    return a[..., [1, 2, 0]] * b[..., [2, 0, 1]] - a[..., [2, 0, 1]] * b[..., [1, 2, 0]]
