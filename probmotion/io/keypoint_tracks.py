"""Assembly of keypoint tracks from detections in single images."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from probmotion.io.errors import LARGEST, MotionFileError, errors_in, shortened
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton

__all__ = ["Detection", "Frames", "frame_number", "keypoint_values", "natural", "tracks_of"]

_LONGEST_TRACK = 500_000  # frames


@dataclass(frozen=True)
class Detection:
    """Keypoints of one person in one image: ``values`` (J, 3) are x, y and confidence.

    ``person`` is the track id, None if missing; error messages give the location ``where``.
    """

    video: str
    frame: int
    person: str | None
    values: np.ndarray
    where: str


Frames = dict[str, range]
"""Range of frame numbers of each video, by the name of the video."""


def keypoint_values(value: Any, where: str) -> np.ndarray:
    """Return a flat list ``[x, y, confidence, x, y, …]`` as an array (J, 3)."""
    if not isinstance(value, list) or not value or len(value) % 3:
        raise MotionFileError(
            f"{where}: expected a list of x, y, confidence per keypoint, got {shortened(value)}"
        )
    for number in value:
        real = isinstance(number, int | float) and not isinstance(number, bool)
        if not real or abs(number) > LARGEST:
            raise MotionFileError(
                f"{where}: expected numbers between -1e9 and 1e9, got {shortened(number)}"
            )
    values = np.array(value, dtype=np.float64).reshape(-1, 3)
    confidence = values[:, 2]
    if not (confidence >= 0).all():
        raise MotionFileError(
            f"{where}: expected confidence of at least 0, got {confidence[~(confidence >= 0)][0]:g}"
        )
    if np.isnan(values[confidence > 0]).any():
        raise MotionFileError(f"{where}: expected numbers where confidence is above 0, got NaN")
    return values


def frame_number(image: Any, where: str) -> tuple[str, int]:
    """Return the video and frame number of an image: ``"walk_012.png"`` → ``("walk_", 12)``.

    The frame is the last number in the image's name; the rest is the name of the video.
    """
    if isinstance(image, int) and not isinstance(image, bool) and image >= 0:
        image = str(image)
    stem = re.sub(r"\.[A-Za-z]\w*$", "", image) if isinstance(image, str) else ""
    numbers = list(re.finditer(r"[0-9]+", stem))
    if not numbers or len(numbers[-1][0]) > 18:
        raise MotionFileError(
            f"{where}: expected a name with a frame number of at most 18 digits, got "
            f"{shortened(image)}"
        )
    last = numbers[-1]
    return stem[: last.start()] + stem[last.end() :], int(last[0])


def natural(text: str) -> tuple[tuple[str, int], ...]:
    """Return a natural sort key: ``"frame9"`` is sorted before ``"frame10"``."""
    parts = re.findall(r"([^0-9]*)([0-9]{0,19})", text)
    return tuple((word, int(number or -1)) for word, number in parts)


def tracks_of(
    detections: Sequence[Detection],
    frames: Frames | None,
    skeleton: Skeleton,
    fps: float,
    file: Path,
) -> list[KeypointTrack]:
    """Return one track per video and person, sorted by video, then by person.

    Tracks span the ``frames`` of their video, by default from the first to the last detection.
    Keypoints of missing detections are NaN with confidence 0.
    """
    unnamed = sum(detection.person is None for detection in detections)
    if 0 < unnamed < len(detections):
        raise MotionFileError(
            f"{file}: expected a track id for all detections or none, got {unnamed} of "
            f"{len(detections)} without one"
        )
    grouped: dict[tuple[str, str], dict[int, Detection]] = {}
    seen: dict[str, list[int]] = {}
    for detection in detections:
        seen.setdefault(detection.video, []).append(detection.frame)
        track = grouped.setdefault((detection.video, detection.person or ""), {})
        if detection.frame in track:
            got = "two people without track ids"
            if detection.person is not None:
                got = f"person {shortened(detection.person)} twice"
            raise MotionFileError(
                f"{detection.where}: expected unique track ids (track_id, idx or person_id), got "
                f"{got} in frame {detection.frame}; set people to track people without ids"
            )
        track[detection.frame] = detection
    if frames is None:
        frames = {video: range(min(each), max(each) + 1) for video, each in seen.items()}

    tracks = []
    for video, person in sorted(grouped, key=lambda key: (natural(key[0]), natural(key[1]))):
        span = frames[video]
        if len(span) > _LONGEST_TRACK:
            raise MotionFileError(
                f"{file}: expected at most {_LONGEST_TRACK} frames, got {span[0]} to {span[-1]}"
            )
        values = np.zeros((len(span), skeleton.n_joints, 3))
        for frame, detection in grouped[video, person].items():
            values[span.index(frame)] = detection.values
        confidence = values[..., 2]
        words = [file.stem, video if len(seen) > 1 else "", person]
        name = " ".join(word for word in words if word)
        keypoints = np.where(confidence[..., np.newaxis] > 0, values[..., :2], np.nan)
        with errors_in(file):
            tracks.append(KeypointTrack(keypoints, confidence, skeleton, fps, name))
    return tracks
