"""Evidence about a motion: 2D keypoints in known cameras, noisy 3D joints.

Both are y = A X + c + noise, entry by entry, where the cameras are orthographic; a confidence
multiplies the precision and 0 hides an entry.
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

__all__ = [
    "EntryNoise",
    "Joints3D",
    "Keypoints2D",
    "LinearObservation",
]


class LinearObservation(NamedTuple):
    """y_v = A_v X + noise of precision w_v, per frame and joint, Gaussian.

    Attributes
    ----------
    axes : ndarray, (V, M, 3)
        A: the rows that a position is multiplied by, M numbers per view.
    target : ndarray, (V, L, J, M)
        y less the observation of the origin; 0 where hidden.
    precision : ndarray, (V, L, J)
        1 / variance of each of the M numbers; 0 where hidden.
    """

    axes: np.ndarray
    target: np.ndarray
    precision: np.ndarray


@dataclass(frozen=True, eq=False)
class EntryNoise:
    """Independent noise of observed entries: Gaussian, or Student-t against outliers.

    Parameters
    ----------
    noise : float
        Standard deviation (Student-t: scale) of an entry of confidence 1.
    confidence : ndarray
        Multiplies the precision, one number per observed joint; 0 hides it.
    degrees_of_freedom : float or None
        Of the Student-t; ``None`` for Gaussian noise.

    Raises
    ------
    ValueError
        If a number is out of range or not finite.
    """

    noise: float
    confidence: np.ndarray
    degrees_of_freedom: float | None = None

    def __post_init__(self) -> None:
        check_positive("noise", self.noise)
        check_finite("confidence", self.confidence)
        if self.confidence.size and self.confidence.min() < 0:
            raise ValueError(
                f"confidence is {self.confidence.min():g} at its least, expected 0 or more"
            )
        if self.degrees_of_freedom is not None:
            check_positive("degrees_of_freedom", self.degrees_of_freedom)

    @property
    def visible(self) -> np.ndarray:
        """Where the evidence says anything, in the shape of ``confidence``."""
        return self.confidence > 0

    @property
    def precision(self) -> np.ndarray:
        """1 / variance (Student-t: 1 / scale²) per entry; 0 where hidden."""
        return self.confidence / self.noise**2

    def log_density(self, residual: Array) -> Array:
        """Return Σ log p(residual): ``(…, *confidence.shape, M) → (…)``; hidden ones count 0."""
        xp = array_namespace(residual)
        n_seen = residual.shape[-1] * int(self.visible.sum())
        log_scale = residual.shape[-1] * 0.5 * float(np.log(self.precision[self.visible]).sum())
        square = residual**2 * constant(self.precision[..., None], residual)
        if self.degrees_of_freedom is None:
            normaliser = -0.5 * math.log(2 * math.pi)
            terms = -0.5 * square
        else:
            nu = self.degrees_of_freedom
            normaliser = (
                math.lgamma((nu + 1) / 2) - math.lgamma(nu / 2) - 0.5 * math.log(nu * math.pi)
            )
            terms = -0.5 * (nu + 1) * xp.log1p(square / nu)
        axes = tuple(range(-1 - self.confidence.ndim, 0))
        return xp.sum(terms, axis=axes) + (log_scale + n_seen * normaliser)

    def draw(self, rng: np.random.Generator, size: int) -> np.ndarray:
        """Return noise of shape ``(*confidence.shape, size)``; 0 where hidden."""
        shape = (*self.confidence.shape, size)
        if self.degrees_of_freedom is None:
            unit = rng.standard_normal(shape)
        else:
            unit = rng.standard_t(self.degrees_of_freedom, shape)
        shown = np.where(self.visible, self.confidence, 1.0)[..., None]
        return np.where(self.visible[..., None], unit * self.noise / np.sqrt(shown), 0.0)

    def require_gaussian(self) -> None:
        """Raise :class:`~probmotion.posteriors.protocols.NotConjugate` if the noise is
        Student-t."""
        if self.degrees_of_freedom is not None:
            raise NotConjugate(
                f"the noise is Student-t with {self.degrees_of_freedom:g} degrees of freedom, "
                "which leaves no closed form; only Gaussian noise does"
            )


@dataclass(frozen=True, eq=False)
class Keypoints2D:
    """Noisy keypoints of one motion in V known cameras.

    Parameters
    ----------
    keypoints : ndarray, (V, L, J, 2)
        Image units. Entries with confidence 0 are not read and may be NaN.
    cameras : Cameras
        The V cameras.
    noise : float
        Standard deviation of a keypoint of confidence 1, image units.
    confidence : ndarray, (V, L, J), optional
        Multiplies the precision; 0 hides an entry; 1 everywhere by default.
    degrees_of_freedom : float, optional
        Student-t noise with this many; Gaussian by default.
    skeleton : Skeleton, optional
        Whose joints they are, where it is known; a posterior refuses a prior over another.
    fps : float, optional
        Frames per second, where it is known; a posterior refuses a prior at another.

    Raises
    ------
    ValueError
        If shapes disagree, a visible keypoint is not finite, or a number is out of range.
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
        keypoints = np.asarray(self.keypoints, dtype=np.float64)
        check_shape("keypoints", keypoints, (self.cameras.n_views, "L", "J", 2))
        entries = _entry_noise(
            self.noise, self.confidence, self.degrees_of_freedom, keypoints.shape[:-1]
        )
        object.__setattr__(self, "entries", entries)
        object.__setattr__(self, "confidence", entries.confidence)
        object.__setattr__(self, "keypoints", _seen("keypoints", keypoints, entries.visible))

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
        """Return what noisy detectors in ``cameras`` would report of ``motion``.

        Parameters
        ----------
        motion : Motion
            The true motion.
        cameras : Cameras
            The V cameras.
        noise : float
            Standard deviation, image units.
        seed : int
            Seed of the noise.
        hidden : ndarray of bool, (L, J) or (V, L, J), optional
            Entries that no detector sees.
        degrees_of_freedom : float, optional
            Student-t noise with this many; Gaussian by default.
        """
        shape = (cameras.n_views, *motion.positions.shape[:2])
        confidence = _confidence_of(hidden, shape)
        blank = cls(
            np.zeros((*shape, 2)),
            cameras,
            noise,
            confidence,
            degrees_of_freedom,
            motion.skeleton,
            motion.fps,
        )
        return blank.simulate(seeds.generator(seed, "evidence"), motion.positions)

    @classmethod
    def from_track(cls, track: KeypointTrack, camera: Cameras, noise: float) -> Keypoints2D:
        """Return the likelihood of a detected track in one known camera."""
        return cls(
            track.keypoints[None],
            camera,
            noise,
            track.confidence[None],
            skeleton=track.skeleton,
            fps=track.fps,
        )

    @property
    def frames(self) -> int:
        """Number of frames L."""
        return self.keypoints.shape[1]

    @property
    def n_joints(self) -> int:
        """Number of joints J."""
        return self.keypoints.shape[2]

    def log_density(self, positions: Array) -> Array:
        """Return log p(y | X): ``(…, L, J, 3) → (…)``."""
        check_shape("positions", positions, ("…", self.frames, self.n_joints, 3))
        residual = constant(self.keypoints, positions) - self.cameras.project(positions)
        return self.entries.log_density(residual)

    def simulate(self, rng: np.random.Generator, positions: np.ndarray) -> Keypoints2D:
        """Return the likelihood of evidence drawn from p(y | X), X of shape (L, J, 3)."""
        check_shape("positions", positions, (self.frames, self.n_joints, 3))
        seen = self.cameras.project(to_numpy(positions)) + self.entries.draw(rng, 2)
        return replace(self, keypoints=seen)

    def linear(self) -> LinearObservation:
        """Return the evidence as linear Gaussian entries.

        Raises
        ------
        NotConjugate
            If a camera is perspective or the noise is Student-t.
        """
        self.entries.require_gaussian()
        if not self.cameras.orthographic:
            raise NotConjugate(
                "the cameras are perspective, which leaves no closed form; only orthographic "
                "cameras do"
            )
        shifted = self.keypoints - self.cameras.offset[:, None, None, :]
        return LinearObservation(
            axes=self.cameras.image_axes,
            target=np.where(self.entries.visible[..., None], shifted, 0.0),
            precision=self.entries.precision,
        )


@dataclass(frozen=True, eq=False)
class Joints3D:
    """Noisy 3D joints of one motion.

    Parameters
    ----------
    joints : ndarray, (L, J, 3)
        Metres. Entries with confidence 0 are not read and may be NaN.
    noise : float
        Standard deviation of a coordinate of confidence 1, metres.
    confidence : ndarray, (L, J), optional
        Multiplies the precision; 0 hides an entry; 1 everywhere by default.
    degrees_of_freedom : float, optional
        Student-t noise with this many; Gaussian by default.
    skeleton : Skeleton, optional
        Whose joints they are, where it is known; a posterior refuses a prior over another.
    fps : float, optional
        Frames per second, where it is known; a posterior refuses a prior at another.

    Raises
    ------
    ValueError
        If shapes disagree, a visible joint is not finite, or a number is out of range.
    """

    joints: np.ndarray
    noise: float
    confidence: np.ndarray | None = None
    degrees_of_freedom: float | None = None
    skeleton: Skeleton | None = None
    fps: float | None = None
    entries: EntryNoise = field(init=False, repr=False)

    def __post_init__(self) -> None:
        joints = np.asarray(self.joints, dtype=np.float64)
        check_shape("joints", joints, ("L", "J", 3))
        entries = _entry_noise(
            self.noise, self.confidence, self.degrees_of_freedom, joints.shape[:-1]
        )
        object.__setattr__(self, "entries", entries)
        object.__setattr__(self, "confidence", entries.confidence)
        object.__setattr__(self, "joints", _seen("joints", joints, entries.visible))

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
        """Return noisy joints of ``motion``; ``hidden`` (L, J) marks those that are not seen."""
        shape = motion.positions.shape[:2]
        blank = cls(
            np.zeros((*shape, 3)),
            noise,
            _confidence_of(hidden, shape),
            degrees_of_freedom,
            motion.skeleton,
            motion.fps,
        )
        return blank.simulate(seeds.generator(seed, "evidence"), motion.positions)

    @property
    def frames(self) -> int:
        """Number of frames L."""
        return self.joints.shape[0]

    @property
    def n_joints(self) -> int:
        """Number of joints J."""
        return self.joints.shape[1]

    def log_density(self, positions: Array) -> Array:
        """Return log p(y | X): ``(…, L, J, 3) → (…)``."""
        check_shape("positions", positions, ("…", self.frames, self.n_joints, 3))
        return self.entries.log_density(constant(self.joints, positions) - positions)

    def simulate(self, rng: np.random.Generator, positions: np.ndarray) -> Joints3D:
        """Return the likelihood of evidence drawn from p(y | X), X of shape (L, J, 3)."""
        check_shape("positions", positions, (self.frames, self.n_joints, 3))
        return replace(self, joints=to_numpy(positions) + self.entries.draw(rng, 3))

    def linear(self) -> LinearObservation:
        """Return the evidence as linear Gaussian entries.

        Raises
        ------
        NotConjugate
            If the noise is Student-t.
        """
        self.entries.require_gaussian()
        return LinearObservation(
            axes=np.eye(3)[None], target=self.joints[None], precision=self.entries.precision[None]
        )


def _entry_noise(
    noise: float,
    confidence: np.ndarray | None,
    degrees_of_freedom: float | None,
    shape: tuple[int, ...],
) -> EntryNoise:
    check_positive("noise", noise)
    shown = np.ones(shape) if confidence is None else np.asarray(confidence, dtype=np.float64)
    check_shape("confidence", shown, shape)
    return EntryNoise(float(noise), shown, degrees_of_freedom)


def _confidence_of(hidden: np.ndarray | None, shape: tuple[int, ...]) -> np.ndarray | None:
    if hidden is None:
        return None
    hidden = np.asarray(hidden, dtype=bool)
    check_shape("hidden", hidden, shape[len(shape) - hidden.ndim :])
    return np.broadcast_to(~hidden, shape).astype(np.float64)


def _seen(name: str, entries: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Return ``entries`` with hidden ones 0; a visible one that is not finite is an error."""
    check_finite(name, entries[visible])
    return np.where(visible[..., None], entries, 0.0)
