"""What is seen of a problem's true motion, by name."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

from probmotion.cameras import Cameras
from probmotion.likelihoods import Keypoints2D
from probmotion.motion import Motion
from probmotion.skeleton import Skeleton

__all__ = ["OBSERVATIONS", "observe"]

_ELEVATION = math.pi / 12
_SPARSE_JOINTS = 6


def observe(motion: Motion, how: str, noise: float, seed: int) -> Keypoints2D | None:
    """Return noisy keypoints of ``motion`` in one orthographic camera 15° above the horizon.

    Parameters
    ----------
    motion : Motion
        The true motion, centred.
    how : str
        A name of :data:`OBSERVATIONS`.
    noise : float
        Standard deviation, metres (the camera shows one image unit per metre).
    seed : int
        Seed of the noise.

    Raises
    ------
    ValueError
        If ``how`` is unknown; the message lists the known names.
    """
    if how not in OBSERVATIONS:
        raise ValueError(f"observe is {how!r}, expected one of {', '.join(OBSERVATIONS)}")
    hides = OBSERVATIONS[how]
    if hides is None:
        return None
    camera = Cameras.ring(1, elevation=_ELEVATION)
    return Keypoints2D.observe(motion, camera, noise, seed, hidden=hides(motion))


def _nothing(motion: Motion) -> np.ndarray:
    return np.zeros(motion.positions.shape[:2], dtype=bool)


def _limb_for_half(motion: Motion) -> np.ndarray:
    hidden = _nothing(motion)
    start = motion.frames // 4
    frames = slice(start, start + motion.frames // 2)
    for joint in _longest_limb(motion.skeleton):
        hidden[frames, joint] = True
    return hidden


def _all_but_a_few(motion: Motion) -> np.ndarray:
    skeleton = motion.skeleton
    nearest = sorted(range(skeleton.n_joints), key=lambda joint: len(skeleton.ancestors(joint)))
    hidden = ~_nothing(motion)
    hidden[motion.frames // 2, nearest[:_SPARSE_JOINTS]] = False
    return hidden


def _longest_limb(skeleton: Skeleton) -> list[int]:
    """Return the longest chain of joints from a leaf up to below the nearest branching."""
    children = np.bincount([p for p in skeleton.parents if p >= 0], minlength=skeleton.n_joints)
    limbs = []
    for leaf in np.flatnonzero(children == 0):
        limb = [int(leaf)]
        for joint in skeleton.ancestors(int(leaf)):
            if children[joint] > 1 or joint in skeleton.roots:
                break
            limb.append(joint)
        limbs.append(limb)
    return max(limbs, key=len)


OBSERVATIONS: Mapping[str, Callable[[Motion], np.ndarray] | None] = {
    "none": None,
    "monocular": _nothing,
    "occluded": _limb_for_half,
    "sparse": _all_but_a_few,
}
"""``none``: no evidence, so that the posterior is the prior; ``monocular``: every joint of every
frame; ``occluded``: the longest limb hidden in the middle half of the frames; ``sparse``: the
six joints nearest to the root in the middle frame, and nothing else. Each says what is hidden,
(L, J)."""
