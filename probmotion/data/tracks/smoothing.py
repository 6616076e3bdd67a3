"""Temporal processing of 2D tracks: gap filling, smoothing and resampling."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.signal import savgol_filter

from probmotion.data.tracks.step_reports import Step, StepReport, entries_of, seen
from probmotion.motion.motion import KeypointTrack
from probmotion.validation import check_positive

__all__ = ["fill_gaps", "resample_tracks", "smooth_tracks"]

_MAX_FPS = 10_000
_ROUNDING = 1e-3  # tolerance of durations, frames, as in probmotion.motion.resampling
_TIME_TOLERANCE = 1e-6  # tolerance of equal times, frames
_DEGREE = 2  # of the Savitzky–Golay filter


def fill_gaps(tracks: Sequence[KeypointTrack], *, longest: float = 0.25) -> Step:
    """Fill gaps of each joint, up to ``longest`` seconds, by monotone cubic interpolation (PCHIP).

    Filled entries have the lower confidence of the two ends of the gap. Nothing is extrapolated.
    """
    check_positive("longest", longest)
    filled = []
    for track in tracks:
        keypoints, confidence = track.keypoints.copy(), track.confidence.copy()
        for joint in range(track.skeleton.n_joints):
            known = np.flatnonzero(confidence[:, joint] > 0)
            gaps = np.diff(known) - 1
            short = np.flatnonzero((gaps > 0) & (gaps <= longest * track.fps + _ROUNDING))
            if not len(short):
                continue
            path = PchipInterpolator(known, keypoints[known, joint])
            for start, stop in zip(known[short], known[short + 1], strict=True):
                frames = np.arange(start + 1, stop)
                keypoints[frames, joint] = path(frames)
                confidence[frames, joint] = min(confidence[start, joint], confidence[stop, joint])
        filled.append(replace(track, keypoints=keypoints, confidence=confidence))
    count = entries_of(filled) - entries_of(tracks)
    why = f"filled gaps of at most {longest:g} s"
    return filled, StepReport.of("gaps", tracks, filled, why, entries_changed=count)


def smooth_tracks(tracks: Sequence[KeypointTrack], *, window: float = 0.25) -> Step:
    """Smooth each joint over its runs of seen frames (Savitzky–Golay, degree 2).

    ``window``, in seconds, is rounded to an odd number of frames, at most the length of the run;
    windows of fewer than 5 frames have no effect.
    """
    check_positive("window", window)
    smoothed = []
    changed = 0
    for track in tracks:
        keypoints = track.keypoints.copy()
        for joint in range(track.skeleton.n_joints):
            for start, stop in _runs(track.confidence[:, joint] > 0):
                width = min(round(window * track.fps), stop - start)
                width -= width % 2 == 0
                if width > _DEGREE + 1:
                    run = keypoints[start:stop, joint]
                    keypoints[start:stop, joint] = savgol_filter(run, width, _DEGREE, axis=0)
                    changed += stop - start
        smoothed.append(replace(track, keypoints=keypoints))
    why = f"fitted parabolas to windows of {window:g} s"
    return smoothed, StepReport.of("smooth", tracks, smoothed, why, entries_changed=changed)


def resample_tracks(tracks: Sequence[KeypointTrack], *, fps: float) -> Step:
    """Resample tracks to ``fps`` frames per second, at most 10 000, by linear interpolation.

    The first frame is preserved; no frame lies after the original end. An entry between two
    frames is seen if it is seen in both; its confidence is interpolated.
    """
    check_positive("fps", fps)
    if fps > _MAX_FPS:
        raise ValueError(f"fps must be at most {_MAX_FPS}, got {fps:g}")
    resampled = [track if track.fps == fps else _resampled(track, float(fps)) for track in tracks]
    rates = sorted({f"{track.fps:g}" for track in tracks}, key=float)
    why = f"resampled {' and '.join(rates) or 'no'} fps to {fps:g}"
    return resampled, StepReport.of("resample", tracks, resampled, why, frames_dropped=0)


def _resampled(track: KeypointTrack, fps: float) -> KeypointTrack:
    last = track.frames - 1
    frames = int(np.floor(last / track.fps * fps + _ROUNDING)) + 1
    time = np.minimum(np.arange(frames) * (track.fps / fps), float(last))
    nearest = np.round(time)
    # Frames at the time of an original frame must not depend on a neighbour, which may be unseen.
    time = np.where(np.abs(time - nearest) < _TIME_TOLERANCE, nearest, time)
    before, after = time.astype(int), np.ceil(time).astype(int)
    weight = (time - before)[:, np.newaxis]
    visible = seen(track)[before] & seen(track)[after]
    confidence = (1 - weight) * track.confidence[before] + weight * track.confidence[after]
    weight = weight[..., np.newaxis]
    keypoints = (1 - weight) * track.keypoints[before] + weight * track.keypoints[after]
    return replace(
        track,
        keypoints=np.where(visible[..., np.newaxis], keypoints, np.nan),
        confidence=np.where(visible, confidence, 0.0),
        fps=fps,
        start=None,
    )


def _runs(visible: np.ndarray) -> list[list[int]]:
    """Return the start and stop indices of each run of True values."""
    edges = np.flatnonzero(np.diff(visible, prepend=False, append=False))
    return edges.reshape(-1, 2).tolist()
