"""Loading of clips of one person from the CMU database by name."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from probmotion.data.downloads import data_places
from probmotion.io.amc import read_amc
from probmotion.io.errors import MotionFileError
from probmotion.io.files import load
from probmotion.motion.motion import Motion

__all__ = ["cmu_clip"]

_FPS = 30.0
_SOURCE_FPS = 120.0
_FRAMES = 900  # maximum length of a clip, 30 s
_NAME = re.compile(r"cmu_(?P<subject>\d{2,3})_(?P<trial>\d{2})", re.ASCII)
_DATASET = "cmu-01-02-03"
_SUBJECTS = ("01", "02", "03")  # subjects of _DATASET
_FOLDER_OPTION = "as folder= or in the environment variable PROBMOTION_DATA"


def cmu_clip(name: str, folder: str | Path | None = None) -> Motion:
    """Return a clip of one person from the CMU database.

    Searches the folders of :func:`~probmotion.data.downloads.data_places` for an archive
    (``cmu_02_02.npz``, or below ``cmu_single``) or the original files (``02.asf`` and
    ``02_02.amc``, or below ``cmu-01-02-03``), of which every fourth frame is used. Both sources
    yield identical single-precision positions of at most 30 seconds. Nothing is downloaded.

    Parameters
    ----------
    name : str
        Subject and trial, such as ``"cmu_02_02"``.
    folder : str or Path, optional
        Folder to search instead of the default folders.

    Returns
    -------
    Motion
        Clip at 30 frames per second, with 31 joints (38 in the archives of subject 131).

    Raises
    ------
    ValueError
        If ``name`` is malformed.
    FileNotFoundError
        If no file of the clip exists; the message explains how to obtain it.
    MotionFileError
        If the file is damaged, or the frame rate of an archive is not 30.
    """
    match = _NAME.fullmatch(name) if isinstance(name, str) else None
    if match is None:
        raise ValueError(f"name must be a subject and a trial, such as 'cmu_02_02', got {name!r}")
    subject, trial = match["subject"], match["trial"]
    folders = data_places(folder)
    for candidate in folders:
        for archive in (candidate / "cmu_single" / f"{name}.npz", candidate / f"{name}.npz"):
            if archive.is_file():
                return _first_seconds(load(archive), name, archive)
        for originals in (candidate / _DATASET, candidate):
            skeleton = originals / f"{subject}.asf"
            motion = originals / f"{subject}_{trial}.amc"
            if skeleton.is_file() and motion.is_file():
                clip = read_amc(motion, skeleton, _SOURCE_FPS)
                # Single precision, as in the archives.
                positions = clip.positions[:: round(_SOURCE_FPS / _FPS)].astype(np.float32)
                return _first_seconds(replace(clip, positions=positions, fps=_FPS), name, motion)
    remedy = f"pass the folder with its archive {_FOLDER_OPTION}"
    if subject in _SUBJECTS:
        names = f'["{subject}.asf", "{subject}_{trial}.amc"]'
        remedy = (
            f'probmotion.data.downloads.download("{_DATASET}", names={names}) downloads it, or '
            f"pass the folder with the files {_FOLDER_OPTION}"
        )
    raise FileNotFoundError(f"clip {name} is not in {', '.join(map(str, folders))}; {remedy}")


def _first_seconds(motion: Motion, name: str, path: Path) -> Motion:
    """Return the first 30 seconds of a clip under ``name``."""
    if motion.fps != _FPS:
        raise MotionFileError(f"{path} must have {_FPS:g} frames per second, got {motion.fps:g}")
    return replace(motion.window(0, min(motion.frames, _FRAMES)), name=name)
