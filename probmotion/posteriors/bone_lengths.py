"""Estimation of bone lengths from noisy joints (β in *Motion-DVAE*)."""

from __future__ import annotations

import numpy as np

from probmotion import seeds
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.likelihoods import entry_noise
from probmotion.validation import check_finite, check_shape

__all__ = ["bone_lengths"]

# Minimum number of simulated bones; their median has a fifth of the standard error of 300 frames.
_SIMULATED = 8000
_HALVINGS = 16  # bisection steps, to a hundredth of a millimetre


def bone_lengths(
    joints: np.ndarray,
    confidence: np.ndarray | None,
    skeleton: Skeleton,
    noise: float,
    degrees_of_freedom: float | None = None,
    typical: np.ndarray | None = None,
) -> np.ndarray:
    """Estimate the length of every bone over a recording (Motion-DVAE, supplements B and C).

    The average length of noisy bones is biased upwards. A bone b between joints of confidence w
    and w' is observed as d = b + n, where each coordinate of n has variance v = σ² (1/w + 1/w'),
    so E‖d‖² = ‖b‖² + 3 v. For Gaussian noise, the estimate

        ℓ² = Σ_t (‖d_t‖² − 3 v_t) / v_t  /  Σ_t 1/v_t

    is unbiased. Student-t noise may have infinite variance; ℓ is then the length at which
    simulated bones, with the observed directions and each frame's noise, have the median length
    of the recording.

    A bone is observed in frames where both of its joints are observed. A bone without an estimate
    (never observed, or not distinguishable from noise) is assigned the length of its mirror image
    or, failing that, its ``typical`` length.

    Parameters
    ----------
    joints : ndarray, (L, J, 3)
        Metres. Entries with confidence 0 are ignored and may be NaN.
    confidence : ndarray, (L, J), or None
        Multiplier of the precision; 0 marks an occluded joint. ``None`` means 1 everywhere.
    skeleton : Skeleton
        Skeleton of the joints.
    noise : float
        σ, the standard deviation (Student-t: scale) of a coordinate of confidence 1, metres.
    degrees_of_freedom : float, optional
        Degrees of freedom of Student-t noise; Gaussian noise by default.
    typical : ndarray, (J,), optional
        Fallback lengths, metres, e.g. averages over the training data.

    Returns
    -------
    ndarray, (J,)
        Length of the bone from each joint to its parent, metres; 0 for a root.

    Raises
    ------
    ValueError
        If a bone has no estimate and no typical length, a visible joint is not finite, or a shape
        or number is invalid.
    """
    joints = np.asarray(joints, dtype=np.float64)
    check_shape("joints", joints, ("L", skeleton.n_joints, 3))
    entries = entry_noise(noise, confidence, degrees_of_freedom, joints.shape[:2])
    check_finite("joints", joints[entries.visible])
    if typical is not None:
        typical = np.asarray(typical, dtype=np.float64)
        check_shape("typical", typical, (skeleton.n_joints,))
        check_finite("typical", typical)
    estimates = np.full(skeleton.n_joints, np.nan)
    for joint, parent in skeleton.bones:
        seen = entries.visible[:, [joint, parent]].all(axis=1)
        if not seen.any():
            continue
        bones = joints[seen, joint] - joints[seen, parent]
        precisions = entries.precision[seen][:, [joint, parent]]
        if degrees_of_freedom is None:
            estimates[joint] = _from_mean_square(bones, precisions)
        else:
            estimates[joint] = _from_median(bones, precisions, degrees_of_freedom)
    return _completed(estimates, skeleton, typical)


def _from_mean_square(bones: np.ndarray, precisions: np.ndarray) -> float:
    """Return ℓ of bones (n, 3) with precisions (n, 2) of their ends; NaN unless ℓ² > 0."""
    variance = (1 / precisions).sum(axis=1)
    excess = ((bones**2).sum(axis=1) - 3 * variance) / variance
    square = excess.sum() / (1 / variance).sum()
    return float(np.sqrt(square)) if square > 0 else np.nan


def _from_median(bones: np.ndarray, precisions: np.ndarray, degrees_of_freedom: float) -> float:
    """Return ℓ at which simulated bones have the observed median length; NaN without a solution."""
    observed = np.linalg.norm(bones, axis=1)
    target = float(np.median(observed))
    copies = -(-_SIMULATED // len(bones))
    rng = seeds.generator(0, "bone lengths")
    # Use the same errors for every ℓ, so that the median is monotone.
    unit = rng.standard_t(degrees_of_freedom, (copies, *bones.shape, 2))
    errors = (unit / np.sqrt(precisions)[:, None, :]).sum(axis=-1)
    directions = bones / np.maximum(observed, 1e-12)[:, None]

    def median(length: float) -> float:
        return float(np.median(np.linalg.norm(length * directions + errors, axis=-1)))

    low, high = 0.0, target
    if median(low) >= target:
        return np.nan
    while median(high) < target:  # rare: the noise may shorten the bones
        high *= 2
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if median(middle) < target else (low, middle)
    return (low + high) / 2


def _completed(estimates: np.ndarray, skeleton: Skeleton, typical: np.ndarray | None) -> np.ndarray:
    """Return the lengths with NaN replaced by mirrored or typical lengths."""
    lengths = estimates.copy()
    lengths[list(skeleton.roots)] = 0.0
    order = skeleton.mirrored_order
    for joint, parent in skeleton.bones:
        if not np.isnan(estimates[joint]):
            continue
        if skeleton.parents[order[joint]] == order[parent]:
            lengths[joint] = estimates[order[joint]]
        if not np.isnan(lengths[joint]):
            continue
        if typical is None:
            names = skeleton.joint_names
            raise ValueError(
                f"joints must determine the length of the bone from {names[parent]} to "
                f"{names[joint]} or its mirror image, got no estimate; pass typical lengths"
            )
        lengths[joint] = typical[joint]
    return lengths
