"""Loading and saving of motions and tracks, in a format chosen by the file's suffix."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import replace
from glob import glob, has_magic
from pathlib import Path

from probmotion.io.amc import read_amc
from probmotion.io.bvh import read_bvh
from probmotion.io.bvh_writing import write_bvh
from probmotion.io.conventions import (
    UNITS,
    Z_UP_TO_Y_UP,
    check_sides,
    check_size,
    check_up,
    gaps_filled,
    in_metres,
    reflected,
    y_up,
)
from probmotion.io.errors import MotionFileError, MotionFileWarning
from probmotion.io.glb import write_glb
from probmotion.io.markers import read_c3d, read_trc
from probmotion.io.npz import Archive, read_joint_npz, read_npz, write_npz
from probmotion.io.tables import write_csv, write_trc
from probmotion.motion.motion import JointTrack, Motion

__all__ = ["files_named", "load", "load_all", "read_joints", "save"]


def load(
    path: str | Path,
    fps: float | None = None,
    *,
    unit: str | None = None,
    up: str | None = None,
    mirror: bool = False,
) -> Motion:
    """Read a motion from a ``.bvh``, ``.npz`` or ``.amc`` file.

    Parameters
    ----------
    path : str or Path
        Motion file; an ``.amc`` file requires its ``.asf`` skeleton in the same folder.
    fps : float, optional
        Frames per second to resample to; the file's rate by default.
    unit : str, optional
        Unit of lengths in a ``.bvh`` or ``.npz`` file, ``m``, ``cm``, ``mm`` or ``in``. By default,
        that of a ``.bvh`` file is inferred, and an ``.npz`` file is in metres.
    up : str, optional
        Vertical axis of the file, ``y`` or ``z``; by default the one declared, or else ``y``.
    mirror : bool
        Reflect x, for files in left-handed axes.

    Returns
    -------
    motion : Motion
        Motion in metres, Y up.

    Raises
    ------
    MotionFileError
        If the file contains no motion or is damaged; if bodies are not 0.3 to 3 m large, unless
        ``unit`` is given; or if they stand along Z, unless ``up`` is given or declared.
    FileNotFoundError
        If the file does not exist.
    ValueError
        If ``unit`` or ``up`` is unknown, or ``unit`` is given for an ``.amc`` file.

    Warns
    -----
    MotionFileWarning
        If a unit or frame rate is assumed, joints are dropped, or left joints are on the body's
        right; see :func:`read_bvh`, :func:`read_amc` and :func:`~probmotion.io.npz.read_npz`.
    """
    path = Path(path)
    _check_conventions(unit, up)
    suffix, declared = path.suffix.lower(), False
    if suffix == ".npz":
        motion = read_npz(path, up)
        declared = "up_axis" in Archive(path).keys
        if unit is not None:
            motion = in_metres(motion, unit)
    elif suffix == ".bvh":
        motion = read_bvh(path, None if unit is None else UNITS[unit])
    elif suffix == ".amc":
        if unit is not None:
            raise ValueError(f"unit must be None for {path}, whose .asf file has one, got {unit!r}")
        motion = read_amc(path)
        warnings.warn(
            f"{path}: assuming {motion.fps:g} frames per second, as in most of the CMU database; "
            "set it with read_amc(path, fps=…)",
            MotionFileWarning,
            stacklevel=2,
        )
    elif not path.exists():
        raise FileNotFoundError(f"path must be an existing file, got {path}")
    else:
        raise MotionFileError(
            f"{path}: suffix must be .bvh, .npz or .amc, got {path.suffix!r}; use "
            "read_joints for .trc and .c3d, read_keypoints for 2D keypoints"
        )
    if unit is None:
        check_size(motion, path)
    if up is None and not declared:
        check_up(motion, path)
    if up == "z" and suffix != ".npz":
        motion = y_up(motion)
    if mirror:
        motion = reflected(motion)
    else:
        check_sides(motion, path)
    return motion if fps is None else motion.resample(fps)


def read_joints(
    path: str | Path,
    *,
    unit: str | None = None,
    up: str | None = None,
    mirror: bool = False,
) -> JointTrack:
    """Read the 3D joints of one person, with gaps.

    Parameters
    ----------
    path : str or Path
        A ``.npz`` file of :mod:`~probmotion.io.npz` with NaN where joints are missing, a ``.trc``
        or ``.c3d`` file of joint centres (:mod:`~probmotion.io.markers`), or a file of
        :func:`load`.
    unit : str, optional
        Unit of lengths, ``m``, ``cm``, ``mm`` or ``in``. By default, that declared by a ``.trc`` or
        ``.c3d`` file, and otherwise as for :func:`load`.
    up, mirror
        As for :func:`load`.

    Returns
    -------
    track : JointTrack
        Joints in metres, Y up: of the file's skeleton, or ``person14`` for ``.trc`` and ``.c3d``.

    Raises
    ------
    MotionFileError, FileNotFoundError, ValueError
        As for :func:`load`; also if a file contains several people or lacks joints of ``person14``.

    Warns
    -----
    MotionFileWarning
        As for :func:`load`.
    """
    path = Path(path)
    _check_conventions(unit, up)
    suffix = path.suffix.lower()
    declared = False
    if suffix == ".npz":
        track = read_joint_npz(path, up)
        declared = "up_axis" in Archive(path).keys
        joints = track.joints * UNITS[unit or "m"]
    elif suffix in (".trc", ".c3d"):
        track = read_trc(path, unit) if suffix == ".trc" else read_c3d(path, unit)
        joints = track.joints @ Z_UP_TO_Y_UP.T if up == "z" else track.joints
    else:
        motion = load(path, unit=unit, up=up, mirror=mirror)
        return JointTrack(motion.positions, motion.skeleton, motion.fps, motion.name)
    if mirror:
        joints = joints * [-1.0, 1.0, 1.0]
    track = replace(track, joints=joints)
    filled = gaps_filled(track)
    if unit is None:
        check_size(filled, path)
    if up is None and not declared:
        check_up(filled, path)
    if not mirror:
        check_sides(filled, path)
    return track


def _check_conventions(unit: str | None, up: str | None) -> None:
    """Raise ``ValueError`` if a unit or axis is unknown."""
    for name, value, known in (("unit", unit, [*UNITS]), ("up", up, ["y", "z"])):
        if value is not None and value not in known:
            raise ValueError(f"{name} must be one of {', '.join(known)}, got {value!r}")


def save(motion: Motion, path: str | Path) -> None:
    """Write a motion to a ``.bvh``, ``.glb``, ``.npz``, ``.trc`` or ``.csv`` file.

    ``.npz`` preserves the motion exactly. ``.bvh`` and ``.glb`` contain rigid bones with rotations
    (:func:`~probmotion.motion.inverse_kinematics.rigid_motion`), ``.trc`` and ``.csv``
    positions only.

    Raises
    ------
    ValueError
        If the suffix is not supported, or the format cannot represent the motion.
    OSError
        If the folder is missing or not writable.

    Warns
    -----
    UserWarning
        If rigid bones do not fit the positions, for ``.bvh`` and ``.glb``.
    """
    path = Path(path)
    writers = {
        ".bvh": write_bvh,
        ".glb": write_glb,
        ".npz": write_npz,
        ".trc": write_trc,
        ".csv": write_csv,
    }
    if path.suffix.lower() not in writers:
        *others, last = writers
        raise ValueError(f"path must end in {', '.join(others)} or {last}, got {path.suffix!r}")
    writers[path.suffix.lower()](motion, path)


def load_all(
    paths: str | Path | Iterable[str | Path],
    fps: float | None = None,
    *,
    unit: str | None = None,
    up: str | None = None,
    mirror: bool = False,
) -> Sequence[Motion]:
    """Read all motions of ``paths``, sorted by path.

    Parameters
    ----------
    paths : str, Path or iterable of them
        Files, or patterns such as ``"walks/*.bvh"``.
    fps : float, optional
        Frames per second to resample to; the rate of each file by default.
    unit, up, mirror
        As for :func:`load`.

    Raises
    ------
    FileNotFoundError
        If a pattern matches no file or a file does not exist.
    """
    files = files_named(paths)
    return [load(file, fps, unit=unit, up=up, mirror=mirror) for file in files]


def files_named(paths: str | Path | Iterable[str | Path]) -> list[Path]:
    """Return the files that match paths or patterns, sorted; see :func:`load_all`."""
    files: list[str] = []
    for pattern in [paths] if isinstance(paths, str | Path) else paths:
        matches = glob(str(pattern)) if has_magic(str(pattern)) else [str(pattern)]
        if not matches:
            raise FileNotFoundError(f"paths must match a file, got {str(pattern)!r}")
        files += matches
    return [Path(path) for path in sorted(files)]
