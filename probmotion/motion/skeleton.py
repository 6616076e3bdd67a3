"""A skeleton: named joints, their parents, left-right pairs and bone radii.

A pair of people, or a gymnast and a ball, is ONE skeleton with several roots.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from probmotion.motion.joint_names import canonical_names, mirrored_name
from probmotion.motion.presets import PRESETS
from probmotion.validation import check_positive

__all__ = ["Skeleton"]


@dataclass(frozen=True)
class Skeleton:
    """Names and topology of J joints.

    Parameters
    ----------
    joint_names : sequence of str
        One name per joint, all different.
    parents : sequence of int
        The index of each joint's parent, -1 for a root. A parent need not come before its child.
    radii : sequence of float, optional
        Radius of each joint's bone to its parent, metres; for contact and penetration.

    Raises
    ------
    ValueError
        If names repeat, lengths differ, a parent is out of range or the parents form a cycle.
    """

    joint_names: tuple[str, ...]
    parents: tuple[int, ...]
    radii: tuple[float, ...] | None = field(default=None, compare=False)

    def __init__(
        self,
        joint_names: Sequence[str],
        parents: Sequence[int],
        radii: Sequence[float] | None = None,
    ) -> None:
        names = tuple(str(name) for name in joint_names)
        for joint, parent in enumerate(parents):
            if isinstance(parent, bool) or not isinstance(parent, int | np.integer):
                raise ValueError(
                    f"parents[{joint}] must be an integer, -1 for a root, got {parent!r}"
                )
        links = tuple(int(parent) for parent in parents)
        if not names:
            raise ValueError("joint_names must contain at least one joint, got none")
        repeated = sorted({name for name in names if names.count(name) > 1})
        if repeated:
            raise ValueError(f"joint_names repeats {repeated}, expected every name once")
        if len(links) != len(names):
            raise ValueError(
                f"parents has {len(links)} entries, expected {len(names)}, one per joint"
            )
        for joint, parent in enumerate(links):
            if not -1 <= parent < len(names):
                raise ValueError(
                    f"parents[{joint}] ({names[joint]}) is {parent}, expected -1 (a root) or a "
                    f"joint's index below {len(names)}"
                )
        _refuse_cycles(names, links)
        if radii is not None and len(radii) != len(names):
            raise ValueError(
                f"radii has {len(radii)} entries, expected {len(names)}, one per joint"
            )
        for joint, radius in enumerate(radii or ()):
            check_positive(f"radii[{joint}]", radius)
        object.__setattr__(self, "joint_names", names)
        object.__setattr__(self, "parents", links)
        object.__setattr__(self, "radii", None if radii is None else tuple(map(float, radii)))

    @classmethod
    def preset(cls, name: str) -> Skeleton:
        """Return a skeleton by name; see :data:`probmotion.motion.presets.PRESETS`.

        Raises
        ------
        ValueError
            If the name is unknown; the message lists the known ones.
        """
        if name not in PRESETS:
            raise ValueError(f"name must be one of {', '.join(sorted(PRESETS))}, got {name!r}")
        return cls(*PRESETS[name]())

    @property
    def n_joints(self) -> int:
        """Number of joints J."""
        return len(self.joint_names)

    @cached_property
    def roots(self) -> tuple[int, ...]:
        """Indices of the joints without a parent."""
        return tuple(j for j, parent in enumerate(self.parents) if parent < 0)

    @cached_property
    def bones(self) -> tuple[tuple[int, int], ...]:
        """Pairs (joint, parent), one per joint that has a parent."""
        return tuple((j, parent) for j, parent in enumerate(self.parents) if parent >= 0)

    @cached_property
    def topological_order(self) -> tuple[int, ...]:
        """Joint indices ordered so that every parent comes before its children."""
        order: list[int] = []
        children: dict[int, list[int]] = {}
        for joint, parent in enumerate(self.parents):
            children.setdefault(parent, []).append(joint)
        waiting = list(reversed(children.get(-1, [])))
        while waiting:
            joint = waiting.pop()
            order.append(joint)
            waiting += reversed(children.get(joint, []))
        return tuple(order)

    @cached_property
    def mirrored_pairs(self) -> tuple[tuple[int, int], ...]:
        """Pairs (left, right) of joints whose names differ in the side alone."""
        pairs = []
        for left, name in enumerate(self.joint_names):
            other = mirrored_name(name)
            if other is not None and other in self.joint_names:
                pairs.append((left, self.joint_names.index(other)))
        return tuple(pairs)

    @cached_property
    def mirrored_order(self) -> tuple[int, ...]:
        """For every joint, the one on the other side; itself where there is none."""
        order = list(range(self.n_joints))
        for left, right in self.mirrored_pairs:
            order[left], order[right] = right, left
        return tuple(order)

    @cached_property
    def canonical_names(self) -> tuple[str, ...]:
        """The field's common name of each joint (``left_knee``), or its own where unknown."""
        return canonical_names(self.joint_names)

    def index(self, joint_name: str) -> int:
        """Return the index of a joint by its own or its canonical name.

        Raises
        ------
        ValueError
            If no joint has that name, or several do.
        """
        if joint_name in self.joint_names:
            return self.joint_names.index(joint_name)
        found = [j for j, name in enumerate(self.canonical_names) if name == joint_name]
        if len(found) == 1:
            return found[0]
        problem = "no joint" if not found else "several joints"
        raise ValueError(
            f"joint_name is {joint_name!r}, which names {problem} of this skeleton, expected one "
            f"of {', '.join(self.joint_names)}"
        )

    def ancestors(self, joint: int) -> tuple[int, ...]:
        """Return the joints on the way from ``joint``'s parent to its root, nearest first."""
        chain = []
        while (joint := self.parents[joint]) >= 0:
            chain.append(joint)
        return tuple(chain)

    def subset(self, joints: Sequence[int]) -> Skeleton:
        """Return the skeleton of ``joints``; a parent that is left out is bridged.

        A joint's new parent is its nearest ancestor among ``joints``; where none is left, it
        becomes a root.
        """
        kept = list(joints)
        for joint in kept:
            if not 0 <= joint < self.n_joints:
                raise ValueError(
                    f"joints has {joint}, expected indices from 0 to {self.n_joints - 1}"
                )
        parents = []
        for joint in kept:
            above = [kept.index(a) for a in self.ancestors(joint) if a in kept]
            parents.append(above[0] if above else -1)
        radii = None if self.radii is None else [self.radii[joint] for joint in kept]
        return Skeleton([self.joint_names[joint] for joint in kept], parents, radii)


def _refuse_cycles(names: tuple[str, ...], parents: tuple[int, ...]) -> None:
    rooted: set[int] = set()
    for joint in range(len(names)):
        path: list[int] = []
        at = joint
        while at >= 0 and at not in rooted:
            if at in path:
                loop = " → ".join(names[i] for i in path[path.index(at) :])
                raise ValueError(f"parents form a cycle ({loop}), expected a tree under each root")
            path.append(at)
            at = parents[at]
        rooted.update(path)
