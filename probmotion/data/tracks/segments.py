"""Segmentation of 2D tracks at jumps and long gaps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from probmotion.data.tracks.step_reports import StepReport, seen
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.splits import name_within_clip
from probmotion.validation import check_positive

__all__ = ["split_discontinuities", "track_size"]


def track_size(track: KeypointTrack) -> float:
    """Return the median diagonal of the bounding box of a track's seen joints."""
    there = seen(track)[..., np.newaxis]
    frames = there.any(axis=(1, 2))
    if not frames.any():
        raise ValueError(f"track {track.name!r} must have a seen joint, got none")
    least = np.where(there, track.keypoints, np.inf).min(axis=1)[frames]
    greatest = np.where(there, track.keypoints, -np.inf).max(axis=1)[frames]
    return float(np.median(np.linalg.norm(greatest - least, axis=-1)))


def split_discontinuities(
    tracks: Sequence[KeypointTrack], *, jump: float = 0.5, unseen: float = 0.5
) -> tuple[list[KeypointTrack], StepReport]:
    """Cut tracks at jumps, which are tracking errors, and at long gaps.

    A track jumps between two frames with seen joints if it moves by more than ``jump`` times its
    size (:func:`track_size`): the median displacement of the joints seen in both frames, or else
    the displacement of the centre of all seen joints.

    Parameters
    ----------
    tracks : sequence of KeypointTrack
        Tracks that are not centred.
    jump : float
        Greatest displacement between frames, in track sizes.
    unseen : float
        Longest time without any seen joint, seconds.

    Returns
    -------
    tracks : list of KeypointTrack
        The segments in order, without unseen frames at cuts and ends. Segments of a cut track are
        numbered: ``"walk/left 0"``, or ``"walk/0"`` for the name ``"walk"``.
    report : StepReport
        What was dropped.
    """
    check_positive("jump", jump)
    check_positive("unseen", unseen)
    segments: list[KeypointTrack] = []
    jumps = gaps = never = 0
    for track in tracks:
        there = np.flatnonzero(seen(track).any(axis=1))
        if not len(there):
            never += 1
            continue
        far = _moved(track, there) > (
            jump * track_size(track) or np.inf
        )  # a single joint has size 0
        long = np.diff(there) - 1 > unseen * track.fps
        cuts = np.flatnonzero(far | long)
        jumps += int((far & ~long).sum())
        gaps += int(long.sum())
        starts = [there[0], *there[cuts + 1]]
        stops = [*(there[cuts] + 1), there[-1] + 1]
        whole = len(starts) == 1
        for number, (start, stop) in enumerate(zip(starts, stops, strict=True)):
            segments.append(
                replace(
                    track,
                    keypoints=track.keypoints[start:stop],
                    confidence=track.confidence[start:stop],
                    name=track.name if whole else name_within_clip(track.name, str(number)),
                )
            )
    why = (
        f"cut at {jumps} jumps of over {jump:g} track sizes and at {gaps} gaps of over {unseen:g} "
        f"s; {never} tracks were never seen"
    )
    return segments, StepReport.of("segments", tracks, segments, why, tracks_dropped=never)


def _moved(track: KeypointTrack, frames: np.ndarray) -> np.ndarray:
    """Return the displacement of a track from each of ``frames`` to the next."""
    there = seen(track)[frames]
    points = np.where(there[..., np.newaxis], track.keypoints[frames], 0.0)
    centres = points.sum(axis=1) / there.sum(axis=1)[:, np.newaxis]
    moved = np.linalg.norm(np.diff(centres, axis=0), axis=-1)
    both = there[1:] & there[:-1]
    steps = np.linalg.norm(np.diff(points, axis=0), axis=-1)
    shared = both.any(axis=1)
    moved[shared] = np.nanmedian(np.where(both, steps, np.nan)[shared], axis=1)
    return moved
