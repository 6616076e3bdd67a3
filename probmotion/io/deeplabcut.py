"""Keypoint tracks from the CSV tables of DeepLabCut, of one animal or several.

The first rows are a header: ``scorer``, ``individuals`` where there are several animals,
``bodyparts`` and ``coords`` (x, y and, unless people labelled the images, likelihood). The first
column is the frame's number, or the image's path, which newer tables of labelled images write in
three columns. Sources: the DeepLabCut user guide (files of results and of labelled data).

A cell that is empty or NaN was not seen: NaN with confidence 0, as is a likelihood of 0. Labelled
images have no likelihood: what is labelled has confidence 1. The individual ``single`` holds body
parts that belong to no animal, such as the corners of a box.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from probmotion.io.errors import MotionFileError, read_bytes, shortened
from probmotion.io.keypoint_layouts import keypoint_skeleton
from probmotion.io.keypoint_tracks import Detection, frame_number, tracks_of
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_positive

__all__ = ["read_deeplabcut"]

_LARGEST = 1e9
_NO_ANIMAL = "single"
_COORDINATES = {"x": 0, "y": 1, "likelihood": 2}
_UNSEEN = frozenset(("", "nan", "NaN"))


def read_deeplabcut(
    path: str | Path, fps: float, skeleton: Skeleton | str | None = None
) -> list[KeypointTrack]:
    """Read every animal's keypoint track.

    Parameters
    ----------
    path : str or Path
        A CSV table.
    fps : float
        Frames per second of the video, which the table does not hold.
    skeleton : Skeleton or str, optional
        The joints to have, or the name of a layout or preset: body parts are matched to them by
        their own or canonical names and put in their order; others are left out. By default every
        body part is a joint under its own name, and a root, because tables hold no links: nothing
        is guessed from the names.

    Returns
    -------
    tracks : list of KeypointTrack
        One per animal, and video where the images belong to several, over all frames of the
        table. Body parts of no animal (``single``) are a track of their own, or left out where a
        ``skeleton`` is given that they lack.

    Raises
    ------
    MotionFileError
        If the file is no such table, is damaged, or lacks a joint of ``skeleton``; the message
        names the line and the column.
    FileNotFoundError
        If there is no such file.
    ValueError
        If ``fps`` is not above 0 or ``skeleton`` is no known name.
    """
    path = Path(path)
    check_positive("fps", fps)
    wanted = keypoint_skeleton(skeleton) if isinstance(skeleton, str) else skeleton
    if path.suffix.lower() in (".h5", ".hdf5"):
        raise MotionFileError(
            f"{path} is HDF5, expected the same table exported as CSV "
            "(DeepLabCut writes it with save_as_csv=True)"
        )
    rows = _rows(path)
    header, rows = _header(rows, path)
    places = [(line, *_place(cells[: header.index_columns], line, path)) for line, cells in rows]
    tracks: list[KeypointTrack] = []
    for animal, parts in header.animals.items():
        joints = Skeleton(list(parts), [-1] * len(parts))
        chosen = list(range(len(parts)))
        if wanted is not None:
            found = _chosen(joints, wanted)
            if isinstance(found, str):
                if animal == _NO_ANIMAL and len(header.animals) > 1:
                    continue
                who = f"the individual {shortened(animal)}" if animal else "the table"
                raise MotionFileError(
                    f"{path}: {who} lacks the joint {found!r} of skeleton, expected it among the "
                    f"body parts {', '.join(parts)}"
                )
            joints, chosen = wanted, found
        values = _values(rows, [list(parts.values())[part] for part in chosen], path)
        detections = [
            Detection(video, frame, animal or None, values[row], f"{path}, line {line}")
            for row, (line, video, frame) in enumerate(places)
        ]
        tracks += tracks_of(detections, None, joints, float(fps), path)
    return tracks


@dataclass(frozen=True)
class _Header:
    """Where a table holds what.

    Attributes
    ----------
    index_columns : int
        How many columns in front name the frame.
    animals : dict
        Per animal (``""`` where the table is of one) and body part the columns of x, y and
        likelihood; that of likelihood is None in tables of labelled images.
    """

    index_columns: int
    animals: dict[str, dict[str, tuple[int, int, int | None]]]


def _rows(path: Path) -> list[tuple[int, list[str]]]:
    """Return the rows of a CSV file that are not empty, each with its line's number."""
    try:
        text = read_bytes(path).decode("utf-8-sig")
        reader = csv.reader(io.StringIO(text, newline=""), strict=True)
        return [(reader.line_num, row) for row in reader if any(row)]
    except (UnicodeDecodeError, csv.Error) as error:
        raise MotionFileError(
            f"{path} is no CSV ({str(error)[:80]}), expected a table of DeepLabCut"
        ) from error


def _header(
    rows: list[tuple[int, list[str]]], path: Path
) -> tuple[_Header, list[tuple[int, list[str]]]]:
    """Return what the header says and the rows below it."""
    names = [row[0].strip().lower() for _, row in rows[:4]]
    several = names[1:2] == ["individuals"]
    expected = ["scorer", *(["individuals"] if several else []), "bodyparts", "coords"]
    if names[: len(expected)] != expected:
        raise MotionFileError(
            f"{path} begins with the rows {shortened(names)}, expected DeepLabCut's scorer, "
            "individuals (where there are several), bodyparts and coords"
        )
    body = rows[len(expected) :]
    if not body:
        raise MotionFileError(f"{path} holds no row below its header, expected one per frame")
    width = len(rows[0][1])
    for line, row in rows:
        if len(row) != width:
            raise MotionFileError(
                f"{path}, line {line} has {len(row)} cells, expected {width} as in the first row"
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
                f"{path}, column {column + 1} is {shortened(coordinates[column])} of the body part "
                f"{shortened(part)}, expected x, y and likelihood, once for each named part"
            )
        columns[coordinate] = column
    animals: dict[str, dict[str, tuple[int, int, int | None]]] = {}
    for animal, parts in found.items():
        animals[animal] = {}
        for part, columns in parts.items():
            if "x" not in columns or "y" not in columns:
                raise MotionFileError(
                    f"{path}: the body part {shortened(part)} has the columns "
                    f"{', '.join(columns)}, expected x and y"
                )
            animals[animal][part] = columns["x"], columns["y"], columns.get("likelihood")
    if not animals:
        raise MotionFileError(f"{path} holds no body part, expected columns of x and y")
    return _Header(first, animals), body


def _place(cells: Sequence[str], line: int, path: Path) -> tuple[str, int]:
    """Return the video and the frame's number of a row, from the columns in front."""
    image = "/".join(cell.strip() for cell in cells if cell.strip()).replace("\\", "/")
    where = f"{path}, line {line}, column 1"
    if not re.fullmatch(r"[0-9]+", image) and not re.search(r"[A-Za-z]", image):
        raise MotionFileError(
            f"{where} holds {shortened(image)}, expected a frame's number or an image's path"
        )
    return frame_number(image, where)


def _chosen(joints: Skeleton, wanted: Skeleton) -> list[int] | str:
    """Return the place of each wanted joint, or the name of one that is not there."""
    chosen = []
    for name, canonical in zip(wanted.joint_names, wanted.canonical_names, strict=True):
        try:
            chosen.append(joints.index(name if name in joints.joint_names else canonical))
        except ValueError:
            return name
    return chosen


def _values(
    rows: list[tuple[int, list[str]]],
    columns: list[tuple[int, int, int | None]],
    path: Path,
) -> np.ndarray:
    """Return x, y and confidence of every frame and joint, (L, J, 3); unseen ones are 0."""
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
                    f"{path}, line {line}, column {(likelihood or 0) + 1} holds the likelihood "
                    f"{numbers[2]:g}, expected 0 or more"
                )
    return values


def _number(cell: str, line: int, column: int, path: Path) -> float:
    """Return a cell's number, NaN where it is empty."""
    text = cell.strip()
    if text in _UNSEEN:
        return np.nan
    try:
        number = float(text)
    except ValueError:
        number = np.inf
    if not abs(number) <= _LARGEST:
        raise MotionFileError(
            f"{path}, line {line}, column {column + 1} holds {shortened(text)}, expected a number "
            "between -1e9 and 1e9"
        )
    return number
