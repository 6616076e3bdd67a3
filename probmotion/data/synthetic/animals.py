"""Clips of four-legged animals: four recorded cycles of a dog, and procedural quadrupeds.

All clips use :data:`ANIMAL_SKELETON`, in metres, with constant bone lengths; in the first frame the
trunk points to +Z and the left side to +X.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from probmotion import seeds
from probmotion.data.synthetic.cycles import repeated_cycle
from probmotion.data.synthetic.gaits import GAITS, make_gait
from probmotion.files import read_arrays
from probmotion.io.files import load
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count, check_positive

__all__ = [
    "ANIMAL_SKELETON",
    "DOG_CLIPS",
    "VARIED_TRUNKS",
    "animal_clips",
    "dog_clips",
    "synthetic_animals",
]

_FPS = 30.0
_STYLES = tuple(style for style, gait in GAITS.items() if gait.body == "quadruped")

ANIMAL_SKELETON = Skeleton.preset("quadruped21")
"""Skeleton of all clips: the joints of the recorded dog without the tips of paws and tail."""

DOG_CLIPS: Mapping[str, tuple[str, ...]] = {
    "train": tuple(f"deepmimic_dog/dog3d_{name}" for name in ("canter", "pace", "spin")),
    "validation": (),
    "test": ("deepmimic_dog/dog3d_trot",),
}
"""Recorded cycles of the dog by part of the split. The trot is held out because the synthetic
animals trot as well. Four cycles are too few for a recorded validation part."""


VARIED_TRUNKS = (0.65, 1.05)
"""Range of trunk lengths relative to those of gaits; the recorded dog is at .72."""


def animal_clips(
    folder: str | Path | None = None,
    *,
    n: int = 60,
    seconds: float = 6.0,
    seed: int = 0,
    trunks: tuple[float, float] = (1.0, 1.0),
) -> dict[str, list[Motion]]:
    """Return animal clips in the parts "train", "validation" and "test", at 30 fps.

    The training part has ``n`` synthetic clips of ``seconds`` s; validation and test have n / 5
    each, at least 2. ``seed`` is the seed of these clips, ``trunks`` the range of their trunk
    lengths (:func:`synthetic_animals`). If ``folder`` is given, its recorded dog clips
    (:func:`dog_clips`) are added.
    """
    check_count("n", n)
    frames = _frames(seconds)
    held_out = max(n // 5, len(_STYLES))
    clips = synthetic_animals(n + 2 * held_out, frames, _FPS, seed, trunks=trunks)
    end = n + held_out
    parts = {"train": clips[:n], "validation": clips[n:end], "test": clips[end:]}
    if folder is None:
        return parts
    dogs = dog_clips(folder, seconds=seconds)
    return {part: [*dogs[part], *synthetic] for part, synthetic in parts.items()}


def dog_clips(folder: str | Path, *, seconds: float = 6.0) -> dict[str, list[Motion]]:
    """Return the dog's cycles of each part, repeated for ``seconds``, at 30 fps.

    ``folder`` contains the cycles of :data:`DOG_CLIPS` (0.4 to 0.7 s) as ``.npz``. Raises
    ``FileNotFoundError`` if a file is missing, and ``ValueError`` if a file is not a cycle
    (``loop`` other than "wrap") or has another frame rate.
    """
    frames = _frames(seconds)
    return {
        part: [_dog_clip(Path(folder) / f"{name}.npz", frames) for name in names]
        for part, names in DOG_CLIPS.items()
    }


def synthetic_animals(
    n: int = 60,
    frames: int = 180,
    fps: float = _FPS,
    seed: int = 0,
    *,
    trunks: tuple[float, float] = (1.0, 1.0),
) -> list[Motion]:
    """Return ``n`` procedural quadrupeds of ``frames`` frames at ``fps`` frames per second.

    Clips of walk and trot alternate, named ``quadruped-walk-0``, …. Trunk and paws follow
    :mod:`probmotion.data.synthetic.gaits`; the legs have a dog's proportions. Lengths of trunks
    relative to those of the gaits are uniform in ``trunks``; front paws are displaced with the
    shoulders. A clip depends only on its number and ``seed``.
    """
    check_count("n", n)
    shortest, longest = trunks
    if not 0 < shortest <= longest < np.inf:
        raise ValueError(
            f"trunks must be two finite numbers above 0, the first at most the second, got {trunks}"
        )
    factors = [seeds.generator(seed, "trunk", number).uniform(*trunks) for number in range(n)]
    return [_quadruped(number, frames, fps, seed, trunk) for number, trunk in enumerate(factors)]


def _frames(seconds: float) -> int:
    check_positive("seconds", seconds)
    return max(round(seconds * _FPS), 1)


def _dog_clip(path: Path, frames: int) -> Motion:
    if not path.is_file():
        name = f"{path.parent.name}/{path.name}"
        raise FileNotFoundError(f"folder must contain {name}, got none")
    loop = str(read_arrays(path).get("loop", "none"))
    cycle = load(path)
    if loop != "wrap" or cycle.fps != _FPS:
        raise ValueError(
            f"{path.name} must be a cycle (loop 'wrap') at {_FPS:g} fps, got loop {loop!r} at "
            f"{cycle.fps:g} fps"
        )
    clip = repeated_cycle(cycle.retarget(ANIMAL_SKELETON), frames)
    trunk = clip.positions[0, ANIMAL_SKELETON.index("neck")] - clip.positions[0, 0]
    clip = clip.turned(-float(np.arctan2(trunk[0], trunk[2])))
    start = clip.positions[0, 0] * [1.0, 0.0, 1.0]
    return replace(clip, positions=clip.positions - start)


# Proportions of the recorded dog, metres. Legs are slightly longer than in make_gait, so that they
# are never fully straight. _FORE and _HIND are bone lengths and the angle of carpus or hock at zero
# and full extension of the leg, degrees; the angle depends on the extension alone.
_TRUNK_FRACTION = 0.2375 / (0.2375 + 0.2813)
_TAIL = np.array([0.0, -0.04, -0.077])
_LEG_LENGTH = 0.60
_FORE = (np.array([0.19, 0.2225, 0.09]) / 0.5025 * _LEG_LENGTH, (50.0, 175.0))
_HIND = (np.array([0.2, 0.225, 0.135]) / 0.56 * _LEG_LENGTH, (95.0, 152.0))


def _quadruped(number: int, frames: int, fps: float, seed: int, trunk: float) -> Motion:
    """Return quadruped ``number`` with a relative length of the trunk; the styles alternate."""
    style = _STYLES[number % len(_STYLES)]
    gait = make_gait(style, number // len(_STYLES), frames=frames, fps=fps, seed=seed)
    joint = dict(zip(gait.skeleton.joint_names, gait.positions.swapaxes(0, 1), strict=True))
    pelvis = joint["tail"]
    shift = (trunk - 1.0) * (joint["neck"] - pelvis)
    for name in ("neck", "nose", "left_front_paw", "right_front_paw"):
        joint[name] = joint[name] + shift
    neck = joint["neck"]
    left = _unit(joint["left_hip"] - joint["right_hip"])
    up = np.broadcast_to([0.0, 1.0, 0.0], left.shape)
    back = _unit(neck - pelvis)
    joints = {
        "pelvis": pelvis,
        "tail": pelvis + _TAIL[1] * up + _TAIL[2] * np.cross(left, up),
        "chest": pelvis + _TRUNK_FRACTION * (neck - pelvis),
        "neck": neck,
        "head": neck + 0.5 * (joint["nose"] - neck),
    }
    for side, sign in (("left", 1.0), ("right", -1.0)):
        # Shoulders tilt with the trunk.
        shoulder = neck + sign * 0.09 * left - 0.1 * np.cross(back, left) + 0.04 * back
        for names, top, bones, bend, first_side in (
            (("shoulder", "elbow", "wrist", "front_paw"), shoulder, *_FORE, 1.0),
            (("hip", "knee", "ankle", "back_paw"), joint[f"{side}_hip"], *_HIND, -1.0),
        ):
            paw = joint[f"{side}_{names[3]}"]
            chain = _leg(top, paw, left, bones, bend, first_side)
            joints.update(zip([f"{side}_{name}" for name in names], chain, strict=True))
    stacked = np.stack([joints[name] for name in ANIMAL_SKELETON.joint_names], axis=1)
    return Motion(stacked, ANIMAL_SKELETON, fps, name=gait.name)


def _leg(
    top: np.ndarray,
    paw: np.ndarray,
    left: np.ndarray,
    bones: np.ndarray,
    bend: tuple[float, float],
    side: float,
) -> tuple[np.ndarray, ...]:
    """Return the four joints of a leg, (L, 3) each; the second points backwards for ``side`` 1.

    The extension of the leg determines the angle of the lower two bones, which act as one bone.
    """
    upper, middle, lower = bones
    stretch = np.linalg.norm(paw - top, axis=-1) / bones.sum()
    angle = np.radians(bend[0] + (bend[1] - bend[0]) * stretch)
    reach = np.sqrt(middle**2 + lower**2 - 2 * middle * lower * np.cos(angle))

    def between(start: np.ndarray, first: float, second: float, side: float) -> np.ndarray:
        """Return the point at given distances from start and paw, in the plane normal to left."""
        line = paw - start
        distance = np.linalg.norm(line, axis=-1)
        along = (first**2 - second**2 + distance**2) / (2 * distance)
        across = np.sqrt(first**2 - along**2) * side
        axis = line / distance[:, None]
        return start + along[:, None] * axis + across[:, None] * np.cross(left, axis)

    knee = between(top, upper, reach, side)
    return top, knee, between(knee, middle, lower, -side), paw


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
