"""Likelihoods of observed 2D keypoints and noisy 3D joints.

With orthographic cameras, each observed joint is y = A X + c + noise. The confidence of a joint
multiplies the precision of its noise; 0 marks an occluded joint.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from probmotion import seeds
from probmotion.arrays import Array, array_namespace, constant, to_numpy
from probmotion.geometry.cameras import Cameras
from probmotion.motion.motion import KeypointTrack, Motion
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.protocols import NotConjugate
from probmotion.validation import check_finite, check_positive, check_shape

__all__ = ["Joints3D", "Keypoints2D", "LinearObservation", "entry_noise"]


class LinearObservation(NamedTuple):
    """Linear Gaussian observation y_v = A_v X + noise of precision w_v, per frame and joint.

    Attributes
    ----------
    axes : ndarray, (V, M, 3)
        Matrices A_v, with M rows each.
    target : ndarray, (V, L, J, M)
        Observed y_v minus the projection of the origin; 0 where occluded.
    precision : ndarray, (V, L, J)
        w_v = 1 / variance of each of the M entries; 0 where occluded.
    """

    axes: np.ndarray
    target: np.ndarray
    precision: np.ndarray


@dataclass(frozen=True, eq=False)
class EntryNoise:
    """Independent Gaussian or Student-t noise of observed entries.

    Parameters
    ----------
    noise : float
        Standard deviation (Student-t: scale) of an entry of confidence 1.
    confidence : ndarray
        Multiplier of the precision of each joint; 0 marks an occluded joint.
    degrees_of_freedom : float or None
        Degrees of freedom of Student-t noise; ``None`` for Gaussian noise.
    """

    noise: float
    confidence: np.ndarray
    degrees_of_freedom: float | None = None

    def __post_init__(self) -> None:
        check_positive("noise", self.noise)
        check_finite("confidence", self.confidence)
        if self.confidence.size and self.confidence.min() < 0:
            raise ValueError(f"confidence must be at least 0, got {self.confidence.min():g}")
        if self.degrees_of_freedom is not None:
            check_positive("degrees_of_freedom", self.degrees_of_freedom)

    @property
    def visible(self) -> np.ndarray:
        """Mask of observed entries, in the shape of ``confidence``."""
        return self.confidence > 0

    @property
    def precision(self) -> np.ndarray:
        """1 / variance (Student-t: 1 / scale²) per entry; 0 where occluded."""
        return self.confidence / self.noise**2

    def log_density(self, residual: Array) -> Array:
        """Return Σ log p(residual) of visible entries: ``(…, *confidence.shape, M) → (…)``."""
        xp = array_namespace(residual)
        n_seen = residual.shape[-1] * int(self.visible.sum())
        log_scale = residual.shape[-1] * 0.5 * float(np.log(self.precision[self.visible]).sum())
        terms, normaliser = self._terms(residual)
        axes = tuple(range(-1 - self.confidence.ndim, 0))
        return xp.sum(terms, axis=axes) + (log_scale + n_seen * normaliser)

    def pointwise_log_density(self, residual: np.ndarray) -> np.ndarray:
        """Return log p(residual) per visible entry: ``(…, *confidence.shape, M) → (…, n)``."""
        terms, normaliser = self._terms(residual)
        log_scale = 0.5 * np.log(self.precision[self.visible])
        return terms.sum(axis=-1)[..., self.visible] + residual.shape[-1] * (log_scale + normaliser)

    def _terms(self, residual: Array) -> tuple[Array, float]:
        """Return the log density of each number up to scale, and its normaliser."""
        square = residual**2 * constant(self.precision[..., None], residual)
        nu = self.degrees_of_freedom
        if nu is None:
            return -0.5 * square, -0.5 * math.log(2 * math.pi)
        gammas = math.lgamma((nu + 1) / 2) - math.lgamma(nu / 2)
        log1p = array_namespace(residual).log1p
        return -0.5 * (nu + 1) * log1p(square / nu), gammas - 0.5 * math.log(nu * math.pi)

    def draw(self, rng: np.random.Generator, size: int) -> np.ndarray:
        """Return noise of shape ``(*confidence.shape, size)``; 0 where occluded."""
        shape = (*self.confidence.shape, size)
        nu = self.degrees_of_freedom
        unit = rng.standard_normal(shape) if nu is None else rng.standard_t(nu, shape)
        weight = np.where(self.visible, self.confidence, 1.0)[..., None]
        return np.where(self.visible[..., None], unit * self.noise / np.sqrt(weight), 0.0)

    def require_gaussian(self) -> None:
        """Raise ``NotConjugate`` if the noise is Student-t."""
        nu = self.degrees_of_freedom
        if nu is not None:
            raise NotConjugate(f"the noise is Student-t with {nu:g} degrees of freedom")


class _Entries:
    """Mixin with the shape and the noise of the observed entries."""

    noise: float
    confidence: np.ndarray | None
    degrees_of_freedom: float | None
    entries: EntryNoise

    @property
    def frames(self) -> int:
        """Number of frames L."""
        return self.entries.confidence.shape[-2]

    @property
    def n_joints(self) -> int:
        """Number of joints J."""
        return self.entries.confidence.shape[-1]

    def log_density(self, positions: Array) -> Array:
        """Return log p(y | X): ``(…, L, J, 3) → (…)``."""
        check_shape("positions", positions, ("…", self.frames, self.n_joints, 3))
        return self.entries.log_density(self._residual(positions))

    def pointwise_log_density(self, positions: np.ndarray) -> np.ndarray:
        """Return log p(yᵢ | X) of every visible entry: ``(…, L, J, 3) → (…, n)``.

        The entries are in the order of ``entries.visible``.
        """
        check_shape("positions", positions, ("…", self.frames, self.n_joints, 3))
        return self.entries.pointwise_log_density(self._residual(positions))

    def _residual(self, positions: Array) -> Array:
        """Return observed minus predicted values, ``(…, L, J, 3) → (…, *entries, M)``."""
        raise NotImplementedError

    def _set_entries(self, name: str, shape: tuple[int | str, ...]) -> None:
        """Validate the observed array ``name``; store it, its confidence and its noise."""
        observed = np.asarray(getattr(self, name), dtype=np.float64)
        check_shape(name, observed, shape)
        entries = entry_noise(
            self.noise, self.confidence, self.degrees_of_freedom, observed.shape[:-1]
        )
        check_finite(name, observed[entries.visible])
        object.__setattr__(self, "entries", entries)
        object.__setattr__(self, "confidence", entries.confidence)
        object.__setattr__(self, name, np.where(entries.visible[..., None], observed, 0.0))


@dataclass(frozen=True, eq=False)
class Keypoints2D(_Entries):
    """Likelihood of noisy keypoints of one motion in V known cameras.

    Parameters
    ----------
    keypoints : ndarray, (V, L, J, 2)
        Image units. Entries with confidence 0 are ignored and may be NaN.
    cameras : Cameras
        The V cameras.
    noise : float
        Standard deviation of a keypoint of confidence 1, image units.
    confidence : ndarray, (V, L, J), optional
        Multiplier of the precision, 1 by default; 0 marks an occluded entry.
    degrees_of_freedom : float, optional
        Degrees of freedom of Student-t noise; Gaussian by default.
    skeleton : Skeleton, optional
        Skeleton of the joints; if given, it must match the prior's.
    fps : float, optional
        Frames per second; if given, it must match the prior's.
    """

    keypoints: np.ndarray
    cameras: Cameras
    noise: float
    confidence: np.ndarray | None = None
    degrees_of_freedom: float | None = None
    skeleton: Skeleton | None = None
    fps: float | None = None
    entries: EntryNoise = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._set_entries("keypoints", (self.cameras.n_views, "L", "J", 2))

    @classmethod
    def observe(
        cls,
        motion: Motion,
        cameras: Cameras,
        noise: float,
        seed: int,
        *,
        hidden: np.ndarray | None = None,
        degrees_of_freedom: float | None = None,
    ) -> Keypoints2D:
        """Return the likelihood of simulated noisy detections of ``motion``.

        ``hidden``, bool, (L, J) or (V, L, J), marks occluded entries; ``noise`` and
        ``degrees_of_freedom`` are as for the class.
        """
        shape = (cameras.n_views, *motion.positions.shape[:2])
        confidence = _confidence_of(hidden, shape)
        zeros, source = np.zeros((*shape, 2)), (motion.skeleton, motion.fps)
        blank = cls(zeros, cameras, noise, confidence, degrees_of_freedom, *source)
        return blank.simulate(seeds.generator(seed, "evidence"), motion.positions)

    @classmethod
    def from_track(cls, track: KeypointTrack, camera: Cameras, noise: float) -> Keypoints2D:
        """Return the likelihood of a detected track in one known camera."""
        points, confidence = track.keypoints[None], track.confidence[None]
        return cls(points, camera, noise, confidence, None, track.skeleton, track.fps)

    def _residual(self, positions: Array) -> Array:
        return constant(self.keypoints, positions) - self.cameras.project(positions)

    def simulate(self, rng: np.random.Generator, positions: np.ndarray) -> Keypoints2D:
        """Return the likelihood of observations drawn from p(y | X), X of shape (L, J, 3)."""
        check_shape("positions", positions, (self.frames, self.n_joints, 3))
        seen = self.cameras.project(to_numpy(positions)) + self.entries.draw(rng, 2)
        return replace(self, keypoints=seen)

    def linear(self) -> LinearObservation:
        """Return the linear form; raise ``NotConjugate`` for perspective cameras or Student-t."""
        self.entries.require_gaussian()
        if not self.cameras.orthographic:
            raise NotConjugate("the cameras are perspective, not orthographic")
        shifted = self.keypoints - self.cameras.offset[:, None, None, :]
        target = np.where(self.entries.visible[..., None], shifted, 0.0)
        return LinearObservation(self.cameras.image_axes, target, self.entries.precision)


@dataclass(frozen=True, eq=False)
class Joints3D(_Entries):
    """Likelihood of noisy 3D joints of one motion.

    Parameters
    ----------
    joints : ndarray, (L, J, 3)
        Metres. Entries with confidence 0 are ignored and may be NaN.
    noise : float
        Standard deviation of a coordinate of confidence 1, metres.
    confidence : ndarray, (L, J), optional
        As for :class:`Keypoints2D`.
    degrees_of_freedom, skeleton, fps
        As for :class:`Keypoints2D`.
    """

    joints: np.ndarray
    noise: float
    confidence: np.ndarray | None = None
    degrees_of_freedom: float | None = None
    skeleton: Skeleton | None = None
    fps: float | None = None
    entries: EntryNoise = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._set_entries("joints", ("L", "J", 3))

    @classmethod
    def observe(
        cls,
        motion: Motion,
        noise: float,
        seed: int,
        *,
        hidden: np.ndarray | None = None,
        degrees_of_freedom: float | None = None,
    ) -> Joints3D:
        """Return the likelihood of simulated noisy joints; ``hidden`` (L, J) marks occlusion."""
        shape = motion.positions.shape[:2]
        zeros, source = np.zeros((*shape, 3)), (motion.skeleton, motion.fps)
        blank = cls(zeros, noise, _confidence_of(hidden, shape), degrees_of_freedom, *source)
        return blank.simulate(seeds.generator(seed, "evidence"), motion.positions)

    def _residual(self, positions: Array) -> Array:
        return constant(self.joints, positions) - positions

    def simulate(self, rng: np.random.Generator, positions: np.ndarray) -> Joints3D:
        """Return the likelihood of observations drawn from p(y | X), X of shape (L, J, 3)."""
        check_shape("positions", positions, (self.frames, self.n_joints, 3))
        return replace(self, joints=to_numpy(positions) + self.entries.draw(rng, 3))

    def linear(self) -> LinearObservation:
        """Return the linear Gaussian form; raise ``NotConjugate`` if the noise is Student-t."""
        self.entries.require_gaussian()
        return LinearObservation(np.eye(3)[None], self.joints[None], self.entries.precision[None])


def entry_noise(
    noise: float,
    confidence: np.ndarray | None,
    degrees_of_freedom: float | None,
    shape: tuple[int, ...],
) -> EntryNoise:
    """Return the noise of entries of ``shape``; confidence 1 by default."""
    check_positive("noise", noise)
    confidences = np.ones(shape) if confidence is None else np.asarray(confidence, dtype=np.float64)
    check_shape("confidence", confidences, shape)
    return EntryNoise(float(noise), confidences, degrees_of_freedom)


def _confidence_of(hidden: np.ndarray | None, shape: tuple[int, ...]) -> np.ndarray | None:
    if hidden is None:
        return None
    hidden = np.asarray(hidden, dtype=bool)
    check_shape("hidden", hidden, shape[len(shape) - hidden.ndim :])
    return np.broadcast_to(~hidden, shape).astype(np.float64)
