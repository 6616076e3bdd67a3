"""Reader of DeepLabCut tables, CSV or HDF5, with keypoint tracks of one or several animals.

The header rows of a CSV table are ``scorer``, ``individuals`` (for several animals), ``bodyparts``
and ``coords``. Coordinates are x, y and, except in manually labelled data, likelihood. The first
column is the frame number or image path, which newer labelled tables split into three. Source:
DeepLabCut guide.

Empty and NaN cells become NaN keypoints with confidence 0. Labelled keypoints have confidence 1.
The individual ``single`` contains points outside animals, such as the corners of a box.

HDF5 tables are those of pandas, in its format ``table`` (analysed videos) or ``fixed`` (labelled
images). The columns of the former are stored as a pickled list of tuples of strings. It is parsed
as text; no pickle is loaded.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from probmotion.io.errors import LARGEST, MotionFileError, number, shortened
from probmotion.io.keypoints.hdf5 import dataset, numbers_of, strings_of
from probmotion.io.keypoints.tracks import (
    Detection,
    KeypointFile,
    chosen_joints,
    frame_number,
    tracks_of,
)
from probmotion.motion.skeleton import Skeleton

__all__ = ["find_table", "read_csv_table", "read_hdf5_table"]

_NO_ANIMAL = "single"  # individual of the points outside animals
_MISSING = frozenset(("", "nan", "NaN"))  # cells without a value
_COORDINATES = ("x", "y", "likelihood")
# Opcodes of a pickled list of tuples of strings, protocol 0: marks, strings, memoised values.
_OPCODE = re.compile(rb"[(lta.]|[pg](?P<memo>\d{1,9})\n|V(?P<text>[^\n]*)\n")

Rows = Sequence[tuple[int, list[str]]]
"""Line numbers and cells of the nonempty rows."""
Animals = dict[str, dict[str, dict[str, int]]]
"""Columns by animal, body part and coordinate: ``x``, ``y`` and, if present, ``likelihood``."""


class _Table(NamedTuple):
    """Columns, locations in error messages and images of the rows, and cells (L, C)."""

    animals: Animals
    places: list[str]
    images: list[tuple[str, int]]
    cells: np.ndarray


def read_csv_table(
    rows: Rows, path: Path, fps: float | None, skeleton: Skeleton | None = None
) -> KeypointFile:
    """Read the keypoint track of every animal in the rows of a CSV table.

    Parameters
    ----------
    rows : sequence of (int, list of str)
        Line numbers and cells.
    path : Path
        File, for names and errors.
    fps : float, optional
        Frames per second of the video, which the table does not contain.
    skeleton : Skeleton, optional
        Joints to return; body parts are matched by name or canonical name. Default: every body
        part as a root, since tables contain no links.

    Returns
    -------
    file : KeypointFile
        One track per animal and video, over all frames of the table. Points outside animals
        (``single``) form a separate track, which is dropped if it lacks a joint of ``skeleton``.

    Raises
    ------
    MotionFileError
        If the file has another format, is damaged, or lacks a joint of ``skeleton``.
    """
    first, animals, body = _header(rows, path)
    cells = np.full((len(body), len(body[0][1])), np.nan)
    for index, (line, row) in enumerate(body):
        for column in range(first, len(row)):
            if row[column].strip() not in _MISSING:
                where = f"{path}, line {line}, column {column + 1}"
                cells[index, column] = number(row[column].strip(), where)
    images = [_image(row[:first], f"{path}, line {line}, column 1") for line, row in body]
    places = [f"{path}, line {line}" for line, _ in body]
    return _tracks(_Table(animals, places, images, cells), path, fps, skeleton)


def read_hdf5_table(
    group: Any, path: Path, fps: float | None, skeleton: Skeleton | None = None
) -> KeypointFile:
    """Read the keypoint track of every animal in a table of pandas; see :func:`read_csv_table`."""
    if "table" in group:
        columns, index, cells = _appendable_table(group, path)
    else:
        columns, index, cells = _fixed_table(group, path)
    if cells.shape != (len(index), len(columns)):
        raise MotionFileError(
            f"{path}: expected {len(index)} rows of {len(columns)} cells, got shape {cells.shape}"
        )
    if (np.abs(cells) > LARGEST).any():
        raise MotionFileError(f"{path}: expected numbers between -1e9 and 1e9 in all cells")
    animals: Animals = {}
    for position, column in enumerate(columns):
        if len(column) not in (3, 4):
            raise MotionFileError(
                f"{path}: expected columns of scorer, individuals (optional), bodyparts and "
                f"coords, got {shortened(column)}"
            )
        animal = column[1] if len(column) == 4 else ""
        _add_column(animals, animal, column[-2], column[-1], position, path)
    _check_columns(animals, path)
    places = [f"{path}, row {row}" for row in range(len(index))]
    images = [_image(image, place) for image, place in zip(index, places, strict=True)]
    return _tracks(_Table(animals, places, images, cells), path, fps, skeleton)


def find_table(file: Any) -> Any:
    """Return the group of the table of pandas in an open HDF5 file; None if it has none."""
    tables = [name for name in file if "pandas_type" in file[name].attrs]
    name = next((name for name in ("df_with_missing", *tables) if name in tables), None)
    return None if name is None else file[name]


def _tracks(
    table: _Table, path: Path, fps: float | None, skeleton: Skeleton | None
) -> KeypointFile:
    if not table.images:
        raise MotionFileError(f"{path}: expected a row per frame, got none")
    tracks = []
    for animal, parts in table.animals.items():
        joints = Skeleton(list(parts), [-1] * len(parts))
        chosen: Sequence[int] = range(len(parts))
        if skeleton is not None:
            owner = f"individual {shortened(animal)}" if animal else "the table"
            try:
                chosen = chosen_joints(joints, skeleton, f"the body parts of {owner}", path)
            except MotionFileError:
                if animal == _NO_ANIMAL and len(table.animals) > 1:
                    continue
                raise
        columns = [list(parts.values())[part] for part in chosen]
        values = _values(table, columns)
        detections = [
            Detection(*image, animal or None, each, place)
            for image, each, place in zip(table.images, values, table.places, strict=True)
        ]
        tracks += tracks_of(detections, None, skeleton or joints, fps, path)
    return KeypointFile("DeepLabCut", fps, tracks)


def _header(rows: Rows, path: Path) -> tuple[int, Animals, Rows]:
    """Return the number of index columns, the columns by animal and the data rows."""
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
    animals: Animals = {}
    coordinates = [cell.strip().lower() for cell in rows[len(expected) - 1][1]]
    first = next((column for column in range(1, width) if coordinates[column]), width)
    for column in range(first, width):
        animal = rows[1][1][column].strip() if several else ""
        part = rows[len(expected) - 2][1][column].strip()
        _add_column(animals, animal, part, coordinates[column], column, path)
    _check_columns(animals, path)
    return first, animals, body


def _add_column(
    animals: Animals, animal: str, part: str, coordinate: str, column: int, path: Path
) -> None:
    columns = animals.setdefault(animal, {}).setdefault(part, {})
    if coordinate not in _COORDINATES or coordinate in columns or not part:
        raise MotionFileError(
            f"{path}, column {column + 1}: expected x, y and likelihood once for each body part, "
            f"got {shortened(coordinate)} of {shortened(part)}"
        )
    columns[coordinate] = column


def _check_columns(animals: Animals, path: Path) -> None:
    for parts in animals.values():
        for part, columns in parts.items():
            if not {"x", "y"} <= set(columns):
                raise MotionFileError(
                    f"{path}: expected x and y of the body part {shortened(part)}, got "
                    f"{', '.join(columns)}"
                )
    if not animals:
        raise MotionFileError(f"{path}: expected at least one body part, got none")


def _appendable_table(
    group: Any, path: Path
) -> tuple[list[tuple[str, ...]], list[list[str]], np.ndarray]:
    """Return columns, index and cells of pandas' format ``table``."""
    table = dataset(group, "table", path)
    fields = table.dtype.names or ()
    block = table.dtype["values_block_0"] if "values_block_0" in fields else np.dtype("S1")
    if tuple(fields) != ("index", "values_block_0") or block.base.kind != "f":
        raise MotionFileError(
            f"{path}: expected a table with index and numbers in values_block_0, got "
            f"{shortened(fields)}; save it as .csv"
        )
    columns = _unpickled_names(bytes(table.attrs["values_block_0_kind"]), path)
    rows = table[()]
    cells = rows["values_block_0"].astype(np.float64)
    return columns, [[_text(image)] for image in rows["index"].tolist()], cells


def _fixed_table(
    group: Any, path: Path
) -> tuple[list[tuple[str, ...]], list[list[str]], np.ndarray]:
    """Return columns, index and cells of pandas' format ``fixed``."""
    if group.attrs.get("nblocks") != 1:
        raise MotionFileError(f"{path}: expected a table of numbers only; save it as .csv")
    cells = numbers_of(group, "block0_values", 2, path)
    if "axis1" in group:
        axis = dataset(group, "axis1", path)
        index = [[_text(image)] for image in axis[()].ravel().tolist()]
    else:
        index = [list(image) for image in _levels(group, "axis1", path)]
    return _levels(group, "block0_items", path), index, cells


def _levels(group: Any, name: str, path: Path) -> list[tuple[str, ...]]:
    """Return the entries of a multi-index of strings, from the codes of its levels."""
    columns = []
    for level in range(min(int(group.attrs.get(f"{name}_nlevels", 0)), 4)):
        texts = strings_of(group, f"{name}_level{level}", path)
        codes = numbers_of(group, f"{name}_label{level}", 1, path)
        if not np.isin(codes, range(len(texts))).all():
            raise MotionFileError(f"{path}: expected codes of {len(texts)} names in {name}")
        columns.append([texts[int(code)] for code in codes])
    if not columns or len({len(column) for column in columns}) > 1:
        raise MotionFileError(f"{path}: expected levels of equal length in {name}")
    return list(zip(*columns, strict=True))


def _unpickled_names(content: bytes, path: Path) -> list[tuple[str, ...]]:
    """Return the tuples of strings in a pickled list, protocol 0, from its text."""
    stack: list[Any] = []
    memo: dict[bytes, Any] = {}
    result: list[tuple[str, ...]] = []
    at, opcode = 0, b""
    while opcode != b"." and (match := _OPCODE.match(content, at)):
        at, opcode = match.end(), match[0][:1]
        if opcode == b"(":
            stack.append(None)
        elif opcode == b"V":
            stack.append(match["text"].decode("raw_unicode_escape", "replace"))
        elif opcode == b"p" and stack:
            memo[match["memo"]] = stack[-1]
        elif opcode == b"g" and memo.get(match["memo"]) is not None:
            stack.append(memo[match["memo"]])
        elif opcode == b"t" and None in stack:
            mark = len(stack) - stack[::-1].index(None)
            stack[mark - 1 :] = [tuple(stack[mark:])]
        elif opcode == b"a" and stack and isinstance(stack[-1], tuple):
            result.append(stack.pop())
        elif opcode not in (b"l", b"."):  # the list itself stays a mark
            break
    texts = all(isinstance(text, str) for row in result for text in row)
    if opcode != b"." or not result or not texts:
        raise MotionFileError(
            f"{path}: expected columns of strings, got {shortened(content)}; save it as .csv"
        )
    return result


def _text(value: Any) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _image(cells: Sequence[str], where: str) -> tuple[str, int]:
    """Return the video and the frame number of a row, from its index columns."""
    image = "/".join(cell.strip() for cell in cells if cell.strip()).replace("\\", "/")
    if not re.fullmatch(r"[0-9]+", image) and not re.search(r"[A-Za-z]", image):
        raise MotionFileError(
            f"{where}: expected a frame number or an image path, got {shortened(image)}"
        )
    return frame_number(image, where)


def _values(table: _Table, parts: list[dict[str, int]]) -> np.ndarray:
    """Return x, y and confidence of every frame and body part, (L, J, 3); 0 if missing."""
    values = np.ones((len(table.cells), len(parts), 3))
    for joint, columns in enumerate(parts):
        for axis, name in enumerate(_COORDINATES):
            if name in columns:
                values[:, joint, axis] = table.cells[:, columns[name]]
        if (values[:, joint, 2] < 0).any():
            row = int(np.argmax(values[:, joint, 2] < 0))
            raise MotionFileError(
                f"{table.places[row]}, column {columns['likelihood'] + 1}: expected a likelihood "
                f"of at least 0, got {values[row, joint, 2]:g}"
            )
    return np.where(np.isnan(values).any(axis=-1, keepdims=True), 0.0, values)
