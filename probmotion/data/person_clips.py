"""Recorded clips of one person by action, split by clip into training, validation and test.

``person_clips.csv`` lists the action and the part of each clip:

- ``test``: the test clips of the earlier splits (``WALK_CLIPS``, ``DENOISING_CLIPS``), and the
  clips of ``cmu_actions`` whose number is a multiple of five
- ``validation``: the other validation clips of the denoising study, and the clips of
  ``cmu_actions`` before those of its test part
- ``unseen``: all clips of one action, soccer, which is in no other part
- ``excluded``: two excerpts of other clips, and a clip shorter than a second
- ``train``: all others

The column ``corrector`` has the parts of ``cmu_actions`` in the training of ``joint-corrector``,
which differ, as it was trained before this split.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from probmotion.files import read_arrays
from probmotion.io.files import load
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton

__all__ = [
    "LEARNT_PARTS", "action_clips", "clip_segments", "clips_of_actions", "moving_clips",
    "on_person",
]  # fmt: skip

LEARNT_PARTS = ("train", "validation", "test")
"""Parts of the split by clip; clips of other parts are in none of them."""

_FPS = 30.0
_FRAMES = 30  # of the shortest segment
_TABLE = Path(__file__).with_suffix(".csv")


def clips_of_actions(*actions: str) -> dict[str, tuple[str, ...]]:
    """Return the names of the clips of actions, such as ``"walking"``, by :data:`LEARNT_PARTS`.

    A name is folder and file, such as ``"cmu_actions/walking_1"``. Raises ``ValueError`` for an
    action without clips in these parts.
    """
    with _TABLE.open(encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["part"] in LEARNT_PARTS]
    known = sorted({row["action"] for row in rows})
    if unknown := [action for action in actions if action not in known]:
        raise ValueError(f"actions must be of {', '.join(known)}, got {unknown[0]!r}")
    return {
        part: tuple(row["clip"] for row in rows if row["part"] == part and row["action"] in actions)
        for part in LEARNT_PARTS
    }


def moving_clips(folder: str | Path) -> dict[str, list[Motion]]:
    """Return the clips of walking, running and jumping by part, on ``person14`` at 30 fps.

    ``folder`` contains the clips of :func:`clips_of_actions` as ``.npz``; they are split at marker
    jumps by :func:`clip_segments`. Raises ``FileNotFoundError`` if a file is missing.
    """
    return {
        part: [
            segment
            for name in names
            for segment in clip_segments(Path(folder) / f"{name}.npz", on_person)
        ]
        for part, names in clips_of_actions("walking", "running", "jumping").items()
    }


def action_clips(folder: str | Path) -> dict[str, list[Motion]]:
    """Return the clips of ``cmu_actions`` by their part in the training of ``joint-corrector``.

    Motions are on ``person14`` at 30 fps.
    The prior ``cmu-motion`` was fitted to all of them but soccer, a part of its own; who uses the
    validation and test parts fits a prior to the training part. ``folder`` and errors are those of
    :func:`moving_clips`.
    """
    with _TABLE.open(encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["corrector"]]
    return {
        part: [
            on_person(load(Path(folder) / f"{row['clip']}.npz")).resample(_FPS)
            for row in rows
            if row["corrector"] == part
        ]
        for part in (*LEARNT_PARTS, "soccer")
    }


def on_person(motion: Motion) -> Motion:
    """Return the motion on ``person14``."""
    return motion.retarget(Skeleton.preset("person14"))


def clip_segments(path: Path, convert: Callable[[Motion], Motion]) -> list[Motion]:
    """Return the converted segments of at least a second between marker jumps, at 30 fps.

    Jumps are frames marked as ``suspect`` in the file. Segments are named ``cmu_01_07-0``, …, or as
    the clip without jumps. Raises ``ValueError`` if ``suspect`` is not one bool per frame.
    """
    motion = convert(load(path))
    suspect = read_arrays(path).get("suspect", np.zeros(motion.frames, bool))
    if suspect.dtype != bool or suspect.shape != (motion.frames,):
        raise ValueError(
            f"{path.name}: suspect must be bool of shape ({motion.frames},), got {suspect.dtype} "
            f"of shape {suspect.shape}"
        )
    if not suspect.any():
        return [motion.resample(_FPS)]
    edges = np.flatnonzero(np.diff(suspect, prepend=True, append=True)).reshape(-1, 2).tolist()
    segments = [motion.window(start, stop - start).resample(_FPS) for start, stop in edges]
    long = [segment for segment in segments if segment.frames >= _FRAMES]
    return [replace(segment, name=f"{motion.name}-{number}") for number, segment in enumerate(long)]
