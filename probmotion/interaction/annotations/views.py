"""Camera views in a pair's own frame, their distribution, and pictures in them (Yin et al. 2018).

A viewing direction d, from the scene towards the viewer, is [i j k] (a, b, c)ᵀ in the frame of
:mod:`probmotion.interaction.annotations.local_frames`, and the view is (eq. 4)

    φ = atan2(c, a),   θ = arccos(b / √(a² + b² + c²)).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from probmotion.arrays import logsumexp
from probmotion.interaction.annotations.local_frames import (
    SMALLEST_SINE,
    cross,
    frames_are_sound,
    pair_frames,
    unit,
)
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count, check_positive, check_shape

__all__ = [
    "ViewDistribution",
    "image_axes",
    "project_to_views",
    "view_angles",
    "view_directions",
    "view_vectors",
]

_ROWS = 1 << 20  # numbers in memory at once, per array
_DEVIATIONS = 9.0  # a kernel this many bandwidths away is below the last digit


@dataclass(frozen=True, eq=False)
class ViewDistribution:
    """Kernel density of camera views, f(v) = (1/n) Σᵢ N(v; v(pᵢ), σ_v² I).

    φ is an angle: the kernel is wrapped round the circle. A kernel that reaches over a pole goes
    down the other side: (φ, −θ) and (φ, 2π − θ) are the views (φ + π, θ). So the density is
    normalised with respect to dφ dθ on [−π, π) × [0, π], and :meth:`sample` draws from it exactly.

    Parameters
    ----------
    views : ndarray, (n, 2)
        φ and θ of each annotation, radians, φ at any turn and θ in [0, π]; NaN for annotations
        whose view is unknown, which are never drawn and never near.
    bandwidth : float
        σ_v, radians.

    Raises
    ------
    ValueError
        If no view is known, θ is out of range, or the bandwidth is not above 0.
    """

    views: np.ndarray
    bandwidth: float = 0.5

    def __post_init__(self) -> None:
        views = np.asarray(self.views, dtype=np.float64)
        check_shape("views", views, ("n", 2))
        if np.isinf(views).any():
            raise ValueError("views has infinite values, expected numbers, or NaN where unknown")
        known = views[~np.isnan(views).any(axis=-1)]
        if len(known) == 0:
            raise ValueError(f"views has {len(views)} rows and none must be at least 1, got known")
        if known[:, 1].min() < 0 or known[:, 1].max() > np.pi:
            raise ValueError(
                f"views has θ from {known[:, 1].min():g} to {known[:, 1].max():g}, expected it "
                "between 0 and π"
            )
        check_positive("bandwidth", self.bandwidth)
        object.__setattr__(self, "views", views)
        object.__setattr__(self, "bandwidth", float(self.bandwidth))

    @cached_property
    def known(self) -> np.ndarray:
        """Indices of the annotations whose view is known, (m,)."""
        return np.flatnonzero(~np.isnan(self.views).any(axis=-1))

    def log_density(self, views: np.ndarray) -> np.ndarray:
        """Return log f(v): ``(…, 2) → (…)``, −∞ where θ is outside [0, π]."""
        views = np.asarray(views, dtype=np.float64)
        check_shape("views", views, ("…", 2))
        flat = views.reshape(-1, 2)
        centres = self.views[self.known]
        rows = max(1, _ROWS // len(centres))
        found = np.empty(len(flat))
        for start in range(0, len(flat), rows):
            phi, theta = np.moveaxis(flat[start : start + rows, np.newaxis] - centres, -1, 0)
            over = flat[start : start + rows, np.newaxis, 1] + centres[:, 1]
            near = self._log_wrapped(phi) + self._log_wrapped(theta)
            across = self._log_wrapped(phi + np.pi) + self._log_wrapped(over)
            found[start : start + rows] = logsumexp(np.logaddexp(near, across), axis=-1)
        found -= math.log(len(centres))
        found[~((flat[:, 1] >= 0) & (flat[:, 1] <= np.pi))] = -np.inf
        return found.reshape(views.shape[:-1])

    def sample(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Return n views (n, 2): an annotation drawn uniformly, and the kernel's noise."""
        check_count("n", n)
        chosen = self.known[rng.integers(len(self.known), size=n)]
        phi, theta = (self.views[chosen] + self.bandwidth * rng.standard_normal((n, 2))).T
        theta = np.mod(theta, 2 * np.pi)
        over = theta > np.pi
        theta = np.where(over, 2 * np.pi - theta, theta)
        phi = np.mod(phi + np.where(over, 2 * np.pi, np.pi), 2 * np.pi) - np.pi
        return np.stack([phi, theta], axis=-1)

    def near(self, views: np.ndarray, n: int) -> np.ndarray:
        """Return the n annotations nearest to each view.

        Near is the angle between the unit vectors of (φ, θ), :func:`view_vectors`.

        Parameters
        ----------
        views : ndarray, (V, 2)
            Views to look from.
        n : int
            Number of annotations; all that are known where there are fewer.

        Returns
        -------
        indices : ndarray, (V, min(n, m)), int
            Nearest first; annotations equally near in the order of their indices.
        """
        check_count("n", n)
        check_shape("views", views, ("V", 2))
        asked = view_vectors(views)
        count = min(n, len(self.known))
        # A tree breaks ties as it likes: ask for all within the n-th distance, then sort.
        reach, _ = self._tree.query(asked, k=[count])
        within = self._tree.query_ball_point(asked, reach[:, 0] * (1 + 1e-9) + 1e-12)
        nearest = np.empty((len(views), count), dtype=np.int64)
        for row, (point, found) in enumerate(zip(asked, within, strict=True)):
            candidates = np.array(sorted(found))
            distance = ((self._vectors[candidates] - point) ** 2).sum(axis=-1)
            order = np.argsort(distance, kind="stable")[:count]
            nearest[row] = self.known[candidates[order]]
        return nearest

    @cached_property
    def _vectors(self) -> np.ndarray:
        return view_vectors(self.views[self.known])

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self._vectors)

    def _log_wrapped(self, angle: np.ndarray) -> np.ndarray:
        """Return the log density of the Gaussian kernel wrapped round the circle."""
        angle = np.mod(angle + np.pi, 2 * np.pi) - np.pi
        turns = math.ceil(max(0.0, _DEVIATIONS * self.bandwidth - np.pi) / (2 * np.pi))
        total = np.full(angle.shape, -np.inf)
        for turn in range(-turns, turns + 1):
            z = (angle + 2 * np.pi * turn) / self.bandwidth
            np.logaddexp(total, -(z**2) / 2, out=total)
        return total - math.log(self.bandwidth * math.sqrt(2 * math.pi))


def view_angles(frames: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return the view (φ, θ) of a viewing direction in each frame (eq. 4).

    Parameters
    ----------
    frames : ndarray, (…, 3, 3)
        Local frames, columns i, j, k.
    direction : ndarray, (…, 3)
        From the scene towards the viewer, any length above 0; broadcast against the frames.

    Returns
    -------
    views : ndarray, (…, 2)
        φ in [−π, π], θ in [0, π], radians.

    Raises
    ------
    ValueError
        If a frame is degenerate or a direction is 0; the message names the first one's index.
    """
    frames = np.asarray(frames, dtype=np.float64)
    direction = np.asarray(direction, dtype=np.float64)
    check_shape("direction", direction, ("…", 3))
    _refuse_first("frames", ~frames_are_sound(frames), "degenerate", "roots apart and a backbone")
    length = np.linalg.norm(direction, axis=-1)
    _refuse_first("direction", ~(np.isfinite(length) & (length > 0)), "no direction", "a vector")
    solved = np.linalg.solve(frames, direction[..., np.newaxis])[..., 0]
    a, b, c = np.moveaxis(solved, -1, 0)
    # arccos(b/√(a² + b² + c²)) with every digit near the poles too.
    return np.stack([np.arctan2(c, a), np.arctan2(np.hypot(a, c), b)], axis=-1)


def view_vectors(views: np.ndarray) -> np.ndarray:
    """Return (sin θ cos φ, cos θ, sin θ sin φ): ``(…, 2) → (…, 3)``, unit vectors."""
    views = np.asarray(views, dtype=np.float64)
    check_shape("views", views, ("…", 2))
    phi, theta = views[..., 0], views[..., 1]
    sine = np.sin(theta)
    return np.stack([sine * np.cos(phi), np.cos(theta), sine * np.sin(phi)], axis=-1)


def view_directions(frames: np.ndarray, views: np.ndarray) -> np.ndarray:
    """Return the viewing direction of each view, the inverse of :func:`view_angles`.

    Parameters
    ----------
    frames : ndarray, (…, 3, 3)
        Local frames.
    views : ndarray, (…, 2)
        φ and θ, broadcast against the frames.

    Returns
    -------
    directions : ndarray, (…, 3)
        Unit vectors in the coordinates of the frames' columns, 0 where a frame has no such
        direction.
    """
    check_shape("frames", frames, ("…", 3, 3))
    return unit(np.matmul(frames, view_vectors(views)[..., np.newaxis])[..., 0])


def image_axes(frames: np.ndarray, views: np.ndarray) -> np.ndarray:
    """Return the image axes of every pose in every view.

    Up is the pair's j, and i at the poles θ = 0 and π, where no choice of up is continuous.

    Parameters
    ----------
    frames : ndarray, (B, 3, 3)
        Local frames. Every number is finite for degenerate ones too.
    views : ndarray, (V, 2)
        φ and θ.

    Returns
    -------
    axes : ndarray, (B, 3, V, 2)
        Unit vectors e₁ (right) and e₂ (up) in the last axis, e₁ × e₂ towards the viewer.
    """
    towards = unit(np.matmul(view_vectors(views), np.swapaxes(frames, -1, -2)))
    up = _across(frames[:, np.newaxis, :, 1], towards)
    flat = np.einsum("bvi,bvi->bv", up, up) < SMALLEST_SINE**2
    if flat.any():
        up[flat] = np.broadcast_to(_across(frames[:, np.newaxis, :, 0], towards), towards.shape)[
            flat
        ]
    up = unit(up)
    return np.moveaxis(np.stack([cross(up, towards), up], axis=-1), 1, 2)


def project_to_views(positions: np.ndarray, views: np.ndarray, skeleton: Skeleton) -> np.ndarray:
    """Return the orthographic pictures of pose-pairs in views of their own frames (eq. 6: Θ_v).

    Parameters
    ----------
    positions : ndarray, (B, J, 3)
        Pose-pairs, metres.
    views : ndarray, (V, 2)
        φ and θ, radians.
    skeleton : Skeleton
        The characters' skeleton.

    Returns
    -------
    keypoints : ndarray, (B, V, J, 2)
        Metres, x right, y up, about the world's origin; finite, without meaning, for degenerate
        poses (``frames_are_sound``).
    """
    positions = np.asarray(positions, dtype=np.float64)
    check_shape("positions", positions, ("B", skeleton.n_joints, 3))
    views = np.asarray(views, dtype=np.float64)
    check_shape("views", views, ("V", 2))
    axes = image_axes(pair_frames(positions, skeleton), views)
    # One product a pose, not one a view: 32 small products cost more than all else together.
    n_poses, n_joints, n_views = len(positions), skeleton.n_joints, len(views)
    pictures = np.matmul(positions, axes.reshape(n_poses, 3, 2 * n_views))
    pictures = pictures.reshape(n_poses, n_joints, n_views, 2)
    return np.ascontiguousarray(np.swapaxes(pictures, 1, 2))


def _across(vectors: np.ndarray, units: np.ndarray) -> np.ndarray:
    """Return what is left of vectors across unit vectors."""
    along = np.einsum("...i,...i->...", vectors, units)
    return vectors - along[..., np.newaxis] * units


def _refuse_first(name: str, bad: np.ndarray, problem: str, expected: str) -> None:
    if bad.any():
        where = tuple(int(index) for index in np.argwhere(bad)[0])
        place = f" at index {where if len(where) != 1 else where[0]}" if where else ""
        raise ValueError(f"{name} is {problem}{place}, expected {expected}")
