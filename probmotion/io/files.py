"""Loading and saving of motions and keypoint tracks, in a format chosen by the file's suffix."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from glob import glob, has_magic
from pathlib import Path

from probmotion.io.amc import read_amc
from probmotion.io.bvh import read_bvh
from probmotion.io.bvh_writing import write_bvh
from probmotion.io.deeplabcut import read_deeplabcut
from probmotion.io.errors import MotionFileError, MotionFileWarning
from probmotion.io.keypoint_json import read_keypoint_json
from probmotion.io.npz import read_keypoint_npz, read_npz, write_npz
from probmotion.motion.motion import KeypointTrack, Motion
from probmotion.motion.skeleton import Skeleton

__all__ = ["files_named", "load", "load_all", "read_keypoints", "save"]


def load(path: str | Path, fps: float | None = None) -> Motion:
    """Read a motion from a ``.bvh``, ``.npz`` or ``.amc`` file.

    Parameters
    ----------
    path : str or Path
        Motion file; an ``.amc`` file requires its ``.asf`` skeleton in the same folder.
    fps : float, optional
        Frames per second to resample to; the file's rate by default.

    Returns
    -------
    motion : Motion
        Motion in metres, Y up.

    Raises
    ------
    MotionFileError
        If the file contains no motion or is damaged.
    FileNotFoundError
        If the file does not exist.

    Warns
    -----
    MotionFileWarning
        If a unit or frame rate is assumed or joints are dropped; see :func:`read_bvh`,
        :func:`read_amc` and :func:`~probmotion.io.npz.read_npz`.
    """
    path = Path(path)
    readers = {".bvh": read_bvh, ".npz": read_npz, ".amc": read_amc}
    if path.suffix.lower() not in readers:
        if not path.exists():
            raise FileNotFoundError(f"path must be an existing file, got {path}")
        raise MotionFileError(
            f"{path}: expected .bvh, .npz or .amc, got {path.suffix!r}; use "
            "read_keypoints for 2D keypoints"
        )
    motion = readers[path.suffix.lower()](path)
    if path.suffix.lower() == ".amc":
        warnings.warn(
            f"{path}: assuming {motion.fps:g} frames per second, as in most of the CMU database; "
            "set it with read_amc(path, fps=…)",
            MotionFileWarning,
            stacklevel=2,
        )
    return motion if fps is None else motion.resample(fps)


def save(motion: Motion, path: str | Path) -> None:
    """Write a motion to a ``.bvh`` or ``.npz`` file.

    Raises
    ------
    ValueError
        If the suffix is not supported, or the format cannot represent the motion.
    OSError
        If the folder is missing or not writable.
    """
    path = Path(path)
    writers = {".bvh": write_bvh, ".npz": write_npz}
    if path.suffix.lower() not in writers:
        raise ValueError(f"path must end in .bvh or .npz, got {path.suffix!r}")
    writers[path.suffix.lower()](motion, path)


def read_keypoints(
    path: str | Path,
    fps: float | None = None,
    skeleton: Skeleton | str | None = None,
    people: int | None = None,
) -> list[KeypointTrack]:
    """Read the 2D keypoint tracks of a file, one per person and camera.

    Parameters
    ----------
    path : str or Path
        COCO, AlphaPose or OpenPose JSON, a folder of OpenPose files, a DeepLabCut ``.csv`` table,
        or an ``.npz`` archive.
    fps : float, optional
        Frames per second; required for JSON files and tables, which do not contain it.
    skeleton : Skeleton or str, optional
        Keypoints of a JSON file in the file's order (see
        :func:`~probmotion.io.keypoint_json.read_keypoint_json`), or the joints to select from a
        table (see :func:`~probmotion.io.deeplabcut.read_deeplabcut`).
    people : int, optional
        Number of people to track in a JSON file without track ids.

    Raises
    ------
    MotionFileError
        If the file contains no keypoint track or is damaged.
    FileNotFoundError
        If the file does not exist.
    ValueError
        If ``fps`` is missing or not above 0, or ``skeleton`` or ``people`` is not applicable.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"path must be an existing file, got {path}")
    archive = path.suffix.lower() == ".npz"
    table = path.suffix.lower() in (".csv", ".h5", ".hdf5")
    unused = {"people": people, "skeleton": skeleton if archive else None}
    for name, value in unused.items():
        if value is not None and (archive or table):
            raise ValueError(f"{name} must be None for {path.suffix} files, got {value!r}")
    if archive:
        return read_keypoint_npz(path, fps)
    if fps is None:
        raise ValueError(f"fps must be given for {path}, which contains no frame rate, got None")
    if table:
        return read_deeplabcut(path, fps, skeleton)
    return read_keypoint_json(path, fps, skeleton, people)


def load_all(
    paths: str | Path | Iterable[str | Path], fps: float | None = None
) -> Sequence[Motion]:
    """Read all motions of ``paths``, sorted by path.

    Parameters
    ----------
    paths : str, Path or iterable of them
        Files, or patterns such as ``"walks/*.bvh"``.
    fps : float, optional
        Frames per second to resample to; the rate of each file by default.

    Raises
    ------
    FileNotFoundError
        If a pattern matches no file or a file does not exist.
    """
    return [load(path, fps) for path in files_named(paths)]


def files_named(paths: str | Path | Iterable[str | Path]) -> list[Path]:
    """Return the files that match paths or patterns, sorted; see :func:`load_all`."""
    files: list[str] = []
    for pattern in [paths] if isinstance(paths, str | Path) else paths:
        matches = glob(str(pattern)) if has_magic(str(pattern)) else [str(pattern)]
        if not matches:
            raise FileNotFoundError(f"paths must match a file, got {str(pattern)!r}")
        files += matches
    return [Path(path) for path in sorted(files)]
