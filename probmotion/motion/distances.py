"""Distances between sets of 3D motions, invariant to heading.

Motions are compared with roots at the origin, after the rotation about the vertical that minimises
their distance. Mirror images are different motions, since depth inversion is the typical error of
lifting from 2D.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from probmotion.validation import check_count, check_finite, check_shape

__all__ = ["mirrored_fraction", "nearest_distances", "windows", "yaw_aligned_distances"]

# Matrix products are padded to this size; rounding is then independent of the number of motions.
_BLOCK = 256


class NearestDistances(NamedTuple):
    """Both directions of a Chamfer distance between sets of motions, metres."""

    of_draws: float
    """Mean distance of draws to the nearest real motion (fidelity)."""
    of_real: float
    """Mean distance of real motions to the nearest draw (coverage)."""


def yaw_aligned_distances(
    a: np.ndarray, b: np.ndarray, *, root: int = 0, mirrored: bool = False
) -> np.ndarray:
    """Return the distances between two sets of motions: ``(N, L, J, 3), (M, …) → (N, M)``, metres.

    The distance is the root mean square over joints and frames, with roots at the origin in every
    frame, minimised over one rotation about the vertical per pair. With h = x + iz and height y::

        d² = (‖a‖² + ‖b‖² − 2 y_a·y_b − 2 |Σ h̄_a h_b|) / (L J)

    Parameters
    ----------
    a, b : ndarray, (N, L, J, 3) and (M, L, J, 3)
        Motions, metres.
    root : int
        Index of the root joint.
    mirrored : bool
        Whether to invert the depth of ``a``, without exchanging left and right joints.

    Raises
    ------
    ValueError
        If shapes disagree or a number is not finite.
    """
    first, second = _pair({"a": a, "b": b}, root)
    distances = np.empty((len(a), len(b)))
    for rows, columns, block in _blocks(first, second, mirrored):
        distances[rows, columns] = block
    return distances


def nearest_distances(draws: np.ndarray, real: np.ndarray, *, root: int = 0) -> NearestDistances:
    """Return the mean distance from draws to the nearest real motion, and the reverse.

    Fidelity alone is not sufficient, since all draws may copy one real motion. Both means decrease
    with the size of the other set, so compare samplers at equal sizes.

    Parameters
    ----------
    draws, real : ndarray, (N, L, J, 3) and (M, L, J, 3)
        Motions, metres; see :func:`windows` for long clips.
    root : int
        Index of the root joint.

    Raises
    ------
    ValueError
        If shapes disagree, a set is empty or a number is not finite.
    """
    of_draws, of_real = _nearest(draws, real, root, mirrored=False)
    return NearestDistances(float(of_draws.mean()), float(of_real.mean()))


def mirrored_fraction(draws: np.ndarray, real: np.ndarray, *, root: int = 0) -> float:
    """Return the fraction of draws that are farther from real motion than their depth mirror image.

    Mirroring inverts depth but does not exchange joint names, so knees bend backwards. Orthographic
    cameras at elevation 0 do not distinguish mirror images, so the expected fraction is 0.5.

    Parameters
    ----------
    draws, real, root
        Parameters of :func:`nearest_distances`.
    """
    unmirrored, _ = _nearest(draws, real, root, mirrored=False)
    mirrored, _ = _nearest(draws, real, root, mirrored=True)
    return float((mirrored < unmirrored).mean())


def windows(positions: np.ndarray, frames: int, stride: int = 1) -> np.ndarray:
    """Return windows of a clip that start every ``stride`` frames: (L, J, 3) → (n, frames, J, 3).

    Raises
    ------
    ValueError
        If the clip is shorter than a window.
    """
    check_shape("positions", positions, ("L", "J", 3))
    check_count("frames", frames)
    check_count("stride", stride)
    if len(positions) < frames:
        raise ValueError(
            f"positions must have at least frames={frames} frames, got {len(positions)}"
        )
    starts = np.arange(0, len(positions) - frames + 1, stride)
    return positions[starts[:, None] + np.arange(frames)]


@dataclass(frozen=True, eq=False)
class _Flat:
    """N motions relative to their root: horizontal positions x + iz and heights, (N, L J) each."""

    horizontal: np.ndarray
    heights: np.ndarray
    squares: np.ndarray
    shape: tuple[int, ...]

    @classmethod
    def of(cls, name: str, motions: np.ndarray, root: int) -> _Flat:
        check_shape(name, motions, ("N", "L", "J", 3))
        check_finite(name, motions)
        if motions.size == 0:
            raise ValueError(f"{name} must contain at least one motion, got shape {motions.shape}")
        centred = np.asarray(motions, np.float64)
        centred = centred - centred[:, :, root : root + 1]
        flat = centred.reshape(len(motions), -1, 3)
        return cls(
            flat[..., 0] + 1j * flat[..., 2],
            np.ascontiguousarray(flat[..., 1]),
            (flat**2).sum(axis=(1, 2)),
            motions.shape[1:],
        )


def _pair(motions: dict[str, np.ndarray], root: int) -> tuple[_Flat, _Flat]:
    """Return two named sets of motions after checking that their shapes agree."""
    first, second = (_Flat.of(name, values, root) for name, values in motions.items())
    if first.shape != second.shape:
        name_a, name_b = motions
        raise ValueError(
            f"{name_b} must have motions of shape {first.shape} like {name_a}, got {second.shape}"
        )
    return first, second


def _blocks(a: _Flat, b: _Flat, mirrored: bool) -> Iterator[tuple[slice, slice, np.ndarray]]:
    """Yield blocks of the distance matrix with their rows and columns."""
    horizontal = a.horizontal if mirrored else a.horizontal.conj()
    for row in range(0, len(horizontal), _BLOCK):
        rows = slice(row, min(row + _BLOCK, len(horizontal)))
        left, upright = _padded(horizontal[rows]), _padded(a.heights[rows])
        for column in range(0, len(b.squares), _BLOCK):
            columns = slice(column, min(column + _BLOCK, len(b.squares)))
            inner = np.abs(left @ _padded(b.horizontal[columns]).T)
            inner += upright @ _padded(b.heights[columns]).T
            inner = inner[: rows.stop - row, : columns.stop - column]
            squares = a.squares[rows, None] + b.squares[columns] - 2 * inner
            # Squared distances of identical motions may be negative by rounding.
            yield rows, columns, np.sqrt(np.maximum(squares, 0.0) / horizontal.shape[1])


def _padded(rows: np.ndarray) -> np.ndarray:
    if len(rows) == _BLOCK:
        return rows
    padded = np.zeros((_BLOCK, rows.shape[1]), rows.dtype)
    padded[: len(rows)] = rows
    return padded


def _nearest(
    draws: np.ndarray, real: np.ndarray, root: int, mirrored: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance of each draw to the nearest real motion, and the reverse."""
    first, second = _pair({"draws": draws, "real": real}, root)
    of_draws, of_real = np.full(len(draws), np.inf), np.full(len(real), np.inf)
    for rows, columns, block in _blocks(first, second, mirrored):
        of_draws[rows] = np.minimum(of_draws[rows], block.min(axis=1))
        of_real[columns] = np.minimum(of_real[columns], block.min(axis=0))
    return of_draws, of_real
