"""Four-legged animals to learn from: four real gait cycles of a dog, and made quadrupeds.

Both come on one skeleton, :data:`ANIMAL_SKELETON`, in metres, at the start with the trunk towards
+Z and the left on +X, with bones of constant length and joints of one meaning: a made leg bends at
the elbow and the hock as the dog's does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from probmotion.data.synthetic.cycles import repeated_cycle
from probmotion.data.synthetic.gaits import GAITS, make_gait
from probmotion.io.files import load_motion
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count, check_positive

__all__ = ["ANIMAL_SKELETON", "DOG_CLIPS", "animal_clips", "dog_clips", "synthetic_animals"]

_FPS = 30.0
_STYLES = tuple(style for style, gait in GAITS.items() if gait.body == "quadruped")

ANIMAL_SKELETON = Skeleton.preset("quadruped21")
"""The dog's joints without its fingers' and tail's ends. The made quadrupeds' own skeleton has no
hock, and a bone from the knee to the paw would not keep its length."""

DOG_CLIPS: Mapping[str, tuple[str, ...]] = {
    "train": (
        "deepmimic_dog/dog3d_canter",
        "deepmimic_dog/dog3d_pace",
        "deepmimic_dog/dog3d_spin",
    ),
    "validation": (),
    "test": ("deepmimic_dog/dog3d_trot",),
}
"""Cycles by part. Tested is on the trot: of the four, the one gait that made animals, which are
learnt from, have too. Validated is on made animals alone, for four cycles are few."""


def animal_clips(
    folder: str | Path | None = None, *, n: int = 60, seconds: float = 6.0, seed: int = 0
) -> dict[str, list[Motion]]:
    """Return the animals of each part, "train", "validation" and "test", at 30 frames a second.

    Parameters
    ----------
    folder : str or Path, optional
        Holds the dog's cycles of :data:`DOG_CLIPS` as ``.npz``; made animals alone by default.
    n : int
        Made animals to learn from; a fifth as many each, two at least, are for validation and for
        tests.
    seconds : float
        Length of a clip.
    seed : int
        Seed of what varies between made animals.

    Raises
    ------
    FileNotFoundError
        If the folder lacks one of the cycles.
    ValueError
        As :func:`dog_clips` and :func:`synthetic_animals`.
    """
    check_count("n", n)
    frames = _frames(seconds)
    held_out = max(n // 5, len(_STYLES))
    made = synthetic_animals(n + 2 * held_out, frames, _FPS, seed)
    parts = {
        "train": made[:n],
        "validation": made[n : n + held_out],
        "test": made[n + held_out :],
    }
    if folder is None:
        return parts
    dogs = dog_clips(folder, seconds=seconds)
    return {part: [*dogs[part], *clips] for part, clips in parts.items()}


def dog_clips(folder: str | Path, *, seconds: float = 6.0) -> dict[str, list[Motion]]:
    """Return the dog's cycles of each part, repeated to a length, at 30 frames per second.

    Parameters
    ----------
    folder : str or Path
        Holds the cycles of :data:`DOG_CLIPS` as ``.npz``.
    seconds : float
        Length of a clip; a cycle takes .4 to .7 seconds.

    Raises
    ------
    FileNotFoundError
        If one is missing.
    ValueError
        If a file is no cycle ("loop" of another kind than "wrap"), or has another frame rate.
    """
    frames = _frames(seconds)
    return {
        part: [_dog(Path(folder) / f"{name}.npz", frames) for name in names]
        for part, names in DOG_CLIPS.items()
    }


def synthetic_animals(
    n: int = 60, frames: int = 180, fps: float = _FPS, seed: int = 0
) -> list[Motion]:
    """Return procedural quadrupeds that walk and trot in turn, called ``quadruped-walk-0``, ….

    They are those of :mod:`probmotion.data.synthetic.gaits`, their trunk and their paws where those
    have them, with legs of a dog's proportions.

    Parameters
    ----------
    n : int
        Number of clips; a clip is the same whatever the number.
    frames : int
        Frames per clip.
    fps : float
        Frames per second.
    seed : int
        Seed of what varies between clips.
    """
    check_count("n", n)
    return [_made(number, frames, fps, seed) for number in range(n)]


def _frames(seconds: float) -> int:
    check_positive("seconds", seconds)
    return max(round(seconds * _FPS), 1)


def _dog(path: Path, frames: int) -> Motion:
    if not path.is_file():
        raise FileNotFoundError(
            f"folder has no {path.parent.name}/{path.name}, expected the dog's cycles"
        )
    with np.load(path) as archive:
        loop = str(archive["loop"]) if "loop" in archive else "none"
    cycle = load_motion(path)
    if loop != "wrap" or cycle.fps != _FPS:
        raise ValueError(
            f"folder has {path.name} with loop {loop!r} at {cycle.fps:g} frames per second, "
            f"expected a cycle (loop 'wrap') at {_FPS:g}"
        )
    clip = repeated_cycle(cycle.retarget(ANIMAL_SKELETON), frames)
    trunk = clip.positions[0, ANIMAL_SKELETON.index("neck")] - clip.positions[0, 0]
    clip = clip.turned(-float(np.arctan2(trunk[0], trunk[2])))
    begin = clip.positions[0, 0] * [1.0, 0.0, 1.0]
    return replace(clip, positions=clip.positions - begin)


# What made animals have of the dog's: where its chest and its tail are, and how a leg's length is
# shared by its bones (metres; a leg is a little longer than gaits' legs, and so never straight).
# Carpi and hocks open as a leg stretches (degrees at no and at full length, read off the dog's), so
# that a leg has one way to reach a paw.
_TRUNK_SHARE = 0.2375 / (0.2375 + 0.2813)
_TAIL = np.array([0.0, -0.04, -0.077])
_LEG_LENGTH = 0.60
_FORE = (np.array([0.19, 0.2225, 0.09]) / 0.5025 * _LEG_LENGTH, (50.0, 175.0))
_HIND = (np.array([0.2, 0.225, 0.135]) / 0.56 * _LEG_LENGTH, (95.0, 152.0))


def _made(number: int, frames: int, fps: float, seed: int) -> Motion:
    """Return the quadruped of a number: styles take turns."""
    style = _STYLES[number % len(_STYLES)]
    gait = make_gait(style, number // len(_STYLES), frames=frames, fps=fps, seed=seed)
    given = dict(zip(gait.skeleton.joint_names, gait.positions.swapaxes(0, 1), strict=True))
    pelvis, neck = given["tail"], given["neck"]
    left = _unit(given["left_hip"] - given["right_hip"])
    up = np.broadcast_to([0.0, 1.0, 0.0], left.shape)
    back = _unit(neck - pelvis)
    joints = {
        "pelvis": pelvis,
        "tail": pelvis + _TAIL[1] * up + _TAIL[2] * np.cross(left, up),
        "chest": pelvis + _TRUNK_SHARE * (neck - pelvis),
        "neck": neck,
        "head": neck + 0.5 * (given["nose"] - neck),
    }
    for side, sign in (("left", 1.0), ("right", -1.0)):
        # Shoulders go with the trunk where it tilts, as the dog's do.
        shoulder = neck + sign * 0.09 * left - 0.1 * np.cross(back, left) + 0.04 * back
        for names, top, bones, bend, behind in (
            (("shoulder", "elbow", "wrist", "front_paw"), shoulder, *_FORE, True),
            (("hip", "knee", "ankle", "back_paw"), given[f"{side}_hip"], *_HIND, False),
        ):
            paw = given[f"{side}_{names[3]}"]
            chain = _leg(top, paw, left, bones, bend, behind)
            joints.update(zip([f"{side}_{name}" for name in names], chain, strict=True))
    stacked = np.stack([joints[name] for name in ANIMAL_SKELETON.joint_names], axis=1)
    return Motion(stacked, ANIMAL_SKELETON, fps, name=gait.name)


def _leg(
    top: np.ndarray,
    paw: np.ndarray,
    left: np.ndarray,
    bones: np.ndarray,
    bend: tuple[float, float],
    behind: bool,
) -> tuple[np.ndarray, ...]:
    """Return the four joints of a leg, (L, 3) each, whose first bends behind or before it.

    The angle in the lowest of the two joints that bend follows from how far the leg is stretched;
    what is between the upper one and the paw is then a single bone of a known length.
    """
    upper, middle, lower = bones
    stretch = np.linalg.norm(paw - top, axis=-1) / bones.sum()
    angle = np.radians(bend[0] + (bend[1] - bend[0]) * stretch)
    reach = np.sqrt(middle**2 + lower**2 - 2 * middle * lower * np.cos(angle))
    first = _between(top, paw, left, upper, reach, behind)
    second = _between(first, paw, left, np.full_like(reach, middle), lower, not behind)
    return top, first, second, paw


def _between(
    top: np.ndarray,
    end: np.ndarray,
    left: np.ndarray,
    first: float | np.ndarray,
    second: float | np.ndarray,
    behind: bool,
) -> np.ndarray:
    """Return the point at two distances from two others, in the plane across ``left``."""
    line = end - top
    distance = np.linalg.norm(line, axis=-1)
    along = (first**2 - second**2 + distance**2) / (2 * distance)
    aside = np.sqrt(first**2 - along**2) * (1.0 if behind else -1.0)
    axis = line / distance[:, None]
    return top + along[:, None] * axis + aside[:, None] * np.cross(left, axis)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
