"""Face points of ``coco17`` for motion capture, which has no nose, eyes and ears.

The points are fixed to the head. Their positions are assumed, not measured: approximate means of
adults, after published anthropometry (Gordon et al. 2014; Pheasant 1996; Farkas 1994).
"""

from __future__ import annotations

import numpy as np

from probmotion.motion.motion import Motion
from probmotion.motion.retargeting import counterpart
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count, check_positive, check_shape

__all__ = ["FACE_POINTS", "head_turns", "with_face_points"]

FACE_POINTS = {
    "nose": (0.0, -0.025, 0.12),
    "left_eye": (0.0315, 0.012, 0.08),
    "right_eye": (-0.0315, 0.012, 0.08),
    "left_ear": (0.07, 0.0, 0.0),
    "right_ear": (-0.07, 0.0, 0.0),
}
"""Positions to the left of, above and in front of the midpoint of the ears (tragia), metres."""

# The head bone of CMU's recordings ends at the level of the temples, above the midpoint of the
# ears: 10 cm below the top of the head of a person with their legs, and the ears 13 cm below it.
_TEMPLES = 0.03
_SHOULDERS_TO_TEMPLES = 0.22  # height in CMU's recordings
_HEAD_BONES = (("head", "head_top"), ("upper_neck", "head"))  # in BVH and in ASF files
_TRUNK = ("chest", "pelvis")
_TURN_SD = np.deg2rad(15.0)
_TURN_SECONDS = 0.3  # time scale of the turns: a correlation of 0.5 after half a second
_SMALLEST_SINE = 1e-3  # of the angle between head and shoulders


def with_face_points(motion: Motion, turns: np.ndarray | None = None) -> Motion:
    """Return a recording on ``coco17``, with face points fixed to its head.

    The head's vertical axis is that of its bone: from ``head`` to ``head_top`` or from
    ``upper_neck`` to ``head``. In recordings without such a bone, the head continues the axis from
    chest (or pelvis) to neck, and the ears are 19 cm above the shoulders. Positions do not show how
    the head turns about this axis: it faces as the shoulders do, except for ``turns``.

    Parameters
    ----------
    motion : Motion
        Recording of L frames, metres.
    turns : ndarray, (L,), optional
        Turns of the head to the left, radians (see :func:`head_turns`); 0 by default.

    Raises
    ------
    ValueError
        If a joint is missing, or the shoulders are parallel to the head's axis in a frame.
    """
    turns = np.zeros(motion.frames) if turns is None else np.asarray(turns)
    check_shape("turns", turns, (motion.frames,))
    coco = Skeleton.preset("coco17")
    limbs = [joint for joint, name in enumerate(coco.joint_names) if name not in FACE_POINTS]
    body = motion.retarget(coco.subset(limbs)).positions
    side = body[:, 0] - body[:, 1]  # from the right shoulder to the left one
    temples, up = _head(motion, body[:, :2].mean(axis=1))
    along = (side * up).sum(axis=-1, keepdims=True) * up
    across = np.linalg.norm(side - along, axis=-1, keepdims=True)
    if across.min() < _SMALLEST_SINE * np.linalg.norm(side, axis=-1).max():
        raise ValueError(
            f"shoulders must not be parallel to the head's axis, got frame {across.argmin()} of "
            f"{motion.name or 'the motion'}; leave it out"
        )
    left = (side - along) / across
    front = np.cross(left, up)
    cos, sin = np.cos(turns)[:, None], np.sin(turns)[:, None]
    axes = np.stack([cos * left - sin * front, up, cos * front + sin * left], axis=1)
    face = (temples - _TEMPLES * up)[:, None] + np.array(list(FACE_POINTS.values())) @ axes
    positions = np.empty((motion.frames, coco.n_joints, 3))
    positions[:, [coco.index(name) for name in FACE_POINTS]] = face
    positions[:, limbs] = body
    return Motion(positions, coco, motion.fps, name=motion.name)


def head_turns(rng: np.random.Generator, frames: int, fps: float) -> np.ndarray:
    """Return random turns of the head to the left of the shoulders' facing, radians, (frames,).

    They are a stationary Gaussian process with a standard deviation of 15° and the autocorrelation
    (1 + τ/ℓ) exp(−τ/ℓ), ℓ = 0.3 s. In four recordings with head rotations, the root mean square is
    14° (a walk), 16° (a dance), 21° and 23° (two partners of a salsa), and the autocorrelation
    after half a second −0.1 to 0.6.
    """
    check_count("frames", frames)
    check_positive("fps", fps)
    lag = np.arange(frames) / (fps * _TURN_SECONDS)
    correlation = (1 + lag) * np.exp(-lag)
    index = np.abs(np.subtract.outer(np.arange(frames), np.arange(frames)))
    values, vectors = np.linalg.eigh(correlation[index])
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    return np.asarray(_TURN_SD * (root @ rng.standard_normal(frames)))


def _head(motion: Motion, shoulders: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the head's position at the level of the temples and its vertical axis, (L, 3).

    ``shoulders`` (L, 3) is the midpoint of the shoulders.
    """
    names = motion.skeleton.canonical_names
    for base, top in _HEAD_BONES:
        if base in names and top in names:
            start, end = _joint(motion, base), _joint(motion, top)
            return end, _unit(end - start)
    trunk = next((name for name in _TRUNK if name in names), _TRUNK[-1])
    neck = _joint(motion, "neck")
    up = _unit(neck - _joint(motion, trunk))
    height = _SHOULDERS_TO_TEMPLES + ((shoulders - neck) * up).sum(axis=-1, keepdims=True)
    return neck + height * up, up


def _joint(motion: Motion, name: str) -> np.ndarray:
    joint = counterpart(motion.skeleton, name, name)
    if joint is None:
        raise ValueError(
            f"motion must have a joint {name}, got {', '.join(motion.skeleton.joint_names)}"
        )
    return motion.positions[:, joint]


def _unit(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
