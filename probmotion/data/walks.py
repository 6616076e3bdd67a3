"""People who walk: the real clips that the prior ``walk2d`` is about, and made ones."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from probmotion.data.gaits import make_gait, make_gaits
from probmotion.motion import Motion, load_motion
from probmotion.skeleton import Skeleton

__all__ = ["WALK_CLIPS", "made_walks", "walk_clips"]

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


def made_walks(
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
    for style in ("walk", "quadruped-walk"):
        if wanted <= set(make_gait(style).skeleton.canonical_names):
            return make_gaits(n, styles={style: 1.0}, frames=round(seconds * fps), fps=fps)
    raise ValueError(
        f"skeleton has the joints {', '.join(sorted(wanted))}, expected those of a person or a "
        "quadruped: bodies are made of no others"
    )
