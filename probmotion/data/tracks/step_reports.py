"""Reports of the preparation steps of 2D tracks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from probmotion.motion.motion import KeypointTrack

__all__ = ["StepReport", "entries_of", "seen"]


@dataclass(frozen=True)
class StepReport:
    """Input, output and losses of one step.

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
        """Return the report of a step; what is missing from its output counts as dropped."""
        tracks, frames = (len(before), len(after)), (frames_of(before), frames_of(after))
        if tracks_dropped is None:
            tracks_dropped = tracks[0] - tracks[1]
        if frames_dropped is None:
            frames_dropped = frames[0] - frames[1]
        return cls(
            step, tracks[0], frames[0], tracks[1], frames[1], tracks_dropped, frames_dropped,
            entries_changed, why,
        )  # fmt: skip

    def __str__(self) -> str:
        return (
            f"{self.step}: tracks {self.tracks_before} → {self.tracks_after}, frames "
            f"{self.frames_before} → {self.frames_after}, {self.entries_changed} detections "
            f"changed; {self.why}"
        )


def frames_of(tracks: Sequence[KeypointTrack]) -> int:
    """Return the total number of frames."""
    return sum(track.frames for track in tracks)


def seen(track: KeypointTrack) -> np.ndarray:
    """Return which entries have a confidence above 0, (L, J) bool."""
    return track.confidence > 0


def entries_of(tracks: Sequence[KeypointTrack]) -> int:
    """Return the total number of seen entries."""
    return sum(int(seen(track).sum()) for track in tracks)
