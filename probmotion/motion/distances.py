"""How far is generated 3D motion from real 3D motion, whichever way a person faces?

Motions are compared about their root, after the turn about the vertical that brings them nearest.
A mirrored motion is another motion: exchanging depths is the error that 2D data invite.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from probmotion.validation import check_count, check_finite, check_shape

__all__ = [
    "NearestDistances",
    "mirrored_fraction",
    "nearest_distances",
    "windows",
    "yaw_aligned_distances",
]

# All products have this shape, padded, so that a distance never depends on the other motions.
_BLOCK = 256


class NearestDistances(NamedTuple):
    """The two halves of a Chamfer distance between sets of motions, metres."""

    of_draws: float
    """Mean over draws of the distance to the nearest real motion: fidelity."""
    of_real: float
    """Mean over real motions of the distance to the nearest draw: coverage."""


def yaw_aligned_distances(
    a: np.ndarray, b: np.ndarray, *, root: int = 0, mirrored: bool = False
) -> np.ndarray:
    """Return every distance between two sets of motions: ``(N, L, J, 3), (M, …) → (N, M)``.

    The root mean square, over joints and frames, of the distance between joints, with roots at the
    origin in every frame, at its minimum over one turn about the vertical per pair. With
    h = x + iz and the heights y, that is, in closed form,

        d² = (‖a‖² + ‖b‖² − 2 y_a·y_b − 2 |Σ h̄_a h_b|) / (L J)

    so copies of a motion are at 0 up to about 1e-8 of its size. (The mean distance of joints has
    no such form.)

    Parameters
    ----------
    a, b : ndarray, (N, L, J, 3) and (M, L, J, 3)
        Motions, metres.
    root : int
        The joint at the origin.
    mirrored : bool
        Measure from the mirror images of ``a`` in depth, left joints still called left.

    Raises
    ------
    ValueError
        If shapes disagree or a number is not finite.
    """
    first, second = _Flat.of("a", a, root), _Flat.of("b", b, root)
    _check_alike(first, second)
    distances = np.empty((len(a), len(b)))
    for rows, columns, block in _blocks(first, second, mirrored):
        distances[rows, columns] = block
    return distances


def nearest_distances(draws: np.ndarray, real: np.ndarray, *, root: int = 0) -> NearestDistances:
    """Return how near draws are to real motion, and real motion to draws.

    Both matter: copies of one real motion are near, and cover nothing. Both fall with the size of
    the other set; compare samplers at equal sizes, beside real motion's own distances.

    Parameters
    ----------
    draws, real : ndarray, (N, L, J, 3) and (M, L, J, 3)
        Motions, metres; see :func:`windows` for long clips.
    root : int
        The joint at the origin.

    Raises
    ------
    ValueError
        If shapes disagree, a set is empty or a number is not finite.
    """
    of_draws, of_real = _nearest(draws, real, root, mirrored=False)
    return NearestDistances(float(of_draws.mean()), float(of_real.mean()))


def mirrored_fraction(draws: np.ndarray, real: np.ndarray, *, root: int = 0) -> float:
    """Return the share of draws whose mirror image in depth is nearer to real motion than they are.

    The image exchanges near and far, and no names: knees bend backwards. Orthographic cameras at
    elevation 0 cannot tell the two apart, so a sampler that sees no more has .5 here.

    Parameters
    ----------
    draws, real, root
        As in :func:`nearest_distances`.
    """
    straight, _ = _nearest(draws, real, root, mirrored=False)
    images, _ = _nearest(draws, real, root, mirrored=True)
    return float((images < straight).mean())


def windows(positions: np.ndarray, frames: int, stride: int = 1) -> np.ndarray:
    """Return a clip's windows, starting every ``stride`` frames: ``(L, J, 3) → (n, frames, J, 3)``.

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
            f"positions has {len(positions)} frames, expected at least frames={frames}"
        )
    starts = np.arange(0, len(positions) - frames + 1, stride)
    return positions[starts[:, None] + np.arange(frames)]


@dataclass(frozen=True, eq=False)
class _Flat:
    """N motions about their root: horizontal positions x + iz and heights, (N, L J) each."""

    horizontal: np.ndarray
    heights: np.ndarray
    squares: np.ndarray
    shape: tuple[int, ...]

    @classmethod
    def of(cls, name: str, motions: np.ndarray, root: int) -> _Flat:
        check_shape(name, motions, ("N", "L", "J", 3))
        check_finite(name, motions)
        if motions.size == 0:
            raise ValueError(f"{name} must have shape at least one motion, got {motions.shape}")
        centred = np.asarray(motions, np.float64)
        centred = centred - centred[:, :, root : root + 1]
        flat = centred.reshape(len(motions), -1, 3)
        return cls(
            flat[..., 0] + 1j * flat[..., 2],
            np.ascontiguousarray(flat[..., 1]),
            (flat**2).sum(axis=(1, 2)),
            motions.shape[1:],
        )


def _check_alike(a: _Flat, b: _Flat) -> None:
    if a.shape != b.shape:
        raise ValueError(f"b has motions of shape {b.shape}, expected {a.shape} like those of a")


def _blocks(a: _Flat, b: _Flat, mirrored: bool) -> Iterator[tuple[slice, slice, np.ndarray]]:
    """Yield rows, columns and the distances between them."""
    turn = a.horizontal if mirrored else a.horizontal.conj()
    for row in range(0, len(turn), _BLOCK):
        rows = slice(row, min(row + _BLOCK, len(turn)))
        level, upright = _padded(turn[rows]), _padded(a.heights[rows])
        for column in range(0, len(b.squares), _BLOCK):
            columns = slice(column, min(column + _BLOCK, len(b.squares)))
            inner = np.abs(level @ _padded(b.horizontal[columns]).T)
            inner += upright @ _padded(b.heights[columns]).T
            inner = inner[: rows.stop - row, : columns.stop - column]
            squares = a.squares[rows, None] + b.squares[columns] - 2 * inner
            # Rounding makes the squared distance of copies a little less than 0.
            yield rows, columns, np.sqrt(np.maximum(squares, 0.0) / turn.shape[1])


def _padded(rows: np.ndarray) -> np.ndarray:
    if len(rows) == _BLOCK:
        return rows
    padded = np.zeros((_BLOCK, rows.shape[1]), rows.dtype)
    padded[: len(rows)] = rows
    return padded


def _nearest(
    draws: np.ndarray, real: np.ndarray, root: int, mirrored: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Distance of each draw to the nearest real motion, and of each real one to a draw."""
    first, second = _Flat.of("draws", draws, root), _Flat.of("real", real, root)
    if first.shape != second.shape:
        raise ValueError(
            f"real has motions of shape {second.shape}, expected {first.shape} like the draws"
        )
    of_draws, of_real = np.full(len(draws), np.inf), np.full(len(real), np.inf)
    for rows, columns, block in _blocks(first, second, mirrored):
        of_draws[rows] = np.minimum(of_draws[rows], block.min(axis=1))
        of_real[columns] = np.minimum(of_real[columns], block.min(axis=0))
    return of_draws, of_real
