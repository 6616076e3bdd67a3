"""Pose-conditioned joint-angle limits (Akhter and Black 2015).

The directions allowed for a bone depend on the direction of its parent. Twist is not limited, as
joint positions do not determine it. Parent directions are divided into coarse bins, bone directions
into fine cells. A table has one bit per bin and cell, set if the combination occurs in or close to
motion capture data (:mod:`.joint_limits_learning`).

The pelvis frame has its left axis along the line of the hips and its up axis as close to the spine
as possible. The frame of neck and arms uses the shoulders and the chest's bone instead. Other bones
use their parent's frame, rotated by the smallest angle from the parent's mean to its actual
direction. This rotation is undefined only opposite to the mean direction.
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

from probmotion.files import check_format, read_arrays, written_whole
from probmotion.models.pose_pairs.joint_limits_kernels import PARTS, LimitArrays, project_poses
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count, check_finite, check_shape

__all__ = ["JointLimits", "sphere_rings"]

_PERSON = Skeleton.preset("person17")
_MAX_RINGS = 1000  # in files; cells are about 1.3 times the square


@dataclass(frozen=True, eq=False)
class JointLimits:
    """Allowed bone directions for every person of a skeleton.

    Parameters
    ----------
    allowed : ndarray of bool, (9, bins, cells)
        Allowed direction cells per bin of the parent's direction; at least one per bin. The nine
        parts are the bones ending in hip, knee, ankle, chest, shoulder, elbow, wrist, neck and
        head, shared by both sides. The spine is limited by ``tilt`` instead.
    rest : ndarray, (9, 3)
        Mean direction of each bone in its frame, unit vectors.
    tilt : float
        Maximum angle between the spine and the plane orthogonal to the hip line, radians.
    bin_rings, cell_rings : int
        Number of rings of the sphere's partition into bins and cells; see :func:`sphere_rings`.
    provenance : mapping
        Record of the training data and settings, JSON-serialisable.
    skeleton : Skeleton
        Skeleton of the poses; each of its trees has the joints of ``person17``.
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
        sizes = [len(sphere_rings(rings)[1]) for rings in (self.bin_rings, self.cell_rings)]
        check_shape("allowed", self.allowed, (len(PARTS), *sizes))
        check_shape("rest", self.rest, (len(PARTS), 3))
        check_finite("rest", self.rest)
        error = np.abs(np.linalg.norm(self.rest, axis=1) - 1.0).max()
        if not error < 1e-9:
            raise ValueError(f"rest must contain unit vectors, got an error of {error:.2g}")
        if not 0 < self.tilt < np.pi / 2:
            raise ValueError(f"tilt must be between 0 and π/2, got {self.tilt!r}")
        empty = np.argwhere(~self.allowed.any(axis=-1))
        if len(empty):
            part, row = empty[0]
            raise ValueError(
                f"allowed must have a cell in every bin, got none for {PARTS[part]} in bin {row}"
            )
        self.trees  # noqa: B018  Validates the skeleton.

    @classmethod
    def shipped(cls, skeleton: Skeleton | None = None) -> JointLimits:
        """Return the limits shipped with the package, learnt from CMU motion capture."""
        source = files("probmotion.models") / "weights" / "joint_limits.npz"
        with as_file(source) as path:
            limits = cls.load(path)
        return limits if skeleton is None else limits.on(skeleton)

    def on(self, skeleton: Skeleton) -> JointLimits:
        """Return the limits for another skeleton."""
        return replace(self, skeleton=skeleton)

    def is_valid(self, pose: np.ndarray) -> np.ndarray:
        """Return a mask of the bones within their limits, ``(…, J, 3) → (…, bones)``.

        Bones are in the order of ``skeleton.bones``. Ancestors are corrected first, so that an
        invalid shoulder does not invalidate the arm.
        """
        return self.project(pose)[0]

    def nearest_valid(self, pose: np.ndarray) -> np.ndarray:
        """Return the pose with each invalid bone rotated to a nearby valid direction.

        ``(…, J, 3) → (…, J, 3)``, metres. The new direction is on the boundary of the allowed
        cells, towards the nearest one. Roots and bone lengths are preserved, descendants rotate
        with the bone, and valid poses are unchanged.
        """
        return self.project(pose)[1]

    def project(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return :meth:`is_valid` and :meth:`nearest_valid` of poses, (…, J, 3) in metres."""
        given = np.asarray(poses, dtype=np.float64)
        check_shape("poses", given, ("…", self.skeleton.n_joints, 3))
        check_finite("poses", given)
        flat = np.ascontiguousarray(given.reshape(prod(given.shape[:-2]), *given.shape[-2:]))
        valid, nearest = project_poses(flat, self.trees, self.arrays)
        of_bones = valid[:, [joint for joint, _ in self.skeleton.bones]]
        return of_bones.reshape(*given.shape[:-2], of_bones.shape[-1]), nearest.reshape(given.shape)

    @cached_property
    def trees(self) -> np.ndarray:
        """Joints of each person in the order of ``person17``, (K, 17)."""
        skeleton, people = self.skeleton, []
        for root in skeleton.roots:
            tree = [j for j in range(skeleton.n_joints) if root in (j, *skeleton.ancestors(j))]
            joints = {skeleton.canonical_names[j].rpartition(":")[2]: j for j in tree}
            person = [joints.get(name, -1) for name in _PERSON.joint_names]
            parents = [skeleton.parents[j] for j in person]
            expected = [-1 if parent < 0 else person[parent] for parent in _PERSON.parents]
            if len(tree) != _PERSON.n_joints or -1 in person or parents != expected:
                raise ValueError(
                    "skeleton must have trees with the joints and parents of 'person17', got "
                    f"{', '.join(skeleton.joint_names[j] for j in tree)}"
                )
            people.append(person)
        return np.array(people)

    @cached_property
    def arrays(self) -> LimitArrays:
        """Arrays of the limits for compiled code."""
        return LimitArrays(
            np.ascontiguousarray(self.allowed, dtype=np.bool_),
            sphere_rings(self.bin_rings)[0],
            *sphere_rings(self.cell_rings),
            rest=np.ascontiguousarray(self.rest, dtype=np.float64),
            tilt=float(np.sin(self.tilt)),
        )

    def save(self, path: str | Path) -> None:
        """Write the limits to an ``.npz`` archive, byte-reproducibly."""
        with written_whole(Path(path)) as unfinished:
            np.savez_compressed(
                unfinished,
                format=np.array(1),
                allowed=np.packbits(self.allowed, axis=-1),
                rest=self.rest,
                tilt=self.tilt,
                rings=np.array([self.bin_rings, self.cell_rings]),
                provenance=json.dumps(self.provenance, sort_keys=True),
            )

    @classmethod
    def load(cls, path: str | Path) -> JointLimits:
        """Read limits written by :meth:`save`; raise ``ValueError`` if the file is damaged."""
        try:
            arrays = read_arrays(path)
            check_format(arrays)
            bin_rings, cell_rings = (int(number) for number in arrays["rings"])
            if max(bin_rings, cell_rings) > _MAX_RINGS:
                raise ValueError(f"rings must be at most {_MAX_RINGS}, got {arrays['rings']}")
            n_cells = len(sphere_rings(cell_rings)[1])
            return cls(
                allowed=np.unpackbits(arrays["allowed"], axis=-1, count=n_cells).astype(bool),
                rest=arrays["rest"],
                tilt=float(arrays["tilt"]),
                bin_rings=bin_rings,
                cell_rings=cell_rings,
                provenance=json.loads(str(arrays["provenance"])),
            )
        except (KeyError, TypeError, ValueError, RecursionError) as error:
            raise ValueError(
                f"path must be a file written by JointLimits.save, got {str(path)!r} "
                f"({str(error)[:120]})"
            ) from error


def sphere_rings(n_rings: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a partition of the sphere into ``n_rings`` rings of nearly square cells.

    Cells are mirror-symmetric in the first axis. ``rings`` (n_rings, 2) contains the number of
    cells and the index of the first cell of each ring, ordered from the positive second axis;
    ``centres`` (cells, 3) are unit vectors.
    """
    heights = (np.arange(n_rings) + 0.5) * np.pi / n_rings
    counts = 2 * np.round(n_rings * np.sin(heights)).astype(np.int64)
    rings = np.stack([counts, np.cumsum(counts) - counts], axis=1)
    height = np.repeat(heights, counts)
    index = np.arange(counts.sum()) - np.repeat(rings[:, 1], counts)
    angle = (index + 0.5) * 2.0 * np.pi / np.repeat(counts, counts)
    centres = np.stack(
        [np.sin(height) * np.sin(angle), np.cos(height), np.sin(height) * np.cos(angle)], axis=1
    )
    return rings, centres
