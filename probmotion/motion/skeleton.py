"""Skeletons: named joints with parents, left-right pairs and bone radii.

Several bodies, such as two people or a gymnast and a ball, form one skeleton with a root per body.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

from probmotion.motion.joint_names import canonical_names, mirrored_name
from probmotion.motion.presets import PRESETS
from probmotion.validation import check_count, check_positive

__all__ = ["Skeleton"]


@dataclass(frozen=True)
class Skeleton:
    """Names and parents of J joints, with optional bone radii.

    Parameters
    ----------
    joint_names : sequence of str
        One unique name per joint.
    parents : sequence of int
        Index of each joint's parent, -1 for a root. Parents may come after their children.
    radii : sequence of float, optional
        Radius of the bone from each joint to its parent, metres, for contact and penetration.

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
        if not names:
            raise ValueError("joint_names must contain at least one joint, got none")
        repeated = sorted({name for name in names if names.count(name) > 1})
        if repeated:
            raise ValueError(f"joint_names must be unique, got {repeated} several times")
        for name, values in (("parents", parents), ("radii", radii)):
            if values is not None and len(values) != len(names):
                raise ValueError(
                    f"{name} must have one entry per joint, {len(names)}, got {len(values)}"
                )
        for joint, parent in enumerate(parents):
            check_count(f"parents[{joint}]", parent, least=-1)
            if parent >= len(names):
                bound = f"-1 or a joint's index below {len(names)}"
                raise ValueError(f"parents[{joint}] must be {bound}, got {parent}")
        links = tuple(int(parent) for parent in parents)
        _refuse_cycles(names, links)
        for joint, radius in enumerate(radii or ()):
            check_positive(f"radii[{joint}]", radius)
        object.__setattr__(self, "joint_names", names)
        object.__setattr__(self, "parents", links)
        object.__setattr__(self, "radii", None if radii is None else tuple(map(float, radii)))

    @classmethod
    def preset(cls, name: str) -> Skeleton:
        """Return the skeleton of this name in :data:`probmotion.motion.presets.PRESETS`.

        Raises
        ------
        ValueError
            If the name is unknown.
        """
        if name not in PRESETS:
            raise ValueError(f"name must be one of {', '.join(sorted(PRESETS))}, got {name!r}")
        return cls(*PRESETS[name])

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
        """Pairs (joint, parent) of all joints with a parent."""
        return tuple((j, parent) for j, parent in enumerate(self.parents) if parent >= 0)

    @cached_property
    def topological_order(self) -> tuple[int, ...]:
        """Joint indices, sorted so that parents precede their children."""
        order: list[int] = []
        waiting = list(reversed(self.roots))
        while waiting:
            joint = waiting.pop()
            order.append(joint)
            waiting += [child for child, parent in reversed(self.bones) if parent == joint]
        return tuple(order)

    @cached_property
    def mirrored_pairs(self) -> tuple[tuple[int, int], ...]:
        """Pairs (left, right) of joints whose names differ only in the side."""
        mirrored = [mirrored_name(name) for name in self.joint_names]
        names = self.joint_names
        return tuple((j, names.index(name)) for j, name in enumerate(mirrored) if name in names)

    @cached_property
    def mirrored_order(self) -> tuple[int, ...]:
        """Index of each joint's left-right counterpart, or of the joint itself if it has none."""
        order = list(range(self.n_joints))
        for left, right in self.mirrored_pairs:
            order[left], order[right] = right, left
        return tuple(order)

    @cached_property
    def canonical_names(self) -> tuple[str, ...]:
        """Canonical name of each joint, such as ``left_knee``; unknown names are unchanged."""
        return canonical_names(self.joint_names)

    def index(self, joint_name: str) -> int:
        """Return the index of a joint by its own or its canonical name.

        Raises
        ------
        ValueError
            If no joint or several joints have that name.
        """
        if joint_name in self.joint_names:
            return self.joint_names.index(joint_name)
        if self.canonical_names.count(joint_name) == 1:
            return self.canonical_names.index(joint_name)
        problem = "several joints" if joint_name in self.canonical_names else "no joint"
        raise ValueError(
            f"joint_name must be one of {', '.join(self.joint_names)}, got {joint_name!r}, which "
            f"names {problem}"
        )

    def ancestors(self, joint: int) -> tuple[int, ...]:
        """Return the ancestors of ``joint``, from its parent to its root."""
        chain = []
        while (joint := self.parents[joint]) >= 0:
            chain.append(joint)
        return tuple(chain)

    def subset(self, joints: Sequence[int]) -> Skeleton:
        """Return the skeleton of ``joints``; parents are nearest ancestors among ``joints``."""
        chosen, parents = list(joints), []
        for joint in chosen:
            if not 0 <= joint < self.n_joints:
                raise ValueError(f"joints must be 0 to {self.n_joints - 1}, got {joint}")
            above = [ancestor for ancestor in self.ancestors(joint) if ancestor in chosen]
            parents.append(chosen.index(above[0]) if above else -1)
        radii = None if self.radii is None else [self.radii[joint] for joint in chosen]
        return Skeleton([self.joint_names[joint] for joint in chosen], parents, radii)


def _refuse_cycles(names: tuple[str, ...], parents: tuple[int, ...]) -> None:
    rooted: set[int] = set()
    for joint in range(len(names)):
        path: list[int] = []
        at = joint
        while at >= 0 and at not in rooted:
            if at in path:
                loop = " → ".join(names[i] for i in path[path.index(at) :])
                raise ValueError(f"parents must form trees, got a cycle ({loop})")
            path.append(at)
            at = parents[at]
        rooted.update(path)
