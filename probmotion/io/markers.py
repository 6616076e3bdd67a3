"""Readers of marker trajectories in TRC and C3D files.

Markers must be joint centres, as pose estimators and biomechanical models export them, and are
mapped by name to the skeleton ``person14``; other markers are ignored. A marker is missing where
its cells are empty (TRC), where its residual is negative (C3D), or at exactly (0, 0, 0), with
which several programs mark gaps.

Sources: OpenSim documentation (TRC); *The C3D file format: user guide*, Motion Lab Systems.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from probmotion.io.conventions import UNITS
from probmotion.io.errors import (
    MotionFileError,
    decoded_lines,
    errors_in,
    number,
    read_bytes,
    shortened,
)
from probmotion.motion.motion import JointTrack
from probmotion.motion.skeleton import Skeleton

__all__ = ["read_c3d", "read_trc"]

_HEADER_ROWS = 5  # file type, keys, values, marker names, coordinate names
_MISSING = frozenset(("", "nan", "NaN"))  # cells without a value
_UNIT_NAMES = {"meters": "m", "metres": "m", "millimeters": "mm", "inches": "in"}


def read_trc(path: str | Path, unit: str | None = None) -> JointTrack:
    """Read the joint centres of a TRC file.

    Parameters
    ----------
    path : str or Path
        Tab-separated TRC file.
    unit : str, optional
        ``m``, ``cm``, ``mm`` or ``in``; the unit declared by the file by default.

    Returns
    -------
    track : JointTrack
        Joints of ``person14``, metres, in the axes of the file; NaN where missing.

    Raises
    ------
    MotionFileError
        If the file is damaged or of another format, declares no known unit, or lacks a joint.
    FileNotFoundError
        If the file does not exist.
    """
    path = Path(path)
    rows = [line.split("\t") for line in decoded_lines(read_bytes(path))]
    if len(rows) < _HEADER_ROWS or rows[0][0].strip() != "PathFileType":
        raise MotionFileError(f"{path}: expected a TRC file, which starts with PathFileType")
    declared = dict(zip((cell.strip() for cell in rows[1]), rows[2], strict=False))
    for key in ("DataRate", "NumFrames", "NumMarkers"):
        if key not in declared:
            raise MotionFileError(
                f"{path}, line 2: expected the key {key}, got {shortened(rows[1])}"
            )
    fps, frames, markers = (
        number(declared[key].strip(), f"{path}, line 3: {key}")
        for key in ("DataRate", "NumFrames", "NumMarkers")
    )
    names = [name.strip() for name in rows[3][2:] if name.strip()]
    if len(names) != markers:
        raise MotionFileError(f"{path}, line 4: expected {markers:g} markers, got {len(names)}")
    table = []
    for line, cells in enumerate(rows[_HEADER_ROWS:], _HEADER_ROWS + 1):
        if not any(cell.strip() for cell in cells):
            continue
        values = [cell.strip() for cell in cells[2:]]
        if any(values[3 * len(names) :]):
            raise MotionFileError(
                f"{path}, line {line}: expected {3 * len(names)} coordinates, got {len(values)}"
            )
        values += [""] * (3 * len(names) - len(values))
        table.append(
            [
                np.nan if value in _MISSING else number(value, f"{path}, line {line}")
                for value in values[: 3 * len(names)]
            ]
        )
    if len(table) != frames:
        raise MotionFileError(f"{path}: expected {frames:g} frames, got {len(table)}")
    positions = np.array(table).reshape(len(table), len(names), 3)
    return _joints(positions, names, fps, unit or declared.get("Units", ""), path)


def read_c3d(path: str | Path, unit: str | None = None) -> JointTrack:
    """Read the joint centres of a C3D file with the package ezc3d (extra ``c3d``).

    Parameters
    ----------
    path : str or Path
        C3D file.
    unit : str, optional
        ``m``, ``cm``, ``mm`` or ``in``; the unit declared by the file by default.

    Returns
    -------
    track : JointTrack
        Joints of ``person14``, metres, in the axes of the file; NaN where missing.

    Raises
    ------
    MotionFileError
        If the file is damaged or of another format, declares no known unit, or lacks a joint.
    FileNotFoundError
        If the file does not exist.
    ModuleNotFoundError
        If ezc3d is not installed.
    """
    path = Path(path)
    read_bytes(path)  # raises for missing and unreadable files
    from probmotion.extras import ezc3d

    try:
        file = ezc3d.c3d(str(path))
        point: dict[str, Any] = file["parameters"]["POINT"]
        fps = float(point["RATE"]["value"][0])
        unit = unit or "".join(point.get("UNITS", {"value": [""]})["value"][:1])
        # Files with more than 255 markers continue in LABELS2, LABELS3, …
        groups = sorted(
            (key for key in point if key.startswith("LABELS")), key=lambda k: (len(k), k)
        )
        names = [name.strip() for key in groups for name in point[key]["value"]]
        positions = file["data"]["points"][:3].transpose(2, 1, 0)
    except Exception as error:  # ezc3d raises many types for damaged files
        raise MotionFileError(f"{path}: expected a C3D file ({str(error)[:80]})") from error
    if not 0 < positions.shape[1] <= len(names):
        raise MotionFileError(
            f"{path}: expected named markers, got {positions.shape[1]} markers and "
            f"{len(names)} names"
        )
    return _joints(positions, names[: positions.shape[1]], fps, unit, path)


def _joints(
    positions: np.ndarray, names: list[str], fps: float, unit: str, path: Path
) -> JointTrack:
    """Return the joints of ``person14`` among markers (L, M, 3) given in ``unit``."""
    unit = unit.strip().lower()
    unit = _UNIT_NAMES.get(unit, unit)
    if unit not in UNITS:
        raise MotionFileError(
            f"{path}: unit must be one of {', '.join(UNITS)}, got {shortened(unit)}; pass "
            "unit='mm' (--unit mm) if that is their unit"
        )
    joints = np.where((positions == 0).all(axis=-1, keepdims=True), np.nan, positions)
    named = [index for index, name in enumerate(names) if name]
    with errors_in(path):
        skeleton = Skeleton([names[index] for index in named], [-1] * len(named))
        track = JointTrack(joints[:, named] * UNITS[unit], skeleton, fps, path.stem)
    try:
        return track.retarget(Skeleton.preset("person14"))
    except ValueError as error:
        raise MotionFileError(
            f"{path}: {error}; markers must be joint centres, named as in OpenPose (RHip, LKnee, "
            "…) or RHJC, LKJC, …"
        ) from error
