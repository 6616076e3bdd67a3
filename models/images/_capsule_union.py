"""Smooth union of capsules: signed distance, normals, and the share of each capsule in it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from probmotion.io.body_mesh import Part

__all__ = ["CapsuleUnion", "Nearby"]

_CHUNK = 4096  # points at once


class Nearby(NamedTuple):
    """A smooth union of P capsules at N points."""

    values: np.ndarray  # (N,), signed distance to the union, metres
    slopes: np.ndarray  # (N, 3), derivatives of the values to first order at the surface
    shares: np.ndarray  # (N, P), derivatives of the values by distances to capsules, sums 1
    radii: np.ndarray  # (N,), mean radius of the capsules next to a point, metres


class CapsuleUnion:
    """Smooth minimum −s log Σ exp(−d_p / s) of the signed distances d_p to P capsules.

    A polynomial minimum of several distances would depend on their order, so that the union of a
    symmetric body would not be symmetric.

    Parameters
    ----------
    parts : sequence of Part
        P capsules.
    softness : float
        Length s over which capsules blend, metres.
    """

    def __init__(self, parts: Sequence[Part], softness: float) -> None:
        self.parts = tuple(parts)
        self.softness = softness
        axes = np.array([part.axes for part in parts])
        self._axes = axes.reshape(-1, 3)
        self._starts = np.einsum("pik,pk->pi", axes, [part.start for part in parts])
        self._lengths = np.array([np.linalg.norm(part.end - part.start) for part in parts])
        self._radii = np.array([part.radii for part in parts])
        self._flat = np.array([[*part.flat, 1.0] for part in parts])

    def at(self, points: np.ndarray) -> Nearby:
        """Return values, slopes, shares and radii at points (N, 3)."""
        chunks = [self._at(points[at : at + _CHUNK]) for at in range(0, len(points), _CHUNK)]
        return Nearby(*(np.concatenate(arrays) for arrays in zip(*chunks, strict=True)))

    def values(self, points: np.ndarray) -> np.ndarray:
        """Return the signed distances of points (N, 3) to the union, (N,), metres."""
        chunks = [points[at : at + _CHUNK] for at in range(0, len(points), _CHUNK)]
        return np.concatenate([self._minimum(self._distances(chunk)[0])[0] for chunk in chunks])

    def projected(self, points: np.ndarray, steps: int = 1) -> np.ndarray:
        """Return points (N, 3) moved to the surface along its normals by Newton steps."""
        for _ in range(steps):
            near = self.at(points)
            size = (near.slopes**2).sum(axis=-1)
            points = points - (near.values / size)[:, None] * near.slopes
        return points

    def _at(self, points: np.ndarray) -> Nearby:
        distances, normals, radii = self._distances(points)
        values, shares = self._minimum(distances)
        slopes = (shares[..., None] * normals).reshape(len(points), -1) @ self._axes
        return Nearby(values, slopes, shares, (shares * radii).sum(axis=-1))

    def _minimum(self, distances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        least = distances.min(axis=-1)
        shares = np.exp((least[:, None] - distances) / self.softness)
        total = shares.sum(axis=-1)
        return least - self.softness * np.log(total), shares / total[:, None]

    def _distances(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return distances to the capsules, exact to first order, with local normals and radii."""
        local = (points @ self._axes.T).reshape(len(points), -1, 3) - self._starts
        along = np.clip(local[..., 2], 0.0, self._lengths)
        first, last = self._radii.T
        radii = first + (last - first) * along / self._lengths
        local[..., 2] -= along
        local /= self._flat
        across = np.linalg.norm(local, axis=-1)
        local /= self._flat
        slope = np.linalg.norm(local, axis=-1)
        # Both are 0 on the axis.
        across, slope = np.maximum(across, 1e-9), np.maximum(slope, 1e-9)
        return (across - radii) * across / slope, local / slope[..., None], radii
