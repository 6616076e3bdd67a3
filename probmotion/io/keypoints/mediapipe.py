"""Reader of the 33 landmarks of MediaPipe Pose, in JSON or in a CSV table.

Entries of a list of frames have ``pose_landmarks`` (or ``landmarks``, ``poses``): the points
``{"x", "y", "visibility"}`` or ``[x, y, z, visibility]`` of one person, or a list of people; null
if there is none. In an object without ``frames``, ``poses`` has the points of one person in every
frame; under the other names are the people of one image, or frames that are objects. ``keypoints``
of points that are objects are landmarks too. Tables have a row per
frame, with columns such as ``nose_x`` or ``x1``, or a row per landmark, with the columns
``landmark_id``, ``x``, ``y`` and ``visibility``. Frames are numbered as in
:mod:`~probmotion.io.keypoints.frames`.

Coordinates normalised to the image are scaled to pixels by its size: that of the file's header
(``width``, ``height``) or the caller's. ``vis``, ``v``, ``score``, ``confidence`` and ``conf`` are
other names of ``visibility``, from 0 to 1. Landmarks without it have confidence 1.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from probmotion.io.errors import MotionFileError, number, shortened
from probmotion.io.keypoints.frames import (
    FRAME,
    TIME,
    Person,
    declared_size,
    matrix_of,
    numbered_frames,
    value_of,
)
from probmotion.io.keypoints.tracks import Parsed
from probmotion.motion.presets import PRESETS
from probmotion.motion.skeleton import Skeleton

__all__ = ["MEDIAPIPE", "read_landmark_table", "read_landmarks"]

MEDIAPIPE = "MediaPipe Pose"
"""Name of the format."""

_LANDMARKS = ("pose_landmarks", "poseLandmarks", "landmarks", "poses")
_LISTS = ("frames", "poses")  # of frames, also of points without a key
_VISIBILITY = ("visibility", "vis", "v", "score", "confidence", "conf")
_LANDMARK = ("landmark_id", "landmark_index", "landmark", "landmark_name")  # columns
_NORMALISED = 2.0  # largest median coordinate relative to the image
_MISSING = frozenset(("", "nan", "none"))  # cells without a value
_NAMES = PRESETS["mediapipe33"].joint_names
_AXIS = rf"(?P<axis>x|y|{'|'.join(_VISIBILITY)})"
_COLUMN = re.compile(rf"(?P<part>.*\w)[_ .]{_AXIS}")
_NUMBERED_COLUMN = re.compile(rf"{_AXIS}_?(?P<part>\d+)")


def read_landmarks(
    content: Any, path: Path, image_size: tuple[float, float] | None = None
) -> Parsed | None:
    """Return the detections of a JSON file; None if it has another format.

    Raises
    ------
    MotionFileError
        If the file is damaged, or ``image_size`` is missing.
    """
    header: dict[str, Any] = content if isinstance(content, dict) else {}
    lists = [header[key] for key in _LISTS if key in header]
    for key in _LANDMARKS:  # people of one image, unless they are objects with landmarks
        value = header.get(key)
        if isinstance(value, list) and any(isinstance(entry, dict) for entry in value):
            lists.append(value)
    entries = next((each for each in lists if _are_frames(each)), None)
    if entries is None:
        entries = [content] if header else content
    return _landmark_frames(entries, header, path, image_size) if _are_frames(entries) else None


def read_landmark_table(
    rows: Sequence[tuple[int, list[str]]],
    path: Path,
    image_size: tuple[float, float] | None = None,
) -> Parsed:
    """Return the detections of MediaPipe landmarks in the rows of a CSV table.

    Raises
    ------
    MotionFileError
        As for :func:`read_landmarks`; also if the columns are not those of 33 landmarks.
    """
    names = [cell.strip().lower() for cell in rows[0][1]] if rows else []
    long = {"x", "y"} <= set(names) and any(name in names for name in _LANDMARK)
    columns: dict[tuple[int, str], int] = {}
    for column, name in enumerate(names):
        match = _COLUMN.fullmatch(name) or _NUMBERED_COLUMN.fullmatch(name)
        if match and (part := _landmark(match["part"])) is not None:
            columns[part, "v" if match["axis"] in _VISIBILITY else match["axis"]] = column
    first = min((part for part, _ in columns), default=0)  # numbers may start at 1
    columns = {(part - first, axis): column for (part, axis), column in columns.items()}
    complete = all((part, axis) in columns for part in range(len(_NAMES)) for axis in "xy")
    if not long and not complete:
        raise MotionFileError(
            f"{path}: expected the rows scorer, individuals (optional), bodyparts and coords of "
            f"DeepLabCut, or columns x and y of MediaPipe's {len(_NAMES)} landmarks, got "
            f"{shortened(rows[0][1] if rows else [])}"
        )
    entries: dict[Any, dict[str, Any]] = {}
    for line, row in rows[1:]:
        where = f"{path}, line {line}"
        if len(row) != len(names):
            raise MotionFileError(
                f"{where}: expected {len(names)} cells as in the first row, got {len(row)}"
            )
        cells = dict(zip(names, (cell.strip() for cell in row), strict=True))
        frame = {key: _cell(cells[key], where) for key in (*FRAME, *TIME) if key in cells}
        blank: list[dict[str, float]] = [{"x": np.nan, "y": np.nan}] * len(_NAMES)
        if not long:
            frame["pose_landmarks"] = points = blank.copy()
            for part in range(len(_NAMES)):
                text = [row[columns[part, axis]] for axis in "xy"]
                text += [row[columns[part, "v"]]] if (part, "v") in columns else ["1"]
                points[part] = _point_of(text, where)
            entries[line] = frame
        elif cells.get("type", cells.get("landmark_type", "pose")).lower() == "pose":
            entry = entries.setdefault(value_of(frame, FRAME + TIME), frame)
            points = entry.setdefault("pose_landmarks", blank.copy())
            name = next(cells[key] for key in _LANDMARK if key in cells)
            part = _landmark(name.lower())
            if part is None or part >= len(_NAMES):
                raise MotionFileError(
                    f"{where}: expected one of {len(_NAMES)} landmarks, got {shortened(name)}"
                )
            visibility = next((cells[key] for key in _VISIBILITY if key in cells), "1")
            points[part] = _point_of([cells["x"], cells["y"], visibility], where)
    return _landmark_frames(list(entries.values()), {}, path, image_size)


def _are_frames(entries: Any) -> bool:
    return isinstance(entries, list) and any(map(_is_frame, entries))


def _is_frame(entry: Any) -> bool:
    if isinstance(entry, dict):
        return any(key in entry for key in _LANDMARKS) or _are_objects(entry.get("keypoints"))
    return _are_objects(entry)


def _are_objects(points: Any) -> bool:
    """Return whether points are objects with coordinates."""
    first = points[0] if isinstance(points, list) and points else None
    return isinstance(first, dict) and _is_point(first)


def _landmark_frames(
    entries: list[Any], header: dict[str, Any], path: Path, image_size: tuple[float, float] | None
) -> Parsed:
    """Return the detections of MediaPipe's landmarks, in pixels."""
    frames = [list(_landmarks(entry, f"{path}, frame {k}")) for k, entry in enumerate(entries)]
    points = [points[points[:, 2] > 0, :2] for people in frames for points, _ in people]
    if points and np.nanmedian([0.0, *np.abs(np.concatenate(points)).ravel()]) <= _NORMALISED:
        size = image_size or declared_size(header, path)
        if size is None:
            raise MotionFileError(
                f"{path}: image_size must be given for landmarks normalised to the image, got "
                "None; pass image_size=(width, height) in pixels (--image-size WIDTH HEIGHT)"
            )
        frames = [[(each * [*size, 1.0], person) for each, person in people] for people in frames]
    skeleton = Skeleton.preset("mediapipe33")
    return numbered_frames(MEDIAPIPE, entries, frames, skeleton, header, path)


def _landmarks(entry: Any, where: str) -> Iterator[Person]:
    """Yield the people of a frame of MediaPipe."""
    if not isinstance(entry, dict | list | None):
        raise MotionFileError(f"{where} must be an object, got {shortened(entry)}")
    value = value_of(entry, (*_LANDMARKS, "keypoints")) if isinstance(entry, dict) else entry
    if not value:
        return
    several = isinstance(value, list) and not _is_point(value[0])
    for k, person in enumerate(value if several else [value]):
        at = f"{where}, person {k}"
        if isinstance(person, dict):  # by name, or a list message of Protocol Buffers
            named = {str(name).lower(): point for name, point in person.items()}
            person = person.get("landmark", [named.get(name) for name in _NAMES])
        if not isinstance(person, list) or not all(map(_is_point, person)):
            raise MotionFileError(f"{at}: expected landmarks, got {shortened(person)}")
        if len(person) != len(_NAMES):
            raise MotionFileError(f"{at}: expected {len(_NAMES)} landmarks, got {len(person)}")
        rows = [
            [point["x"], point["y"], next((point[k] for k in _VISIBILITY if k in point), 1.0)]
            if isinstance(point, dict)
            else [point[0], point[1], point[3] if len(point) > 3 else 1.0]
            for point in person
        ]
        points = matrix_of(rows, at)
        if (points[:, 2] > 1).any():
            got = points[points[:, 2] > 1, 2][0]
            raise MotionFileError(f"{at}: expected visibility of at most 1, got {got:g}")
        yield points, None


def _is_point(value: Any) -> bool:
    if isinstance(value, dict):
        return {"x", "y"} <= set(value)
    return isinstance(value, list) and len(value) > 1 and not isinstance(value[0], list | dict)


def _landmark(name: str) -> int | None:
    """Return the index of a landmark by its name or number, such as ``landmark_12``."""
    if name in _NAMES:
        return _NAMES.index(name)
    match = re.fullmatch(r"(?:landmark|point|pose|lm)?_?(\d{1,3})", name)
    return None if match is None else int(match[1])


def _cell(text: str, where: str) -> Any:
    """Return a frame number or timestamp; None if empty, the text if it is a date."""
    if text.lower() in _MISSING or re.search(r"[:_]", text):
        return text or None
    value = number(text, where)
    return int(value) if value.is_integer() else value


def _point_of(texts: list[str], where: str) -> dict[str, float]:
    values = [
        np.nan if text.strip().lower() in _MISSING else number(text.strip(), where)
        for text in texts
    ]
    return dict(zip(("x", "y", "visibility"), values, strict=True))
