"""Numbering of the frames of JSON files with a list of frames, and helpers for their entries.

Frames are numbered by ``frame_id`` or a similar key, else by ``timestamp``, else in the file's
order. The frame rate is ``fps`` of the file's header, or follows from the timestamps.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from probmotion.io.errors import LARGEST, MotionFileError, shortened
from probmotion.io.keypoints.tracks import Detection, Parsed
from probmotion.motion.skeleton import Skeleton

__all__ = ["FRAME", "TIME", "Person", "declared_size", "matrix_of", "numbered_frames", "value_of"]

FRAME = ("frame_id", "frame", "frame_idx", "frame_index", "frame_number")
"""Keys of the number of a frame."""
TIME = ("timestamp_ms", "ts_ms", "time_ms", "timestamp", "timestamp_s", "timestamp_sec", "time")
"""Keys of the time of a frame."""
_FPS = ("fps", "frame_rate", "frameRate")
_LONGEST_STEP = 2.0  # between frames, seconds; timestamps with longer steps are milliseconds
_SHORTEST_STEP = 1e-6
_LARGEST_NUMBER = 10**18  # of a frame

Person = tuple[np.ndarray, Any]
"""Keypoints (J, 3), x, y and confidence, and track id."""


def numbered_frames(
    name: str,
    entries: Sequence[Any],
    frames: Sequence[Sequence[Person]],
    skeleton: Skeleton | None,
    header: dict[str, Any],
    path: Path,
) -> Parsed:
    """Return the detections of ``frames``, numbered by their ``entries``.

    Raises
    ------
    MotionFileError
        If frame numbers or the frame rate are not plausible.
    """
    fps = _declared(header, _FPS, path)
    numbers = [value_of(entry, FRAME) for entry in entries]
    times = _times(entries)
    numbered = any(value not in (None, -1) for value in numbers)
    if not numbered:
        numbers = list(range(len(entries)))
        if len(times):  # steps are rounded one by one, since timestamps may be whole milliseconds
            steps = np.diff(times)
            steps = np.round(steps * (fps or 1 / np.median(steps)))
            numbers = [int(k) for k in np.cumsum([0.0, *steps])]
    for k in numbers:
        if not isinstance(k, int) or isinstance(k, bool) or not 0 <= k < _LARGEST_NUMBER:
            raise MotionFileError(
                f"{path}: expected a frame number of at least 0 in every frame, got {shortened(k)}"
            )
    for before, after in pairwise(numbers):
        if after < before or (after == before and not numbered):
            raise MotionFileError(
                f"{path}: expected increasing frame numbers, or timestamps of evenly spaced "
                f"frames, got frames {before} and {after}"
            )
    if fps is None and len(times) and numbers[-1] > numbers[0]:
        fps = round(float((numbers[-1] - numbers[0]) / (times[-1] - times[0])), 3)
    detections = [
        Detection(
            "", k, None if person is None else str(person), _cleaned(points), f"{path}, frame {k}"
        )
        for k, people in zip(numbers, frames, strict=True)
        for points, person in people
    ]
    span = {"": range(numbers[0], numbers[-1] + 1)} if numbers else {}
    size = declared_size(header, path)
    return Parsed(name, detections, span, skeleton, fps, size, numbered)


def _times(entries: Sequence[Any]) -> np.ndarray:
    """Return the increasing timestamps of two or more frames in seconds; empty without them."""
    keys = [key for key in TIME if all(isinstance(e, dict) and key in e for e in entries)]
    values = [entry[keys[0]] for entry in entries] if keys else []
    real = all(isinstance(value, int | float) and abs(value) < 1e15 for value in values)
    times = np.array(values if real else [], dtype=np.float64)
    if len(times) < 2:
        return np.empty(0)
    if keys[0].endswith("_ms") or np.median(np.diff(times)) > _LONGEST_STEP:
        times /= 1000
    return times if (np.diff(times) >= _SHORTEST_STEP).all() else np.empty(0)


def _declared(header: dict[str, Any], keys: tuple[str, ...], path: Path) -> float | None:
    """Return a number above 0 of the file's header or of its metadata."""
    inner = [header[key] for key in ("metadata", "meta", "video_info", "video") if key in header]
    for part in [header, *inner]:
        value = value_of(part, keys)
        if value is not None:
            real = isinstance(value, int | float) and not isinstance(value, bool)
            if not real or not 0 < value <= LARGEST:
                raise MotionFileError(
                    f"{path}: {keys[0]} must be a number above 0, got {shortened(value)}"
                )
            return float(value)
    return None


def declared_size(header: dict[str, Any], path: Path) -> tuple[int, int] | None:
    """Return the width and height of the file's header or of its metadata."""
    width, height = _declared(header, ("width",), path), _declared(header, ("height",), path)
    return None if width is None or height is None else (int(width), int(height))


def value_of(entry: Any, keys: tuple[str, ...]) -> Any:
    """Return the first value of an object that is not null; None if there is none."""
    if not isinstance(entry, dict):
        return None
    return next((entry[key] for key in keys if entry.get(key) is not None), None)


def matrix_of(value: Any, where: str) -> np.ndarray:
    """Return rows of at least two numbers as an array; null is NaN."""
    try:
        rows = [[np.nan if cell is None else cell for cell in row] for row in value]
        array = np.array(rows)
    except (TypeError, ValueError, OverflowError):
        array = np.empty(0)
    if array.ndim != 2 or array.dtype.kind not in "fiu" or (np.abs(array) > LARGEST).any():
        raise MotionFileError(
            f"{where}: expected numbers between -1e9 and 1e9 per keypoint, got {shortened(value)}"
        )
    return array.astype(np.float64)


def _cleaned(points: np.ndarray) -> np.ndarray:
    """Return x, y and confidence in 0 to 1; 0 where a value is NaN."""
    points = np.where(np.isnan(points).any(axis=1, keepdims=True), 0.0, points)
    return np.column_stack([points[:, :2], points[:, 2].clip(0, 1)])
