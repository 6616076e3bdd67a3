"""Orthographic views of a motion and 3D denoisers built from 2D denoisers.

P_v are the image axes of the cameras, w_v the weights of the views and M = Σ_v w_v P_vᵀ P_v. All
motions are in normalised units.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np

from probmotion.geometry.cameras import Cameras
from probmotion.posteriors.protocols import (
    DenoiserCovariance2D,
    DenoiserCovariance3D,
    Denoises2D,
    Denoises3D,
    MotionPrior,
)
from probmotion.validation import check_count

__all__ = [
    "MotionDenoiser", "MultiViewDenoiser", "StateDenoiser", "Views", "pools", "symmetric_power",
    "view_sets", "views_around", "warn_of_mirror_images",
]  # fmt: skip

_MIN_EXTENT = 1e-6
"""Smallest eigenvalue of M relative to its largest; below, errors of views grow a thousandfold."""


class Views:
    """Projection of motions to V orthographic views, and triangulation.

    Parameters
    ----------
    cameras : Cameras
        The V cameras; perspective cameras are approximated by orthographic ones at the origin.
    weights : sequence of float, optional
        Weights w_v; 1 by default.
    """

    def __init__(self, cameras: Cameras, weights: Sequence[float] | None = None) -> None:
        self.cameras = cameras.as_orthographic()
        self.axes = self.cameras.image_axes
        self.weights = np.ones(len(self.axes)) if weights is None else np.asarray(weights)
        self.gram = np.einsum("v,vcx,vcy->xy", self.weights, self.axes, self.axes)

    @property
    def n_views(self) -> int:
        """Number of views V."""
        return len(self.axes)

    def project(self, motions: np.ndarray) -> np.ndarray:
        """Return P_v X: ``(B, L, J, 3) → (B, V, L, J, 2)``."""
        B, L, J, _ = motions.shape
        flat = motions.reshape(B, L * J, 3)
        return (flat[:, None] @ self.axes.swapaxes(1, 2)).reshape(B, self.n_views, L, J, 2)

    def combine(self, views: np.ndarray) -> np.ndarray:
        """Return M⁻¹ Σ_v w_v P_vᵀ x_v, the least-squares motion, (B, L, J, 3)."""
        return self._sum(views, self._combine_axes)

    def scatter(self, views: np.ndarray) -> np.ndarray:
        """Return Σ_v w_v P_vᵀ x_v: ``(B, V, L, J, 2) → (B, L, J, 3)``."""
        return self._sum(views, self.weights[:, None, None] * self.axes)

    @cached_property
    def _combine_axes(self) -> np.ndarray:
        extent = np.linalg.eigvalsh(self.gram)
        if extent[0] < _MIN_EXTENT * extent[-1]:
            elevations = ", ".join(f"{angle:.3g}" for angle in self.cameras.elevation)
            raise ValueError(
                "views must determine all three dimensions, got cameras that look along almost the "
                f"same line, with elevations {elevations}; use views that differ in azimuth and an "
                "elevation such as pi/16"
            )
        weighted = self.weights[:, None, None] * self.axes
        return weighted @ np.linalg.inv(self.gram)

    @staticmethod
    def _sum(views: np.ndarray, axes: np.ndarray) -> np.ndarray:
        B, V, L, J, _ = views.shape
        flat = views.reshape(B, V, L * J, 2)
        out = flat[:, 0] @ axes[0]
        for view in range(1, V):
            out += flat[:, view] @ axes[view]
        return out.reshape(B, L, J, 3)


def views_around(
    n_views: int,
    elevation: float,
    *,
    start: float = 0.0,
    distance: float = 7.0,
    perspective: bool = False,
) -> Cameras:
    """Return the cameras of V views evenly spaced in azimuth from ``start``, in turns.

    Two views are 120° apart (MAS, table 2), since opposite views do not determine the depth.
    """
    azimuth = 2 * np.pi * (start + np.arange(n_views) / max(3, n_views))
    tilt = np.full(n_views, elevation)
    return Cameras.around(azimuth, tilt, distance=distance, perspective=perspective)


def view_sets(
    prior: Denoises2D, n_views: int, elevation: float | None, rings: int = 1
) -> list[Views]:
    """Return the sets of orthographic views between which a sampler alternates.

    Estimates of single views are biased differently in different directions. A learnt denoiser
    holds for the ``view_elevation`` of its training: rings of V views that differ in azimuth. An
    exact one holds for any view: the 15 two-fold axes of an icosahedron cover the sphere evenly, in
    five sets of three orthogonal axes, each of which weights all directions equally. A given
    ``elevation`` is that of rings for any prior.
    """
    check_count("n_views", n_views, least=2)
    elevation = elevation_of_views(prior, elevation)
    if elevation is not None:
        turns = np.arange(rings) / (rings * max(3, n_views))
        return [Views(views_around(n_views, elevation, start=turn)) for turn in turns]
    golden = (1 + math.sqrt(5)) / 2
    first = 0.5 * np.array([[golden, 1.0, 1 / golden], [-1 / golden, golden, -1.0]])
    triads = [np.eye(3)]
    # Half-turns about two coordinate axes turn one triad into the other three.
    for signs in ([1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]):
        pair = first * signs
        triads.append(np.concatenate([pair, np.cross(pair[0], pair[1])[None]]))
    return [
        Views(Cameras.around(np.arctan2(x, z), np.arcsin(np.clip(y, -1, 1))))
        for x, y, z in (triad.T for triad in triads)
    ]


def elevation_of_views(prior: Denoises2D | MotionPrior, elevation: float | None) -> float | None:
    """Return a sampler's setting, or else the elevation of the views of a learnt denoiser."""
    return getattr(prior, "view_elevation", None) if elevation is None else elevation


def warn_of_mirror_images(name: str, elevation: float | None, *, stacklevel: int) -> None:
    """Warn that a sampler's views at elevation 0 do not distinguish mirror images."""
    if elevation == 0:
        warnings.warn(
            f"{name} cannot distinguish a motion from its mirror image with elevation 0: draws may "
            "be reflected in depth; use an elevation such as pi/16",
            stacklevel=stacklevel + 1,
        )


class MotionDenoiser:
    """3D denoiser of a prior, with E[X₀ | X_t], Cov[X₀ | X_t] and counts of evaluations."""

    covariance_protocol = DenoiserCovariance3D

    def __init__(self, prior: Denoises3D) -> None:
        self.prior = prior
        self.counts = {"denoiser": 0}
        self.gram = np.eye(3)

    def denoise(self, x_t: np.ndarray, alpha_bar: float) -> np.ndarray:
        """Return E[X₀ | X_t]: ``(B, L, J, 3) → (B, L, J, 3)``."""
        self.counts["denoiser"] += len(x_t)
        return self.prior.denoise_motion(x_t, alpha_bar)

    def covariance(self, x_t: np.ndarray, alpha_bar: float) -> Callable[[np.ndarray], np.ndarray]:
        """Return u ↦ Cov[X₀ | X_t] u; arrays are (B, L, J, 3)."""
        assert isinstance(self.prior, DenoiserCovariance3D)
        covariance = self.prior.motion_covariance(x_t, alpha_bar)

        def product(vectors: np.ndarray) -> np.ndarray:
            _count(self.counts, "covariance", len(vectors))
            return covariance(vectors)

        return product


class MultiViewDenoiser:
    """3D denoiser of MAS, D(X, t) = M⁻¹ Σ_v w_v P_vᵀ E[x₀ | P_v X, t], from a 2D denoiser.

    D approximates E[X₀ | X_t]: each term conditions on a single view instead of X_t. Evaluations
    are added to ``counts``.
    """

    covariance_protocol = DenoiserCovariance2D

    def __init__(
        self, prior: Denoises2D, views: Views, counts: dict[str, int] | None = None
    ) -> None:
        self.prior = prior
        self.views = views
        self.counts = {"denoiser": 0} if counts is None else counts
        self.gram = views.gram

    def denoise(self, x_t: np.ndarray, alpha_bar: float) -> np.ndarray:
        """Return D(X_t): ``(B, L, J, 3) → (B, L, J, 3)``."""
        self.counts["denoiser"] += len(x_t) * self.views.n_views
        noisy = self.views.project(x_t)
        return self.views.combine(self.prior.denoise(noisy, alpha_bar, self.views.cameras))

    def covariance(self, x_t: np.ndarray, alpha_bar: float) -> Callable[[np.ndarray], np.ndarray]:
        """Return u ↦ C u with C = M^(-½) (Σ_v w_v P_vᵀ Cov[x₀ | P_v X_t] P_v) M^(-½).

        By Tweedie's formula the Jacobian of D times (1−ᾱ)/√ᾱ is M⁻¹ Σ_v w_v P_vᵀ Cov_v P_v, which
        is similar to the symmetric matrix C.
        """
        assert isinstance(self.prior, DenoiserCovariance2D)
        noisy = self.views.project(x_t)
        covariance = self.prior.view_covariance(noisy, alpha_bar, self.views.cameras)

        def product(vectors: np.ndarray) -> np.ndarray:
            _count(self.counts, "covariance", len(vectors) * self.views.n_views)
            inside = self.views.project(vectors @ self._half)
            return self.views.scatter(covariance(inside)) @ self._half

        return product

    @cached_property
    def _half(self) -> np.ndarray:
        return symmetric_power(self.gram, -0.5)


def pools(prior: Denoises2D, sets: Sequence[Views]) -> list[MultiViewDenoiser]:
    """Return the denoisers of sets of views, with common counts of evaluations."""
    counts = {"denoiser": 0}
    return [MultiViewDenoiser(prior, views, counts) for views in sets]


StateDenoiser = MotionDenoiser | MultiViewDenoiser
"""Denoiser of noisy 3D motions."""


def symmetric_power(matrix: np.ndarray, exponent: float) -> np.ndarray:
    """Return a power of a symmetric positive definite matrix."""
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * values**exponent) @ vectors.T


def _count(counts: dict[str, int], name: str, n: int) -> None:
    counts[name] = counts.get(name, 0) + n
