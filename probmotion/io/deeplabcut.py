"""Reader of DeepLabCut CSV tables with keypoint tracks of one or several animals.

The header rows are ``scorer``, ``individuals`` (for several animals), ``bodyparts`` and ``coords``:
x, y and, except in manually labelled data, likelihood. The first column is the frame number or the
image path, which newer labelled tables split into three columns. Source: DeepLabCut user guide.

Empty and NaN cells are missing: NaN with confidence 0. Labelled data have confidence 1. The
individual ``single`` contains body parts of no animal, such as the corners of a box.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from probmotion.io.errors import MotionFileError, read_bytes, shortened
from probmotion.io.keypoint_tracks import Detection, frame_number, tracks_of
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_positive

__all__ = ["read_deeplabcut"]

_LARGEST = 1e9
_NO_ANIMAL = "single"
_COORDINATES = {"x": 0, "y": 1, "likelihood": 2}
_MISSING = frozenset(("", "nan", "NaN"))

Rows = list[tuple[int, list[str]]]
"""Line numbers and cells of the nonempty rows."""
Columns = tuple[int, int, int | None]
"""Columns of x, y and likelihood of a body part."""


def read_deeplabcut(
    path: str | Path, fps: float, skeleton: Skeleton | str | None = None
) -> list[KeypointTrack]:
    """Read the keypoint track of every animal.

    Parameters
    ----------
    path : str or Path
        A CSV table.
    fps : float
        Frames per second of the video, which the table does not contain.
    skeleton : Skeleton or str, optional
        Joints to return, or the name of a preset; body parts are matched by their own or canonical
        names. Default: every body part as a root, since tables contain no links.

    Returns
    -------
    tracks : list of KeypointTrack
        One per animal and video, over all frames of the table. Body parts of no animal (``single``)
        form a separate track, which is dropped if they lack joints of ``skeleton``.

    Raises
    ------
    MotionFileError
        If the file has another format, is damaged, or lacks a joint of ``skeleton``.
    ValueError
        If ``fps`` is not above 0 or ``skeleton`` is an unknown name.
    """
    path = Path(path)
    check_positive("fps", fps)
    wanted = Skeleton.preset(skeleton) if isinstance(skeleton, str) else skeleton
    if path.suffix.lower() in (".h5", ".hdf5"):
        raise MotionFileError(
            f"{path}: expected a CSV table, got HDF5; export it with DeepLabCut's save_as_csv=True"
        )
    index_columns, animals, rows = _header(_rows(path), path)
    places = [(line, *_place(cells[:index_columns], line, path)) for line, cells in rows]
    tracks: list[KeypointTrack] = []
    for animal, parts in animals.items():
        joints = Skeleton(list(parts), [-1] * len(parts))
        chosen = list(range(len(parts)))
        if wanted is not None:
            found = _chosen(joints, wanted)
            if isinstance(found, str):
                if animal == _NO_ANIMAL and len(animals) > 1:
                    continue
                who = f"individual {shortened(animal)}" if animal else "the table"
                raise MotionFileError(
                    f"{path}: expected the joint {found!r} of skeleton among the body parts of "
                    f"{who}, got {', '.join(parts)}"
                )
            joints, chosen = wanted, found
        values = _values(rows, [list(parts.values())[part] for part in chosen], path)
        detections = [
            Detection(video, frame, animal or None, values[row], f"{path}, line {line}")
            for row, (line, video, frame) in enumerate(places)
        ]
        tracks += tracks_of(detections, None, joints, float(fps), path)
    return tracks


def _rows(path: Path) -> Rows:
    try:
        text = read_bytes(path).decode("utf-8-sig")
        reader = csv.reader(io.StringIO(text, newline=""), strict=True)
        return [(reader.line_num, row) for row in reader if any(row)]
    except (UnicodeDecodeError, csv.Error) as error:
        raise MotionFileError(f"{path}: expected a CSV table ({str(error)[:80]})") from error


def _header(rows: Rows, path: Path) -> tuple[int, dict[str, dict[str, Columns]], Rows]:
    """Return the number of index columns, the columns of body parts by animal, and the body."""
    names = [row[0].strip().lower() for _, row in rows[:4]]
    several = names[1:2] == ["individuals"]
    expected = ["scorer", *(["individuals"] if several else []), "bodyparts", "coords"]
    if names[: len(expected)] != expected:
        raise MotionFileError(
            f"{path}: expected the rows scorer, individuals (for several), bodyparts and coords, "
            f"got {shortened(names)}"
        )
    body = rows[len(expected) :]
    if not body:
        raise MotionFileError(f"{path}: expected a row per frame, got none below the header")
    width = len(rows[0][1])
    for line, row in rows:
        if len(row) != width:
            raise MotionFileError(
                f"{path}, line {line}: expected {width} cells as in the first row, got {len(row)}"
            )
    coordinates = [cell.strip().lower() for cell in rows[len(expected) - 1][1]]
    first = next((column for column in range(1, width) if coordinates[column]), width)
    found: dict[str, dict[str, dict[str, int]]] = {}
    for column in range(first, width):
        animal = rows[1][1][column].strip() if several else ""
        part = rows[len(expected) - 2][1][column].strip()
        columns = found.setdefault(animal, {}).setdefault(part, {})
        coordinate = coordinates[column]
        if coordinate not in _COORDINATES or coordinate in columns or not part:
            raise MotionFileError(
                f"{path}, column {column + 1}: expected x, y and likelihood once for each body "
                f"part, got {shortened(coordinate)} of {shortened(part)}"
            )
        columns[coordinate] = column
    animals: dict[str, dict[str, Columns]] = {}
    for animal, parts in found.items():
        animals[animal] = {}
        for part, columns in parts.items():
            if "x" not in columns or "y" not in columns:
                raise MotionFileError(
                    f"{path}: expected x and y of the body part {shortened(part)}, got "
                    f"{', '.join(columns)}"
                )
            animals[animal][part] = columns["x"], columns["y"], columns.get("likelihood")
    if not animals:
        raise MotionFileError(f"{path}: expected at least one body part, got none")
    return first, animals, body


def _place(cells: Sequence[str], line: int, path: Path) -> tuple[str, int]:
    """Return the video and the frame number of a row, from its index columns."""
    image = "/".join(cell.strip() for cell in cells if cell.strip()).replace("\\", "/")
    where = f"{path}, line {line}, column 1"
    if not re.fullmatch(r"[0-9]+", image) and not re.search(r"[A-Za-z]", image):
        raise MotionFileError(
            f"{where}: expected a frame number or an image path, got {shortened(image)}"
        )
    return frame_number(image, where)


def _chosen(joints: Skeleton, wanted: Skeleton) -> list[int] | str:
    """Return the index of each wanted joint, or the name of a missing one."""
    chosen = []
    for name, canonical in zip(wanted.joint_names, wanted.canonical_names, strict=True):
        try:
            chosen.append(joints.index(name if name in joints.joint_names else canonical))
        except ValueError:
            return name
    return chosen


def _values(rows: Rows, columns: list[Columns], path: Path) -> np.ndarray:
    """Return x, y and confidence of every frame and joint, (L, J, 3); 0 if missing."""
    values = np.zeros((len(rows), len(columns), 3))
    for row, (line, cells) in enumerate(rows):
        for joint, (x, y, likelihood) in enumerate(columns):
            numbers = [
                1.0 if column is None else _number(cells[column], line, column, path)
                for column in (x, y, likelihood)
            ]
            if not np.isnan(numbers).any():
                values[row, joint] = numbers
            if numbers[2] < 0:
                raise MotionFileError(
                    f"{path}, line {line}, column {(likelihood or 0) + 1}: expected a likelihood "
                    f"of 0 or more, got {numbers[2]:g}"
                )
    return values


def _number(cell: str, line: int, column: int, path: Path) -> float:
    """Return the number of a cell, NaN if it is missing."""
    text = cell.strip()
    if text in _MISSING:
        return np.nan
    try:
        number = float(text)
    except ValueError:
        number = np.inf
    if not abs(number) <= _LARGEST:
        raise MotionFileError(
            f"{path}, line {line}, column {column + 1}: expected a number between -1e9 and 1e9, "
            f"got {shortened(text)}"
        )
    return number
