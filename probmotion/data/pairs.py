"""Clips of two people as motions of one skeleton, ``pair17``: from archives and pairs of BVH files.

What is done with them (which frames are the dance, whole clips held out, heights, the seed) is in
:mod:`probmotion.data.pair_sets`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from probmotion.data.pair_sets import (
    SALSA_HELD_OUT,
    choose_seed,
    dance_frames,
    describe_dance_frames,
    ground_truth,
    hold_out,
    person_height,
    scaled_to_height,
)
from probmotion.io.bvh import read_bvh
from probmotion.io.files import load_motions
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton

__all__ = [
    "SALSA_HELD_OUT",
    "choose_seed",
    "dance_frames",
    "describe_dance_frames",
    "ground_truth",
    "hold_out",
    "load_pairs",
    "pair_motion",
    "pair_of",
    "person_height",
    "read_salsa_bvh",
    "scaled_to_height",
]

# Metres per unit of the files of CMU's subjects 60 (lead) and 61 (follow). Their conversion put
# both on one figure and scaled each root's path by the ratio of the legs; 0.0254/0.45 m is CMU's
# unit, and the divisors were fitted to a metric conversion of trial 01 (rms residual 5 mm).
_SALSA_SCALES = (0.0254 / 0.45 / 0.04389, 0.0254 / 0.45 / 0.04700)
# The bodies come out of the figure's rest pose in the first frames, and the last ones jump.
_SALSA_START, _SALSA_END = 24, 6
_SALSA_FPS = 60.0  # the files say 120, at which the dance is twice too fast
_SALSA_NAME = re.compile(r"(?P<subject>60|61)_(?P<trial>\d\d)(_scaled)?")


def load_pairs(paths: str | Path | Iterable[str | Path]) -> list[Motion]:
    """Read clips of two people.

    Parameters
    ----------
    paths : str, Path or iterable of them
        A folder (all of its ``.npz`` files), files, or patterns such as ``"dances/*.npz"``.

    Returns
    -------
    list of Motion
        On ``pair17``, sorted by path, each at its own rate and called by its file's stem. The
        people are ``person0`` and ``person1`` in the file's order.

    Raises
    ------
    FileNotFoundError
        If a folder or a pattern holds no file.
    ValueError
        If a clip has not two people, or one of them lacks a joint; the message says who and which.
    """
    given = [paths] if isinstance(paths, str | Path) else list(paths)
    patterns: list[str | Path] = []
    for path in map(Path, given):
        if path.is_dir() and not any(path.glob("*.npz")):
            raise FileNotFoundError(f"paths has the folder {path}, which holds no .npz file")
        patterns += sorted(path.glob("*.npz")) if path.is_dir() else [path]
    return [pair_of(motion) for motion in load_motions(patterns)]


def pair_of(motion: Motion) -> Motion:
    """Return a motion of two people on ``pair17``, joints matched by their canonical names.

    Parameters
    ----------
    motion : Motion
        Of a skeleton with two trees, whatever their joints are called; the tree whose root comes
        first becomes ``person0``.

    Raises
    ------
    ValueError
        If there are not two trees, or one lacks a joint; the message names the joints.
    """
    skeleton = Skeleton.preset("pair17")
    if motion.skeleton == skeleton:
        return motion
    roots = motion.skeleton.roots
    if len(roots) != 2:
        raise ValueError(
            f"motion is {motion} with {len(roots)} root{'s' * (len(roots) != 1)}, expected 2: one "
            "for each person"
        )
    people = [_person(motion, number, root) for number, root in enumerate(roots)]
    return Motion(np.concatenate(people, axis=1), skeleton, motion.fps, name=motion.name)


def pair_motion(first: Motion, second: Motion, name: str = "") -> Motion:
    """Return two people's motions as one of ``pair17``: two BVH files with a common frame.

    Nothing is moved: both must be in metres, in one world, and begin at one moment.

    Parameters
    ----------
    first, second : Motion
        One person each, ``person0`` and ``person1``; of one frame rate and length.
    name : str
        What to call the clip, both names by default.

    Raises
    ------
    ValueError
        If rates or lengths differ, or a motion is not one person with all joints; the message
        says how to make it fit.
    """
    if first.fps != second.fps:
        raise ValueError(
            f"second has {second.fps:g} frames per second and first {first.fps:g}, expected one "
            f"rate: second.resample({first.fps:g}) has it"
        )
    if first.frames != second.frames:
        longer = "second" if second.frames > first.frames else "first"
        raise ValueError(
            f"second has {second.frames} frames and first {first.frames}, expected clips of one "
            f"moment: {longer}.window(start, {min(first.frames, second.frames)}) cuts the longer "
            "one to the frames that they share"
        )
    people = []
    for number, (argument, motion) in enumerate((("first", first), ("second", second))):
        roots = motion.skeleton.roots
        if len(roots) != 1:
            raise ValueError(
                f"{argument} is {motion} with {len(roots)} roots, expected one person; pair_of "
                "takes a motion of both"
            )
        people.append(_person(motion, number, roots[0]))
    return Motion(
        np.concatenate(people, axis=1),
        Skeleton.preset("pair17"),
        first.fps,
        name=name or f"{first.name} & {second.name}",
    )


def read_salsa_bvh(lead: str | Path, follow: str | Path) -> Motion:
    """Read one trial of CMU's salsa from its two BVH files, in metres and at 30 fps.

    The files are the DAZ-friendly conversion of the CMU database, subjects 60 and 61, scaled as
    :mod:`probmotion.data.downloads` finds them. Each person gets a factor of his or her own
    about the world's origin (1.286 and 1.201 m per unit); the first 24 and last 6 frames, where
    the bodies leave the figure's rest pose and jump, are cut; every second frame of the 60 per
    second is kept (the headers' 120 is wrong); and both are lowered together until the
    lowest joints of each person and frame are above the floor, y = 0, in 98 of 100 cases.

    Parameters
    ----------
    lead, follow : str or Path
        ``60_TT_scaled.bvh`` and ``61_TT_scaled.bvh`` of one trial TT.

    Returns
    -------
    Motion
        On ``pair17``, called ``cmu_60_61_TT``.

    Raises
    ------
    ValueError
        If the names are not those of one trial, lengths differ or a file is damaged.
    FileNotFoundError
        If a file is missing.
    """
    trial = _salsa_trial(Path(lead), Path(follow))
    end_sites = [
        read_bvh(path, scale=scale, end_sites=True)
        for path, scale in zip((lead, follow), _SALSA_SCALES, strict=True)
    ]
    both = pair_motion(end_sites[0], end_sites[1], f"cmu_60_61_{trial}")
    least = _SALSA_START + _SALSA_END + 1
    if both.frames < least:
        raise ValueError(f"lead has {both.frames} frames, expected a trial of at least {least}")
    # Toes are End Sites: the floor is found before they are left out.
    lowest = np.stack([motion.positions[..., 1].min(axis=1) for motion in end_sites])
    floor = np.percentile(lowest, 2)
    kept = both.positions[_SALSA_START : both.frames - _SALSA_END : 2]
    return Motion(kept - [0.0, floor, 0.0], both.skeleton, _SALSA_FPS / 2, name=both.name)


def _salsa_trial(lead: Path, follow: Path) -> str:
    """Return the two digits of the trial; scales depend on the subject, whom the name tells."""
    trials = []
    for argument, path, subject in (("lead", lead, "60"), ("follow", follow, "61")):
        match = _SALSA_NAME.fullmatch(path.stem)
        if match is None or match["subject"] != subject:
            raise ValueError(
                f"{argument} is {path.name!r}, expected '{subject}_TT_scaled.bvh' with the two "
                "digits TT of a trial"
            )
        trials.append(match["trial"])
    if trials[0] != trials[1]:
        raise ValueError(f"follow is of trial {trials[1]} and lead of {trials[0]}, expected one")
    return trials[0]


def _person(motion: Motion, number: int, root: int) -> np.ndarray:
    """Return the positions (L, 17, 3) of the person below ``root``."""
    skeleton = motion.skeleton
    tree = [j for j in range(skeleton.n_joints) if j == root or root in skeleton.ancestors(j)]
    # Named on their own, joints lose what stands before all of them alike: the person's name.
    names = skeleton.subset(tree).canonical_names
    wanted = Skeleton.preset("person17").joint_names
    missing = [name for name in wanted if names.count(name) != 1]
    if missing:
        raise ValueError(
            f"motion is {motion}, whose person {number} (root {skeleton.joint_names[root]!r}) "
            f"lacks {', '.join(missing)}, expected the 17 joints of person17"
        )
    return motion.positions[:, [tree[names.index(name)] for name in wanted]]
