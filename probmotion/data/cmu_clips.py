"""Single clips of one person in the CMU database by name: from archives, or from its own files."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from probmotion.data.downloads import data_places
from probmotion.io.amc import read_amc
from probmotion.io.errors import MotionFileError
from probmotion.io.files import load_motion
from probmotion.motion.motion import Motion

__all__ = ["cmu_clip"]

_FPS = 30.0
_SOURCE_FPS = 120.0
_FRAMES = 900
_NAME = re.compile(r"cmu_(?P<subject>\d{2,3})_(?P<trial>\d{2})", re.ASCII)
_DATASET = "cmu-01-02-03"
_SUBJECTS = ("01", "02", "03")  # of the data set
_PLACE = "as folder= or in the environment variable PROBMOTION_DATA"


def cmu_clip(name: str, folder: str | Path | None = None) -> Motion:
    """Return a clip of one person from the CMU database, from where it is found first.

    Looked at are the folders of :func:`~probmotion.data.downloads.data_places`. One holds the clip
    as an archive (``cmu_02_02.npz``, or below ``cmu_single``) or as the database's own files
    (``02.asf`` and ``02_02.amc``, or below ``cmu-01-02-03``), of which every fourth frame is
    taken. Both give the same numbers, which are rounded to single precision and end after 30
    seconds.

    Parameters
    ----------
    name : str
        The subject and the trial: ``"cmu_02_02"``.
    folder : str or Path, optional
        Where it is.

    Returns
    -------
    Motion
        At 30 frames per second, on the database's 31 joints (38 in the archives of subject 131).

    Raises
    ------
    ValueError
        If ``name`` is no such name.
    FileNotFoundError
        If it is nowhere; the message says how to get it. Nothing is fetched.
    MotionFileError
        If the file that is found is damaged, or an archive of another rate.
    """
    match = _NAME.fullmatch(name) if isinstance(name, str) else None
    if match is None:
        raise ValueError(f"name must be a subject and a trial, such as 'cmu_02_02', got {name!r}")
    subject, trial = match["subject"], match["trial"]
    places = data_places(folder)
    for place in places:
        for archive in (place / "cmu_single" / f"{name}.npz", place / f"{name}.npz"):
            if archive.is_file():
                return _shortened(_archived(archive), name)
        for originals in (place / _DATASET, place):
            skeleton = originals / f"{subject}.asf"
            motion = originals / f"{subject}_{trial}.amc"
            if skeleton.is_file() and motion.is_file():
                return _shortened(_thinned(read_amc(motion, skeleton, _SOURCE_FPS)), name)
    raise FileNotFoundError(
        f"the clip {name} is not in {', '.join(map(str, places))}; {_way_to_get(subject, trial)}"
    )


def _archived(path: Path) -> Motion:
    """Return the motion of an archive."""
    motion = load_motion(path)
    if motion.fps != _FPS:
        raise MotionFileError(
            f"{path} has {motion.fps:g} frames per second, expected {_FPS:g}: a clip of a known "
            "name is the same everywhere"
        )
    return motion


def _thinned(motion: Motion) -> Motion:
    """Return the frames that an archive has of an original, rounded as there."""
    step = round(motion.fps / _FPS)
    return replace(motion, positions=motion.positions[::step].astype(np.float32), fps=_FPS)


def _shortened(motion: Motion, name: str) -> Motion:
    """Return the clip's first 30 seconds under its name."""
    return replace(motion.window(0, min(motion.frames, _FRAMES)), name=name)


def _way_to_get(subject: str, trial: str) -> str:
    """Return what the error says of a clip that is nowhere."""
    if subject not in _SUBJECTS:
        return f"give the folder that holds its archive, {_PLACE}"
    names = f'["{subject}.asf", "{subject}_{trial}.amc"]'
    return (
        f'probmotion.data.downloads.download("{_DATASET}", names={names}) fetches it, or give the '
        f"folder that holds it, {_PLACE}"
    )
