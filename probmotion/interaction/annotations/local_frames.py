"""The local frame of a pair of characters (Yin et al. 2018, eq. 3).

Its columns are

    i = N(r₂ − r₁),   j = N(Σ_k N(B_k)),   k = i × j,

with roots r and backbones B = chest − root. It is not orthogonal, and k is no unit vector.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_shape

__all__ = [
    "SMALLEST_SINE",
    "chests",
    "cross",
    "frames_are_sound",
    "local_frames",
    "pair_frames",
    "trees",
    "unit",
]

SMALLEST_SINE = 1e-6
"""Sine of the angle between i and j below which a frame is degenerate."""

_TINY = 1e-300


def local_frames(roots: np.ndarray, backbones: np.ndarray) -> np.ndarray:
    """Return the local frame of each pair (eq. 3).

    Parameters
    ----------
    roots : ndarray, (…, K, 3)
        Root joints of K ≥ 2 characters, metres. The first two span i.
    backbones : ndarray, (…, K, 3)
        Chest minus root of each character, metres. All of them make j.

    Returns
    -------
    frames : ndarray, (…, 3, 3)
        Columns i, j, k. A column that has no direction (roots coincide, backbones cancel) is 0;
        see :func:`frames_are_sound`.

    Raises
    ------
    ValueError
        If shapes differ, or there are fewer than two characters.
    """
    roots = np.asarray(roots, dtype=np.float64)
    backbones = np.asarray(backbones, dtype=np.float64)
    check_shape("roots", roots, ("…", "K", 3))
    check_shape("backbones", backbones, roots.shape)
    _check_characters("roots", roots.shape[-2])
    i = unit(roots[..., 1, :] - roots[..., 0, :])
    j = unit(unit(backbones).sum(axis=-2))
    return np.stack([i, j, cross(i, j)], axis=-1)


def pair_frames(positions: np.ndarray, skeleton: Skeleton) -> np.ndarray:
    """Return the local frame of each pose-pair, columns i, j, k: ``(…, J, 3) → (…, 3, 3)``.

    Raises
    ------
    ValueError
        If the skeleton has one tree only, or a tree without a chest.
    """
    positions = np.asarray(positions, dtype=np.float64)
    check_shape("positions", positions, ("…", skeleton.n_joints, 3))
    _check_characters("skeleton", len(skeleton.roots))
    roots = positions[..., list(skeleton.roots), :]
    return local_frames(roots, positions[..., list(chests(skeleton)), :] - roots)


@lru_cache(maxsize=32)
def trees(skeleton: Skeleton) -> tuple[int, ...]:
    """Return the root of each joint's tree, the character that it belongs to."""
    return tuple((joint, *skeleton.ancestors(joint))[-1] for joint in range(skeleton.n_joints))


@lru_cache(maxsize=32)
def chests(skeleton: Skeleton) -> tuple[int, ...]:
    """Return the index of each tree's chest (by canonical name), in the order of the roots.

    Raises
    ------
    ValueError
        If a tree has no chest, or several.
    """
    found: dict[int, list[int]] = {root: [] for root in skeleton.roots}
    for joint, name in enumerate(skeleton.canonical_names):
        if name.rpartition(":")[2] == "chest":
            found[trees(skeleton)[joint]].append(joint)
    for root, joints in found.items():
        if len(joints) != 1:
            raise ValueError(
                f"skeleton has {len(joints)} chests in the tree of {skeleton.joint_names[root]}, "
                "expected one"
            )
    return tuple(joints[0] for joints in found.values())


def frames_are_sound(frames: np.ndarray) -> np.ndarray:
    """Whether each frame spans space: ``(…, 3, 3) → (…)`` bool.

    It does not where the roots coincide, the backbones cancel, i and j are parallel (to a sine of
    :data:`SMALLEST_SINE`), or a number is not finite.
    """
    frames = np.asarray(frames, dtype=np.float64)
    check_shape("frames", frames, ("…", 3, 3))
    finite = np.isfinite(frames).all(axis=(-2, -1))
    # k = i × j: its length is the sine of the angle between i and j, 0 where one of them is 0.
    return finite & (np.linalg.norm(frames[..., 2], axis=-1) > SMALLEST_SINE)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Return vectors (…, 3) of length 1; 0 stays 0."""
    length = np.sqrt(np.einsum("...i,...i->...", vectors, vectors))
    return vectors / np.maximum(length, _TINY)[..., np.newaxis]


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return a × b over the last axis; NumPy's own is several times slower for few vectors."""
    return a[..., [1, 2, 0]] * b[..., [2, 0, 1]] - a[..., [2, 0, 1]] * b[..., [1, 2, 0]]


def _check_characters(name: str, count: int) -> None:
    if count < 2:
        raise ValueError(
            f"{name} has {count} character, expected at least two (one person missing)"
        )
