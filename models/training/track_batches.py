"""Training batches of 2D tracks: random windows, augmented and padded to one length."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from probmotion.models.training.standardisation import Standards
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count, check_not_negative

__all__ = ["Augmentation", "Batch", "TrackBatches", "describe_tracks", "learning_and_held_out"]


@dataclass(frozen=True)
class Augmentation:
    """Settings of the data augmentation of tracks, as in the training of MAS (section 6.1).

    Parameters
    ----------
    shortest : float
        Minimum length of a random window, as a fraction of the full length; in (0, 1].
    scale : float
        Windows are scaled by a random factor from 1 − scale to 1 + scale.
    shift : float
        Maximum random translation of windows along each axis, metres.
    mirror : bool
        Mirror windows with probability 1/2, exchanging left and right joints.

    Raises
    ------
    ValueError
        If a parameter is out of range.
    """

    shortest: float = 0.5
    scale: float = 0.05
    shift: float = 0.0
    mirror: bool = True

    def __post_init__(self) -> None:
        if not 0 < self.shortest <= 1:
            raise ValueError(f"shortest must be above 0 and at most 1, got {self.shortest}")
        if not 0 <= self.scale < 1:
            raise ValueError(f"scale must be at least 0 and below 1, got {self.scale}")
        check_not_negative("shift", self.shift)

    @classmethod
    def none(cls) -> Augmentation:
        """Return settings without augmentation."""
        return cls(1.0, 0.0, 0.0, False)


class Batch(NamedTuple):
    """Windows of tracks, padded to one length."""

    keypoints: np.ndarray
    """(B, L, J, 2) float32, metres; 0 where occluded or padded."""
    confidence: np.ndarray
    """(B, L, J) float32; 0 where below the threshold."""
    valid: np.ndarray
    """(B, L) bool: frames with a visible joint; False for padding."""
    frames: np.ndarray
    """(B, L): index into :meth:`TrackBatches.all_frames`; -1 for padding."""
    scale: np.ndarray
    """(B,) float32: scale factor of each window."""

    @property
    def seen(self) -> np.ndarray:
        """(B, L, J) bool: joints with a confidence at or above the threshold."""
        return self.confidence > 0


class TrackBatches:
    """Sampler of random windows of tracks.

    Tracks are drawn in proportion to their length; those shorter than a window count as one window.

    Parameters
    ----------
    tracks : sequence of KeypointTrack
        Centred tracks of one skeleton and frame rate, metres.
    frames : int
        Length L of a window; shorter tracks are padded.
    threshold : float
        Minimum confidence of a visible joint.
    augmentation : Augmentation
        Settings of the augmentation of windows.

    Raises
    ------
    ValueError
        If ``tracks`` is empty, tracks differ in skeleton or frame rate, no joint is visible, or a
        parameter is out of range.
    """

    def __init__(
        self,
        tracks: Sequence[KeypointTrack],
        frames: int,
        threshold: float,
        augmentation: Augmentation,
    ) -> None:
        check_count("frames", frames, least=2)
        check_not_negative("threshold", threshold)
        _check_alike(tracks)
        self.skeleton: Skeleton = tracks[0].skeleton
        self.fps = tracks[0].fps
        self.frames = frames
        self.threshold = threshold
        self.augmentation = augmentation
        self._confidence = [
            np.where(track.confidence >= threshold, track.confidence, 0.0).astype(np.float32)
            for track in tracks
        ]
        self._seen = [confidence > 0 for confidence in self._confidence]
        if not any(seen.any() for seen in self._seen):
            raise ValueError(
                f"tracks must contain joints with a confidence of at least {threshold:g}, got none"
            )
        self._keypoints = [
            np.where(seen[..., None], track.keypoints, 0.0).astype(np.float32)
            for track, seen in zip(tracks, self._seen, strict=True)
        ]
        # Number of windows per track; a short track counts as one.
        lengths = np.array([track.frames for track in tracks])
        windows = lengths / np.minimum(lengths, frames)
        windows *= [seen.any() for seen in self._seen]
        self._probability = windows / windows.sum()
        self._first = np.concatenate([[0], np.cumsum(lengths)])
        self._order = list(self.skeleton.mirrored_order)
        self.description = describe_tracks(tracks)

    def check_all_seen(self) -> None:
        """Raise ``ValueError`` if a joint is never visible: its position could not be learnt."""
        seen = self.all_frames()[1].any(axis=0)
        if not seen.all():
            never_seen = np.array(self.skeleton.joint_names)[~seen]
            raise ValueError(
                f"tracks must show every joint with a confidence of at least {self.threshold:g}, "
                f"got none for {', '.join(never_seen)}; choose a skeleton without these joints"
            )

    @property
    def standards(self) -> Standards:
        """Mean and standard deviation of visible joints under mirroring and translation.

        Scaling is ignored: factors of .95 to 1.05 would increase the variance of projected walks by
        a seventh.
        """
        points, seen = self.all_frames()
        points = points.astype(np.float64)
        count = np.maximum(seen.sum(axis=0), 1)[:, None]
        mean = (points * seen[..., None]).sum(axis=0) / count
        squares = ((points - mean) ** 2 * seen[..., None]).sum(axis=0) / count
        # Remove the rounding error of a centred root.
        squares = np.where(squares > 1e-12, squares, 0.0)
        # Windows are translated by U(-shift, shift) along each axis.
        return Standards(mean, np.sqrt(squares + self.augmentation.shift**2 / 3))

    def all_frames(self) -> tuple[np.ndarray, np.ndarray]:
        """Return keypoints (F, J, 2) and visibility (F, J) of all frames of all tracks.

        With mirroring, the mirror images of all frames follow.
        """
        points, seen = np.concatenate(self._keypoints), np.concatenate(self._seen)
        if self.augmentation.mirror:
            points = np.concatenate([points, self._mirrored(points)])
            seen = np.concatenate([seen, seen[:, self._order]])
        return points, seen

    def draw(self, rng: np.random.Generator, n: int) -> Batch:
        """Return n random windows."""
        check_count("n", n)
        J = self.skeleton.n_joints
        batch = Batch(
            np.zeros((n, self.frames, J, 2), np.float32),
            np.zeros((n, self.frames, J), np.float32),
            np.zeros((n, self.frames), bool),
            np.full((n, self.frames), -1),
            np.ones(n, np.float32),
        )
        for row, track in enumerate(rng.choice(len(self._probability), n, p=self._probability)):
            self._write_window(rng, int(track), batch, row)
        return batch

    def _write_window(self, rng: np.random.Generator, track: int, batch: Batch, row: int) -> None:
        """Write a random window of a track into a row of a batch."""
        keypoints, confidence = self._keypoints[track], self._confidence[track]
        longest = min(self.frames, len(keypoints))
        shortest = max(1, int(np.ceil(self.augmentation.shortest * longest)))
        length = int(rng.integers(shortest, longest + 1))
        start = int(rng.integers(0, len(keypoints) - length + 1))
        # Attention requires at least one frame with a visible joint.
        while not confidence[start : start + length].any():
            start = int(rng.integers(0, len(keypoints) - length + 1))
        keypoints = keypoints[start : start + length]
        confidence = confidence[start : start + length]
        frames = self._first[track] + start + np.arange(length)
        factor = 1 + self.augmentation.scale * rng.uniform(-1, 1)
        moved = self.augmentation.shift * rng.uniform(-1, 1, 2)
        mirrored = rng.random() < 0.5
        if self.augmentation.mirror and mirrored:
            keypoints, confidence = self._mirrored(keypoints), confidence[:, self._order]
            frames += self._first[-1]
        seen = confidence > 0
        batch.keypoints[row, :length] = np.where(seen[..., None], factor * keypoints + moved, 0.0)
        batch.confidence[row, :length] = confidence
        batch.valid[row, :length] = seen.any(axis=-1)
        batch.frames[row, :length] = frames
        batch.scale[row] = factor

    def _mirrored(self, keypoints: np.ndarray) -> np.ndarray:
        return keypoints[:, self._order] * np.array([-1, 1], keypoints.dtype)


def learning_and_held_out(
    tracks: Sequence[KeypointTrack],
    validation: Sequence[KeypointTrack],
    frames: int,
    threshold: float,
    augmentation: Augmentation,
) -> tuple[TrackBatches, TrackBatches]:
    """Return samplers of training windows and of validation windows without augmentation.

    Raises ``ValueError`` if the tracks differ in skeleton or frame rate.
    """
    batches = TrackBatches(tracks, frames, threshold, augmentation)
    held_out = TrackBatches(validation, frames, threshold, Augmentation.none())
    if held_out.skeleton != batches.skeleton:
        names = ", ".join(held_out.skeleton.joint_names)
        raise ValueError(f"validation must have the skeleton of tracks, got joints {names}")
    if held_out.fps != batches.fps:
        raise ValueError(
            f"validation must have the frame rate of tracks, {batches.fps:g}, got {held_out.fps:g}"
        )
    return batches, held_out


def describe_tracks(tracks: Sequence[KeypointTrack]) -> dict[str, Any]:
    """Return the numbers of tracks and frames, the names of clips and the SHA-256 of the data."""
    digest = hashlib.sha256()
    for track in tracks:
        digest.update(np.nan_to_num(track.keypoints, nan=0.0).tobytes())
        digest.update(track.confidence.tobytes())
    clips = sorted({track.name.rpartition("/")[0] or track.name for track in tracks})
    frames = sum(track.frames for track in tracks)
    return {"tracks": len(tracks), "frames": frames, "clips": clips, "sha256": digest.hexdigest()}


def _check_alike(tracks: Sequence[KeypointTrack]) -> None:
    if not tracks:
        raise ValueError("tracks must contain at least one track, got none")
    first = tracks[0]
    for track in tracks:
        if track.skeleton != first.skeleton:
            raise ValueError(
                f"tracks must have one skeleton, got different ones for {track.name or 'a track'} "
                f"and {first.name or 'the first'}"
            )
        if track.fps != first.fps:
            raise ValueError(
                f"tracks must have one frame rate, got {track.fps:g} for {track.name or 'a track'} "
                f"and {first.fps:g} for {first.name or 'the first'}"
            )
