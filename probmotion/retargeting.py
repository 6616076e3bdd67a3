"""Motions of one skeleton on another, joints matched by name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from probmotion.motion import Motion
from probmotion.skeleton import Skeleton

__all__ = ["common_skeleton", "retarget_motion"]


def retarget_motion(motion: Motion, skeleton: Skeleton) -> Motion:
    """Return the motion on another skeleton: its joints chosen, ordered and linked anew.

    Where the motion has every joint of ``skeleton`` by its own name, those are taken; elsewhere
    joints are matched by their canonical names (:mod:`probmotion.joint_names`). Positions stay
    where they are: proportions are the motion's, and no joint is made up. Rotations are dropped
    unless the skeletons are equal.

    Parameters
    ----------
    motion : Motion
        The motion.
    skeleton : Skeleton
        The skeleton to have.

    Raises
    ------
    ValueError
        If a joint of ``skeleton`` has no counterpart, or several; the message names it.
    """
    source = motion.skeleton
    if source == skeleton:
        return motion
    if set(skeleton.joint_names) <= set(source.joint_names):
        chosen = [source.joint_names.index(name) for name in skeleton.joint_names]
    else:
        chosen = [
            _counterpart(source, name, canonical)
            for name, canonical in zip(skeleton.joint_names, skeleton.canonical_names, strict=True)
        ]
    return replace(
        motion,
        positions=motion.positions[:, chosen],
        skeleton=skeleton,
        rotations=None,
        rest_offsets=None,
    )


def common_skeleton(motions: Sequence[Motion]) -> Skeleton:
    """Return the skeleton of the joints that all motions have.

    Motions of one skeleton have that skeleton in common. Otherwise the joints are those of the
    first motion that every other one has too, by their canonical names and in the first one's
    order; a parent that is left out is bridged.

    Parameters
    ----------
    motions : sequence of Motion
        At least one.

    Raises
    ------
    ValueError
        If there is no motion, or no joint that all of them have.
    """
    skeletons = list(dict.fromkeys(motion.skeleton for motion in motions))
    if not skeletons:
        raise ValueError("motions is empty, expected at least one")
    if len(skeletons) == 1:
        return skeletons[0]
    first, *others = skeletons
    shared = [
        joint
        for joint, name in enumerate(first.canonical_names)
        if all(other.canonical_names.count(name) == 1 for other in skeletons)
    ]
    if not shared:
        raise ValueError(
            f"motions have no joint in common: {', '.join(first.joint_names[:5])}, … and "
            f"{', '.join(others[-1].joint_names[:5])}, …; expected joints of the same names"
        )
    subset = first.subset(shared)
    names = [first.canonical_names[joint] for joint in shared]
    return Skeleton(names, subset.parents, subset.radii)


def _counterpart(source: Skeleton, name: str, canonical: str) -> int:
    """Return the index in ``source`` of the joint that another skeleton calls ``name``."""
    for wanted, known in (
        (canonical, source.canonical_names),
        (name, source.canonical_names),
        (name, source.joint_names),
    ):
        if wanted in known:
            if known.count(wanted) > 1:
                raise ValueError(
                    f"skeleton has the joint {name!r}, which is several joints of the motion, "
                    "expected one"
                )
            return known.index(wanted)
    raise ValueError(
        f"skeleton has the joint {name!r}, which has no counterpart in the motion, expected one "
        f"of {', '.join(source.joint_names)}"
    )
