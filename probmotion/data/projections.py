"""2D tracks from 3D clips, as if the clips had been filmed and a detector had found the joints.

What is learnt from such tracks has seen no third dimension; the clips stay behind as the truth.
"""

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
    """How a detector errs.

    A joint is either found, with small errors and a high confidence, or lost for a while, with
    large errors and a low one, or not reported at all.

    Parameters
    ----------
    found : float
        Standard deviation of a found joint, metres at the subject's distance.
    lost : float
        Standard deviation of a lost joint that is reported.
    share : float
        Share of the time that a joint is lost, at least 0 and below 1.
    frames : float
        Frames that a joint stays lost, on average.
    silent : float
        Share of lost joints that are not reported: NaN with confidence 0.

    Raises
    ------
    ValueError
        If a number is out of range.
    """

    found: float = 0.01
    lost: float = 0.15
    share: float = 0.03
    frames: float = 6.0
    silent: float = 0.3

    def __post_init__(self) -> None:
        for name in ("found", "lost"):
            value = getattr(self, name)
            if not 0 <= value < math.inf:
                raise ValueError(f"{name} must be a finite number of at least 0, got {value}")
        if not 0 <= self.share < 1:
            raise ValueError(f"share must be at least 0 and below 1, got {self.share}")
        if not 0 <= self.silent <= 1:
            raise ValueError(f"silent must be 0 to 1, got {self.silent}")
        if not 1 <= self.frames < math.inf:
            raise ValueError(f"frames must be a finite number of at least 1, got {self.frames}")
        if self._begin > 1:
            raise ValueError(
                f"share is {self.share} with frames {self.frames}, expected a joint to be found "
                "for a frame between two losses"
            )

    @classmethod
    def none(cls) -> DetectorNoise:
        """Return the detector that makes no error."""
        return cls(found=0.0, share=0.0)

    @property
    def _begin(self) -> float:
        """Chance that a found joint is lost in the next frame."""
        return self.share / (1 - self.share) / self.frames

    def lost_spans(self, rng: np.random.Generator, frames: int, joints: int) -> np.ndarray:
        """Return when joints are lost: a Markov chain in time for each, (frames, joints) bool."""
        stay = 1 - 1 / self.frames
        begin = self.share / (1 - self.share) / self.frames
        if begin > 1:
            raise ValueError(
                f"share is {self.share} with frames {self.frames}, expected a joint to be found "
                "for a frame between two losses"
            )
        lost = np.empty((frames, joints), bool)
        lost[0] = rng.random(joints) < self.share
        for frame in range(1, frames):
            chance = np.where(lost[frame - 1], stay, self._begin)
            lost[frame] = rng.random(joints) < chance
        return lost

    def detect(
        self, rng: np.random.Generator, keypoints: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return what is reported of true keypoints: ``(L, J, 2) → (L, J, 2), (L, J)``."""
        L, J, _ = keypoints.shape
        lost = self.lost_spans(rng, L, J)
        silent = lost & (rng.random((L, J)) < self.silent)
        size = np.where(lost, self.lost, self.found)
        reported = keypoints + size[..., None] * rng.standard_normal((L, J, 2))
        # Found joints score .5 to 1, lost ones 0 to .3, as the thresholds in use expect.
        confidence = np.where(lost, 0.3 * rng.random((L, J)), 0.5 + 0.5 * rng.random((L, J)))
        confidence = np.where(silent, 0.0, confidence)
        return np.where(confidence[..., None] > 0, reported, np.nan), confidence


@dataclass(frozen=True)
class Filming:
    """Where the cameras stand, and on what pictures are centred.

    Parameters
    ----------
    elevation : float
        Mean elevation of the cameras, radians: the published π/16.
    tilt : float
        Elevations vary by up to this much about the mean, radians.
    distance : float
        Metres from the subject.
    perspective : bool
        Perspective cameras, whose pictures are in metres at the subject's distance.
    centre : {"frame", "sequence"}
        The root is at the origin in every frame, as in pictures that follow the subject, or on
        average over the track's frames.

    Raises
    ------
    ValueError
        If a number is out of range or the centre unknown.
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
                f"elevation is {self.elevation} with tilt {self.tilt}, expected cameras between "
                "-pi/2 and pi/2"
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
    """Return what cameras around each clip and a detector would have found.

    Parameters
    ----------
    motions : sequence of Motion
        3D clips with a name each.
    views : int
        Cameras per clip, each at a random azimuth and elevation.
    seed : int
        Of cameras and errors; a clip's tracks do not depend on the other clips.
    filming : Filming, optional
        Where the cameras stand; the defaults of :class:`Filming`.
    noise : DetectorNoise, optional
        How the detector errs; the defaults of :class:`DetectorNoise`.

    Returns
    -------
    list of KeypointTrack
        Called ``"<clip>/<view>"``; metres at the subject's distance, x right and y down, centred
        on the root.

    Raises
    ------
    ValueError
        If there is no clip, or two have one name or none.
    """
    check_count("views", views)
    if not motions:
        raise ValueError("motions must contain at least one clip, got none")
    names = [motion.name for motion in motions]
    if len(set(names)) < len(names) or "" in names:
        raise ValueError(f"motions has the names {', '.join(names)}, expected one of its own each")
    shot, erring = filming or Filming(), noise or DetectorNoise()
    tracks = []
    for motion in motions:
        rng = seeds.generator(seed, "filming", motion.name)
        cameras = shot.cameras(rng, views)
        pictures = cameras.project(centre_motion(motion, shot.centre).positions)
        for view, picture in enumerate(pictures):
            keypoints, confidence = erring.detect(rng, picture)
            name = f"{motion.name}/{view}"
            tracks.append(KeypointTrack(keypoints, confidence, motion.skeleton, motion.fps, name))
    return tracks


def centre_motion(motion: Motion, centre: Centre = "frame") -> Motion:
    """Return the motion with its root at the origin, in every frame or on average."""
    if centre == "sequence":
        return motion.centred()
    root = motion.skeleton.roots[0]
    positions = motion.positions - motion.positions[:, root : root + 1]
    return replace(motion, positions=positions, rotations=None, rest_offsets=None)
