"""Segmentation of 2D tracks at jumps and long gaps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from probmotion.data.tracks.step_reports import Step, StepReport, boxes_of, seen
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.splits import name_within_clip
from probmotion.validation import check_positive

__all__ = ["split_discontinuities", "track_size"]


def track_size(track: KeypointTrack) -> float:
    """Return the median diagonal of the bounding box of a track's seen joints."""
    if not seen(track).any():
        raise ValueError(f"track {track.name!r} must have a seen joint, got none")
    sides = np.diff(boxes_of(track), axis=1)[:, 0]
    return float(np.nanmedian(np.linalg.norm(sides, axis=-1)))


def split_discontinuities(
    tracks: Sequence[KeypointTrack], *, jump: float = 0.5, unseen: float = 0.5
) -> Step:
    """Cut uncentred tracks at jumps, which are tracking errors, and at long gaps.

    A track jumps between two frames with seen joints if it moves by more than ``jump`` times its
    size (:func:`track_size`): the median displacement of the joints seen in both frames, or else
    the displacement of the centre of all seen joints. A gap is longer than ``unseen`` seconds
    without any seen joint. Segments omit unseen frames at cuts and ends; segments of a cut track
    are numbered: ``"walk/left 0"``, or ``"walk/0"`` for the name ``"walk"``.
    """
    check_positive("jump", jump)
    check_positive("unseen", unseen)
    segments: list[KeypointTrack] = []
    jumps = gaps = n_unseen = 0
    for track in tracks:
        frames = np.flatnonzero(seen(track).any(axis=1))
        if not len(frames):
            n_unseen += 1
            continue
        # Tracks of a single joint have size 0 and no limit.
        jumped = _displacements(track, frames) > (jump * track_size(track) or np.inf)
        long = np.diff(frames) - 1 > unseen * track.fps
        cuts = np.flatnonzero(jumped | long)
        jumps += int((jumped & ~long).sum())
        gaps += int(long.sum())
        starts = [frames[0], *frames[cuts + 1]]
        stops = [*(frames[cuts] + 1), frames[-1] + 1]
        for number, (start, stop) in enumerate(zip(starts, stops, strict=True)):
            segments.append(
                replace(
                    track,
                    keypoints=track.keypoints[start:stop],
                    confidence=track.confidence[start:stop],
                    name=name_within_clip(track.name, str(number)) if len(cuts) else track.name,
                    start=None,
                )
            )
    why = (
        f"cut at jumps of over {jump:g} track sizes: {jumps}, at gaps of over {unseen:g} s: "
        f"{gaps}; tracks never seen: {n_unseen}"
    )
    return segments, StepReport.of("segments", tracks, segments, why, tracks_dropped=n_unseen)


def _displacements(track: KeypointTrack, frames: np.ndarray) -> np.ndarray:
    """Return the displacement of a track from each of ``frames`` to the next."""
    visible = seen(track)[frames]
    points = np.where(visible[..., np.newaxis], track.keypoints[frames], 0.0)
    centres = points.sum(axis=1) / visible.sum(axis=1)[:, np.newaxis]
    displacements = np.linalg.norm(np.diff(centres, axis=0), axis=-1)
    visible = visible[1:] & visible[:-1]
    steps = np.linalg.norm(np.diff(points, axis=0), axis=-1)
    shared = visible.any(axis=1)
    displacements[shared] = np.nanmedian(np.where(visible, steps, np.nan)[shared], axis=1)
    return displacements
