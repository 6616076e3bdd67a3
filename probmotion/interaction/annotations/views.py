"""Camera views in a pair's local frame, their distribution and projections (Yin et al. 2018).

A viewing direction from the scene towards the viewer is [i j k] (a, b, c)ᵀ in the local frame of
:mod:`probmotion.interaction.annotations.local_frames`. The view is (eq. 4)

    φ = atan2(c, a),   θ = arccos(b / √(a² + b² + c²)).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from probmotion.arrays import logsumexp
from probmotion.interaction.annotations.local_frames import (
    SMALLEST_SINE,
    cross,
    pair_frames,
    unit,
    valid_frames,
)
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count, check_positive, check_shape

__all__ = ["ViewDistribution", "image_axes", "project_to_views", "view_angles", "view_vectors"]

_MAX_ELEMENTS = 1 << 20  # maximum number of elements of a temporary array
_DEVIATIONS = 9.0  # bandwidths beyond which a kernel is below machine precision


@dataclass(frozen=True, eq=False)
class ViewDistribution:
    """Kernel density of camera views, f(v) = (1/n) Σᵢ N(v; v(pᵢ), σ_v² I).

    Kernels are wrapped around the circle in φ and reflected at the poles: (φ, −θ) and (φ, 2π − θ)
    are the view (φ + π, θ). The density is normalised with respect to dφ dθ on [−π, π) × [0, π],
    and :meth:`sample` draws from it exactly.

    Parameters
    ----------
    views : ndarray, (n, 2)
        Views v(pᵢ) of the annotations: φ (modulo 2π) and θ in [0, π], radians; NaN if unknown. At
        least one must be known.
    bandwidth : float
        Bandwidth σ_v, radians.
    """

    views: np.ndarray
    bandwidth: float = 0.5

    def __post_init__(self) -> None:
        views = np.asarray(self.views, dtype=np.float64)
        check_shape("views", views, ("n", 2))
        if np.isinf(views).any():
            raise ValueError("views must be finite, or NaN if unknown, got infinite values")
        known = views[~np.isnan(views).any(axis=-1)]
        if len(known) == 0:
            raise ValueError("views must contain at least one known view, got none")
        if known[:, 1].min() < 0 or known[:, 1].max() > np.pi:
            raise ValueError(
                f"views must have θ from 0 to π, got {known[:, 1].min():g} to {known[:, 1].max():g}"
            )
        check_positive("bandwidth", self.bandwidth)
        object.__setattr__(self, "views", views)
        object.__setattr__(self, "bandwidth", float(self.bandwidth))

    @cached_property
    def known(self) -> np.ndarray:
        """Indices of annotations with a known view, (m,)."""
        return np.flatnonzero(~np.isnan(self.views).any(axis=-1))

    def log_density(self, views: np.ndarray) -> np.ndarray:
        """Return log f(v): ``(…, 2) → (…)``, −∞ for θ outside [0, π]."""
        views = np.asarray(views, dtype=np.float64)
        check_shape("views", views, ("…", 2))
        flat = views.reshape(-1, 2)
        centres = self.views[self.known]
        n_rows = max(1, _MAX_ELEMENTS // len(centres))
        log_f = np.empty(len(flat))
        for start in range(0, len(flat), n_rows):
            rows = slice(start, start + n_rows)
            phi, theta = np.moveaxis(flat[rows, np.newaxis] - centres, -1, 0)
            theta_sum = flat[rows, np.newaxis, 1] + centres[:, 1]
            direct = self._log_wrapped(phi) + self._log_wrapped(theta)
            across = self._log_wrapped(phi + np.pi) + self._log_wrapped(theta_sum)
            log_f[rows] = logsumexp(np.logaddexp(direct, across), axis=-1)
        log_f -= math.log(len(centres))
        log_f[~((flat[:, 1] >= 0) & (flat[:, 1] <= np.pi))] = -np.inf
        return log_f.reshape(views.shape[:-1])

    def sample(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Draw n views, (n, 2): those of uniformly drawn annotations plus kernel noise."""
        check_count("n", n)
        chosen = self.known[rng.integers(len(self.known), size=n)]
        phi, theta = (self.views[chosen] + self.bandwidth * rng.standard_normal((n, 2))).T
        theta = np.mod(theta, 2 * np.pi)
        crossed = theta > np.pi
        theta = np.where(crossed, 2 * np.pi - theta, theta)
        phi = np.mod(phi + np.where(crossed, 2 * np.pi, np.pi), 2 * np.pi) - np.pi
        return np.stack([phi, theta], axis=-1)

    def near(self, views: np.ndarray, n: int) -> np.ndarray:
        """Return the n annotations whose :func:`view_vectors` are closest to that of each view.

        ``(V, 2) → (V, min(n, m))`` for m known views, nearest first; the lower index breaks ties.
        """
        check_count("n", n)
        check_shape("views", views, ("V", 2))
        queries = view_vectors(views)
        count = min(n, len(self.known))
        # The tree breaks ties arbitrarily: query all within the n-th distance, then sort.
        radius, _ = self._tree.query(queries, k=[count])
        within = self._tree.query_ball_point(queries, radius[:, 0] * (1 + 1e-9) + 1e-12)
        nearest = np.empty((len(views), count), dtype=np.int64)
        for row, (point, indices) in enumerate(zip(queries, within, strict=True)):
            candidates = np.array(sorted(indices))
            distance = ((self._vectors[candidates] - point) ** 2).sum(axis=-1)
            order = np.argsort(distance, kind="stable")[:count]
            nearest[row] = self.known[candidates[order]]
        return nearest

    @cached_property
    def _vectors(self) -> np.ndarray:
        return view_vectors(self.views[self.known])

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self._vectors)

    def _log_wrapped(self, angle: np.ndarray) -> np.ndarray:
        """Return the log density of the wrapped Gaussian kernel."""
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
        Local frames, columns i, j, k; must not be degenerate.
    direction : ndarray, (…, 3)
        Direction from the scene towards the viewer, of any length above 0; broadcasts to frames.

    Returns
    -------
    views : ndarray, (…, 2)
        φ in [−π, π], θ in [0, π], radians.
    """
    frames = np.asarray(frames, dtype=np.float64)
    direction = np.asarray(direction, dtype=np.float64)
    check_shape("direction", direction, ("…", 3))
    length = np.linalg.norm(direction, axis=-1)
    for name, valid, requirement in (
        ("frames", valid_frames(frames), "non-degenerate"),
        ("direction", np.isfinite(length) & (length > 0), "finite and nonzero"),
    ):
        if not valid.all():
            index = np.argwhere(~valid)[0].tolist()
            raise ValueError(f"{name} must be {requirement}, got a violation at index {index}")
    solved = np.linalg.solve(frames, direction[..., np.newaxis])[..., 0]
    a, b, c = np.moveaxis(solved, -1, 0)
    # Equals arccos(b/√(a² + b² + c²)), but is accurate near the poles.
    return np.stack([np.arctan2(c, a), np.arctan2(np.hypot(a, c), b)], axis=-1)


def view_vectors(views: np.ndarray) -> np.ndarray:
    """Return the unit vectors (sin θ cos φ, cos θ, sin θ sin φ): ``(…, 2) → (…, 3)``."""
    views = np.asarray(views, dtype=np.float64)
    check_shape("views", views, ("…", 2))
    phi, theta = views[..., 0], views[..., 1]
    sine = np.sin(theta)
    return np.stack([sine * np.cos(phi), np.cos(theta), sine * np.sin(phi)], axis=-1)


def image_axes(frames: np.ndarray, views: np.ndarray) -> np.ndarray:
    """Return the image axes of every pose in every view; finite for degenerate frames too.

    ``(B, 3, 3), (V, 2) → (B, 3, V, 2)``: the last axis indexes the unit vectors e₁ (right) and e₂
    (up), and e₁ × e₂ points to the viewer. The up vector is the projection of j, or of i at the
    poles θ = 0 and π.
    """
    towards = unit(np.matmul(view_vectors(views), np.swapaxes(frames, -1, -2)))
    up = _across(frames[:, np.newaxis, :, 1], towards)
    pole = np.einsum("bvi,bvi->bv", up, up) < SMALLEST_SINE**2
    if pole.any():
        up[pole] = _across(frames[:, np.newaxis, :, 0], towards)[pole]
    up = unit(up)
    return np.moveaxis(np.stack([cross(up, towards), up], axis=-1), 1, 2)


def project_to_views(positions: np.ndarray, views: np.ndarray, skeleton: Skeleton) -> np.ndarray:
    """Return the orthographic projections Θ_v of pose-pairs to views in local frames (eq. 6).

    Parameters
    ----------
    positions : ndarray, (B, J, 3)
        Pose-pairs, metres.
    views : ndarray, (V, 2)
        φ and θ, radians.
    skeleton : Skeleton
        Skeleton of the J joints.

    Returns
    -------
    keypoints : ndarray, (B, V, J, 2)
        Metres, x right, y up, relative to the world's origin; finite but meaningless for
        degenerate poses.
    """
    positions = np.asarray(positions, dtype=np.float64)
    check_shape("positions", positions, ("B", skeleton.n_joints, 3))
    views = np.asarray(views, dtype=np.float64)
    check_shape("views", views, ("V", 2))
    axes = image_axes(pair_frames(positions, skeleton), views)
    # One matrix product per pose; separate products for the views would dominate the run time.
    projections = np.matmul(positions, axes.reshape(len(positions), 3, 2 * len(views)))
    projections = projections.reshape(len(positions), skeleton.n_joints, len(views), 2)
    return np.ascontiguousarray(np.swapaxes(projections, 1, 2))


def _across(vectors: np.ndarray, units: np.ndarray) -> np.ndarray:
    """Return the components of vectors orthogonal to unit vectors."""
    along = np.einsum("...i,...i->...", vectors, units)
    return vectors - along[..., np.newaxis] * units
