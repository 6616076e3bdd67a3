"""Tracks cut where they are not one motion: at jumps, and where nobody was seen for long."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from probmotion.data.tracks.step_reports import StepReport, frames_of, seen
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.splits import name_within_clip
from probmotion.validation import check_positive

__all__ = ["split_discontinuities", "track_size"]


def track_size(track: KeypointTrack) -> float:
    """Return a track's size: the median over frames of the diagonal of its seen joints' box."""
    there = seen(track)[..., np.newaxis]
    frames = there.any(axis=(1, 2))
    if not frames.any():
        raise ValueError(f"track {track.name!r} has no seen joint, expected at least one")
    least = np.where(there, track.keypoints, np.inf).min(axis=1)[frames]
    greatest = np.where(there, track.keypoints, -np.inf).max(axis=1)[frames]
    return float(np.median(np.linalg.norm(greatest - least, axis=-1)))


def split_discontinuities(
    tracks: Sequence[KeypointTrack], *, jump: float = 0.5, unseen: float = 0.5
) -> tuple[list[KeypointTrack], StepReport]:
    """Cut tracks at jumps, which are tracking errors, and where nothing was seen for long.

    A track jumps between two frames, with none or only unseen ones between them, if it moves by
    more than ``jump`` times its own size (:func:`track_size`): by the median of the distances that
    the joints seen in both frames move, or that of the centres of all seen joints where no joint
    is seen in both. The median, because one joint may be mistaken where the body is not.

    Parameters
    ----------
    tracks : sequence of KeypointTrack
        Tracks that are not centred.
    jump : float
        The greatest distance between frames, in units of the track's size.
    unseen : float
        The longest time without any seen joint that a track may span, seconds.

    Returns
    -------
    tracks : list of KeypointTrack
        The pieces, in order. Frames without a seen joint at a cut, and at the ends, belong to no
        piece. Pieces of a track that is cut are numbered: ``"walk/left 0"``, or ``"walk/0"``
        where the name has no ``/``, so that all belong to one clip.
    report : StepReport
        ``frames_dropped`` counts unseen frames; ``tracks_dropped`` tracks that were never seen.
    """
    check_positive("jump", jump)
    check_positive("unseen", unseen)
    pieces: list[KeypointTrack] = []
    jumps = gaps = never = 0
    for track in tracks:
        there = np.flatnonzero(seen(track).any(axis=1))
        if not len(there):
            never += 1
            continue
        far = _moved(track, there) > (jump * track_size(track) or np.inf)  # one joint has no size
        long = np.diff(there) - 1 > unseen * track.fps
        cuts = np.flatnonzero(far | long)
        jumps += int((far & ~long).sum())
        gaps += int(long.sum())
        starts = [there[0], *there[cuts + 1]]
        stops = [*(there[cuts] + 1), there[-1] + 1]
        whole = len(starts) == 1
        for number, (start, stop) in enumerate(zip(starts, stops, strict=True)):
            pieces.append(
                replace(
                    track,
                    keypoints=track.keypoints[start:stop],
                    confidence=track.confidence[start:stop],
                    name=track.name if whole else name_within_clip(track.name, str(number)),
                )
            )
    why = (
        f"cut at {jumps} jumps of more than {jump:g} of the track's size and at {gaps} gaps of "
        f"more than {unseen:g} s; {never} tracks were never seen"
    )
    dropped = frames_of(tracks) - frames_of(pieces)
    return pieces, StepReport.of(
        "pieces", tracks, pieces, why, tracks_dropped=never, frames_dropped=dropped
    )


def _moved(track: KeypointTrack, frames: np.ndarray) -> np.ndarray:
    """Return how far a track moves from each of ``frames`` to the next, (len(frames) - 1,)."""
    there = seen(track)[frames]
    points = np.where(there[..., np.newaxis], track.keypoints[frames], 0.0)
    centres = points.sum(axis=1) / there.sum(axis=1)[:, np.newaxis]
    moved = np.linalg.norm(np.diff(centres, axis=0), axis=-1)
    both = there[1:] & there[:-1]
    steps = np.linalg.norm(np.diff(points, axis=0), axis=-1)
    shared = both.any(axis=1)
    moved[shared] = np.nanmedian(np.where(both, steps, np.nan)[shared], axis=1)
    return moved
