"""How long a body's bones are, from noisy joints: the β of *Motion-DVAE*."""

from __future__ import annotations

import numpy as np

from probmotion import seeds
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.likelihoods import EntryNoise
from probmotion.validation import check_finite, check_shape

__all__ = ["bone_lengths"]

_SIMULATED = 8000
"""Simulated bones, at least, that a median is compared with: its own error is then a fifth of what
the median of 300 frames has."""
_HALVINGS = 16
"""Of the interval that the length is in: to a hundredth of a millimetre."""


def bone_lengths(
    joints: np.ndarray,
    confidence: np.ndarray | None,
    skeleton: Skeleton,
    noise: float,
    degrees_of_freedom: float | None = None,
    typical: np.ndarray | None = None,
) -> np.ndarray:
    """Return the length of every bone over a whole recording (Motion-DVAE, supplement B and C).

    The plain average of noisy bones is too long. A bone b between joints of confidence w and w'
    is seen as d = b + n, where each coordinate of n has the variance v = σ² (1/w + 1/w'), so that
    E‖d‖² = ‖b‖² + 3 v, or ‖b‖² + 6 σ² at confidence 1. For Gaussian noise the estimate is

        ℓ² = Σ_t (‖d_t‖² − 3 v_t) / v_t  /  Σ_t 1/v_t,

    of which the mean is exact, and which has the least variance where bones are long beside the
    noise. Student-t noise may have no variance. There, ℓ is the length at which simulated bones,
    of the directions seen and with the frames' own noise, have the median that the recording has.

    A bone is seen where both of its joints are. One that never is, or whose median or mean square
    is no greater than the noise alone would make it, is as long as its mirror image (a left
    forearm as the right one); where that has no length either, as ``typical`` says.

    Parameters
    ----------
    joints : ndarray, (L, J, 3)
        Metres. Entries with confidence 0 are not read and may be NaN.
    confidence : ndarray, (L, J), or None
        Multiplies the precision; 0 hides a joint; 1 everywhere where None.
    skeleton : Skeleton
        Whose joints they are.
    noise : float
        σ, the standard deviation (Student-t: scale) of a coordinate of confidence 1, metres.
    degrees_of_freedom : float, optional
        Of Student-t noise; Gaussian by default.
    typical : ndarray, (J,), optional
        Lengths of bones that the recording does not show, metres, such as the average over what
        was learnt from; without them such a bone is an error.

    Returns
    -------
    ndarray, (J,)
        Length of the bone from each joint to its parent, metres; 0 for a root.

    Raises
    ------
    ValueError
        If a bone has no length and there is no ``typical`` one, a joint that is seen is not
        finite, or a shape or a number does not fit.
    """
    joints = np.asarray(joints, dtype=np.float64)
    check_shape("joints", joints, ("L", skeleton.n_joints, 3))
    shown = np.ones(joints.shape[:2]) if confidence is None else np.asarray(confidence, np.float64)
    check_shape("confidence", shown, joints.shape[:2])
    entries = EntryNoise(float(noise), shown, degrees_of_freedom)
    check_finite("joints", joints[entries.visible])
    if typical is not None:
        typical = np.asarray(typical, dtype=np.float64)
        check_shape("typical", typical, (skeleton.n_joints,))
        check_finite("typical", typical)
    found = np.full(skeleton.n_joints, np.nan)
    for joint, parent in skeleton.bones:
        seen = entries.visible[:, [joint, parent]].all(axis=1)
        if not seen.any():
            continue
        bones = joints[seen, joint] - joints[seen, parent]
        precisions = entries.precision[seen][:, [joint, parent]]
        if degrees_of_freedom is None:
            found[joint] = _from_mean_square(bones, precisions)
        else:
            found[joint] = _from_median(bones, precisions, degrees_of_freedom)
    return _completed(found, skeleton, typical)


def _from_mean_square(bones: np.ndarray, precisions: np.ndarray) -> float:
    """Return ℓ of bones (n, 3) with precisions (n, 2) of their ends, NaN if ℓ² is not above 0."""
    variance = (1 / precisions).sum(axis=1)
    excess = ((bones**2).sum(axis=1) - 3 * variance) / variance
    square = excess.sum() / (1 / variance).sum()
    return float(np.sqrt(square)) if square > 0 else np.nan


def _from_median(bones: np.ndarray, precisions: np.ndarray, degrees_of_freedom: float) -> float:
    """Return ℓ at which simulated bones have the median length, NaN if none at 0 is as short.

    The same numbers are drawn for every ℓ, so that the median rises steadily with it.
    """
    seen = np.linalg.norm(bones, axis=1)
    wanted = float(np.median(seen))
    copies = -(-_SIMULATED // len(bones))
    rng = seeds.generator(0, "bone lengths")
    unit = rng.standard_t(degrees_of_freedom, (copies, *bones.shape, 2))
    stray = (unit / np.sqrt(precisions)[:, None, :]).sum(axis=-1)
    directions = bones / np.maximum(seen, 1e-12)[:, None]

    def median(length: float) -> float:
        return float(np.median(np.linalg.norm(length * directions + stray, axis=-1)))

    low, high = 0.0, wanted
    if median(low) >= wanted:
        return np.nan
    while median(high) < wanted:  # seldom: strays may point against bones
        high *= 2
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if median(middle) < wanted else (low, middle)
    return (low + high) / 2


def _completed(found: np.ndarray, skeleton: Skeleton, typical: np.ndarray | None) -> np.ndarray:
    """Return the lengths with those that are NaN taken from mirrored bones or typical ones."""
    lengths = found.copy()
    order = skeleton.mirrored_order
    for joint, parent in enumerate(skeleton.parents):
        if parent < 0:
            lengths[joint] = 0.0
        elif np.isnan(found[joint]):
            mirrored = order[joint]
            same_bone = skeleton.parents[mirrored] == order[parent]
            if same_bone and not np.isnan(found[mirrored]):
                lengths[joint] = found[mirrored]
            elif typical is not None:
                lengths[joint] = typical[joint]
            else:
                names = skeleton.joint_names
                raise ValueError(
                    f"joints show no length of the bone from {names[parent]} to {names[joint]}, "
                    "nor of its mirror image, above the noise in any frame; expected one that "
                    "does, or typical lengths"
                )
    return lengths
