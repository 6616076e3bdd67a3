"""Clips of two people on the skeleton ``pair17``, from archives and pairs of BVH files.

See :mod:`probmotion.data.pair_sets` for dance frames, held-out clips, heights and the seed pose.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from probmotion.io.bvh import read_bvh
from probmotion.io.files import load_all
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton

__all__ = ["load_pairs", "pair_motion", "pair_of", "read_salsa_bvh"]

# Metres per unit of the BVH files of CMU's subjects 60 (lead) and 61 (follow). The conversion used
# one character for both and scaled each root's path by the ratio of leg lengths; CMU's unit is
# 0.0254/0.45 m, and the divisors were fitted to a metric conversion of trial 01 (rms 5 mm).
_SALSA_SCALES = (0.0254 / 0.45 / 0.04389, 0.0254 / 0.45 / 0.04700)
# The first frames start in the rest pose of the character, and the last frames jump.
_SALSA_START, _SALSA_END = 24, 6
_SALSA_FPS = 60.0  # the files incorrectly state 120


def load_pairs(paths: str | Path | Iterable[str | Path]) -> list[Motion]:
    """Read clips of two people.

    Parameters
    ----------
    paths : str, Path or iterable of them
        A folder of ``.npz`` files, files, or patterns such as ``"dances/*.npz"``.

    Returns
    -------
    list of Motion
        Clips on ``pair17`` (:func:`pair_of`), sorted by path and named after their files.

    Raises
    ------
    FileNotFoundError
        If no file matches.
    ValueError
        If a motion does not show two people with all joints (:func:`pair_of`).
    """
    patterns: list[str | Path] = []
    for path in map(Path, [paths] if isinstance(paths, str | Path) else paths):
        if path.is_dir() and not any(path.glob("*.npz")):
            raise FileNotFoundError(f"folder {path} contains no .npz file")
        patterns += sorted(path.glob("*.npz")) if path.is_dir() else [path]
    return [pair_of(motion) for motion in load_all(patterns)]


def pair_of(motion: Motion) -> Motion:
    """Return a motion of two people on ``pair17``, with joints matched by canonical name.

    The person with the first root becomes ``person0``. Raises ``ValueError`` unless the motion
    has two roots and all joints.
    """
    skeleton = Skeleton.preset("pair17")
    if motion.skeleton == skeleton:
        return motion
    roots = motion.skeleton.roots
    if len(roots) != 2:
        raise ValueError(f"motion must have 2 roots, one per person, got {len(roots)} in {motion}")
    people = [_person(motion, number, root) for number, root in enumerate(roots)]
    return Motion(np.concatenate(people, axis=1), skeleton, motion.fps, name=motion.name)


def pair_motion(first: Motion, second: Motion, name: str = "") -> Motion:
    """Combine the motions of two people into one on ``pair17``.

    Both motions must be in metres, share a world frame and start at the same time.

    Parameters
    ----------
    first, second : Motion
        Motions of one person each, with the same frame rate and number of frames.
    name : str
        Name of the combined motion; both names by default.

    Raises
    ------
    ValueError
        If frame rates or lengths differ, or a motion is not one person with all joints.
    """
    if first.fps != second.fps:
        raise ValueError(
            f"first and second must share a frame rate, got {first.fps:g} and {second.fps:g}; use "
            f"second.resample({first.fps:g})"
        )
    if first.frames != second.frames:
        longer = "second" if second.frames > first.frames else "first"
        raise ValueError(
            f"first and second must be equally long, got {first.frames} and {second.frames}; "
            f"use {longer}.window(start, {min(first.frames, second.frames)})"
        )
    people = []
    for number, (argument, motion) in enumerate((("first", first), ("second", second))):
        roots = motion.skeleton.roots
        if len(roots) != 1:
            raise ValueError(
                f"{argument} must have one root, got {len(roots)} in {motion}; use pair_of for a "
                "motion of two people"
            )
        people.append(_person(motion, number, roots[0]))
    name = name or f"{first.name} & {second.name}"
    return Motion(np.concatenate(people, axis=1), Skeleton.preset("pair17"), first.fps, name=name)


def read_salsa_bvh(lead: str | Path, follow: str | Path) -> Motion:
    """Read a trial of CMU's salsa from its two BVH files, in metres and at 30 fps.

    The files are the DAZ-friendly conversion of the CMU database, subjects 60 and 61, in the scaled
    version of :mod:`probmotion.data.downloads`. Each person is scaled about the origin (1.286 and
    1.201 m per unit); the first 24 and last 6 frames are cut; the rate is halved from 60 fps; the
    2 % quantile of the lowest joint's height becomes the floor, y = 0.

    Parameters
    ----------
    lead, follow : str or Path
        ``60_TT_scaled.bvh`` and ``61_TT_scaled.bvh`` of a trial TT.

    Returns
    -------
    Motion
        Motion on ``pair17``, named ``cmu_60_61_TT``.

    Raises
    ------
    ValueError
        If the files belong to different trials, differ in length, are too short or damaged.
    """
    trial = _salsa_trial(Path(lead), Path(follow))
    leader, follower = (
        read_bvh(path, scale=scale, end_sites=True)
        for path, scale in zip((lead, follow), _SALSA_SCALES, strict=True)
    )
    pair = pair_motion(leader, follower, name=f"cmu_60_61_{trial}")
    min_frames = _SALSA_START + _SALSA_END + 1
    if pair.frames < min_frames:
        raise ValueError(f"lead must have at least {min_frames} frames, got {pair.frames}")
    # The floor is estimated with the toes, which are End Sites and dropped later.
    lowest = np.stack([motion.positions[..., 1].min(axis=1) for motion in (leader, follower)])
    floor = np.percentile(lowest, 2)
    positions = pair.positions[_SALSA_START : pair.frames - _SALSA_END : 2]
    return Motion(positions - [0.0, floor, 0.0], pair.skeleton, _SALSA_FPS / 2, name=pair.name)


def _salsa_trial(lead: Path, follow: Path) -> str:
    """Return the trial number, two digits."""
    trials = []
    for argument, path, subject in (("lead", lead, "60"), ("follow", follow, "61")):
        match = re.fullmatch(rf"{subject}_(\d\d)(_scaled)?", path.stem)
        if match is None:
            raise ValueError(
                f"{argument} must be named {subject}_TT_scaled.bvh, TT being the trial, got "
                f"{path.name!r}"
            )
        trials.append(match[1])
    if trials[0] != trials[1]:
        raise ValueError(f"lead and follow must belong to one trial, got {' and '.join(trials)}")
    return trials[0]


def _person(motion: Motion, number: int, root: int) -> np.ndarray:
    """Return the positions (L, 17, 3) of the person below ``root``."""
    skeleton = motion.skeleton
    tree = [j for j in range(skeleton.n_joints) if j == root or root in skeleton.ancestors(j)]
    # Canonical names of a sub-skeleton drop the common prefix, the person's name.
    names = skeleton.subset(tree).canonical_names
    required = Skeleton.preset("person17").joint_names
    missing = [name for name in required if names.count(name) != 1]
    if missing:
        raise ValueError(
            f"person {number} (root {skeleton.joint_names[root]!r}) of {motion} must have the "
            f"joints of person17, but lacks {', '.join(missing)}"
        )
    return motion.positions[:, [tree[names.index(name)] for name in required]]
