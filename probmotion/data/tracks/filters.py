"""Filters of 2D tracks: uncertain detections, outliers, and short, crowded or low-quality tracks.

Source: *MAS*, section 6.1 ("filtering short motions, crowd motions, and motions of low quality"),
which states no limits. Defaults are hand-chosen, except confidence thresholds (section 6.2).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from probmotion.data.tracks.segments import track_size
from probmotion.data.tracks.step_reports import (
    Step,
    StepReport,
    boxes_of,
    entries_of,
    masked,
    seen,
)
from probmotion.motion.motion import KeypointTrack
from probmotion.validation import check_positive

__all__ = ["drop_crowds", "drop_low_quality", "drop_short", "mask_outliers", "mask_uncertain"]

_MIN_DETECTIONS = 3  # detections required for a meaningful median


def mask_uncertain(tracks: Sequence[KeypointTrack], *, threshold: float = 0.3) -> Step:
    """Mark detections with a confidence below ``threshold`` as unseen (NaN, confidence 0).

    *MAS* uses 0.3 for people, 0.5 for horses and 0.01 for people with a ball.
    """
    check_positive("threshold", threshold)
    uncertain = [track.confidence < threshold for track in tracks]
    why = f"dropped detections with a confidence below {threshold:g}"
    return _masked("uncertain", tracks, uncertain, why)


def mask_outliers(
    tracks: Sequence[KeypointTrack], *, distance: float = 0.15, window: float = 0.25
) -> Step:
    """Mark detections over ``distance`` from their joint's median in a time window as unseen.

    ``distance`` is in units of :func:`~probmotion.data.tracks.segments.track_size`, ``window`` in
    seconds; windows with fewer than 3 detections are skipped. The tracks must have no jumps
    (:func:`~probmotion.data.tracks.segments.split_discontinuities`).
    """
    check_positive("distance", distance)
    check_positive("window", window)
    outliers = [
        # Tracks of a single joint have size 0 and no limit.
        _median_distance(track, window) > (distance * track_size(track) or np.inf)
        for track in tracks
    ]
    why = f"dropped detections over {distance:g} track sizes from their median in {window:g} s"
    return _masked("outliers", tracks, outliers, why)


def drop_short(tracks: Sequence[KeypointTrack], *, seconds: float = 1.0) -> Step:
    """Drop tracks shorter than ``seconds`` (number of frames divided by frames per second)."""
    check_positive("seconds", seconds)
    # Tolerance for rounded frame rates: 60 frames of .016666 s count as 1 s.
    long_enough = [track.frames + 0.01 >= seconds * track.fps for track in tracks]
    why = f"dropped tracks shorter than {seconds:g} s"
    if tracks and not any(long_enough):
        longest = max(tracks, key=lambda track: track.frames / track.fps)
        why += (
            f", {math.ceil(seconds * longest.fps - 0.01)} frames at {longest.fps:g} fps; the "
            f"longest track has {longest.frames}"
        )
    return _selected("short", tracks, long_enough, why)


def drop_low_quality(
    tracks: Sequence[KeypointTrack], *, threshold: float = 0.3, share: float = 0.6
) -> Step:
    """Drop tracks in which too few joints have a confidence of at least ``threshold``.

    ``share`` in (0, 1] is the minimum fraction of such joints, counted over all frames.
    """
    check_positive("threshold", threshold)
    _check_fraction("share", share)
    good = [(track.confidence >= threshold).mean() >= share for track in tracks]
    why = f"dropped tracks with under {share:.0%} of joints at confidence {threshold:g} or more"
    return _selected("quality", tracks, good, why)


def drop_crowds(
    tracks: Sequence[KeypointTrack],
    *,
    overlap: float = 0.3,
    videos: Sequence[str] | None = None,
) -> Step:
    """Drop tracks that lie largely inside another track's bounding box in the same video.

    The overlap of a track with another is the fraction of its box inside the other's box, averaged
    over the frames in which the track is seen. If a small person stands behind a large one, only
    the track of the small person is dropped.

    Parameters
    ----------
    tracks : sequence of KeypointTrack
        Tracks before segmentation; all tracks of a video must have the same number of frames.
    overlap : float
        Maximum overlap with any other track, in (0, 1].
    videos : sequence of str, optional
        Video of each track; by default the name before its last space (``"video person"``) together
        with the number of frames.
    """
    _check_fraction("overlap", overlap)
    if videos is not None and len(videos) != len(tracks):
        raise ValueError(f"videos must have one name per track, {len(tracks)}, got {len(videos)}")
    groups: dict[tuple[str, int], list[int]] = {}
    for number, track in enumerate(tracks):
        video, space, _ = track.name.rpartition(" ")
        key = (video if space else f"{track.name} {number}", track.frames)
        groups.setdefault(key if videos is None else (videos[number], 0), []).append(number)
    isolated = [True] * len(tracks)
    for (video, _), members in groups.items():
        lengths = sorted({tracks[number].frames for number in members})
        if len(lengths) > 1:
            raise ValueError(f"tracks of video {video!r} must have equal lengths, got {lengths}")
        boxes = np.stack([boxes_of(tracks[number]) for number in members])
        for index, number in enumerate(members):
            overlaps = [_overlap(boxes[index], other) for other in np.delete(boxes, index, axis=0)]
            isolated[number] = max(overlaps, default=0.0) <= overlap
    why = f"dropped tracks with over {overlap:.0%} of their box inside another track's"
    return _selected("crowds", tracks, isolated, why)


def _masked(
    step: str, tracks: Sequence[KeypointTrack], dropped: Sequence[np.ndarray], why: str
) -> Step:
    after = [masked(track, entries) for track, entries in zip(tracks, dropped, strict=True)]
    changed = entries_of(tracks) - entries_of(after)
    return after, StepReport.of(step, tracks, after, why, entries_changed=changed)


def _median_distance(track: KeypointTrack, window: float) -> np.ndarray:
    """Return distances (L, J) of entries from their median in a window of ``window`` seconds."""
    side = round(window * track.fps / 2)
    visible = seen(track)
    points = np.where(visible[..., np.newaxis], track.keypoints, np.nan)
    padded = np.pad(points, ((side, side), (0, 0), (0, 0)), constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * side + 1, axis=0)
    tested = visible & (np.isfinite(windows[:, :, 0]).sum(axis=-1) >= _MIN_DETECTIONS)
    medians = np.nanmedian(windows[tested], axis=-1)
    distances = np.zeros(visible.shape)
    distances[tested] = np.linalg.norm(points[tested] - medians, axis=-1)
    return distances


def _selected(step: str, tracks: Sequence[KeypointTrack], keep: Sequence[bool], why: str) -> Step:
    after = [track for track, selected in zip(tracks, keep, strict=True) if selected]
    return after, StepReport.of(step, tracks, after, why)


def _overlap(boxes: np.ndarray, containers: np.ndarray) -> float:
    """Return the mean fraction of ``boxes`` (L, 2, 2) inside ``containers`` where both exist."""
    sides = np.fmin(boxes[:, 1], containers[:, 1]) - np.fmax(boxes[:, 0], containers[:, 0])
    common = np.where(np.isnan(containers[:, 0, 0]), 0.0, np.prod(np.maximum(sides, 0.0), axis=-1))
    area = np.prod(boxes[:, 1] - boxes[:, 0], axis=-1)
    counted = np.flatnonzero(area > 0)  # excludes missing boxes (NaN) and single joints
    return float((common[counted] / area[counted]).mean()) if len(counted) else 0.0


def _check_fraction(name: str, value: float) -> None:
    check_positive(name, value)
    if value > 1:
        raise ValueError(f"{name} must be at most 1, got {value:g}")
