"""Reading and writing motion files: BVH, AMC, npz, keypoint JSON, DeepLabCut, predictions."""

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

__all__ = [
    "files_named",
    "load_motion",
    "load_motions",
    "read_keypoints",
    "read_motion",
    "save_motion",
]


def read_motion(path: str | Path) -> Motion:
    """Read a motion; the file's ending chooses the format: ``.bvh``, ``.npz`` or ``.amc``.

    Parameters
    ----------
    path : str or Path
        The file.

    Returns
    -------
    motion : Motion
        In metres, Y up, at the file's own rate. Where a unit had to be inferred, a rate assumed
        or joints left out, a :class:`MotionFileWarning` says so in one sentence; see
        :func:`read_bvh`, :func:`read_amc` and :func:`~probmotion.io.npz.read_npz`.

    Raises
    ------
    MotionFileError
        If the file is no motion, or is damaged; the message names the line or key.
    FileNotFoundError
        If there is no such file.
    """
    path = Path(path)
    readers = {".bvh": read_bvh, ".npz": read_npz, ".amc": _read_amc_at_usual_rate}
    if path.suffix.lower() not in readers:
        if not path.exists():
            raise FileNotFoundError(f"there is no file {path}")
        raise MotionFileError(
            f"{path} ends in {path.suffix!r}, expected a motion in .bvh or .npz, or in .amc beside "
            "its .asf (2D keypoints: read_keypoints)"
        )
    return readers[path.suffix.lower()](path)


def _read_amc_at_usual_rate(path: Path) -> Motion:
    """Return the motion of an AMC file, and warn of the rate."""
    motion = read_amc(path)
    warnings.warn(
        f"{path} is taken to have {motion.fps:g} frames per second, as most of the CMU database "
        "has; read_amc(path, fps=…) takes another rate",
        MotionFileWarning,
        stacklevel=4,
    )
    return motion


def save_motion(motion: Motion, path: str | Path) -> None:
    """Write a motion; the file's ending chooses the format: ``.bvh`` or ``.npz``.

    Raises
    ------
    ValueError
        If the ending is another one, or the format cannot hold the motion.
    OSError
        If the folder is missing or cannot be written to.
    """
    path = Path(path)
    writers = {".bvh": write_bvh, ".npz": write_npz}
    if path.suffix.lower() not in writers:
        raise ValueError(f"path ends in {path.suffix!r}, expected .bvh or .npz")
    writers[path.suffix.lower()](motion, path)


def read_keypoints(
    path: str | Path,
    fps: float | None = None,
    skeleton: Skeleton | str | None = None,
    people: int | None = None,
) -> list[KeypointTrack]:
    """Read the 2D keypoint tracks of a file: one per person and camera.

    Parameters
    ----------
    path : str or Path
        COCO, AlphaPose or OpenPose JSON, a folder of OpenPose files, a ``.csv`` table of
        DeepLabCut, or an ``.npz`` archive.
    fps : float, optional
        Frames per second. JSON files and tables do not hold it: there it must be given.
    skeleton : Skeleton or str, optional
        The keypoints of a JSON file in their order (see
        :func:`~probmotion.io.keypoint_json.read_keypoint_json`), or the joints to take from a
        table (see :func:`~probmotion.io.deeplabcut.read_deeplabcut`).
    people : int, optional
        How many people to follow in a JSON file that does not say who is who.

    Raises
    ------
    MotionFileError
        If the file holds no keypoint track, or is damaged; the message says where.
    FileNotFoundError
        If there is no such file.
    ValueError
        If ``fps`` is missing or not above 0, or ``skeleton`` is unknown or not to be given.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"there is no file {path}")
    if path.suffix.lower() == ".npz":
        if people is not None:
            raise ValueError(
                f"people was given with {path}, expected none: npz files say who is who"
            )
        if skeleton is not None:
            raise ValueError(f"skeleton was given with {path}, expected none: npz files hold it")
        return read_keypoint_npz(path, fps)
    table = path.suffix.lower() in (".csv", ".h5", ".hdf5")
    if fps is None:
        kind = "a table" if table else "JSON"
        raise ValueError(
            f"fps is missing, expected frames per second: {path} is {kind}, which does not hold it"
        )
    if table:
        if people is not None:
            raise ValueError(f"people was given with {path}, expected none: tables say who is who")
        return read_deeplabcut(path, fps, skeleton)
    return read_keypoint_json(path, fps, skeleton, people)


def load_motion(path: str | Path, fps: float | None = None) -> Motion:
    """Read one motion from a ``.bvh``, ``.npz`` or ``.amc`` file.

    Parameters
    ----------
    path : str or Path
        The file; an ``.amc`` has the ``.asf`` of its skeleton beside it.
    fps : float, optional
        Resample to this rate; the file's own rate is kept by default.

    Raises
    ------
    MotionFileError
        If the file is no motion, or is damaged; the message says where.
    FileNotFoundError
        If there is no such file.
    """
    motion = read_motion(Path(path))
    return motion if fps is None else motion.resample(fps)


def load_motions(
    paths: str | Path | Iterable[str | Path], fps: float | None = None
) -> Sequence[Motion]:
    """Read every motion that ``paths`` names, sorted by path.

    Parameters
    ----------
    paths : str, Path or iterable of them
        Files, or patterns such as ``"walks/*.bvh"``.
    fps : float, optional
        Resample every clip to this rate.

    Raises
    ------
    FileNotFoundError
        If a pattern matches no file.
    """
    return [load_motion(path, fps) for path in files_named(paths)]


def files_named(paths: str | Path | Iterable[str | Path]) -> list[Path]:
    """Return the files that paths or patterns such as ``"walks/*.bvh"`` name, sorted.

    Raises
    ------
    FileNotFoundError
        If a pattern matches no file.
    """
    given = [paths] if isinstance(paths, str | Path) else list(paths)
    found: list[str] = []
    for pattern in map(str, given):
        matches = glob(pattern) if has_magic(pattern) else [pattern]
        if not matches:
            raise FileNotFoundError(f"paths has {pattern!r}, which matches no file")
        found += matches
    return [Path(path) for path in sorted(found)]
