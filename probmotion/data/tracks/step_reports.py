"""What a step of preparation did to a data set of 2D tracks, in numbers and words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from probmotion.motion.motion import KeypointTrack

__all__ = ["StepReport", "entries_of", "frames_of", "seen"]


@dataclass(frozen=True)
class StepReport:
    """One step: what came, what was dropped or changed, what left, and why.

    Steps that only drop keep the sums: what came is what left and what was dropped. Splitting
    makes more tracks of the same frames, mirroring doubles both, resampling counts time anew.

    Attributes
    ----------
    step : str
        The step's name.
    tracks_before, frames_before : int
        What came.
    tracks_after, frames_after : int
        What left.
    tracks_dropped, frames_dropped : int
        Tracks that were dropped whole, and frames that were, theirs included.
    entries_changed : int
        Joints of single frames that were hidden, filled or moved.
    why : str
        What was done, and why something was dropped, in words.
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
        tracks_dropped: int = 0,
        frames_dropped: int = 0,
        entries_changed: int = 0,
    ) -> StepReport:
        """Return the report of a step from the tracks that came and those that left."""
        return cls(
            step, len(before), frames_of(before), len(after), frames_of(after),
            tracks_dropped, frames_dropped, entries_changed, why,
        )  # fmt: skip

    def __str__(self) -> str:
        return (
            f"{self.step}: {_counted(self.tracks_before, 'track')} of "
            f"{_counted(self.frames_before, 'frame')} became {self.tracks_after} of "
            f"{self.frames_after}; {_counted(self.tracks_dropped, 'track')} and "
            f"{_counted(self.frames_dropped, 'frame')} dropped, "
            f"{_counted(self.entries_changed, 'joint')} changed; {self.why}"
        )


def _counted(number: int, thing: str) -> str:
    return f"{number} {thing}" if number == 1 else f"{number} {thing}s"


def frames_of(tracks: Sequence[KeypointTrack]) -> int:
    """Return how many frames the tracks have together."""
    return sum(track.frames for track in tracks)


def seen(track: KeypointTrack) -> np.ndarray:
    """Return which entries were seen, (L, J) bool: those with a confidence above 0."""
    return track.confidence > 0


def entries_of(tracks: Sequence[KeypointTrack]) -> int:
    """Return how many joints of single frames were seen in the tracks together."""
    return sum(int(seen(track).sum()) for track in tracks)
