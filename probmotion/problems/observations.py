"""Simulated 2D keypoints of a motion, with named occlusion patterns."""

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
    "limb_occlusion",
    "middle_frame",
    "nearest_joints",
    "observe",
    "one_camera_keypoints",
]

_ELEVATION = math.pi / 12  # of the camera, radians
_SPARSE_JOINTS = 6  # visible joints of the pattern "sparse"


def observe(motion: Motion, how: str, noise: float, seed: int) -> Keypoints2D | None:
    """Return noisy keypoints of ``motion`` from an orthographic camera at 15° elevation.

    ``how`` is a key of :data:`OBSERVATIONS`; ``noise`` is the standard deviation in metres, with
    one image unit per metre. Return ``None`` if ``how`` is ``"none"``.
    """
    if how not in OBSERVATIONS:
        raise ValueError(f"observe must be one of {', '.join(OBSERVATIONS)}, got {how!r}")
    occlusion = OBSERVATIONS[how]
    if occlusion is None:
        return None
    return one_camera_keypoints(motion, noise, seed, occlusion(motion))


def one_camera_keypoints(
    motion: Motion, noise: float, seed: int, hidden: np.ndarray
) -> Keypoints2D:
    """Return noisy keypoints of :func:`observe`'s camera; ``hidden`` (L, J) marks occlusion."""
    camera = Cameras.ring(1, elevation=_ELEVATION)
    return Keypoints2D.observe(motion, camera, noise, seed, hidden=hidden)


def limb_occlusion(motion: Motion, fraction: float = 0.5) -> np.ndarray:
    """Return the mask (L, J) of the longest limb in the middle ``fraction`` of the frames."""
    if not 0 <= fraction <= 1:
        raise ValueError(f"hidden must be between 0 and 1, got {fraction!r}")
    hidden = _no_occlusion(motion)
    # Round down to full frames; the constant absorbs floating-point error.
    start = int((1 - fraction) / 2 * motion.frames + 1e-9)
    stop = start + int(fraction * motion.frames + 1e-9)
    hidden[start:stop, _longest_limb(motion.skeleton)] = True
    return hidden


def nearest_joints(skeleton: Skeleton, n: int) -> list[int]:
    """Return the n joints with the fewest ancestors, root first."""
    check_count("joints", n)
    if n > skeleton.n_joints:
        raise ValueError(f"joints must be at most {skeleton.n_joints}, got {n}")
    order = sorted(range(skeleton.n_joints), key=lambda joint: len(skeleton.ancestors(joint)))
    return order[:n]


def middle_frame(motion: Motion) -> np.ndarray:
    """Return the mask (L, J) of the middle frame."""
    mask = _no_occlusion(motion)
    mask[motion.frames // 2] = True
    return mask


def _no_occlusion(motion: Motion) -> np.ndarray:
    return np.zeros(motion.positions.shape[:2], dtype=bool)


def _all_but_central_joints(motion: Motion) -> np.ndarray:
    n_joints = motion.skeleton.n_joints
    visible = nearest_joints(motion.skeleton, min(_SPARSE_JOINTS, n_joints))
    return ~middle_frame(motion) | ~np.isin(np.arange(n_joints), visible)


def _longest_limb(skeleton: Skeleton) -> list[int]:
    """Return the longest chain of joints from a leaf to below a branching joint or root."""
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
    "monocular": _no_occlusion,
    "occluded": limb_occlusion,
    "sparse": _all_but_central_joints,
}
"""Functions that return the mask of occluded joints (L, J), by name.

``none``: no observations, the posterior is the prior; ``monocular``: all joints visible;
``occluded``: longest limb occluded in the middle half of the frames; ``sparse``: only the six
joints closest to the root visible, in the middle frame.
"""
