"""Steps that leave out what is not worth learning from: stray joints, poor tracks, crowds.

Source: *MAS*, section 6.1 ("filtering short motions, crowd motions, and motions of low quality"),
which prints no limits; the numbers here are ours, but for the confidence thresholds (section 6.2).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from probmotion.data.tracks.segments import track_size
from probmotion.data.tracks.step_reports import StepReport, entries_of, frames_of, seen
from probmotion.motion.motion import KeypointTrack
from probmotion.validation import check_positive

__all__ = ["drop_crowds", "drop_low_quality", "drop_short", "hide_strays", "hide_uncertain"]

Step = tuple[list[KeypointTrack], StepReport]
_FEWEST = 3  # the least number of entries that have a median other than their mean


def hide_uncertain(tracks: Sequence[KeypointTrack], *, threshold: float = 0.3) -> Step:
    """Hide entries below a confidence: they become unseen, NaN with confidence 0.

    Parameters
    ----------
    tracks : sequence of KeypointTrack
        Tracks of any skeletons.
    threshold : float
        The least confidence that stays: 0.3 for people, 0.5 for horses, 0.01 with a ball.

    Returns
    -------
    tracks : list of KeypointTrack
        As many tracks and frames; later steps need no threshold, only what is seen.
    report : StepReport
        ``entries_changed`` counts what was hidden.
    """
    check_positive("threshold", threshold)
    kept = [_hidden(track, track.confidence < threshold) for track in tracks]
    why = f"hid entries with a confidence below {threshold:g}"
    return kept, StepReport.of(
        "uncertain", tracks, kept, why, entries_changed=entries_of(tracks) - entries_of(kept)
    )


def hide_strays(
    tracks: Sequence[KeypointTrack], *, distance: float = 0.15, window: float = 0.25
) -> Step:
    """Hide entries far from where their joint is just before and after: detectors' lapses.

    Smoothing would spread one wild entry over its whole window. An entry is compared with the
    median of its joint's seen entries in the window around it, itself included; a joint that moves
    one way is at its own median however fast it is.

    Parameters
    ----------
    tracks : sequence of KeypointTrack
        Tracks without jumps (:func:`~probmotion.data.tracks.segments.split_discontinuities`).
    distance : float
        The greatest distance from the median, in units of the track's size
        (:func:`~probmotion.data.tracks.segments.track_size`).
    window : float
        Seconds, rounded to frames on either side. With fewer than 3 entries nothing is judged.

    Returns
    -------
    tracks : list of KeypointTrack
        As many tracks and frames.
    report : StepReport
        ``entries_changed`` counts what was hidden.
    """
    check_positive("distance", distance)
    check_positive("window", window)
    kept = [
        _hidden(track, _off_median(track, round(window * track.fps / 2)) > distance * size)
        if (size := track_size(track)) > 0
        else track
        for track in tracks
    ]
    why = f"hid entries more than {distance:g} of the track's size off their median of {window:g} s"
    return kept, StepReport.of(
        "strays", tracks, kept, why, entries_changed=entries_of(tracks) - entries_of(kept)
    )


def drop_short(tracks: Sequence[KeypointTrack], *, seconds: float = 1.0) -> Step:
    """Drop tracks that last less than ``seconds`` (frames over frames per second)."""
    check_positive("seconds", seconds)
    # A hundredth of a frame for frame rates that files round: 60 frames of .016666 s are a second.
    lasts = [track.frames + 0.01 >= seconds * track.fps for track in tracks]
    why = f"dropped tracks of less than {seconds:g} s"
    if tracks and not any(lasts):
        longest = max(tracks, key=lambda track: track.frames / track.fps)
        why += (
            f", {math.ceil(seconds * longest.fps - 0.01)} frames at {longest.fps:g} per second, of "
            f"which the longest has {longest.frames}"
        )
    return _kept("short", tracks, lasts, why)


def drop_low_quality(
    tracks: Sequence[KeypointTrack], *, threshold: float = 0.3, share: float = 0.6
) -> Step:
    """Drop tracks in which too few entries are sure.

    Parameters
    ----------
    tracks : sequence of KeypointTrack
        Tracks of any skeletons.
    threshold : float
        The least confidence of a sure entry: 0.3 for people, 0.5 for horses, 0.01 with a ball.
    share : float
        The least share of sure entries, over all joints and frames of a track, in (0, 1].
    """
    check_positive("threshold", threshold)
    _check_share("share", share)
    good = [(track.confidence >= threshold).mean() >= share for track in tracks]
    why = f"dropped tracks with less than {share:.0%} of entries at confidence {threshold:g}"
    return _kept("quality", tracks, good, why)


def drop_crowds(
    tracks: Sequence[KeypointTrack],
    *,
    overlap: float = 0.3,
    videos: Sequence[str] | None = None,
) -> Step:
    """Drop tracks that lie too much in the boxes of others of the same video.

    A track's box in a frame is that of its seen joints. Its overlap with another track is the
    share of its own box's area that lies in the other's, averaged over the frames in which it is
    seen; a track is dropped if its overlap with any other is above ``overlap``. A small person
    far behind a large one is therefore dropped, and the large one kept.

    Parameters
    ----------
    tracks : sequence of KeypointTrack
        Tracks before any cut: those of a video have the same frames.
    overlap : float
        The greatest overlap to keep, in (0, 1].
    videos : sequence of str, optional
        The video of each track. By default what stands before the last space of its name, as the
        readers of this package name people (``"video person"``), together with its number of
        frames; a name without a space is a video of its own.

    Raises
    ------
    ValueError
        If ``videos`` are not one per track, or a video's tracks differ in frames.
    """
    _check_share("overlap", overlap)
    if videos is not None and len(videos) != len(tracks):
        raise ValueError(f"videos has {len(videos)} names, expected {len(tracks)}, one per track")
    groups: dict[tuple[str, int], list[int]] = {}
    for number, track in enumerate(tracks):
        video, space, _ = track.name.rpartition(" ")
        guess = (video, track.frames) if space else (f"{track.name} {number}", track.frames)
        groups.setdefault(guess if videos is None else (videos[number], 0), []).append(number)
    alone = [True] * len(tracks)
    for (video, _), members in groups.items():
        lengths = sorted({tracks[number].frames for number in members})
        if len(lengths) > 1:
            raise ValueError(
                f"tracks of the video {video!r} have {lengths} frames, expected one number"
            )
        boxes = np.stack([_boxes(tracks[number]) for number in members])
        for own, number in enumerate(members):
            others = [_share_inside(boxes[own], other) for other in np.delete(boxes, own, axis=0)]
            alone[number] = max(others, default=0.0) <= overlap
    why = f"dropped tracks with more than {overlap:.0%} of their box in another's"
    return _kept("crowds", tracks, alone, why)


def _hidden(track: KeypointTrack, hide: np.ndarray) -> KeypointTrack:
    """Return a track whose entries ``hide`` (L, J) are unseen."""
    return replace(
        track,
        keypoints=np.where(hide[..., np.newaxis], np.nan, track.keypoints),
        confidence=np.where(hide, 0.0, track.confidence),
    )


def _off_median(track: KeypointTrack, side: int) -> np.ndarray:
    """Return how far entries are from the median of ``side`` frames on either side, (L, J)."""
    there = seen(track)
    points = np.where(there[..., np.newaxis], track.keypoints, np.nan)
    padded = np.pad(points, ((side, side), (0, 0), (0, 0)), constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * side + 1, axis=0)
    judged = there & (np.isfinite(windows[:, :, 0]).sum(axis=-1) >= _FEWEST)
    off = np.zeros(there.shape)
    off[judged] = np.linalg.norm(points[judged] - np.nanmedian(windows[judged], axis=-1), axis=-1)
    return off


def _kept(step: str, tracks: Sequence[KeypointTrack], keep: Sequence[bool], why: str) -> Step:
    kept = [track for track, stays in zip(tracks, keep, strict=True) if stays]
    return kept, StepReport.of(
        step,
        tracks,
        kept,
        why,
        tracks_dropped=len(tracks) - len(kept),
        frames_dropped=frames_of(tracks) - frames_of(kept),
    )


def _boxes(track: KeypointTrack) -> np.ndarray:
    """Return the least and greatest x and y of each frame, (L, 2, 2); NaN where unseen."""
    there = seen(track)[..., np.newaxis]
    least = np.where(there, track.keypoints, np.inf).min(axis=1)
    greatest = np.where(there, track.keypoints, -np.inf).max(axis=1)
    boxes = np.stack([least, greatest], axis=1)
    return np.where(there.any(axis=1, keepdims=True), boxes, np.nan)


def _share_inside(boxes: np.ndarray, others: np.ndarray) -> float:
    """Return the mean share of ``boxes`` (L, 2, 2) inside ``others`` over frames with a box."""
    sides = np.fmin(boxes[:, 1], others[:, 1]) - np.fmax(boxes[:, 0], others[:, 0])
    common = np.where(np.isnan(others[:, 0, 0]), 0.0, np.prod(np.maximum(sides, 0.0), axis=-1))
    area = np.prod(boxes[:, 1] - boxes[:, 0], axis=-1)
    counted = np.flatnonzero(area > 0)  # not where the box is missing, NaN, or of one joint
    return float((common[counted] / area[counted]).mean()) if len(counted) else 0.0


def _check_share(name: str, value: float) -> None:
    check_positive(name, value)
    if value > 1:
        raise ValueError(f"{name} must be a share of at most 1, got {value:g}")
