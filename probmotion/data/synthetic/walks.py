"""Walking clips: recorded clips for training the prior ``walk2d``, and synthetic walks."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from probmotion.data.synthetic.animals import ANIMAL_SKELETON, synthetic_animals
from probmotion.data.synthetic.gaits import make_gait, make_gaits
from probmotion.io.files import load
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton

__all__ = ["WALK_CLIPS", "shared_skeleton", "synthetic_walks", "walk_clips"]

_STYLES = ("walk", "quadruped-walk")

WALK_CLIPS: Mapping[str, tuple[str, ...]] = {
    "train": (
        "deepmimic_human/humanoid3d_long_walk1",
        "deepmimic_human/humanoid3d_long_walk2",
        "deepmimic_human/humanoid3d_stealthy_walk0",
        "cmu_single/cmu_02_01",
    ),
    "validation": ("cmu_single/cmu_02_02",),
    "test": ("deepmimic_human/humanoid3d_long_walk3", "deepmimic_human/humanoid3d_stealthy_walk"),
}
"""Clips by part of the split, 3352 frames at 30 fps. Excerpts of other clips (humanoid3d_walk,
humanoid3d_zombie_walk), styles with a single clip (zombie) and runs are excluded."""


def walk_clips(folder: str | Path) -> dict[str, list[Motion]]:
    """Return the recorded walks of each part, read from ``.npz`` files below ``folder``.

    Raises
    ------
    FileNotFoundError
        If a clip is missing.
    """
    return {
        part: [load(Path(folder) / f"{name}.npz") for name in names]
        for part, names in WALK_CLIPS.items()
    }


def synthetic_walks(
    n: int = 60,
    skeleton: Skeleton | None = None,
    *,
    seconds: float = 6.0,
    fps: float = 30.0,
) -> list[Motion]:
    """Return ``n`` procedural walks of ``seconds`` s at ``fps`` frames per second.

    The body is a person, or a quadruped if the person lacks a joint of ``skeleton``. Raises
    ``ValueError`` if the quadruped lacks a joint too.
    """
    required = set() if skeleton is None else set(skeleton.canonical_names)
    for style in _STYLES:
        if required <= set(make_gait(style).skeleton.canonical_names):
            return make_gaits(n, styles={style: 1.0}, frames=round(seconds * fps), fps=fps)
    if required <= set(ANIMAL_SKELETON.canonical_names):
        return synthetic_animals(n, round(seconds * fps), fps)
    raise ValueError(
        f"skeleton must have joints of a person or a quadruped, got {', '.join(sorted(required))}"
    )


def shared_skeleton(skeleton: Skeleton) -> Skeleton | None:
    """Return the part of a skeleton that a body of :func:`synthetic_walks` also has.

    Joints are matched by canonical names with the body, person or quadruped, that shares more
    bones. A joint whose parent is dropped becomes a root. Returns None if no bone is shared.
    """
    bodies = [make_gait(style).skeleton.canonical_names for style in _STYLES]
    known = [[name in body for name in skeleton.canonical_names] for body in bodies]
    n_bones = [sum(flags[j] and flags[p] for j, p in skeleton.bones) for flags in known]
    best = known[int(np.argmax(n_bones))]
    if all(best) or not any(n_bones):
        return skeleton if any(n_bones) else None
    joints = [joint for joint, is_known in enumerate(best) if is_known]
    parents = [skeleton.parents[joint] for joint in joints]
    names = [skeleton.joint_names[joint] for joint in joints]
    return Skeleton(names, [joints.index(p) if p in joints else -1 for p in parents])
