"""Gaussian mixture prior over motions, with exact density, denoisers and posterior.

Each of K styles is a probabilistic PCA with covariance W Wᵀ + δ² I, rotated about the vertical by a
yaw that is uniform on a grid of A azimuths. The mixture thus has K·A Gaussian components.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal
from weakref import WeakKeyDictionary

import numpy as np

from probmotion.arrays import Array, array_namespace
from probmotion.geometry.cameras import Cameras
from probmotion.models.mixture.conditioned_mixture import ConditionedMixture
from probmotion.models.mixture.fit import fit_styles
from probmotion.models.mixture.posterior import MixturePosterior
from probmotion.models.mixture.rotated_mixture import RotatedMixture, rotation_fields
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.protocols import Likelihood, OrthographicOnly
from probmotion.seeds import RandomNumbers
from probmotion.validation import check_count, check_finite, check_positive, check_shape

__all__ = ["GaussianMixtureMotion"]


@dataclass(frozen=True, eq=False)
class GaussianMixtureMotion:
    """Mixture of K·A Gaussians over root-centred motions of one skeleton.

    Parameters
    ----------
    skeleton : Skeleton
        Skeleton of the J joints.
    fps : float
        Frames per second.
    means : ndarray, (K, L, J, 3)
        Mean motion of each style, metres.
    factors : ndarray, (K, r, L, J, 3)
        W: displacements per unit of each of the r latent coordinates, metres.
    weights : ndarray, (K,)
        Probabilities of the styles, summing to 1.
    noise : float
        δ: standard deviation of the isotropic noise around the subspaces, metres.
    azimuths : int
        A: number of yaws ψ_a = 2π a / A.
    styles : sequence of str, optional
        Names of the styles.
    coordinates : {"latent", "positions"}
        Definition of θ: the latent z of length r, with style, yaw and noise integrated out, or all
        3·L·J positions.

    Raises
    ------
    ValueError
        If shapes are inconsistent or a number is out of range.
    """

    skeleton: Skeleton
    fps: float
    means: np.ndarray
    factors: np.ndarray
    weights: np.ndarray
    noise: float
    azimuths: int = 36
    styles: Sequence[str] = ()
    coordinates: Literal["latent", "positions"] = "latent"
    _posteriors: WeakKeyDictionary = field(
        init=False, repr=False, default_factory=WeakKeyDictionary
    )
    _views: dict[bytes, RotatedMixture] = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        J = self.skeleton.n_joints
        check_shape("means", self.means, ("K", "L", J, 3))
        K, L = self.means.shape[:2]
        check_shape("factors", self.factors, (K, "r", L, J, 3))
        check_shape("weights", self.weights, (K,))
        for name in ("means", "factors", "weights"):
            check_finite(name, getattr(self, name))
        check_positive("noise", self.noise)
        check_positive("fps", self.fps)
        check_count("azimuths", self.azimuths)
        if self.weights.min() <= 0 or abs(self.weights.sum() - 1) > 1e-9:
            raise ValueError(f"weights must be positive and sum to 1, got {self.weights}")
        names = tuple(self.styles) or tuple(f"style-{k}" for k in range(K))
        if len(names) != K:
            raise ValueError(f"styles must contain {K} names, one per mean, got {len(names)}")
        kind = self.coordinates
        if kind not in ("latent", "positions"):
            raise ValueError(f"coordinates must be 'latent' or 'positions', got {kind!r}")
        object.__setattr__(self, "styles", names)

    def __getstate__(self) -> dict:
        # Weak references cannot be pickled; the caches are rebuilt on demand.
        return self.__dict__ | {"_posteriors": None, "_views": None}

    def __setstate__(self, state: dict) -> None:
        self.__dict__.update(state | {"_posteriors": WeakKeyDictionary(), "_views": {}})

    @classmethod
    def fit(
        cls,
        motions: Sequence[Motion],
        frames: int,
        *,
        rank: int = 10,
        styles: int | Sequence[str] = 3,
        weights: Sequence[float] | None = None,
        azimuths: int = 36,
        stride: int | None = None,
        coordinates: Literal["latent", "positions"] = "latent",
        seed: int = 0,
    ) -> GaussianMixtureMotion:
        """Fit the mixture to windows of clips: align headings, then one PCA per style.

        Parameters
        ----------
        motions : sequence of Motion
            Clips of one skeleton and frame rate.
        frames : int
            Length L of the prior's motions.
        rank : int
            Number of latent dimensions r per style.
        styles : int or sequence of str
            Number of k-means clusters, or one label per clip.
        weights : sequence of float, optional
            Probabilities of the styles, in the order of their sorted names; by default their
            proportions among the windows.
        azimuths : int
            A: number of yaws.
        stride : int, optional
            Frames between the starts of successive windows; default ``frames // 4``.
        coordinates : {"latent", "positions"}
            Definition of θ.
        seed : int
            Seed of the k-means.

        Raises
        ------
        ValueError
            If clips differ in skeleton or frame rate, all are shorter than ``frames``, or a style
            has too few windows for ``rank``.
        """
        fitted = fit_styles(motions, frames, rank, styles, stride, seed)
        if weights is not None:
            fitted["weights"] = np.asarray(weights, dtype=np.float64)
        fitted |= {"azimuths": azimuths, "coordinates": coordinates}
        return cls(skeleton=motions[0].skeleton, fps=motions[0].fps, **fitted)

    @property
    def frames(self) -> int:
        """Number of frames L."""
        return self.means.shape[1]

    @property
    def rank(self) -> int:
        """Number of latent dimensions r."""
        return self.factors.shape[1]

    @property
    def dim(self) -> int:
        """Length of θ."""
        return self.rank if self.coordinates == "latent" else self.means[0].size

    @property
    def yaws(self) -> np.ndarray:
        """Azimuths ψ_a, radians, (A,)."""
        return 2 * np.pi * np.arange(self.azimuths) / self.azimuths

    @cached_property
    def scale(self) -> float:
        """Metres per normalised unit: the root mean square of all coordinates."""
        square = (self.means**2).mean(axis=(1, 2, 3))
        square = square + (self.factors**2).sum(axis=1).mean(axis=(1, 2, 3))
        return float(np.sqrt(self.weights @ square + self.noise**2))

    @cached_property
    def base_fields(self) -> np.ndarray:
        """Base fields (``rotated_mixture``) of means and factors, metres, (K, 1 + r, 3, L·J, 3)."""
        return rotation_fields(self._fields)

    @property
    def _fields(self) -> np.ndarray:
        """Mean and factors of each style, metres, (K, 1 + r, L·J, 3)."""
        fields = np.concatenate([self.means[:, None], self.factors], axis=1)
        return fields.reshape(*fields.shape[:2], -1, 3)

    # Protocols of probmotion.posteriors.protocols.

    def sample(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Return n independent motions, (n, L, J, 3), metres."""
        return self.exact_posterior(None).sample(rng, n)

    def motion(self, theta: Array) -> Array:
        """Return the positions at θ, ``(…, dim) → (…, L, J, 3)``; undefined for latent θ."""
        if self.coordinates == "latent":
            raise ValueError(
                "coordinates must be 'positions', got 'latent', where the motion at θ is random; "
                "use complete(rng, theta, likelihood)"
            )
        xp = array_namespace(theta)
        return xp.reshape(theta, (*theta.shape[:-1], *self.means.shape[1:]))

    def log_density(self, theta: Array) -> Array:
        """Return log p(θ), normalised: ``(…, dim) → (…)``."""
        xp = array_namespace(theta)
        if self.coordinates == "latent":
            constant = -0.5 * self.rank * math.log(2 * math.pi)
            return constant - 0.5 * xp.sum(theta**2, axis=-1)
        return self._metres.log_density(theta)

    def initial(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Return n draws of θ, (n, dim)."""
        if self.coordinates == "latent":
            return rng.standard_normal((n, self.rank))
        return self.sample(rng, n).reshape(n, -1)

    def log_likelihood(self, theta: Array, likelihood: Likelihood) -> Array:
        """Return log p(y | θ): ``(…, dim) → (…)``.

        Raises
        ------
        NotConjugate
            In latent coordinates, if the likelihood is not linear with Gaussian noise.
        """
        if self.coordinates == "latent":
            return self.exact_posterior(likelihood).log_likelihood(theta)
        return likelihood.log_density(self.motion(theta))

    def complete(
        self, rng: RandomNumbers, theta: np.ndarray, likelihood: Likelihood | None
    ) -> np.ndarray:
        """Return one draw from p(X | θ, y) for each θ: ``(n, dim) → (n, L, J, 3)``, metres."""
        if self.coordinates == "latent":
            return self.exact_posterior(likelihood).complete(rng, theta)
        return np.asarray(self.motion(theta))

    def exact_posterior(self, likelihood: Likelihood | None) -> MixturePosterior:
        """Return p(X | y), also a Gaussian mixture.

        Raises
        ------
        NotConjugate
            If the likelihood is not linear in the positions with Gaussian noise.
        """
        key = self if likelihood is None else likelihood
        if key not in self._posteriors:
            parameters = (self.base_fields, self.yaws, self.weights, self.noise)
            posterior = MixturePosterior(*parameters, self.means.shape[1:], likelihood)
            self._posteriors[key] = posterior
        return self._posteriors[key]

    def given(self, likelihood: Likelihood) -> ConditionedMixture:
        """Return p(X | y) as a prior with exact denoisers.

        Raises
        ------
        NotConjugate
            If the likelihood is not linear in the positions with Gaussian noise.
        """
        return ConditionedMixture(self, self.exact_posterior(likelihood), self.scale)

    def denoise(self, x_t: np.ndarray, alpha_bar: float, cameras: Cameras) -> np.ndarray:
        """Return E[x₀ | x_t] for each view, arrays (B, V, L, J, 2), normalised units.

        Raises
        ------
        OrthographicOnly
            If a camera is perspective, as its marginals are not Gaussian mixtures.
        """
        out = np.empty_like(x_t)
        for view, mixture in enumerate(self._view_mixtures(cameras, x_t)):
            flat = np.ascontiguousarray(x_t[:, view]).reshape(len(x_t), mixture.dim)
            out[:, view] = mixture.denoise(flat, alpha_bar).reshape(out[:, view].shape)
        return out

    def view_covariance(
        self, x_t: np.ndarray, alpha_bar: float, cameras: Cameras
    ) -> Callable[[np.ndarray], np.ndarray]:
        """Return v ↦ Cov[x₀ | x_t] v for each view, arrays (B, V, L, J, 2)."""
        mixtures = self._view_mixtures(cameras, x_t)
        rows = (len(x_t), mixtures[0].dim)
        covariances = [
            mixture.covariance(np.ascontiguousarray(x_t[:, view]).reshape(rows), alpha_bar)
            for view, mixture in enumerate(mixtures)
        ]

        def product(vectors: np.ndarray) -> np.ndarray:
            check_shape("vectors", vectors, x_t.shape)
            out = np.empty_like(vectors)
            for view, covariance in enumerate(covariances):
                flat = np.ascontiguousarray(vectors[:, view]).reshape(rows)
                out[:, view] = covariance(flat).reshape(out[:, view].shape)
            return out

        return product

    def denoise_motion(self, x_t: np.ndarray, alpha_bar: float) -> np.ndarray:
        """Return E[X₀ | X_t]: ``(B, L, J, 3) → (B, L, J, 3)``, normalised units."""
        check_shape("x_t", x_t, ("B", *self.means.shape[1:]))
        flat = x_t.reshape(len(x_t), self._normalised.dim)
        return self._normalised.denoise(flat, alpha_bar).reshape(x_t.shape)

    def motion_covariance(
        self, x_t: np.ndarray, alpha_bar: float
    ) -> Callable[[np.ndarray], np.ndarray]:
        """Return v ↦ Cov[X₀ | X_t] v, arrays (B, L, J, 3), normalised units."""
        check_shape("x_t", x_t, ("B", *self.means.shape[1:]))
        rows = (len(x_t), self._normalised.dim)
        covariance = self._normalised.covariance(x_t.reshape(rows), alpha_bar)

        def product(vectors: np.ndarray) -> np.ndarray:
            check_shape("vectors", vectors, x_t.shape)
            return covariance(vectors.reshape(rows)).reshape(x_t.shape)

        return product

    # Properties specific to the mixture.

    def style_responsibilities(self, positions: np.ndarray) -> np.ndarray:
        """Return the probability of each style given a motion: ``(n, L, J, 3) → (n, K)``."""
        flat = np.asarray(positions).reshape(len(positions), self._metres.dim)
        return self._metres.responsibilities(flat).sum(axis=2)

    def off_manifold(self, positions: np.ndarray) -> np.ndarray:
        """Return the variance outside the most likely component's subspace, divided by δ²: (n,).

        The expectation under the prior is 1.
        """
        flat = np.asarray(positions).reshape(len(positions), self._metres.dim)
        return self._metres.residual_variance(flat) / self.noise**2

    def log_prior(self, positions: Array) -> Array:
        """Return the normalised log density of positions: ``(…, L, J, 3) → (…)``."""
        xp = array_namespace(positions)
        check_shape("positions", positions, ("…", *self.means.shape[1:]))
        return self._metres.log_density(
            xp.reshape(positions, (*positions.shape[:-3], self._metres.dim))
        )

    def reduced(self) -> tuple[GaussianMixtureMotion, np.ndarray]:
        """Return an equivalent prior on the span of its scalar fields, and a basis of that span.

        The prior depends on frames and joints only through the x, y and z fields of the means and
        factors. Operations that are linear and treat all entries alike (rotation, orthographic
        projection, triangulation, isotropic noise) are unchanged on the span of these fields.

        Returns
        -------
        prior : GaussianMixtureMotion
            One frame of M anonymous joints, M the dimension of the span.
        basis : ndarray, (L·J, M)
            Orthonormal; the coordinates of a motion are ``basis.T @ motion.reshape(-1, 3)``.
        """
        fields = self._fields
        scalars = fields.transpose(2, 0, 1, 3).reshape(fields.shape[2], -1)
        basis, size, _ = np.linalg.svd(scalars, full_matrices=False)
        basis = basis[:, size > 1e-12 * size[0]]
        M = basis.shape[1]
        small = np.einsum("fm,kifc->kimc", basis, fields)
        prior = replace(
            self,
            skeleton=Skeleton([f"field-{m}" for m in range(M)], [-1] * M),
            means=small[:, :1],
            factors=small[:, 1:, None],
        )
        # The denoiser's normalised unit must be that of the full prior.
        prior.__dict__["scale"] = self.scale
        return prior, basis

    def _mixture(self, fields: np.ndarray, scale: float) -> RotatedMixture:
        """Return the mixture of base fields (K, 1 + r, 3, L·J, M) divided by a scale."""
        flat = fields.reshape(*fields.shape[:3], -1) / scale
        return RotatedMixture(flat, self.yaws, self.weights, (self.noise / scale) ** 2)

    @cached_property
    def _metres(self) -> RotatedMixture:
        return self._mixture(self.base_fields, 1.0)

    @cached_property
    def _normalised(self) -> RotatedMixture:
        return self._mixture(self.base_fields, self.scale)

    def _view_mixtures(self, cameras: Cameras, x_t: np.ndarray) -> list[RotatedMixture]:
        """Return the 2D marginals of the V views, which are mixtures with the same weights."""
        if not cameras.orthographic:
            raise OrthographicOnly("cameras must be orthographic, got perspective")
        check_shape("x_t", x_t, ("B", cameras.n_views, *self.means.shape[1:3], 2))
        for axes in cameras.image_axes:
            if axes.tobytes() not in self._views:
                self._views[axes.tobytes()] = self._mixture(self.base_fields @ axes.T, self.scale)
        return [self._views[axes.tobytes()] for axes in cameras.image_axes]
