"""Clips of one person to learn denoising from: real ones, apart by clip, and made ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from probmotion.data.synthetic.gaits import GAITS, make_gait
from probmotion.io.files import load_motion
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count, check_positive

__all__ = ["DENOISING_CLIPS", "denoising_clips", "synthetic_denoising_clips"]

_FPS = 30.0
_FRAMES = 30

DENOISING_CLIPS: Mapping[str, tuple[str, ...]] = {
    "train": (
        *(f"cmu_single/cmu_01_{trial:02}" for trial in (*range(1, 9), 10, 11, 12, 14)),
        *(f"cmu_single/cmu_02_{trial:02}" for trial in (1, 3, 4, 5, 6, 8, 10)),
        "cmu_single/cmu_131_01",
        "deepmimic_human/humanoid3d_backflip",
        "deepmimic_human/humanoid3d_cartwheel",
        "deepmimic_human/humanoid3d_crawl",
        "deepmimic_human/humanoid3d_dance_a",
        "deepmimic_human/humanoid3d_dance_spin",
        "deepmimic_human/humanoid3d_getup_facedown",
        "deepmimic_human/humanoid3d_long_walk1",
        "deepmimic_human/humanoid3d_long_walk2",
        "deepmimic_human/humanoid3d_long_zombie",
        "deepmimic_human/humanoid3d_punch",
        "deepmimic_human/humanoid3d_roll",
        "deepmimic_human/humanoid3d_sideflip",
        "deepmimic_human/humanoid3d_spin",
        "deepmimic_human/humanoid3d_spinkick",
        "deepmimic_human/humanoid3d_stealthy_walk0",
    ),
    "validation": (
        "cmu_single/cmu_01_09",
        "cmu_single/cmu_02_09",
        "deepmimic_human/humanoid3d_jump",
        "deepmimic_human/humanoid3d_stealthy_walk",
    ),
    "test": (
        "cmu_single/cmu_01_13",
        "cmu_single/cmu_02_02",
        "cmu_single/cmu_02_07",
        "cmu_single/cmu_131_02",
        "deepmimic_human/humanoid3d_getup_faceup",
        "deepmimic_human/humanoid3d_long_walk3",
    ),
}
"""Clips by part: 45 of the 48 of one person, the held-out ones held out whole.

Tested are a climb (``cmu_01_13``; twelve others are learnt from), a walk (``cmu_02_02``), sword
play (``cmu_02_07``; of two other trials one is learnt from, one validated on), a dance
(``cmu_131_02``; ``cmu_131_01`` is learnt from), DeepMimic's walk (``humanoid3d_long_walk3``), and
what nothing that is learnt is like: getting up from the back (``humanoid3d_getup_faceup``).
Validated on are a climb, sword play, a jump and a sneaking walk.

Left out are two excerpts, ``humanoid3d_walk`` of ``humanoid3d_long_walk1`` and
``humanoid3d_zombie_walk`` of ``humanoid3d_long_zombie``, and ``humanoid3d_jog``, which is shorter
than a window.
"""

_STYLES = tuple(style for style, gait in GAITS.items() if gait.body == "person")


def denoising_clips(folder: str | Path) -> dict[str, list[Motion]]:
    """Return the clips of each part on ``person14`` at 30 frames per second.

    A clip with frames that its file marks as ``suspect`` (its markers jump there) comes as the
    pieces between them, called ``cmu_01_07-0`` and so on: no window holds such a frame.

    Parameters
    ----------
    folder : str or Path
        Holds the clips of :data:`DENOISING_CLIPS` as ``.npz``.

    Raises
    ------
    FileNotFoundError
        If one is missing.
    ValueError
        If a file's ``suspect`` is not one truth value per frame.
    """
    return {
        part: [piece for name in names for piece in _pieces(Path(folder) / f"{name}.npz")]
        for part, names in DENOISING_CLIPS.items()
    }


def synthetic_denoising_clips(
    n: int = 60, *, seconds: float = 4.0, seed: int = 0
) -> dict[str, list[Motion]]:
    """Return people who walk, run and march, made by the project, for where there are no clips.

    They are on ``person14`` at 30 frames per second, in the parts of :func:`denoising_clips`.

    Parameters
    ----------
    n : int
        Number of clips to learn from; a fifth as many each, of every style one at least, are for
        validation and for tests.
    seconds : float
        Length of a clip.
    seed : int
        Seed of what varies between clips.
    """
    check_count("n", n)
    check_positive("seconds", seconds)
    held_out = max(n // 5, len(_STYLES))
    skeleton = Skeleton.preset("person14")
    frames = max(round(seconds * _FPS), 1)
    parts: dict[str, list[Motion]] = {}
    first = 0
    for part, size in (("train", n), ("validation", held_out), ("test", held_out)):
        parts[part] = [
            _made(number, frames, seed).retarget(skeleton) for number in range(first, first + size)
        ]
        first += size
    return parts


def _made(number: int, frames: int, seed: int) -> Motion:
    """Return the gait of a number: styles take turns."""
    style = _STYLES[number % len(_STYLES)]
    return make_gait(style, number // len(_STYLES), frames=frames, fps=_FPS, seed=seed)


def _pieces(path: Path) -> list[Motion]:
    """Return what lies between a clip's suspect frames, each piece at least a window long."""
    motion = load_motion(path).retarget(Skeleton.preset("person14"))
    with np.load(path) as archive:
        suspect = archive["suspect"] if "suspect" in archive else np.zeros(motion.frames, bool)
    if suspect.dtype != bool or suspect.shape != (motion.frames,):
        raise ValueError(
            f"folder has {path.name} with suspect of {suspect.dtype} and shape {suspect.shape}, "
            f"expected {motion.frames} truth values, one per frame"
        )
    if not suspect.any():
        return [motion.resample(_FPS)]
    edges = np.flatnonzero(np.diff(suspect, prepend=True, append=True))
    pieces = [motion.window(start, stop - start) for start, stop in edges.reshape(-1, 2).tolist()]
    whole = [piece.resample(_FPS) for piece in pieces]
    kept = [piece for piece in whole if piece.frames >= _FRAMES]
    return [replace(piece, name=f"{motion.name}-{number}") for number, piece in enumerate(kept)]
