"""Mixture of stationary Gaussian motions, with exact density, denoisers and posterior.

Each of K components has a mean pose that moves at a mean velocity, and a spectrum: the DCT
coefficients of its 3 J coordinates over time are independent between frequencies f, with covariance
V diag(λ_f) Vᵀ. The orthonormal directions V are shared by the frequencies of a band, an octave. At
frequency 0, two directions are the ground translations, whose variance is set separately.
Components are repeated at several scales of variance, and rotated about the vertical by a yaw that
is uniform on a grid.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from probmotion.arrays import Array, array_namespace, constant
from probmotion.files import read_arrays, written_whole
from probmotion.geometry.cameras import Cameras
from probmotion.models.mixture.conditioned_spectra import ConditionedSpectra
from probmotion.models.mixture.conditioning import Component, Components
from probmotion.models.mixture.rotated_spectra import RotatedSpectra
from probmotion.models.mixture.spectral_fit import fit_components
from probmotion.models.mixture.spectral_posterior import SpectralPosterior
from probmotion.models.mixture.spectrum import (
    from_frequencies,
    ramp,
    resampled,
    to_frequencies,
    translations,
)
from probmotion.models.mixture.view_spectra import ViewSpectra
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.protocols import Likelihood, OrthographicOnly
from probmotion.validation import check_count, check_finite, check_positive, check_shape

__all__ = ["SpectralMixtureMotion"]

_MAX_VIEWS = 16  # views whose decompositions are kept
_WEIGHTS = Path(__file__).parents[1] / "weights"  # priors shipped with the package
_FORMAT = 1  # version of the format
_ROUNDING = 1e-3  # error of products of rounded directions
_ROUNDED = ("poses", "velocities", "directions", "variances")
_EXACT = ("band", "weights", "scales", "scale_weights")


@dataclass(frozen=True, eq=False)
class SpectralMixtureMotion:
    """Mixture of stationary Gaussian motions of one skeleton, at any number of frames.

    θ contains all positions, whitened by the first component (:meth:`motion`).

    Parameters
    ----------
    skeleton : Skeleton
        Skeleton of the J joints.
    fps : float
        Frames per second.
    poses : ndarray, (K, J, 3)
        Mean poses, metres, which face +Z with their centroid above the origin.
    velocities : ndarray, (K, 2)
        Mean velocities along x and z, metres per second.
    directions : ndarray, (K, B, P, P)
        Orthonormal columns over the P = 3 J coordinates, for each band of frequencies. The first
        two of the first band, which is frequency 0, are the translations along x and z.
    band : ndarray of int, (L,)
        Band of each frequency, ascending.
    variances : ndarray, (K, L, P)
        λ_k: variances of DCT coefficients, square metres. Those of the two translations at
        frequency 0 are replaced according to ``ground``.
    weights : ndarray, (K,)
        Probabilities of the components, summing to 1.
    scales, scale_weights : ndarray, (S,)
        Factors of the variances, and their probabilities.
    ground : float
        Standard deviation of the centroid's mean ground position, metres.
    azimuths : int
        A: number of yaws ψ_a = 2π a / A.
    card : dict
        Provenance, stored with the prior.

    Raises
    ------
    ValueError
        If shapes are inconsistent or a number is out of range.
    """

    skeleton: Skeleton
    fps: float
    poses: np.ndarray
    velocities: np.ndarray
    directions: np.ndarray
    band: np.ndarray
    variances: np.ndarray
    weights: np.ndarray
    scales: np.ndarray = field(default_factory=lambda: np.ones(1))
    scale_weights: np.ndarray = field(default_factory=lambda: np.ones(1))
    ground: float = 1.0
    azimuths: int = 24
    card: dict[str, Any] = field(default_factory=dict)
    _posteriors: WeakKeyDictionary = field(
        init=False, repr=False, default_factory=WeakKeyDictionary
    )
    _views: dict[bytes, ViewSpectra] = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        J = self.skeleton.n_joints
        check_shape("poses", self.poses, ("K", J, 3))
        K = len(self.poses)
        check_shape("velocities", self.velocities, (K, 2))
        check_shape("directions", self.directions, (K, "B", 3 * J, 3 * J))
        check_shape("variances", self.variances, (K, "L", 3 * J))
        check_shape("band", self.band, (self.variances.shape[1],))
        check_shape("weights", self.weights, (K,))
        check_shape("scales", self.scales, ("S",))
        check_shape("scale_weights", self.scale_weights, self.scales.shape)
        for name in ("poses", "velocities", "directions"):
            check_finite(name, getattr(self, name))
        steps = np.diff(self.band, prepend=0)
        if self.band[0] != 0 or steps.min() < 0 or self.band[-1] >= self.directions.shape[1]:
            bands = self.directions.shape[1]
            raise ValueError(f"band must ascend from 0 to at most {bands - 1}, got {self.band}")
        gram = self.directions.swapaxes(-1, -2) @ self.directions
        if abs(gram - np.eye(3 * J)).max() > 1e-6:
            raise ValueError("directions must have orthonormal columns; orthonormalise them first")
        for name in ("variances", "weights", "scales", "scale_weights"):
            values = getattr(self, name)
            check_finite(name, values)
            if values.min() <= 0:
                raise ValueError(f"{name} must be positive, got {values.min():g}")
        for name in ("weights", "scale_weights"):
            if abs(getattr(self, name).sum() - 1) > 1e-9:
                raise ValueError(f"{name} must sum to 1, got {getattr(self, name).sum():g}")
        check_positive("ground", self.ground)
        check_positive("fps", self.fps)
        check_count("azimuths", self.azimuths)

    def __getstate__(self) -> dict:
        # Weak references cannot be pickled; the caches are rebuilt on demand.
        return self.__dict__ | {"_posteriors": None, "_views": None}

    def __setstate__(self, state: dict) -> None:
        self.__dict__.update(state | {"_posteriors": WeakKeyDictionary(), "_views": {}})

    @classmethod
    def fit(
        cls,
        motions: Sequence[Motion],
        frames: int = 60,
        *,
        components: int | None = None,
        azimuths: int = 24,
        ground: float = 1.0,
        seed: int = 0,
        progress: bool = True,
    ) -> SpectralMixtureMotion:
        """Fit the mixture to windows of clips.

        Windows are clustered, and the moments of each cluster shrunk towards those of all windows.

        Parameters
        ----------
        motions : sequence of Motion
            Clips of one skeleton and frame rate.
        frames : int
            Length L of the windows and of the prior's motions (see :meth:`resampled`).
        components : int, optional
            K: number of components. By default, the number and the amount of shrinkage have the
            largest likelihood of held-out clips.
        azimuths, ground
            As for the class.
        seed : int
            Seed of the clustering and of the held-out clips.
        progress : bool
            Show a progress bar.

        Raises
        ------
        ValueError
            If clips differ in skeleton or frame rate, all are shorter than ``frames``, a joint is
            not finite, or there are fewer windows than components.
        """
        fitted = fit_components(motions, frames, components, azimuths, seed, progress)
        first = motions[0]
        return cls(first.skeleton, first.fps, **fitted, ground=ground, azimuths=azimuths)

    def resampled(self, frames: int, fps: float | None = None) -> SpectralMixtureMotion:
        """Return the prior for other numbers of frames or frame rates.

        Spectral densities are interpolated; variances of means over time are unchanged.
        """
        check_count("frames", frames)
        fps = self.fps if fps is None else fps
        check_positive("fps", fps)
        if (frames, fps) == (self.frames, self.fps):
            return self
        variances, band = resampled(self.variances, self.band, self.fps, frames, fps)
        return replace(self, fps=fps, variances=variances, band=band)

    @property
    def frames(self) -> int:
        """Number of frames L."""
        return self.variances.shape[1]

    @property
    def dim(self) -> int:
        """Length of θ."""
        return self.frames * 3 * self.skeleton.n_joints

    @property
    def yaws(self) -> np.ndarray:
        """Azimuths ψ_a, radians, (A,)."""
        return 2 * np.pi * np.arange(self.azimuths) / self.azimuths

    @property
    def styles(self) -> tuple[str, ...]:
        """Names of the K components."""
        return tuple(f"component-{k}" for k in range(len(self.weights)))

    @cached_property
    def spectra(self) -> np.ndarray:
        """Variances of all coefficients, square metres, (K, S, L, P)."""
        spectra = self.variances[:, None] * self.scales[:, None, None]
        # The coefficient of a translation is √(J L) times the mean position.
        spectra[:, :, 0, :2] = self.skeleton.n_joints * self.frames * self.ground**2
        return spectra

    @cached_property
    def _means(self) -> np.ndarray:
        """Mean motions in their canonical heading, metres, (K, L, J, 3)."""
        times = from_frequencies(ramp(self.frames, self.fps), axis=0)
        means = np.repeat(self.poses[:, None], self.frames, axis=1)
        means[..., [0, 2]] += times[:, None, None] * self.velocities[:, None, None, :]
        return means

    @cached_property
    def scale(self) -> float:
        """Metres per normalised unit: the root mean square of all coordinates."""
        square = (self._means**2).mean(axis=(1, 2, 3))
        spread = self.spectra.mean(axis=(2, 3)) @ self.scale_weights
        return float(np.sqrt(self.weights @ (square + spread)))

    @cached_property
    def components(self) -> Components:
        """Gaussians of all components and scales, (K S), in their canonical heading."""
        gaussians = tuple(
            Component(mean, directions, self.band, variances)
            for mean, directions, spectra in zip(
                self._means, self.directions, self.spectra, strict=True
            )
            for variances in spectra
        )
        both = np.log(self.weights)[:, None] + np.log(self.scale_weights)
        return Components(gaussians, both.reshape(-1) - math.log(self.azimuths), self.yaws)

    def mean(self) -> np.ndarray:
        """Return E[X], (L, J, 3), metres."""
        mean = np.einsum("k,kljx->ljx", self.weights, self._means)
        if self.azimuths > 1:
            mean[..., [0, 2]] = 0.0  # the average over headings
        return mean

    # Protocols of probmotion.posteriors.protocols.

    def sample(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Return n independent motions, (n, L, J, 3), metres."""
        return self.exact_posterior(None).sample(rng, n)

    def motion(self, theta: Array) -> Array:
        """Return the positions at θ: ``(…, dim) → (…, L, J, 3)``, metres.

        θ are standard normal under the first component at the first scale and azimuth 0.
        """
        xp = array_namespace(theta)
        scores = xp.reshape(theta, (*theta.shape[:-1], *self.variances.shape[1:]))
        scores = scores * constant(np.sqrt(self.spectra[0, 0]), theta)
        V = self.directions[0, self.band]
        coefficients = (constant(V, theta) @ scores[..., None])[..., 0]
        basis = to_frequencies(np.eye(self.frames), axis=0)  # (f, t)
        values = constant(basis.T, theta) @ coefficients
        positions = xp.reshape(values, (*theta.shape[:-1], *self._means.shape[1:]))
        return positions + constant(self._means[0], theta)

    def theta(self, positions: np.ndarray) -> np.ndarray:
        """Return θ of positions, the inverse of :meth:`motion`: ``(…, L, J, 3) → (…, dim)``."""
        check_shape("positions", positions, ("…", *self._means.shape[1:]))
        deviation = (positions - self._means[0]).reshape(*positions.shape[:-2], -1)
        coefficients = to_frequencies(deviation, axis=-2)
        scores = (coefficients[..., None, :] @ self.directions[0, self.band])[..., 0, :]
        return (scores / np.sqrt(self.spectra[0, 0])).reshape(*positions.shape[:-3], -1)

    def log_density(self, theta: Array) -> Array:
        """Return log p(θ), normalised: ``(…, dim) → (…)``."""
        return self.log_prior(self.motion(theta)) + 0.5 * float(np.log(self.spectra[0, 0]).sum())

    def initial(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Return n draws of θ, (n, dim)."""
        return self.theta(self.sample(rng, n))

    def exact_posterior(self, likelihood: Likelihood | None) -> SpectralPosterior:
        """Return p(X | y).

        Raises
        ------
        NotConjugate
            If the likelihood is not linear in the positions with Gaussian noise.
        """
        key = self if likelihood is None else likelihood
        if key not in self._posteriors:
            parts = (self.components, self.log_prior, self.mean(), likelihood)
            self._posteriors[key] = SpectralPosterior(*parts)
        return self._posteriors[key]

    def given(self, likelihood: Likelihood) -> ConditionedSpectra:
        """Return p(X | y) as a prior with exact denoisers.

        Raises
        ------
        NotConjugate
            If the likelihood is not linear in the positions with Gaussian noise.
        """
        return ConditionedSpectra(self, self.exact_posterior(likelihood), self.scale)

    def denoise(self, x_t: np.ndarray, alpha_bar: float, cameras: Cameras) -> np.ndarray:
        """Return E[x₀ | x_t] for each view, arrays (B, V, L, J, 2), normalised units.

        Raises
        ------
        OrthographicOnly
            If a camera is perspective, as its marginals are not Gaussian mixtures.
        """
        out = np.empty_like(x_t)
        factor, variance = self._noise(alpha_bar)
        for view, mixture in enumerate(self._view_mixtures(cameras, x_t)):
            noisy = to_frequencies(factor * x_t[:, view], axis=1)
            out[:, view] = from_frequencies(mixture.denoise(noisy, variance), axis=1)
        return out / self.scale

    def view_covariance(
        self, x_t: np.ndarray, alpha_bar: float, cameras: Cameras
    ) -> Callable[[np.ndarray], np.ndarray]:
        """Return v ↦ Cov[x₀ | x_t] v for each view, arrays (B, V, L, J, 2)."""
        factor, variance = self._noise(alpha_bar)
        covariances = [
            mixture.covariance(to_frequencies(factor * x_t[:, view], axis=1), variance)
            for view, mixture in enumerate(self._view_mixtures(cameras, x_t))
        ]

        def product(vectors: np.ndarray) -> np.ndarray:
            check_shape("vectors", vectors, x_t.shape)
            out = np.empty_like(vectors)
            for view, covariance in enumerate(covariances):
                turned = to_frequencies(vectors[:, view], axis=1)
                out[:, view] = from_frequencies(covariance(turned), axis=1)
            return out / self.scale**2

        return product

    def denoise_motion(self, x_t: np.ndarray, alpha_bar: float) -> np.ndarray:
        """Return E[X₀ | X_t]: ``(B, L, J, 3) → (B, L, J, 3)``, normalised units."""
        check_shape("x_t", x_t, ("B", *self._means.shape[1:]))
        factor, variance = self._noise(alpha_bar)
        noisy = to_frequencies(factor * x_t, axis=1)
        return from_frequencies(self._spectra_mixture.denoise(noisy, variance), axis=1) / self.scale

    def motion_covariance(
        self, x_t: np.ndarray, alpha_bar: float
    ) -> Callable[[np.ndarray], np.ndarray]:
        """Return v ↦ Cov[X₀ | X_t] v, arrays (B, L, J, 3), normalised units."""
        check_shape("x_t", x_t, ("B", *self._means.shape[1:]))
        factor, variance = self._noise(alpha_bar)
        noisy = to_frequencies(factor * x_t, axis=1)
        covariance = self._spectra_mixture.covariance(noisy, variance)

        def product(vectors: np.ndarray) -> np.ndarray:
            check_shape("vectors", vectors, x_t.shape)
            turned = to_frequencies(vectors, axis=1)
            return from_frequencies(covariance(turned), axis=1) / self.scale**2

        return product

    # Properties specific to the mixture.

    def style_responsibilities(self, positions: np.ndarray) -> np.ndarray:
        """Return the probability of each component given a motion: ``(n, L, J, 3) → (n, K)``."""
        check_shape("positions", positions, ("n", *self._means.shape[1:]))
        coefficients = to_frequencies(np.asarray(positions), axis=1)
        return self._spectra_mixture.responsibilities(coefficients).sum(axis=(2, 3))

    def log_evidence(self, positions: np.ndarray, noise: float) -> np.ndarray:
        """Return log p(component, azimuth, y) for positions y with noise, up to a constant, (C, A).

        ``positions`` (L, J, 3) and the standard deviation ``noise`` are in metres.
        """
        check_shape("positions", positions, self._means.shape[1:])
        coefficients = to_frequencies(positions, axis=0)[None]
        evidence = self._spectra_mixture.log_evidence(coefficients, noise**2)
        return evidence.reshape(-1, self.azimuths)

    def log_prior(self, positions: Array) -> Array:
        """Return the normalised log density of positions: ``(…, L, J, 3) → (…)``."""
        xp = array_namespace(positions)
        check_shape("positions", positions, ("…", *self._means.shape[1:]))
        L, J, _ = self._means.shape[1:]
        basis = constant(to_frequencies(np.eye(L), axis=0), positions)
        flat = xp.reshape(positions, (-1, L, 3 * J))
        coefficients = xp.reshape(basis @ flat, (-1, L, J, 3))
        values = self._spectra_mixture.log_density(coefficients)
        return xp.reshape(values, positions.shape[:-3])

    def save(self, path: str | Path) -> None:
        """Write the prior to an ``.npz`` file; coefficients are rounded to single precision."""
        names, parents = self.skeleton.joint_names, self.skeleton.parents
        joints = {"joint_names": list(names), "parents": [int(parent) for parent in parents]}
        numbers = {name: getattr(self, name) for name in ("fps", "ground", "azimuths", "card")}
        arrays = {name: getattr(self, name).astype(np.float32) for name in _ROUNDED}
        arrays |= {name: getattr(self, name) for name in _EXACT}
        header = np.array(json.dumps({"format": _FORMAT, "skeleton": joints, **numbers}))
        with written_whole(Path(path)) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, header=header, **arrays)

    @classmethod
    def load(cls, source: str | Path = "cmu-motion") -> SpectralMixtureMotion:
        """Read a shipped prior by name, or a file written by :meth:`save`.

        ``cmu-motion`` is on ``person14``. ``cmu-motion-coco17`` is on ``coco17``, with face points
        that were assumed, not recorded (:mod:`probmotion.data.face_points`).

        Raises
        ------
        FileNotFoundError
            If there is no such file.
        ValueError
            If the file is not a prior of this kind.
        """
        path = _WEIGHTS / f"{source}.npz"
        if not path.is_file():
            path = Path(source)
        if not path.is_file():
            shipped = ", ".join(sorted(name.stem for name in _WEIGHTS.glob("*-motion*.npz")))
            raise FileNotFoundError(
                f"source must be a file or one of {shipped}, got {str(source)!r}"
            )
        try:
            archive = read_arrays(path)
            header = json.loads(str(archive["header"]))
            if header["format"] != _FORMAT:
                raise ValueError(f"format {header['format']}: fit and save the prior again")
            arrays: dict[str, Any] = {name: archive[name] for name in (*_ROUNDED, *_EXACT)}
            for name, array in arrays.items():
                if array.dtype.kind != ("i" if name == "band" else "f"):
                    raise ValueError(f"{name} has the type {array.dtype}")
            arrays |= {name: arrays[name].astype(np.float64) for name in _ROUNDED}
            # Rounding to single precision must not cost orthonormality.
            arrays["directions"] = _orthonormal(arrays["directions"])
            numbers = {name: header[name] for name in ("fps", "ground", "azimuths", "card")}
            prior = cls(Skeleton(**header["skeleton"]), **numbers, **arrays)
            with np.errstate(over="ignore", invalid="ignore"):
                check_positive("scale", prior.scale)
        except (ArithmeticError, LookupError, OSError, TypeError, ValueError, RecursionError) as e:
            raise ValueError(
                f"source must be a file written by SpectralMixtureMotion.save, got {path.name} "
                f"({str(e)[:200]})"
            ) from e
        return prior

    def _noise(self, alpha_bar: float) -> tuple[float, float]:
        """Return s/√ᾱ and the variance of X_t s/√ᾱ around X₀, square metres; s is the scale."""
        if not 0 < alpha_bar <= 1:
            raise ValueError(f"alpha_bar must be in (0, 1], got {alpha_bar!r}")
        return self.scale / math.sqrt(alpha_bar), self.scale**2 * (1 - alpha_bar) / alpha_bar

    @cached_property
    def _spectra_mixture(self) -> RotatedSpectra:
        K, L, P = self.variances.shape
        coefficients = to_frequencies(self._means, axis=1).reshape(K, L, P)
        log_weights = np.log(self.weights)[:, None] + np.log(self.scale_weights)
        return RotatedSpectra(
            self.directions, self.band, coefficients, self.spectra, log_weights, self.yaws
        )

    def _view_mixtures(self, cameras: Cameras, x_t: np.ndarray) -> list[ViewSpectra]:
        """Return the 2D marginals of the V views, which are mixtures with the same weights."""
        if not cameras.orthographic:
            raise OrthographicOnly("cameras must be orthographic, got perspective")
        check_shape("x_t", x_t, ("B", cameras.n_views, *self._means.shape[1:3], 2))
        mixtures = []
        for axes in cameras.image_axes:
            key = axes.tobytes()
            if key not in self._views:
                while len(self._views) >= _MAX_VIEWS:
                    self._views.pop(next(iter(self._views)))
                self._views[key] = ViewSpectra(self.components, axes)
            mixtures.append(self._views[key])
        return mixtures


def _orthonormal(directions: np.ndarray) -> np.ndarray:
    """Return the nearest orthonormal columns; the translations stay exact: (K, B, P, P)."""
    # The decomposition of infinite numbers does not end.
    check_finite("directions", directions)
    gram = directions.swapaxes(-1, -2) @ directions
    if abs(gram - np.eye(directions.shape[-1])).max() > _ROUNDING:
        raise ValueError("directions must have orthonormal columns")
    left, _, right = np.linalg.svd(directions)
    out = left @ right
    fixed = translations(directions.shape[2] // 3)
    free = directions[:, 0, :, 2:]
    left, _, right = np.linalg.svd(free - fixed @ (fixed.T @ free), full_matrices=False)
    out[:, 0] = np.concatenate([np.broadcast_to(fixed, (len(out), *fixed.shape)), left @ right], -1)
    return out
