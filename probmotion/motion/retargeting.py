"""Matching of the joints of different skeletons by name."""

from __future__ import annotations

from collections.abc import Sequence

from probmotion.motion.skeleton import Skeleton

__all__ = ["common_skeleton", "counterpart", "matching_joints"]


def matching_joints(source: Skeleton, target: Skeleton) -> list[int]:
    """Return the index in ``source`` of each joint of ``target``.

    Joints are matched by their own names if ``source`` has all names of ``target``, and otherwise
    by canonical names (:mod:`probmotion.motion.joint_names`).
    """
    if set(target.joint_names) <= set(source.joint_names):
        return [source.joint_names.index(name) for name in target.joint_names]
    chosen = []
    for name, canonical in zip(target.joint_names, target.canonical_names, strict=True):
        joint = counterpart(source, name, canonical)
        if joint is None:
            raise ValueError(
                f"skeleton must have joints among {', '.join(source.joint_names)}, got {name!r}, "
                "which has no counterpart"
            )
        chosen.append(joint)
    return chosen


def common_skeleton(skeletons: Sequence[Skeleton]) -> Skeleton:
    """Return the skeleton of the joints common to all skeletons.

    Joints are matched by canonical names and ordered as in the first skeleton. A parent that is not
    common to all skeletons is replaced by its nearest ancestor that is.

    Raises
    ------
    ValueError
        If there are no skeletons or no common joints.
    """
    skeletons = list(dict.fromkeys(skeletons))
    if not skeletons:
        raise ValueError("skeletons must contain at least one skeleton, got none")
    if len(skeletons) == 1:
        return skeletons[0]
    first, *rest = skeletons
    shared = [
        joint
        for joint, name in enumerate(first.canonical_names)
        if all(other.canonical_names.count(name) == 1 for other in skeletons)
    ]
    if not shared:
        raise ValueError(
            f"skeletons must have a joint in common, got {', '.join(first.joint_names[:5])}, … "
            f"and {', '.join(rest[-1].joint_names[:5])}, …"
        )
    subset = first.subset(shared)
    names = [first.canonical_names[joint] for joint in shared]
    return Skeleton(names, subset.parents, subset.radii)


def counterpart(source: Skeleton, name: str, canonical: str) -> int | None:
    """Return the index in ``source`` of the counterpart of a joint, or ``None`` if missing."""
    canonicals = source.canonical_names
    for key, names in ((canonical, canonicals), (name, canonicals), (name, source.joint_names)):
        if names.count(key) > 1:
            raise ValueError(f"skeleton must have one counterpart of {name!r}, got several")
        if key in names:
            return names.index(key)
    return None
