"""Joint-angle limits: the directions in which each bone of a person has been seen.

A limit is conditioned on pose (Akhter and Black 2015): where a bone may point depends on where its
parent points. Both are directions, as joint positions tell nothing of a bone's own twist. Parent
directions fall into coarse bins of the sphere, bone directions into fine cells, and a table has one
bit for each pair: seen in real motion, or near something seen (:mod:`.joint_limits_learning`).

Frames. The pelvis has left from hip to hip and up nearest the spine; neck and arms have left from
shoulder to shoulder and up nearest the chest's bone. Below those, a bone's frame is its parent's
frame turned by the least rotation that takes the bone from its mean direction, which puts the
singularity opposite to where bones point.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib.resources import as_file, files
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from probmotion.files import written_whole
from probmotion.models.pose_pairs.joint_limits_kernels import PARTS, LimitArrays, project_poses
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count, check_finite, check_shape

__all__ = ["JointLimits", "sphere_rings"]

_PERSON = Skeleton.preset("person17")


@dataclass(frozen=True, eq=False)
class JointLimits:
    """Where the bones of a person may point, for every person of a skeleton.

    Parameters
    ----------
    allowed : ndarray of bool, (9, bins, cells)
        Which cells a bone may point into, per bin of its parent's direction. The nine are the
        bones that end in hip, knee, ankle, chest, shoulder, elbow, wrist, neck and head; the two
        sides share one. The spine has ``tilt`` instead.
    rest : ndarray, (9, 3)
        Mean direction of each bone in its frame.
    tilt : float
        Largest angle of the spine against the plane between the hips, radians.
    bin_rings, cell_rings : int
        Rings of the sphere's partition into bins and into cells; see :func:`sphere_rings`.
    provenance : mapping
        What the limits were learnt from and how; anything that JSON can hold.
    skeleton : Skeleton
        The skeleton of the poses; each of its trees has the joints of ``person17``.

    Raises
    ------
    ValueError
        If shapes do not fit each other, a bin allows nothing, or a tree of the skeleton is no
        person.
    """

    allowed: np.ndarray
    rest: np.ndarray
    tilt: float
    bin_rings: int
    cell_rings: int
    provenance: Mapping[str, Any] = field(default_factory=dict)
    skeleton: Skeleton = _PERSON

    def __post_init__(self) -> None:
        for name in ("bin_rings", "cell_rings"):
            check_count(name, getattr(self, name), 2)
        n_bins, n_cells = (
            len(sphere_rings(rings)[1]) for rings in (self.bin_rings, self.cell_rings)
        )
        check_shape("allowed", self.allowed, (len(PARTS), n_bins, n_cells))
        check_shape("rest", self.rest, (len(PARTS), 3))
        check_finite("rest", self.rest)
        if not np.abs(np.linalg.norm(self.rest, axis=1) - 1.0).max() < 1e-9:
            raise ValueError("rest has vectors of another length than 1, expected unit vectors")
        if not 0 < self.tilt < np.pi / 2:
            raise ValueError(f"tilt must be an angle between 0 and π/2, got {self.tilt!r}")
        empty = np.argwhere(~self.allowed.any(axis=-1))
        if len(empty):
            part, row = empty[0]
            raise ValueError(
                f"allowed has no cell for {PARTS[part]} in bin {row}, expected at least one"
            )
        self.trees  # noqa: B018  A skeleton of others than people is refused here.

    @classmethod
    def shipped(cls, skeleton: Skeleton | None = None) -> JointLimits:
        """Return the limits that come with the package, for ``person17`` or another skeleton.

        They are learnt from motion capture of CMU; ``provenance`` says from which clips.
        """
        source = files("probmotion.models") / "weights" / "joint_limits.npz"
        with as_file(source) as path:
            limits = cls.load(path)
        return limits if skeleton is None else limits.on(skeleton)

    def on(self, skeleton: Skeleton) -> JointLimits:
        """Return the same limits for the poses of another skeleton of people."""
        return replace(self, skeleton=skeleton)

    def is_valid(self, pose: np.ndarray) -> np.ndarray:
        """Return which bones are within their limits, ``(…, J, 3) → (…, bones)``.

        Bones are those of ``skeleton.bones``, in that order. A bone is judged with its ancestors
        already corrected, so that a wrong shoulder does not make the arm wrong.
        """
        return self.project(pose)[0]

    def nearest_valid(self, pose: np.ndarray) -> np.ndarray:
        """Return the pose with each invalid bone turned to a valid direction near its own.

        ``(…, J, 3) → (…, J, 3)``, metres. The direction is where the way to the nearest allowed
        cell enters allowed cells. Roots and lengths stay; what hangs from a corrected bone turns
        along with it. The result is valid, and a valid pose is returned as it is.
        """
        return self.project(pose)[1]

    def project(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return :meth:`is_valid` and :meth:`nearest_valid` for the price of one.

        Parameters
        ----------
        poses : ndarray, (…, J, 3)
            Metres.

        Returns
        -------
        valid : ndarray of bool, (…, bones)
        nearest : ndarray, (…, J, 3)
            Metres.

        Raises
        ------
        ValueError
            If the shape does not fit the skeleton or a value is NaN or infinite.
        """
        given = np.asarray(poses, dtype=np.float64)
        check_shape("poses", given, ("…", self.skeleton.n_joints, 3))
        check_finite("poses", given)
        flat = np.ascontiguousarray(given.reshape(prod(given.shape[:-2]), *given.shape[-2:]))
        valid, nearest = project_poses(flat, self.trees, self.arrays)
        of_bones = valid[:, [joint for joint, _ in self.skeleton.bones]]
        return of_bones.reshape(*given.shape[:-2], of_bones.shape[-1]), nearest.reshape(given.shape)

    @cached_property
    def trees(self) -> np.ndarray:
        """Joints of each tree in the order of ``person17``, (K, 17)."""
        return _people(self.skeleton)

    @cached_property
    def arrays(self) -> LimitArrays:
        """What compiled code reads."""
        cell_rings, centres = sphere_rings(self.cell_rings)
        return LimitArrays(
            allowed=np.ascontiguousarray(self.allowed, dtype=np.bool_),
            bin_rings=sphere_rings(self.bin_rings)[0],
            cell_rings=cell_rings,
            centres=centres,
            rest=np.ascontiguousarray(self.rest, dtype=np.float64),
            tilt=float(np.sin(self.tilt)),
        )

    def save(self, path: str | Path) -> None:
        """Write the limits to an ``.npz`` archive; the same limits give the same bytes."""
        with written_whole(Path(path)) as unfinished:
            np.savez_compressed(
                unfinished,
                allowed=np.packbits(self.allowed, axis=-1),
                rest=self.rest,
                tilt=self.tilt,
                rings=np.array([self.bin_rings, self.cell_rings]),
                provenance=json.dumps(self.provenance, sort_keys=True),
            )

    @classmethod
    def load(cls, path: str | Path) -> JointLimits:
        """Return the limits that :meth:`save` wrote, for ``person17``.

        Raises
        ------
        ValueError
            If the file is not one that :meth:`save` wrote.
        FileNotFoundError
            If there is no such file.
        """
        try:
            with np.load(path) as archive:
                bin_rings, cell_rings = (int(number) for number in archive["rings"])
                n_cells = len(sphere_rings(cell_rings)[1])
                return cls(
                    allowed=np.unpackbits(archive["allowed"], axis=-1, count=n_cells).astype(bool),
                    rest=archive["rest"],
                    tilt=float(archive["tilt"]),
                    bin_rings=bin_rings,
                    cell_rings=cell_rings,
                    provenance=json.loads(str(archive["provenance"])),
                )
        except FileNotFoundError:
            raise
        except Exception as error:  # a damaged archive fails in a dozen ways
            raise ValueError(
                f"path is {str(path)!r}, which holds no joint limits, expected a file that save() "
                "wrote"
            ) from error


def sphere_rings(n_rings: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a sphere cut into ``n_rings`` rings of cells that are about as wide as high.

    Cells are symmetric about the plane across the first axis, as a body is.

    Returns
    -------
    rings : ndarray of int, (n_rings, 2)
        How many cells each ring has, and the index of its first; from the second axis downwards.
    centres : ndarray, (cells, 3)
        Unit vectors.
    """
    heights = (np.arange(n_rings) + 0.5) * np.pi / n_rings
    counts = 2 * np.round(n_rings * np.sin(heights)).astype(np.int64)
    rings = np.stack([counts, np.cumsum(counts) - counts], axis=1)
    height = np.repeat(heights, counts)
    place = np.arange(counts.sum()) - np.repeat(rings[:, 1], counts)
    turn = (place + 0.5) * 2.0 * np.pi / np.repeat(counts, counts)
    centres = np.stack(
        [np.sin(height) * np.sin(turn), np.cos(height), np.sin(height) * np.cos(turn)], axis=1
    )
    return rings, centres


def _people(skeleton: Skeleton) -> np.ndarray:
    """Return the joints of each tree in the order of ``person17``, (K, 17)."""
    people = []
    for root in skeleton.roots:
        joints = [root, *(j for j in range(skeleton.n_joints) if root in skeleton.ancestors(j))]
        names = {skeleton.canonical_names[j].rpartition(":")[2]: j for j in joints}
        parents = {
            name: skeleton.canonical_names[skeleton.parents[j]].rpartition(":")[2]
            for name, j in names.items()
            if j != root
        }
        wanted = {
            _PERSON.joint_names[j]: _PERSON.joint_names[parent] for j, parent in _PERSON.bones
        }
        if len(joints) != _PERSON.n_joints or parents != wanted:
            raise ValueError(
                f"skeleton has a tree under {skeleton.joint_names[root]!r} of "
                f"{', '.join(skeleton.joint_names[j] for j in joints)}, expected the joints of "
                "'person17' and their parents"
            )
        people.append([names[name] for name in _PERSON.joint_names])
    return np.array(people)
