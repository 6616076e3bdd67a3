"""Data sets of pose pairs: dance frames, held-out clips, body heights and seed poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count, check_finite, check_positive, check_shape

__all__ = [
    "SALSA_HELD_OUT",
    "check_close_people",
    "choose_seed",
    "dance_frames",
    "describe_dance_frames",
    "ground_truth",
    "hold_out",
    "person_height",
    "scaled_to_height",
]

SALSA_HELD_OUT = ("cmu_60_61_03", "cmu_60_61_07", "cmu_60_61_11")
"""Names of the held-out salsa clips: 3 of 10 clips, with 2658 of the 8257 dance frames."""

# Fractions of the body height below the ankles and above the base of the skull, from Drillis and
# Contini (ankle .039, eyes .936, chin .870 of the height).
_FOOT = 0.039
_SKULL = 0.10
_SEED_POSES = 400  # maximum number of pose pairs compared by choose_seed
_HEIGHTS = (0.5, 3.0)  # plausible heights, m
_MAX_ROOT_DISTANCE = 5.0  # maximum distance between roots, m
_MAX_DISTANCE, _MAX_SPEED = 1.2, 7.0  # limits of dance frames, m and m/s
_LEG = ("hip", "knee", "ankle")


def dance_frames(
    motion: Motion, *, farthest: float = _MAX_DISTANCE, fastest: float = _MAX_SPEED
) -> np.ndarray:
    """Return a mask of the frames that show the dance.

    The mask excludes the opening (before the partners first come close), frames with a person over
    ``farthest`` from all others, and glitches (before and after a step faster than ``fastest``).

    Parameters
    ----------
    motion : Motion
        Motion of at least two people.
    farthest : float
        Maximum distance of a person's root from the nearest other root, metres.
    fastest : float
        Maximum speed of a joint, metres per second.

    Returns
    -------
    ndarray of bool, (L,)
    """
    return ~np.any(_excluded_frames(motion, farthest, fastest), axis=0)


def describe_dance_frames(motion: Motion) -> str:
    """Return a sentence with the numbers of frames that :func:`dance_frames` includes and excludes.

    The default limits apply. An excluded frame counts only for the first reason that applies.
    """
    opening, distant, glitch = _excluded_frames(motion, _MAX_DISTANCE, _MAX_SPEED)
    counts = opening.sum(), (distant & ~opening).sum(), (glitch & ~distant & ~opening).sum()
    return (
        f"{motion.name or 'the motion'}: {motion.frames - sum(counts)} of {motion.frames} frames "
        f"show the dance; excluded: {counts[0]} of the opening, {counts[1]} with partners over "
        f"{_MAX_DISTANCE:g} m apart, {counts[2]} next to a step faster than {_MAX_SPEED:g} m/s"
    )


def ground_truth(
    motions: Sequence[Motion], n: int | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pose pairs evenly spaced over the dance frames of several clips.

    Yin et al. (2018), section 6, use 6000 such frames of the salsa clips of the CMU database.

    Parameters
    ----------
    motions : sequence of Motion
        Clips of one skeleton, each of at least two people.
    n : int, optional
        Number of pose pairs; all dance frames by default.

    Returns
    -------
    positions : ndarray, (n, J, 3)
        Pose pairs, metres.
    clip, frame : ndarray of int, (n,)
        Index of the motion and of its frame.

    Raises
    ------
    ValueError
        If ``motions`` is empty, skeletons differ, or fewer than ``n`` frames show the dance.
    """
    if not motions:
        raise ValueError("motions must contain at least one, got none")
    for motion in motions:
        if motion.skeleton != motions[0].skeleton:
            raise ValueError(
                f"motions must share one skeleton, got {motions[0]} and {motion}; use "
                "motion.retarget(skeleton)"
            )
    frames = [np.flatnonzero(dance_frames(motion)) for motion in motions]
    clip = np.repeat(np.arange(len(motions)), list(map(len, frames)))
    frame = np.concatenate(frames)
    total = len(frame)
    if total == 0:
        first = describe_dance_frames(motions[0])
        raise ValueError(f"motions must contain dance frames, got none; {first}")
    n = total if n is None else n
    check_count("n", n)
    if n > total:
        raise ValueError(f"n must be at most the {total} dance frames, got {n}")
    positions = np.concatenate([m.positions[f] for m, f in zip(motions, frames, strict=True)])
    chosen = _evenly_spaced(n, total)
    return positions[chosen], clip[chosen], frame[chosen]


def _evenly_spaced(n: int, total: int) -> np.ndarray:
    """Return the midpoints of n equal intervals of ``range(total)``."""
    return (2 * np.arange(n) + 1) * total // (2 * n)


def hold_out(
    motions: Sequence[Motion], names: Sequence[str] = SALSA_HELD_OUT
) -> tuple[list[Motion], list[Motion]]:
    """Split motions by name into training and held-out motions.

    Raises
    ------
    ValueError
        If a name does not match exactly one motion, or either part would be empty.
    """
    if isinstance(names, str):
        raise ValueError(f"names must be a list of names, got {names!r}")
    known = [motion.name for motion in motions]
    for name in names:
        if known.count(name) != 1:
            raise ValueError(
                f"names must match one motion each ({', '.join(dict.fromkeys(known))}), got "
                f"{name!r}, the name of {known.count(name)}"
            )
    training = [motion for motion in motions if motion.name not in names]
    held_out = [motion for motion in motions if motion.name in names]
    if not training or not held_out:
        raise ValueError(
            f"names must hold out at least one and not all of the {len(motions)} motions, got "
            f"{len(held_out)} names"
        )
    return training, held_out


def person_height(positions: np.ndarray, skeleton: Skeleton) -> np.ndarray:
    """Return the standing heights of the people, estimated from their bone lengths.

    The height is the sum of the lengths of shin and thigh (means of both sides), the distance from
    the pelvis to the midpoint of the hips, and the bones from pelvis to ``head``, divided by 0.861,
    because 3.9 % of the height is below the ankles and 10 % above the base of the skull.

    Parameters
    ----------
    positions : ndarray, (…, J, 3)
        Poses, metres.
    skeleton : Skeleton
        K people, each with hips, knees, ankles and a ``head``, the base of the skull.

    Returns
    -------
    ndarray, (…, K)
        Heights, metres.
    """
    positions = np.asarray(positions, dtype=np.float64)
    check_shape("positions", positions, ("…", skeleton.n_joints, 3))
    return np.stack([_height(positions, skeleton, root) for root in skeleton.roots], axis=-1)


def check_close_people(name: str, pose: np.ndarray, skeleton: Skeleton) -> None:
    """Raise ``ValueError`` unless a pose (J, 3) shows people in metres, close to each other.

    People must be 0.5 to 3 m tall (:func:`person_height`), with roots at most 5 m apart.
    """
    check_shape(name, pose, (skeleton.n_joints, 3))
    check_finite(name, pose)
    heights = person_height(pose, skeleton)
    implausible = heights[(heights < _HEIGHTS[0]) | (heights > _HEIGHTS[1])]
    if implausible.size:
        raise ValueError(
            f"people in {name} must be {_HEIGHTS[0]:g} to {_HEIGHTS[1]:g} m tall, got "
            f"{implausible[0]:.3g}; positions are in metres"
        )
    roots = pose[list(skeleton.roots)]
    distance = np.linalg.norm(roots[:, None] - roots, axis=-1).max()
    if distance > _MAX_ROOT_DISTANCE:
        raise ValueError(
            f"people in {name} must be at most {_MAX_ROOT_DISTANCE:g} m apart, got {distance:.3g}"
        )


def scaled_to_height(motion: Motion, height: float = 1.7) -> Motion:
    """Return the motion scaled about the origin to a mean :func:`person_height` of ``height`` m."""
    check_positive("height", height)
    factor = height / person_height(motion.positions, motion.skeleton).mean()
    offsets = motion.rest_offsets
    return replace(
        motion,
        positions=motion.positions * factor,
        rest_offsets=None if offsets is None else offsets * factor,
    )


def choose_seed(positions: np.ndarray) -> int:
    """Return the index of the medoid pose pair, for use as the seed pose.

    The medoid has the least sum of distances to the others. Distances are root mean squares over
    joints after rigid alignment (Kabsch), between at most 400 evenly spaced pose pairs.

    Parameters
    ----------
    positions : ndarray, (n, J, 3)
        At least one pose pair, metres and finite.
    """
    positions = np.asarray(positions, dtype=np.float64)
    check_shape("positions", positions, ("n", "J", 3))
    if len(positions) == 0:
        raise ValueError("positions must contain at least one pose pair, got none")
    check_finite("positions", positions)
    chosen = _evenly_spaced(min(len(positions), _SEED_POSES), len(positions))
    centred = positions[chosen] - positions[chosen].mean(axis=1, keepdims=True)
    return int(chosen[np.argmin([_aligned_distances(pose, centred).sum() for pose in centred])])


def _aligned_distances(pose: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the aligned rms distances of a centred pose (J, 3) to others (n, J, 3).

    ‖A R − B‖² = ‖A‖² + ‖B‖² − 2 tr(Rᵀ AᵀB); the trace is at most σ₁ + σ₂ ± σ₃ (σ of AᵀB).
    """
    products = pose.T @ others
    sigma = np.linalg.svd(products, compute_uv=False)
    best = sigma[:, 0] + sigma[:, 1] + np.sign(np.linalg.det(products)) * sigma[:, 2]
    square = (pose**2).sum() + (others**2).sum(axis=(1, 2)) - 2 * best
    return np.sqrt(np.maximum(square, 0.0) / len(pose))


def _excluded_frames(motion: Motion, farthest: float, fastest: float) -> np.ndarray:
    """Return masks (3, L) of opening, distant and glitch frames."""
    check_positive("farthest", farthest)
    check_positive("fastest", fastest)
    roots = motion.positions[:, motion.skeleton.roots]
    if roots.shape[1] < 2:
        raise ValueError(f"motion must have at least 2 people, got {motion}")
    distances = np.linalg.norm(roots[:, :, None] - roots[:, None], axis=-1)
    distances += np.where(np.eye(roots.shape[1]), np.inf, 0.0)
    distant = distances.min(axis=-1).max(axis=-1) > farthest
    close = np.flatnonzero(~distant)
    opening = np.arange(motion.frames) < (close[0] if len(close) else motion.frames)
    step = np.linalg.norm(np.diff(motion.positions, axis=0), axis=-1).max(axis=-1)
    fast = step * motion.fps > fastest
    glitch = np.append(fast, False) | np.append(False, fast)
    return np.stack([opening, distant, glitch])


def _height(positions: np.ndarray, skeleton: Skeleton, root: int) -> np.ndarray:
    """Return the height (…) of the person below ``root``."""
    tree = [j for j in range(skeleton.n_joints) if j == root or root in skeleton.ancestors(j)]
    names = skeleton.subset(tree).canonical_names
    required = ("head", *(f"{side}_{part}" for side in ("left", "right") for part in _LEG))
    missing = [name for name in required if name not in names]
    if missing:
        raise ValueError(
            f"skeleton must have hips, knees, ankles and a head below "
            f"{skeleton.joint_names[root]!r}, but lacks {', '.join(missing)}"
        )
    at = {name: positions[..., tree[names.index(name)], :] for name in required}
    hips = (at["left_hip"] + at["right_hip"]) / 2
    head = tree[names.index("head")]
    length = np.linalg.norm(hips - positions[..., root, :], axis=-1)
    for joint, parent in pairwise([head, *skeleton.ancestors(head)]):
        bone = positions[..., joint, :] - positions[..., parent, :]
        length = length + np.linalg.norm(bone, axis=-1)
    for side in ("left", "right"):
        for upper, lower in pairwise(_LEG):
            bone = at[f"{side}_{upper}"] - at[f"{side}_{lower}"]
            length = length + np.linalg.norm(bone, axis=-1) / 2
    return length / (1 - _FOOT - _SKULL)
