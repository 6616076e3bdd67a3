"""Assembly of keypoint tracks from detections in single images, and tracking of people."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from probmotion.io.errors import LARGEST, MotionFileError, errors_in, shortened
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.presets import PRESETS
from probmotion.motion.skeleton import Skeleton

__all__ = [
    "Detection", "Frames", "KeypointFile", "Parsed", "chosen_joints", "dense_tracks",
    "frame_number", "keypoint_values", "link_people", "named_skeleton", "natural", "tracks_of",
]  # fmt: skip

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


class Parsed(NamedTuple):
    """Detections of a file and, if it contains them, its frames, skeleton, rate and image size.

    ``numbered``: the numbers of ``frames`` are those of the video.
    """

    format: str
    detections: list[Detection]
    frames: Frames | None = None
    skeleton: Skeleton | None = None
    fps: float | None = None
    image_size: tuple[int, int] | None = None
    numbered: bool = False


@dataclass(frozen=True, eq=False)
class KeypointFile:
    """Content of a keypoint file; see :func:`~probmotion.io.files.open_keypoints`.

    Parameters
    ----------
    format : str
        Name of the format, such as ``"OpenPose"``.
    fps : float, optional
        Frames per second; None if neither the file nor the caller has it.
    tracks : list of KeypointTrack
        One per person and camera; of 1 frame per second if ``fps`` is None.
    image_size : (int, int), optional
        Width and height of the image, pixels, if the file contains them.
    declared_fps : float, optional
        Frames per second according to a JSON or CSV file.
    """

    format: str
    fps: float | None
    tracks: list[KeypointTrack]
    image_size: tuple[int, int] | None = None
    declared_fps: float | None = None


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
    fps: float | None,
    file: Path,
    numbered: bool = False,
) -> list[KeypointTrack]:
    """Return one track per video and person, sorted by video, then by person.

    Tracks span the ``frames`` of their video, by default from the first to the last detection. The
    first is their ``start`` by default, or if ``frames`` are ``numbered``. Keypoints of
    missing detections are NaN with confidence 0.
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
            got, hint = "two people without track ids", "set people to track people without ids"
            if detection.person is not None:
                got = f"person {shortened(detection.person)} twice"
            if any(one.person != detection.person for one in detections):
                hint = "correct or remove the ids"
            raise MotionFileError(
                f"{detection.where}: expected unique track ids (track_id, idx or person_id), got "
                f"{got} in frame {detection.frame}; {hint}"
            )
        track[detection.frame] = detection
    numbered = numbered or frames is None
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
        made = _track(values, skeleton, fps, file, video if len(seen) > 1 else "", person)
        tracks.append(replace(made, start=span[0]) if numbered else made)
    return tracks


def dense_tracks(
    values: np.ndarray,
    people: Sequence[str],
    joints: Skeleton,
    wanted: Skeleton | None,
    fps: float | None,
    file: Path,
) -> list[KeypointTrack]:
    """Return one track per person of ``values``, (P, L, J, 3): x, y and confidence.

    Keypoints with NaN coordinates are missing; others without confidence (NaN) have confidence 1.
    ``wanted`` selects joints by name; see :func:`chosen_joints`.
    """
    if 0 in values.shape:
        raise MotionFileError(
            f"{file}: expected at least one person, frame and keypoint, got {values.shape[:3]}"
        )
    if wanted is not None:
        values = values[:, :, chosen_joints(joints, wanted, "the keypoints", file)]
    confidence = np.where(np.isnan(values[..., 2]), 1.0, values[..., 2])
    confidence = np.where(np.isnan(values[..., :2]).any(axis=-1), 0.0, confidence)
    values = np.concatenate([values[..., :2], confidence[..., np.newaxis]], axis=-1)
    return [
        _track(each, wanted or joints, fps, file, person)
        for person, each in zip(people, values, strict=True)
    ]


def chosen_joints(joints: Skeleton, wanted: Skeleton, owner: str, file: Path) -> list[int]:
    """Return the index of each joint of ``wanted`` among ``joints``, by name or canonical name."""
    indices = []
    for name, canonical in zip(wanted.joint_names, wanted.canonical_names, strict=True):
        try:
            indices.append(joints.index(name if name in joints.joint_names else canonical))
        except ValueError as error:
            raise MotionFileError(
                f"{file}: expected the joint {name!r} of skeleton among {owner}, got "
                f"{', '.join(joints.joint_names)}"
            ) from error
    return indices


def named_skeleton(names: Sequence[str], edges: Sequence[Sequence[float]]) -> Skeleton:
    """Return the skeleton of named joints and pairs of joint indices.

    The parents are those of the preset with these joints, if there is one, and otherwise those of
    a spanning tree of the edges, which generally contain cycles.

    Raises
    ------
    ValueError
        If the names are not unique strings or an edge is not a pair of joints.
    """
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ValueError(f"keypoints must be a list of names, got {shortened(names)}")
    rootless = Skeleton(names, [-1] * len(names))
    for preset in map(Skeleton.preset, PRESETS):
        if preset.canonical_names == rootless.canonical_names:
            return Skeleton(names, preset.parents)
    neighbours: list[list[int]] = [[] for _ in names]
    for edge in edges:
        if len(edge) != 2 or not all(isinstance(joint, int | float) for joint in edge):
            raise ValueError(f"skeleton must have pairs of keypoints, got {shortened(edge)}")
        first, second = edge
        if not {first, second} <= set(range(len(names))):
            raise ValueError(
                f"skeleton must have edges between keypoints 1 to {len(names)}, got "
                f"{shortened([first + 1, second + 1])}"
            )
        neighbours[int(first)].append(int(second))
        neighbours[int(second)].append(int(first))
    parents: dict[int, int] = {}
    for root in range(len(names)):
        queue = [] if root in parents else [root]
        parents.setdefault(root, -1)
        for joint in queue:  # breadth-first search; grows in the loop
            for neighbour in neighbours[joint]:
                if neighbour not in parents:
                    parents[neighbour] = joint
                    queue.append(neighbour)
    return Skeleton(names, [parents[joint] for joint in range(len(names))])


def _track(
    values: np.ndarray, skeleton: Skeleton, fps: float | None, file: Path, *words: str
) -> KeypointTrack:
    """Return the track of ``values``, (L, J, 3), named after the file and ``words``."""
    confidence = values[..., 2]
    keypoints = np.where(confidence[..., np.newaxis] > 0, values[..., :2], np.nan)
    name = " ".join(word for word in (file.stem, *words) if word)
    with errors_in(file):
        return KeypointTrack(keypoints, confidence, skeleton, 1.0 if fps is None else fps, name)


def link_people(detections: Sequence[Detection], people: int) -> list[Detection]:
    """Return the detections of ``people`` people, with track ids ``"0"``, ``"1"``, …

    Tracking starts at the first image of a video with at least ``people`` detections and proceeds
    forwards and backwards. In this image, the most confident detections are numbered from left to
    right. In every other image, the Hungarian method assigns detections to people: it minimises
    the total distance to keypoints extrapolated at constant velocity. Unassigned detections are
    dropped. People who swap positions during occlusion may be confused.
    """
    videos: dict[str, dict[int, list[Detection]]] = {}
    for detection in detections:
        videos.setdefault(detection.video, {}).setdefault(detection.frame, []).append(detection)
    linked: list[Detection] = []
    for frames in videos.values():
        order = sorted(frames)
        full = [number for number in order if len(frames[number]) >= people]
        if not full:
            most = max(map(len, frames.values()))
            raise ValueError(f"people must be at most {most}, the most in any image, got {people}")
        confident = sorted(frames[full[0]], key=lambda one: -one.values[:, 2].mean())[:people]
        first = sorted(confident, key=lambda one: float(_middle(one.values)[0]))
        tracked = {full[0]: dict(enumerate(first))}
        start = order.index(full[0])
        for numbers in (order[start + 1 :], order[:start][::-1]):
            recent: list[tuple[Detection, Detection | None]] = [(one, None) for one in first]
            for number in numbers:
                expected = [_expected(*pair, number) for pair in recent]
                tracked[number] = _assigned(frames[number], expected)
                for person, one in tracked[number].items():
                    recent[person] = one, recent[person][0]
        for number in order:
            linked += [replace(one, person=str(k)) for k, one in sorted(tracked[number].items())]
    return linked


def _expected(last: Detection, before: Detection | None, frame: int) -> np.ndarray:
    """Return keypoints (J, 3) of a person, moved to ``frame`` at the velocity of their mean."""
    values = last.values.copy()
    if before is not None:
        step = _middle(last.values) - _middle(before.values)
        step /= last.frame - before.frame
        values[:, :2] += step * (frame - last.frame)
    return values


def _assigned(detections: list[Detection], expected: list[np.ndarray]) -> dict[int, Detection]:
    """Return the detection assigned to each person, by index of the person."""
    from scipy.optimize import linear_sum_assignment

    cost = np.array([[_distance(where, one.values) for one in detections] for where in expected])
    return {int(k): detections[i] for k, i in zip(*linear_sum_assignment(cost), strict=True)}


def _distance(first: np.ndarray, second: np.ndarray) -> float:
    """Return the mean distance of keypoints detected in both, else of the mean keypoints."""
    both = (first[:, 2] > 0) & (second[:, 2] > 0)
    if not both.any():
        return float(np.linalg.norm(_middle(first) - _middle(second)))
    return float(np.linalg.norm(first[both, :2] - second[both, :2], axis=-1).mean())


def _middle(values: np.ndarray) -> np.ndarray:
    """Return the mean of the detected keypoints, (2,); 0 if none is detected."""
    seen = values[:, 2] > 0
    return values[seen, :2].mean(axis=0) if seen.any() else np.zeros(2)
