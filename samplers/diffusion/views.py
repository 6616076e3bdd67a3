"""Views of one motion, and the 3D denoiser that is made of 2D ones.

Normalised units throughout: P_v are the image axes of orthographic cameras and
M = Σ_v w_v P_vᵀ P_v, w_v the views' weights (1 by default).
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import cached_property

import numpy as np

from probmotion.geometry.cameras import Cameras
from probmotion.posteriors.protocols import (
    DenoiserCovariance2D,
    DenoiserCovariance3D,
    Denoises2D,
    Denoises3D,
)

__all__ = [
    "MotionDenoiser",
    "MultiViewDenoiser",
    "Views",
    "symmetric_power",
    "views_around",
    "warn_of_level_views",
]


class Views:
    """V orthographic views: projecting a motion into them and combining them into one.

    Parameters
    ----------
    cameras : Cameras
        The V cameras; perspective ones are replaced by the orthographic ones that agree with them
        at the origin.
    weights : sequence of float, optional
        How much each view counts where views are combined; 1 each by default.
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
    n_views: int, elevation: float, *, distance: float = 7.0, perspective: bool = False
) -> Cameras:
    """Return V views evenly around the motion, the first at azimuth 0.

    Two stand 120° apart (MAS, table 2): opposite ones would see the same, and nothing of the depth.
    """
    azimuth = 2 * np.pi * np.arange(n_views) / max(3, n_views)
    tilt = np.full(n_views, elevation)
    return Cameras.around(azimuth, tilt, distance=distance, perspective=perspective)


def warn_of_level_views(sampler: str, elevation: float) -> None:
    """Warn a caller's caller if views are level: then a motion and its mirror image look alike."""
    if elevation == 0:
        warnings.warn(
            "elevation is 0: views that never tilt leave a mirror ambiguity that "
            f"{sampler} cannot resolve, expected an elevation such as pi/16",
            stacklevel=3,
        )


class MotionDenoiser:
    """E[X₀ | X_t] and Cov[X₀ | X_t] of a prior that knows them in 3D; counts its evaluations."""

    covariance_protocol = DenoiserCovariance3D

    def __init__(self, prior: Denoises3D) -> None:
        self.prior = prior
        self.counts = {"denoiser": 0}
        self.gram = np.eye(3)

    def denoise(self, x_t: np.ndarray, alpha_bar: float) -> np.ndarray:
        """Return E[X₀ | X_t]: ``(B, L, J, 3) → (B, L, J, 3)``."""
        self.counts["denoiser"] += len(x_t)
        return self.prior.denoise_motion(x_t, alpha_bar)

    def covariance_product(
        self, x_t: np.ndarray, alpha_bar: float, vectors: np.ndarray
    ) -> np.ndarray:
        """Return Cov[X₀ | X_t] v, all arrays (B, L, J, 3)."""
        assert isinstance(self.prior, DenoiserCovariance3D)
        _count(self.counts, "covariance", len(x_t))
        return self.prior.motion_covariance_product(x_t, alpha_bar, vectors)


class MultiViewDenoiser:
    """D(X, t) = M⁻¹ Σ_v w_v P_vᵀ E[x₀ | P_v X, t]: what MAS uses for E[X₀ | X_t].

    It conditions on one view at a time, where E[X₀ | X_t] conditions on all of X_t.

    Parameters
    ----------
    prior : Denoises2D
        Its denoiser is called on all views at once.
    views : Views
        The V views.
    """

    covariance_protocol = DenoiserCovariance2D

    def __init__(self, prior: Denoises2D, views: Views) -> None:
        self.prior = prior
        self.views = views
        self.counts = {"denoiser": 0}
        self.gram = views.gram

    def denoise(self, x_t: np.ndarray, alpha_bar: float) -> np.ndarray:
        """Return D(X_t): ``(B, L, J, 3) → (B, L, J, 3)``."""
        self.counts["denoiser"] += len(x_t) * self.views.n_views
        seen = self.views.project(x_t)
        return self.views.combine(self.prior.denoise(seen, alpha_bar, self.views.cameras))

    def covariance_product(
        self, x_t: np.ndarray, alpha_bar: float, vectors: np.ndarray
    ) -> np.ndarray:
        """Return C v with C = M^(-½) (Σ_v w_v P_vᵀ Cov[x₀ | P_v X_t] P_v) M^(-½).

        By Tweedie's formula D's Jacobian times (1−ᾱ)/√ᾱ is M⁻¹ Σ_v w_v P_vᵀ Cov_v P_v, which is
        self-adjoint in the inner product uᵀ M v: C is the symmetric matrix similar to it.
        """
        assert isinstance(self.prior, DenoiserCovariance2D)
        _count(self.counts, "covariance", len(x_t) * self.views.n_views)
        seen = self.views.project(x_t)
        inside = self.views.project(vectors @ self._half)
        product = self.prior.view_covariance_product(seen, alpha_bar, self.views.cameras, inside)
        return self.views.scatter(product) @ self._half

    @cached_property
    def _half(self) -> np.ndarray:
        return symmetric_power(self.gram, -0.5)


def symmetric_power(matrix: np.ndarray, exponent: float) -> np.ndarray:
    """Return a symmetric positive matrix to a power."""
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * values**exponent) @ vectors.T


def _count(counts: dict[str, int], name: str, n: int) -> None:
    counts[name] = counts.get(name, 0) + n
