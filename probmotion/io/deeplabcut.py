"""Reader of DeepLabCut CSV tables with keypoint tracks of one or several animals.

The header rows are ``scorer``, ``individuals`` (for several animals), ``bodyparts`` and ``coords``.
Coordinates are x, y and, except in manually labelled data, likelihood. The first column is the
frame number or image path, which newer labelled tables split into three. Source: DeepLabCut guide.

Empty and NaN cells become NaN keypoints with confidence 0. Labelled keypoints have confidence 1.
The individual ``single`` contains points outside animals, such as the corners of a box.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from probmotion.io.errors import MotionFileError, number, read_bytes, shortened
from probmotion.io.keypoint_tracks import Detection, frame_number, tracks_of
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_positive

__all__ = ["read_deeplabcut"]

_NO_ANIMAL = "single"  # individual of the points outside animals
_MISSING = frozenset(("", "nan", "NaN"))  # cells without a value

Rows = list[tuple[int, list[str]]]
"""Line numbers and cells of the nonempty rows."""
Columns = dict[str, int]
"""Columns of ``x``, ``y`` and, if present, ``likelihood`` of a body part."""


def read_deeplabcut(
    path: str | Path, fps: float, skeleton: Skeleton | str | None = None
) -> list[KeypointTrack]:
    """Read the keypoint track of every animal.

    Parameters
    ----------
    path : str or Path
        CSV table.
    fps : float
        Frames per second of the video, which the table does not contain.
    skeleton : Skeleton or str, optional
        Joints to return, or the name of a preset; body parts are matched by name or canonical
        name. Default: every body part as a root, since tables contain no links.

    Returns
    -------
    tracks : list of KeypointTrack
        One per animal and video, over all frames of the table. Points outside animals (``single``)
        form a separate track, which is dropped if it lacks a joint of ``skeleton``.

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
    images = [(line, *_image(cells[:index_columns], line, path)) for line, cells in rows]
    tracks: list[KeypointTrack] = []
    for animal, parts in animals.items():
        joints = Skeleton(list(parts), [-1] * len(parts))
        chosen: Sequence[int] = range(len(parts))
        if wanted is not None:
            matches = _matches(joints, wanted)
            if None in matches:
                if animal == _NO_ANIMAL and len(animals) > 1:
                    continue
                missing = wanted.joint_names[matches.index(None)]
                owner = f"individual {shortened(animal)}" if animal else "the table"
                raise MotionFileError(
                    f"{path}: expected the joint {missing!r} of skeleton among the body parts of "
                    f"{owner}, got {', '.join(parts)}"
                )
            joints, chosen = wanted, [part for part in matches if part is not None]
        values = _values(rows, [list(parts.values())[part] for part in chosen], path)
        detections = [
            Detection(video, frame, animal or None, values[row], f"{path}, line {line}")
            for row, (line, video, frame) in enumerate(images)
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
    """Return the number of index columns, the columns of body parts by animal and the data rows."""
    names = [row[0].strip().lower() for _, row in rows[:4]]
    several = names[1:2] == ["individuals"]
    expected = ["scorer", *["individuals"] * several, "bodyparts", "coords"]
    if names[: len(expected)] != expected:
        raise MotionFileError(
            f"{path}: expected the rows scorer, individuals (optional), bodyparts and coords, "
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
    columns_by_animal: dict[str, dict[str, Columns]] = {}
    coordinates = [cell.strip().lower() for cell in rows[len(expected) - 1][1]]
    first = next((column for column in range(1, width) if coordinates[column]), width)
    for column in range(first, width):
        animal = rows[1][1][column].strip() if several else ""
        part = rows[len(expected) - 2][1][column].strip()
        columns = columns_by_animal.setdefault(animal, {}).setdefault(part, {})
        coordinate = coordinates[column]
        if coordinate not in ("x", "y", "likelihood") or coordinate in columns or not part:
            raise MotionFileError(
                f"{path}, column {column + 1}: expected x, y and likelihood once for each body "
                f"part, got {shortened(coordinate)} of {shortened(part)}"
            )
        columns[coordinate] = column
    for parts in columns_by_animal.values():
        for part, columns in parts.items():
            if not {"x", "y"} <= set(columns):
                raise MotionFileError(
                    f"{path}: expected x and y of the body part {shortened(part)}, got "
                    f"{', '.join(columns)}"
                )
    if not columns_by_animal:
        raise MotionFileError(f"{path}: expected at least one body part, got none")
    return first, columns_by_animal, body


def _image(cells: Sequence[str], line: int, path: Path) -> tuple[str, int]:
    """Return the video and the frame number of a row, from its index columns."""
    image = "/".join(cell.strip() for cell in cells if cell.strip()).replace("\\", "/")
    where = f"{path}, line {line}, column 1"
    if not re.fullmatch(r"[0-9]+", image) and not re.search(r"[A-Za-z]", image):
        raise MotionFileError(
            f"{where}: expected a frame number or an image path, got {shortened(image)}"
        )
    return frame_number(image, where)


def _matches(joints: Skeleton, wanted: Skeleton) -> list[int | None]:
    """Return the index of each wanted joint, by name or canonical name; None if missing."""
    indices: list[int | None] = []
    for name, canonical in zip(wanted.joint_names, wanted.canonical_names, strict=True):
        try:
            indices.append(joints.index(name if name in joints.joint_names else canonical))
        except ValueError:
            indices.append(None)
    return indices


def _values(rows: Rows, parts: list[Columns], path: Path) -> np.ndarray:
    """Return x, y and confidence of every frame and body part, (L, J, 3); 0 if missing."""
    values = np.zeros((len(rows), len(parts), 3))
    for row, (line, cells) in enumerate(rows):
        for joint, columns in enumerate(parts):
            entry = [1.0] * 3
            for axis, name in enumerate(("x", "y", "likelihood")):
                if name in columns:
                    where = f"{path}, line {line}, column {columns[name] + 1}"
                    text = cells[columns[name]].strip()
                    entry[axis] = np.nan if text in _MISSING else number(text, where)
            if entry[2] < 0:  # ``where`` is the likelihood cell
                raise MotionFileError(
                    f"{where}: expected a likelihood of at least 0, got {entry[2]:g}"
                )
            if not np.isnan(entry).any():
                values[row, joint] = entry
    return values
