"""Writers of joint positions in tables: TRC files and CSV files."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from probmotion.files import written_whole
from probmotion.motion.motion import Motion

__all__ = ["write_csv", "write_trc"]

_DECIMALS = 6  # of metres


def write_trc(motion: Motion, path: str | Path) -> None:
    """Write joint positions to a TRC file, in metres and atomically, for biomechanics programs.

    Rotations are not written. A position at the origin, with which programs mark gaps, is written
    1e-6 m above it.

    Raises
    ------
    ValueError
        If a joint's name is empty or contains a tab or a line break.
    OSError
        If the folder is missing or not writable.
    """
    path, names = Path(path), motion.skeleton.joint_names
    for name in names:
        if not name.strip() or set(name) & set("\t\r\n"):
            raise ValueError(
                "joint_names must not be empty or contain tabs or line breaks in TRC files, got "
                f"{name!r}"
            )
    positions = motion.positions.round(_DECIMALS)
    positions[(positions == 0).all(axis=-1), 1] = 10.0**-_DECIMALS
    rate, frames, joints = f"{motion.fps:.10g}", str(motion.frames), str(len(names))
    keys = ["DataRate", "CameraRate", "NumFrames", "NumMarkers", "Units"]
    origin = ["OrigDataRate", "OrigDataStartFrame", "OrigNumFrames"]
    header = [
        ["PathFileType", "4", "(X/Y/Z)", path.name],
        [*keys, *origin],
        [rate, rate, frames, joints, "m", rate, "1", frames],
        ["Frame#", "Time", *(cell for name in names for cell in (name, "", ""))],
        ["", "", *(f"{axis}{at}" for at in range(1, len(names) + 1) for axis in "XYZ")],
        [],
    ]
    lines = ["\t".join(row) for row in header]
    _write(path, [*lines, *_rows(positions, motion.fps, "\t", first=1)])


def write_csv(motion: Motion, path: str | Path) -> None:
    """Write joint positions to a CSV file, in metres and atomically.

    The columns are ``frame`` (from 0), ``time`` in seconds and ``JOINT_x``, ``JOINT_y`` and
    ``JOINT_z`` for each joint. Rotations are not written.

    Raises
    ------
    OSError
        If the folder is missing or not writable.
    """
    names = motion.skeleton.joint_names
    header = io.StringIO()
    columns = ["frame", "time", *(f"{name}_{axis}" for name in names for axis in "xyz")]
    csv.writer(header, lineterminator="").writerow(columns)
    rows = _rows(motion.positions.round(_DECIMALS), motion.fps, ",", first=0)
    _write(Path(path), [header.getvalue(), *rows])


def _rows(positions: np.ndarray, fps: float, separator: str, first: int) -> Iterable[str]:
    """Return a line per frame: its number from ``first``, its time and its positions."""
    row = separator.join(["%d", "%.6f", *[f"%.{_DECIMALS}f"] * positions[0].size])
    values = positions.reshape(len(positions), -1) + 0.0  # avoids -0.000000
    return (row % (first + at, at / fps, *frame) for at, frame in enumerate(values.tolist()))


def _write(path: Path, lines: Iterable[str]) -> None:
    with written_whole(path) as unfinished:
        unfinished.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")
