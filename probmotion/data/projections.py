"""Synthetic 2D tracks: projections of 3D clips with detection errors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from probmotion import seeds
from probmotion.geometry.cameras import Cameras
from probmotion.motion.motion import KeypointTrack, Motion
from probmotion.validation import check_count, check_positive

__all__ = ["Centre", "DetectorNoise", "Filming", "centre_motion", "project_clips"]

Centre = Literal["frame", "sequence"]


@dataclass(frozen=True)
class DetectorNoise:
    """Error model of a keypoint detector.

    A joint is either detected, with small errors and high confidence, or lost for several frames,
    with large errors and low confidence or not reported at all.

    Parameters
    ----------
    found : float
        Error of a detected joint (standard deviation), metres at the subject's distance.
    lost : float
        Error of a lost joint (standard deviation), metres at the subject's distance.
    share : float
        Fraction of time that a joint is lost, in [0, 1).
    frames : float
        Mean duration of a loss, frames, at least 1.
    silent : float
        Fraction of lost joints that are not reported (NaN with confidence 0), in [0, 1].
    """

    found: float = 0.01
    lost: float = 0.15
    share: float = 0.03
    frames: float = 6.0
    silent: float = 0.3

    def __post_init__(self) -> None:
        for name, valid, expected in (
            ("found", 0 <= self.found < math.inf, "a finite number of at least 0"),
            ("lost", 0 <= self.lost < math.inf, "a finite number of at least 0"),
            ("silent", 0 <= self.silent <= 1, "0 to 1"),
            ("frames", 1 <= self.frames < math.inf, "a finite number of at least 1"),
            ("share", 0 <= self.share < 1, "at least 0 and below 1"),
        ):
            if not valid:
                raise ValueError(f"{name} must be {expected}, got {getattr(self, name)}")
        if self._loss_probability > 1:
            raise ValueError(
                f"share must be at most frames / (1 + frames), got {self.share} with frames "
                f"{self.frames}"
            )

    @classmethod
    def none(cls) -> DetectorNoise:
        """Return a detector without errors."""
        return cls(found=0.0, share=0.0)

    @property
    def _loss_probability(self) -> float:
        """Probability that a detected joint is lost in the next frame."""
        return self.share / (1 - self.share) / self.frames

    def lost_spans(self, rng: np.random.Generator, frames: int, joints: int) -> np.ndarray:
        """Return a mask of lost joints, (frames, joints), sampled from a Markov chain per joint."""
        lost = np.empty((frames, joints), bool)
        lost[0] = rng.random(joints) < self.share
        for frame in range(1, frames):
            probability = np.where(lost[frame - 1], 1 - 1 / self.frames, self._loss_probability)
            lost[frame] = rng.random(joints) < probability
        return lost

    def detect(
        self, rng: np.random.Generator, keypoints: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return detections of keypoints (L, J, 2) and their confidences (L, J)."""
        L, J, _ = keypoints.shape
        lost = self.lost_spans(rng, L, J)
        silent = lost & (rng.random((L, J)) < self.silent)
        size = np.where(lost, self.lost, self.found)
        detected = keypoints + size[..., None] * rng.standard_normal((L, J, 2))
        # The usual thresholds, 0.3 and 0.5, separate detected from lost joints.
        confidence = np.where(lost, 0.3 * rng.random((L, J)), 0.5 + 0.5 * rng.random((L, J)))
        confidence = np.where(silent, 0.0, confidence)
        return np.where(confidence[..., None] > 0, detected, np.nan), confidence


@dataclass(frozen=True)
class Filming:
    """Placement of random cameras and centring of their images.

    Parameters
    ----------
    elevation : float
        Mean elevation of the cameras, radians; π/16 as in *MAS*.
    tilt : float
        Maximum deviation from the mean elevation, radians.
    distance : float
        Distance of the cameras from the subject, metres.
    perspective : bool
        Whether the cameras are perspective instead of orthographic; either way, images are in
        metres at the subject's distance.
    centre : {"frame", "sequence"}
        Whether the root is at the origin in every frame or on average.
    """

    elevation: float = math.pi / 16
    tilt: float = math.radians(3)
    distance: float = 7.0
    perspective: bool = True
    centre: Centre = "frame"

    def __post_init__(self) -> None:
        check_positive("distance", self.distance)
        if not abs(self.elevation) + self.tilt < math.pi / 2 or self.tilt < 0:
            raise ValueError(
                f"elevation must be less than pi/2 - tilt in magnitude, and tilt at least 0, got "
                f"{self.elevation} and {self.tilt}"
            )
        if self.centre not in get_args(Centre):
            raise ValueError(f"centre must be frame or sequence, got {self.centre!r}")

    def cameras(self, rng: np.random.Generator, n: int) -> Cameras:
        """Return n cameras at random azimuths."""
        return Cameras.around(
            rng.uniform(0, 2 * np.pi, n),
            self.elevation + self.tilt * rng.uniform(-1, 1, n),
            distance=self.distance,
            perspective=self.perspective,
        )


def project_clips(
    motions: Sequence[Motion],
    *,
    views: int = 16,
    seed: int = 0,
    filming: Filming | None = None,
    noise: DetectorNoise | None = None,
) -> list[KeypointTrack]:
    """Project 3D clips into random cameras and return noisy 2D tracks.

    Parameters
    ----------
    motions : sequence of Motion
        3D clips with unique names.
    views : int
        Number of cameras per clip, each at a random azimuth and elevation.
    seed : int
        Seed of cameras and detection errors; the tracks of a clip do not depend on other clips.
    filming, noise : optional
        :class:`Filming` and :class:`DetectorNoise`, with their defaults if omitted.

    Returns
    -------
    list of KeypointTrack
        Tracks named ``"<clip>/<view>"``, in metres at the subject's distance, with x right and y
        down, centred on the root.

    Raises
    ------
    ValueError
        If ``motions`` is empty, or names are missing or repeated.
    """
    check_count("views", views)
    if not motions:
        raise ValueError("motions must contain at least one clip, got none")
    names = [motion.name for motion in motions]
    if len(set(names)) < len(names) or "" in names:
        raise ValueError(f"motions must have unique names, got {', '.join(names)}")
    filming, detector = filming or Filming(), noise or DetectorNoise()
    tracks = []
    for motion in motions:
        rng = seeds.generator(seed, "filming", motion.name)
        cameras = filming.cameras(rng, views)
        images = cameras.project(centre_motion(motion, filming.centre).positions)
        for view, image in enumerate(images):
            detected, name = detector.detect(rng, image), f"{motion.name}/{view}"
            tracks.append(KeypointTrack(*detected, motion.skeleton, motion.fps, name))
    return tracks


def centre_motion(motion: Motion, centre: Centre = "frame") -> Motion:
    """Return the motion with its root at the origin, in every frame or on average."""
    if centre == "sequence":
        return motion.centred()
    root = motion.skeleton.roots[0]
    positions = motion.positions - motion.positions[:, root : root + 1]
    return replace(motion, positions=positions, rotations=None, rest_offsets=None)
