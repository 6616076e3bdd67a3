"""Batches of 2D tracks for learning: random sub-sequences, varied, padded to one length."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from probmotion.models.training.standardisation import Standards
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count

__all__ = ["Augmentation", "Batch", "TrackBatches", "describe_tracks", "learning_and_held_out"]


@dataclass(frozen=True)
class Augmentation:
    """How tracks are varied (MAS, section 6.1; the authors' training).

    Parameters
    ----------
    shortest : float
        Least share of the window that a random sub-sequence keeps, above 0 and at most 1.
    scale : float
        Tracks are scaled by a factor from 1 − scale to 1 + scale.
    shift : float
        Tracks are moved by up to this much, metres; 0 where the root is at the origin.
    mirror : bool
        Mirror every other track, left and right joints exchanged.

    Raises
    ------
    ValueError
        If a number is out of range.
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
        if not 0 <= self.shift < np.inf:
            raise ValueError(f"shift must be a number of at least 0, got {self.shift}")

    @classmethod
    def none(cls) -> Augmentation:
        """Return the augmentation that changes nothing."""
        return cls(1.0, 0.0, 0.0, False)


class Batch(NamedTuple):
    """Tracks padded to one length."""

    keypoints: np.ndarray
    """(B, L, J, 2) float32, metres; 0 where not seen or not there."""
    confidence: np.ndarray
    """(B, L, J) float32: the tracks' own, 0 where it is below the threshold."""
    valid: np.ndarray
    """(B, L) bool: frames that are there and in which something is seen."""
    frames: np.ndarray
    """(B, L): which of :meth:`TrackBatches.all_frames` it shows; -1 where not there."""
    scale: np.ndarray
    """(B,) float32: by which its tracks are scaled."""

    @property
    def seen(self) -> np.ndarray:
        """(B, L, J) bool: joints whose confidence is not below the threshold."""
        return self.confidence > 0


class TrackBatches:
    """Random windows of tracks.

    A frame is as likely to be in one whichever track it is of; frames near a track's ends are in
    fewer windows than those between.

    Parameters
    ----------
    tracks : sequence of KeypointTrack
        Of one skeleton and frame rate, metres, centred.
    frames : int
        Length L of a window; shorter tracks are padded.
    threshold : float
        Least confidence of a joint that counts.
    augmentation : Augmentation
        How windows are varied.

    Raises
    ------
    ValueError
        If there is no track, they differ in skeleton or frame rate, none has a confident joint, or
        a number is out of range.
    """

    def __init__(
        self,
        tracks: Sequence[KeypointTrack],
        frames: int,
        threshold: float,
        augmentation: Augmentation,
    ) -> None:
        check_count("frames", frames, least=2)
        if not 0 <= threshold < np.inf:
            raise ValueError(f"threshold must be a number of at least 0, got {threshold}")
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
                f"tracks has no joint of confidence {threshold:g} or more, expected some to learn "
                "from"
            )
        self._keypoints = [
            np.where(seen[..., None], track.keypoints, 0.0).astype(np.float32)
            for track, seen in zip(tracks, self._seen, strict=True)
        ]
        # A draw shows no more frames of a long track than a window's, and all of a short one's.
        lengths = np.array([track.frames for track in tracks])
        windows = lengths / np.minimum(lengths, frames)
        windows *= [seen.any() for seen in self._seen]
        self._share = windows / windows.sum()
        self._first = np.concatenate([[0], np.cumsum(lengths)])
        self._order = list(self.skeleton.mirrored_order)
        self.description = describe_tracks(tracks)

    @property
    def never_seen(self) -> tuple[str, ...]:
        """Names of the joints that no window shows, nor a mirror image if there are."""
        seen = np.any([track.any(axis=0) for track in self._seen], axis=0)
        if self.augmentation.mirror:
            seen = seen | seen[self._order]
        return tuple(
            name for name, there in zip(self.skeleton.joint_names, seen, strict=True) if not there
        )

    def check_all_seen(self) -> None:
        """Refuse tracks that never show one of the joints: nothing would say where it is.

        Raises
        ------
        ValueError
            If there is such a joint.
        """
        if unseen := self.never_seen:
            raise ValueError(
                f"tracks never shows {', '.join(unseen)} with a confidence of {self.threshold:g} "
                "or more, expected every joint to be seen somewhere; choose a skeleton without them"
            )

    @property
    def standards(self) -> Standards:
        """Mean and deviation of the joints that are seen, as windows have them: mirrored, moved.

        The scale's part is left out: with the usual factors of .95 to 1.05 its deviation is 3 % of
        a joint's mean, which makes the variance of walks that are filmed a seventh larger.
        """
        points = np.concatenate(self._keypoints).astype(np.float64)
        seen = np.concatenate(self._seen)
        if self.augmentation.mirror:
            points = np.concatenate([points, self._mirrored(points)])
            seen = np.concatenate([seen, seen[:, self._order]])
        count = np.maximum(seen.sum(axis=0), 1)[:, None]
        mean = (points * seen[..., None]).sum(axis=0) / count
        squares = ((points - mean) ** 2 * seen[..., None]).sum(axis=0) / count
        # Rounding leaves a root that pictures are centred on with a hair's breadth.
        squares = np.where(squares > 1e-12, squares, 0.0)
        # A window is moved by U(-shift, shift) along each axis, whatever the track does.
        return Standards(mean, np.sqrt(squares + self.augmentation.shift**2 / 3))

    def all_frames(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the keypoints, (F, J, 2), and what is seen, (F, J), of all frames of all tracks.

        Where windows are mirrored, the mirror images of all frames come after them.
        """
        points, seen = np.concatenate(self._keypoints), np.concatenate(self._seen)
        if not self.augmentation.mirror:
            return points, seen
        return (
            np.concatenate([points, self._mirrored(points)]),
            np.concatenate([seen, seen[:, self._order]]),
        )

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
        for row, track in enumerate(rng.choice(len(self._share), n, p=self._share)):
            self._show(rng, int(track), batch, row)
        return batch

    def _show(self, rng: np.random.Generator, track: int, batch: Batch, row: int) -> None:
        """Put a random window of a track into a row of a batch."""
        keypoints, confidence = self._keypoints[track], self._confidence[track]
        longest = min(self.frames, len(keypoints))
        shortest = max(1, int(np.ceil(self.augmentation.shortest * longest)))
        length = int(rng.integers(shortest, longest + 1))
        start = int(rng.integers(0, len(keypoints) - length + 1))
        # Attention needs a frame to look at; a pause in which nothing is seen is no motion.
        while not confidence[start : start + length].any():
            start = int(rng.integers(0, len(keypoints) - length + 1))
        keypoints = keypoints[start : start + length]
        confidence = confidence[start : start + length]
        frames = self._first[track] + start + np.arange(length)
        factor = 1 + self.augmentation.scale * rng.uniform(-1, 1)
        moved = self.augmentation.shift * rng.uniform(-1, 1, 2)
        turned = rng.random() < 0.5
        if self.augmentation.mirror and turned:
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
    """Return batches to learn from and batches to watch learning by, which are not varied.

    Parameters
    ----------
    tracks : sequence of KeypointTrack
        Of one skeleton and frame rate, metres, centred.
    validation : sequence of KeypointTrack
        As ``tracks``, of clips that are not among theirs.
    frames, threshold
        As for :class:`TrackBatches`.
    augmentation : Augmentation
        How ``tracks`` are varied.

    Raises
    ------
    ValueError
        If either cannot be batched, or they differ in skeleton or frame rate.
    """
    batches = TrackBatches(tracks, frames, threshold, augmentation)
    held_out = TrackBatches(validation, frames, threshold, Augmentation.none())
    if held_out.skeleton != batches.skeleton:
        raise ValueError("validation has another skeleton than tracks, expected the same")
    if held_out.fps != batches.fps:
        raise ValueError(
            f"validation is at {held_out.fps:g} frames per second, expected tracks' {batches.fps:g}"
        )
    return batches, held_out


def describe_tracks(tracks: Sequence[KeypointTrack]) -> dict[str, Any]:
    """Return how many tracks, frames and clips there are, the clips' names and a digest of all."""
    digest = hashlib.sha256()
    for track in tracks:
        digest.update(np.nan_to_num(track.keypoints, nan=0.0).tobytes())
        digest.update(track.confidence.tobytes())
    clips = sorted({track.name.rpartition("/")[0] or track.name for track in tracks})
    return {
        "tracks": len(tracks),
        "frames": sum(track.frames for track in tracks),
        "clips": clips,
        "sha256": digest.hexdigest(),
    }


def _check_alike(tracks: Sequence[KeypointTrack]) -> None:
    if not tracks:
        raise ValueError("tracks must contain at least one track, got none")
    first = tracks[0]
    for track in tracks:
        if track.skeleton != first.skeleton:
            raise ValueError(
                f"tracks has {track.name or 'one'} with other joints than "
                f"{first.name or 'the first'}, expected one skeleton"
            )
        if track.fps != first.fps:
            raise ValueError(
                f"tracks has {track.name or 'one'} at {track.fps:g} frames per second and "
                f"{first.name or 'the first'} at {first.fps:g}, expected one rate"
            )
