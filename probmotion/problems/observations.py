"""What is seen of a problem's true motion, by name."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

from probmotion.geometry.cameras import Cameras
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.likelihoods import Keypoints2D
from probmotion.validation import check_count

__all__ = [
    "OBSERVATIONS",
    "in_one_camera",
    "limb_hidden",
    "nearest_joints",
    "observe",
    "one_frame",
]

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
        raise ValueError(f"observe must be one of {', '.join(OBSERVATIONS)}, got {how!r}")
    hides = OBSERVATIONS[how]
    if hides is None:
        return None
    return in_one_camera(motion, noise, seed, hides(motion))


def in_one_camera(motion: Motion, noise: float, seed: int, hidden: np.ndarray) -> Keypoints2D:
    """Return noisy keypoints as :func:`observe` does, but for those ``hidden`` (L, J)."""
    camera = Cameras.ring(1, elevation=_ELEVATION)
    return Keypoints2D.observe(motion, camera, noise, seed, hidden=hidden)


def limb_hidden(motion: Motion, share: float) -> np.ndarray:
    """Return what is hidden (L, J): the longest limb, in the middle ``share`` of the frames.

    Raises
    ------
    ValueError
        If the share is not between 0 and 1.
    """
    if not 0 <= share <= 1:
        raise ValueError(f"hidden must be a share of the frames between 0 and 1, got {share!r}")
    hidden = _nothing(motion)
    # As many as the share has, counted in whole frames; the start likewise.
    start = int((1 - share) / 2 * motion.frames + 1e-9)
    frames = slice(start, start + int(share * motion.frames + 1e-9))
    for joint in _longest_limb(motion.skeleton):
        hidden[frames, joint] = True
    return hidden


def nearest_joints(skeleton: Skeleton, n: int) -> list[int]:
    """Return the n joints with the fewest ancestors, the root first.

    Raises
    ------
    ValueError
        If the skeleton has fewer.
    """
    check_count("joints", n)
    if n > skeleton.n_joints:
        raise ValueError(f"joints must be at most the {skeleton.n_joints} there are, got {n}")
    order = sorted(range(skeleton.n_joints), key=lambda joint: len(skeleton.ancestors(joint)))
    return order[:n]


def one_frame(motion: Motion) -> np.ndarray:
    """Return what of the motion is its middle frame, (L, J)."""
    seen = _nothing(motion)
    seen[motion.frames // 2] = True
    return seen


def _nothing(motion: Motion) -> np.ndarray:
    return np.zeros(motion.positions.shape[:2], dtype=bool)


def _limb_for_half(motion: Motion) -> np.ndarray:
    return limb_hidden(motion, 0.5)


def _all_but_a_few(motion: Motion) -> np.ndarray:
    hidden = ~one_frame(motion)
    shown = nearest_joints(motion.skeleton, min(_SPARSE_JOINTS, motion.skeleton.n_joints))
    hidden[:, [j for j in range(motion.skeleton.n_joints) if j not in shown]] = True
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
