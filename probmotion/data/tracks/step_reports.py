"""Reports on preparation steps of 2D tracks, and helpers shared by the steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from probmotion.motion.motion import KeypointTrack

__all__ = ["Step", "StepReport", "boxes_of", "entries_of", "masked", "seen"]


@dataclass(frozen=True)
class StepReport:
    """Report on one preparation step: amounts of input, output, dropped and changed data.

    ``entries_changed`` counts detections (joints of single frames) that were removed, filled or
    moved; ``frames_dropped`` includes the frames of dropped tracks.
    """

    step: str
    tracks_before: int
    frames_before: int
    tracks_after: int
    frames_after: int
    tracks_dropped: int = 0
    frames_dropped: int = 0
    entries_changed: int = 0
    why: str = ""

    @classmethod
    def of(
        cls,
        step: str,
        before: Sequence[KeypointTrack],
        after: Sequence[KeypointTrack],
        why: str,
        *,
        tracks_dropped: int | None = None,
        frames_dropped: int | None = None,
        entries_changed: int = 0,
    ) -> StepReport:
        """Return the report of a step; missing tracks and frames count as dropped by default."""
        frames = [sum(track.frames for track in tracks) for tracks in (before, after)]
        return cls(
            step,
            len(before),
            frames[0],
            len(after),
            frames[1],
            len(before) - len(after) if tracks_dropped is None else tracks_dropped,
            frames[0] - frames[1] if frames_dropped is None else frames_dropped,
            entries_changed,
            why,
        )

    def __str__(self) -> str:
        return (
            f"{self.step}: tracks {self.tracks_before} → {self.tracks_after}, frames "
            f"{self.frames_before} → {self.frames_after}, {self.entries_changed} detections "
            f"changed; {self.why}"
        )


Step = tuple[list[KeypointTrack], StepReport]
"""Return type of a preparation step: the resulting tracks and a report."""


def seen(track: KeypointTrack) -> np.ndarray:
    """Return a mask of the entries with a confidence above 0, (L, J) bool."""
    return track.confidence > 0


def entries_of(tracks: Sequence[KeypointTrack]) -> int:
    """Return the total number of seen entries."""
    return sum(int(seen(track).sum()) for track in tracks)


def masked(track: KeypointTrack, entries: np.ndarray) -> KeypointTrack:
    """Return a track with ``entries`` (L, J) marked as unseen."""
    return replace(
        track,
        keypoints=np.where(entries[..., np.newaxis], np.nan, track.keypoints),
        confidence=np.where(entries, 0.0, track.confidence),
    )


def boxes_of(track: KeypointTrack) -> np.ndarray:
    """Return the minimum and maximum (x, y) of seen joints per frame, (L, 2, 2); NaN if none."""
    visible = seen(track)[..., np.newaxis]
    minimum = np.where(visible, track.keypoints, np.inf).min(axis=1)
    maximum = np.where(visible, track.keypoints, -np.inf).max(axis=1)
    boxes = np.stack([minimum, maximum], axis=1)
    return np.where(visible.any(axis=1, keepdims=True), boxes, np.nan)
