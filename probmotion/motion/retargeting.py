"""Matching of the joints of different skeletons by name."""

from __future__ import annotations

from collections.abc import Sequence

from probmotion.motion.skeleton import Skeleton

__all__ = ["common_skeleton", "matching_joints"]


def matching_joints(source: Skeleton, target: Skeleton) -> list[int]:
    """Return the index in ``source`` of each joint of ``target``.

    Where the source has every joint of the target by its own name, those are taken; elsewhere
    joints are matched by their canonical names (:mod:`probmotion.motion.joint_names`).

    Raises
    ------
    ValueError
        If a joint of ``target`` has no counterpart, or several; the message names it.
    """
    if set(target.joint_names) <= set(source.joint_names):
        return [source.joint_names.index(name) for name in target.joint_names]
    return [
        _counterpart(source, name, canonical)
        for name, canonical in zip(target.joint_names, target.canonical_names, strict=True)
    ]


def common_skeleton(skeletons: Sequence[Skeleton]) -> Skeleton:
    """Return the skeleton of the joints that all skeletons have.

    Equal skeletons have that skeleton in common. Otherwise the joints are those of the first one
    that every other one has too, by their canonical names and in the first one's order; a parent
    that is left out is bridged.

    Raises
    ------
    ValueError
        If there is no skeleton, or no joint that all of them have.
    """
    skeletons = list(dict.fromkeys(skeletons))
    if not skeletons:
        raise ValueError("skeletons must contain at least one, got none")
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
            f"skeletons have no joint in common: {', '.join(first.joint_names[:5])}, … and "
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
