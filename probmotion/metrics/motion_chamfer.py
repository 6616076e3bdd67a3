"""Motion Chamfer Distance between sets of 2D sequences.

Sun et al. 2024 ("Ponymation", section 4.3 and appendix C) compare 1400 generated sequences of 10
frames, projected to 2D, with annotated sequences.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from probmotion.validation import check_count, check_finite, check_shape

__all__ = ["MotionChamfer", "motion_chamfer_distance"]

# Matrix products are padded to this size; rounding is then independent of the number of sequences.
_BLOCK = 256


class MotionChamfer(NamedTuple):
    """Both directions of a Motion Chamfer Distance, in squared keypoint units.

    ``of_generated`` is the mean error of generated sequences to the nearest real one (fidelity).
    ``of_real`` is the mean error of real sequences to the nearest generated one (coverage).
    """

    of_generated: float
    of_real: float

    @property
    def mean(self) -> float:
        """Motion Chamfer Distance: mean of the two directions."""
        return (self.of_generated + self.of_real) / 2


def motion_chamfer_distance(
    generated: np.ndarray,
    real: np.ndarray,
    *,
    visible: np.ndarray | None = None,
    frames: int = 10,
) -> MotionChamfer:
    """Return the mean nearest-neighbour errors between generated and real sequences.

    The error of a pair is the keypoint MSE averaged over frames::

        d(g, r) = 1/|T_r| Σ_{t ∈ T_r} 1/|V_rt| Σ_{j ∈ V_rt} ‖g_tj − r_tj‖²

    for a generated sequence g and a real one r. V_rt are the keypoints of r visible in frame t, T_r
    the frames with visible keypoints. Centre and scale both sets alike; nothing is aligned here.

    Sequences are split into windows of ``frames`` frames. All real windows form one set. The
    generated windows at each position form one set, and distances are averaged over positions
    (appendix C), so that longer sequences do not enlarge the set.

    Parameters
    ----------
    generated : ndarray, (N, L, J, 2)
        Generated keypoints.
    real : ndarray, (M, L', J, 2)
        Annotated keypoints; invisible ones may be NaN.
    visible : ndarray of bool, (M, L', J), optional
        Mask of visible real keypoints; all by default.
    frames : int
        Frames per window; must divide L and L'.
    """
    check_count("frames", frames)
    check_shape("generated", generated, ("N", "L", "J", 2))
    check_shape("real", real, ("M", "L", generated.shape[2], 2))
    seen = np.ones(real.shape[:3], bool) if visible is None else visible
    check_shape("visible", seen, real.shape[:3])
    if seen.dtype != bool:
        raise ValueError(f"visible must be boolean, got {seen.dtype}")
    check_finite("generated", generated)
    filled = np.where(seen[..., None], real, 0.0)
    check_finite("real", filled)
    for name, sequences in (("generated", generated), ("real", real)):
        if sequences.size == 0:
            raise ValueError(f"{name} must contain at least one sequence, got {sequences.shape}")
        if sequences.shape[1] % frames:
            raise ValueError(
                f"{name} must have a multiple of frames={frames} frames, got {sequences.shape[1]}"
            )
    targets = filled.reshape(-1, frames, *filled.shape[2:])
    weights = _weights(seen.reshape(-1, frames, seen.shape[2]))
    distances = [
        _chamfer(generated[:, start : start + frames], targets, weights)
        for start in range(0, generated.shape[1], frames)
    ]
    of_generated, of_real = np.mean(distances, axis=0)
    return MotionChamfer(float(of_generated), float(of_real))


def _weights(seen: np.ndarray) -> np.ndarray:
    """Return the weights (M, L, J) of keypoints in d(g, r); they sum to 1 in every sequence."""
    in_frame = seen.sum(axis=2, keepdims=True)
    in_sequence = (in_frame > 0).sum(axis=1, keepdims=True)
    if not in_sequence.all():
        raise ValueError(
            "visible must contain a keypoint in every real window, got none in window "
            f"{int(np.flatnonzero(in_sequence == 0)[0])}"
        )
    return seen / np.maximum(in_frame, 1) / in_sequence


def _chamfer(generated: np.ndarray, real: np.ndarray, weights: np.ndarray) -> tuple[float, float]:
    """Return the mean nearest-neighbour errors in both directions.

    The error of a pair, Σ w ‖g‖² − 2 Σ w g·r + Σ w ‖r‖² with weights w, is computed in blocks.
    """
    of_generated, of_real = np.full(len(generated), np.inf), np.full(len(real), np.inf)
    constant = (weights * (real**2).sum(axis=-1)).sum(axis=(1, 2))
    factor = np.concatenate([weights[..., None], -2 * weights[..., None] * real], axis=-1)
    right = factor.reshape(len(real), -1)
    for row in range(0, len(generated), _BLOCK):
        rows = slice(row, min(row + _BLOCK, len(generated)))
        g = np.asarray(generated[rows], np.float64)
        left = np.concatenate([(g**2).sum(axis=-1, keepdims=True), g], axis=-1)
        left = _padded(left.reshape(len(g), -1))
        for column in range(0, len(real), _BLOCK):
            columns = slice(column, min(column + _BLOCK, len(real)))
            block = left @ _padded(right[columns]).T
            block = block[: rows.stop - row, : columns.stop - column] + constant[columns]
            # Errors of identical sequences may be negative by rounding.
            block = np.maximum(block, 0.0)
            of_generated[rows] = np.minimum(of_generated[rows], block.min(axis=1))
            of_real[columns] = np.minimum(of_real[columns], block.min(axis=0))
    return float(of_generated.mean()), float(of_real.mean())


def _padded(rows: np.ndarray) -> np.ndarray:
    return np.pad(rows, ((0, _BLOCK - len(rows)), (0, 0)))
