"""People who walk: the real clips that the prior ``walk2d`` is about, and made ones."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from probmotion.data.synthetic.animals import ANIMAL_SKELETON, synthetic_animals
from probmotion.data.synthetic.gaits import make_gait, make_gaits
from probmotion.io.files import load_motion
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
    "test": (
        "deepmimic_human/humanoid3d_long_walk3",
        "deepmimic_human/humanoid3d_stealthy_walk",
    ),
}
"""Clips by part, 3352 frames at 30 a second. Left out are excerpts of others (humanoid3d_walk is,
in the median, 1 cm from humanoid3d_long_walk1, humanoid3d_zombie_walk is one of
humanoid3d_long_zombie), what has one clip only and so cannot be held out (the zombie), and runs."""


def walk_clips(folder: str | Path) -> dict[str, list[Motion]]:
    """Return the clips of each part, from a folder that holds them as ``.npz``.

    Raises
    ------
    FileNotFoundError
        If one is missing.
    """
    return {
        part: [load_motion(Path(folder) / f"{name}.npz") for name in names]
        for part, names in WALK_CLIPS.items()
    }


def synthetic_walks(
    n: int = 60,
    skeleton: Skeleton | None = None,
    *,
    seconds: float = 6.0,
    fps: float = 30.0,
) -> list[Motion]:
    """Return bodies that walk, made by the project itself, for where there are no clips.

    Parameters
    ----------
    n : int
        Number of clips.
    skeleton : Skeleton, optional
        What the clips must have the joints of: quadrupeds walk where it is one's; people by
        default.
    seconds, fps : float
        Length of a clip, and its frames per second.

    Raises
    ------
    ValueError
        If neither people nor quadrupeds have the joints.
    """
    wanted = set() if skeleton is None else set(skeleton.canonical_names)
    for style in _STYLES:
        if wanted <= set(make_gait(style).skeleton.canonical_names):
            return make_gaits(n, styles={style: 1.0}, frames=round(seconds * fps), fps=fps)
    if wanted <= set(ANIMAL_SKELETON.canonical_names):
        return synthetic_animals(n, round(seconds * fps), fps)
    raise ValueError(
        f"skeleton has the joints {', '.join(sorted(wanted))}, expected those of a person or a "
        "quadruped: bodies are made of no others"
    )


def shared_skeleton(skeleton: Skeleton) -> Skeleton | None:
    """Return the joints, by canonical names, that a body of :func:`synthetic_walks` has too.

    Of people and quadrupeds, it is the body that has both ends of more of the skeleton's bones;
    people where that is the same. A joint whose parent is left out becomes a root. None where no
    bone is shared: then neither body is like the skeleton.
    """
    found: Skeleton | None = None
    for style in _STYLES:
        part = _joints_of(make_gait(style).skeleton, skeleton)
        if part is not None and len(part.bones) > (0 if found is None else len(found.bones)):
            found = part
    return found


def _joints_of(body: Skeleton, skeleton: Skeleton) -> Skeleton | None:
    """Return what is left of the skeleton without the joints that the body lacks."""
    known = [name in body.canonical_names for name in skeleton.canonical_names]
    if all(known):
        return skeleton
    kept = [joint for joint, there in enumerate(known) if there]
    above = [skeleton.parents[joint] for joint in kept]
    names = [skeleton.joint_names[joint] for joint in kept]
    return Skeleton(names, [kept.index(p) if p in kept else -1 for p in above]) if kept else None
