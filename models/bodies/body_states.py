"""Pose vectors of an articulated body: root translation and joint rotations.

The state of a frame (x_t of Motion-DVAE) consists of the root translation (3) and the 6D rotations
(Zhou et al. 2019) of all joints with children, root first. Bone lengths are stored separately.

A trunk, such as the bone that ends at the neck of ``person14``, has its own rotation. Otherwise the
hips of skeletons without spine joints would tilt when the trunk bends.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from probmotion.arrays import Array, array_namespace, constant
from probmotion.geometry.rotations import matrix_to_rotation_6d, rotation_6d_to_matrix
from probmotion.motion.kinematics import fit_rotations, forward_kinematics
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_finite, check_shape

__all__ = [
    "BodyStates", "check_bones", "check_single_root", "heading_of", "rest_pose", "to_world",
    "trunk_joints", "turned_about_vertical",
]  # fmt: skip

_GUIDE = 0.07
"""Position of a trunk's guide joint, as a fraction of the trunk's length."""
_MAX_BONE_LENGTH = 3.0
"""Maximum bone length, metres; longer bones suggest that the unit is not metres."""
_MIN_BONE_LENGTH = 1e-6
"""Minimum bone length, metres; the direction of shorter bones is undefined."""


@dataclass(frozen=True, eq=False)
class BodyStates:
    """Conversion between joint positions and pose vectors of one skeleton.

    Parameters
    ----------
    skeleton : Skeleton
        J joints, one root.
    rest : ndarray, (J, 3)
        Offset of each joint from its parent in the rest pose, metres.

    Raises
    ------
    ValueError
        If the skeleton has several roots, a shape is invalid, or a bone length is 0 or above
        3 m.
    """

    skeleton: Skeleton
    rest: np.ndarray

    def __post_init__(self) -> None:
        check_single_root(self.skeleton)
        rest = np.asarray(self.rest, dtype=np.float64)
        check_bones("rest", rest, self.skeleton)
        object.__setattr__(self, "rest", rest)

    @cached_property
    def _trunks(self) -> tuple[int, ...]:
        return trunk_joints(self.skeleton)

    @cached_property
    def _rig(self) -> Skeleton:
        """Skeleton with two additional joints per trunk.

        The first, at the lower end of the trunk, rotates the trunk. The second, a guide slightly
        above, rotates with the limbs and sets the lower joint's pitch if the limbs are collinear.
        """
        names, parents = list(self.skeleton.joint_names), list(self.skeleton.parents)
        for joint in self._trunks:
            names += [f"{names[joint]} trunk", f"{names[joint]} guide"]
            parents += [self.skeleton.parents[joint]] * 2
            parents[joint] = len(names) - 2
        return Skeleton(names, parents)

    def _offsets(self, offsets: Array) -> Array:
        """Return offsets (…, J, 3), followed by those of the rig's additional joints."""
        xp = array_namespace(offsets)
        parts = [offsets]
        for joint in self._trunks:
            trunk = offsets[..., joint : joint + 1, :]
            parts += [0 * trunk, _GUIDE * trunk]
        return xp.concat(parts, axis=-2)

    def _rig_positions(self, positions: np.ndarray) -> np.ndarray:
        lower = positions[:, [self.skeleton.parents[joint] for joint in self._trunks]]
        guides = lower + _GUIDE * (positions[:, list(self._trunks)] - lower)
        added = np.stack([lower, guides], axis=2).reshape(len(positions), -1, 3)
        return np.concatenate([positions, added], axis=1)

    @cached_property
    def turning(self) -> tuple[int, ...]:
        """Indices of the rotating joints, which have children; root first, trunks last."""
        root = self.skeleton.roots[0]
        parents = set(self._rig.parents) - {root}
        return (root, *(joint for joint in range(self._rig.n_joints) if joint in parents))

    @property
    def dim(self) -> int:
        """Length of a pose vector."""
        return 3 + 6 * len(self.turning)

    @property
    def groups(self) -> tuple[tuple[str, int, int], ...]:
        """Name, start and end of each part of a pose vector; orientation is the root's rotation."""
        return (("translation", 0, 3), ("orientation", 3, 9), ("rotations", 9, self.dim))

    def body(self, positions: np.ndarray) -> np.ndarray:
        """Return the rest offsets β of a recorded body, ``(L, J, 3) → (J, 3)``, metres.

        Bone lengths are means over frames. Bones from joints with several children have mean
        directions, as the widths of hips and shoulders differ; others have those of ``rest``.
        """
        lengths = np.zeros(self.skeleton.n_joints)
        for joint, parent in self.skeleton.bones:
            bones = positions[:, joint] - positions[:, parent]
            lengths[joint] = np.linalg.norm(bones, axis=-1).mean()
        # Fit the rotations to a body of the same size, or the joints would not coincide.
        offsets = self.of_lengths(lengths)
        rotations = self._global_rotations(positions, offsets)
        parents = self._rig.parents
        for joint, parent in self.skeleton.bones:
            if parents.count(parents[joint]) > 1:
                bones = positions[:, joint] - positions[:, parent]
                direction = np.einsum("lji,lj->i", rotations[:, parent], bones)
                offsets[joint] = direction * lengths[joint] / np.linalg.norm(direction)
        return offsets

    def of_lengths(self, lengths: np.ndarray) -> np.ndarray:
        """Return rest offsets with given bone lengths, ``(J,) → (J, 3)``, metres."""
        check_shape("lengths", lengths, (self.skeleton.n_joints,))
        bones = np.linalg.norm(self.rest, axis=-1, keepdims=True)
        return self.rest * (np.asarray(lengths)[:, None] / np.where(bones > 0, bones, 1.0))

    def states(self, positions: np.ndarray, body: np.ndarray) -> np.ndarray:
        """Return the pose vectors closest to positions, ``(L, J, 3), (J, 3) → (L, dim)``.

        Positions do not determine the twist of a limb; see
        :func:`~probmotion.motion.kinematics.fit_rotations`.
        """
        rotations, _ = fit_rotations(self._rig, self._rig_positions(positions), self._offsets(body))
        rotations_6d = matrix_to_rotation_6d(rotations[:, list(self.turning)])
        root = positions[:, self.skeleton.roots[0]]
        return np.concatenate([root, rotations_6d.reshape(len(positions), -1)], axis=-1)

    def positions(self, states: Array, body: Array) -> Array:
        """Return the joint positions M_β(x): ``(…, L, dim), (…, J, 3) → (…, L, J, 3)``, metres.

        ``body`` is β: the rest offsets of one body, or of one body per motion.
        """
        check_shape("states", states, ("…", "L", self.dim))
        xp = array_namespace(states)
        rotations_6d = xp.reshape(states[..., 3:], (*states.shape[:-1], len(self.turning), 6))
        matrices = rotation_6d_to_matrix(rotations_6d)
        identity = xp.zeros_like(matrices[..., 0, :, :]) + constant(np.eye(3), states)
        index = {joint: at for at, joint in enumerate(self.turning)}
        joints = range(self._rig.n_joints)
        rotations = [matrices[..., index[j], :, :] if j in index else identity for j in joints]
        offsets = self._offsets(constant(body, states) if isinstance(body, np.ndarray) else body)
        joints, _ = forward_kinematics(
            self._rig, xp.stack(rotations, axis=-3), states[..., None, :3], offsets
        )
        return joints[..., : self.skeleton.n_joints, :]

    def _global_rotations(self, positions: np.ndarray, body: np.ndarray) -> np.ndarray:
        """Return the global rotations of the J' joints of the rig, (L, J', 3, 3)."""
        rest = self._offsets(body)
        rotations, _ = fit_rotations(self._rig, self._rig_positions(positions), rest)
        translation = np.zeros((len(positions), 1, 3))
        return forward_kinematics(self._rig, rotations, translation, rest)[1]


def trunk_joints(skeleton: Skeleton) -> tuple[int, ...]:
    """Return the joints at the upper ends of trunks: unpaired siblings of paired joints."""
    paired = {joint for pair in skeleton.mirrored_pairs for joint in pair}
    branching = {parent for joint, parent in skeleton.bones if joint in paired}
    return tuple(j for j, parent in skeleton.bones if parent in branching and j not in paired)


def check_single_root(skeleton: Skeleton) -> None:
    """Raise ``ValueError`` unless the skeleton has exactly one root."""
    if len(skeleton.roots) != 1:
        raise ValueError(f"skeleton must have one root, got {len(skeleton.roots)}")


def check_bones(name: str, offsets: np.ndarray, skeleton: Skeleton) -> None:
    """Raise ``ValueError`` unless offsets from parents, (J, 3), are plausible bones in metres."""
    check_shape(name, offsets, (skeleton.n_joints, 3))
    check_finite(name, offsets)
    lengths = np.linalg.norm(offsets, axis=-1)
    for joint, _ in skeleton.bones:
        if not lengths[joint] > _MIN_BONE_LENGTH or lengths[joint] > _MAX_BONE_LENGTH:
            raise ValueError(
                f"{name} must have bones longer than 0 and at most {_MAX_BONE_LENGTH:g} m, got "
                f"{lengths[joint]:.4g} m for {skeleton.joint_names[joint]}"
            )


def heading_of(matrix: np.ndarray) -> np.ndarray:
    """Return the angle of the closest rotation about Y, ``(…, 3, 3) → (…)``, radians.

    The angle is ill-conditioned close to half turns about horizontal axes.
    """
    return np.arctan2(matrix[..., 0, 2] - matrix[..., 2, 0], matrix[..., 0, 0] + matrix[..., 2, 2])


def turned_about_vertical(positions: Array, angle: Array) -> Array:
    """Return motions rotated about Y by one angle each: ``(…, L, J, 3), (…) → (…, L, J, 3)``."""
    xp = array_namespace(positions)
    angle = constant(angle, positions) if isinstance(angle, np.ndarray | float) else angle
    cosine, sine = xp.cos(angle)[..., None, None], xp.sin(angle)[..., None, None]
    x, y, z = positions[..., 0], positions[..., 1], positions[..., 2]
    return xp.stack([cosine * x + sine * z, y, cosine * z - sine * x], axis=-1)


def to_world(positions: Array, heading: np.ndarray, ground: np.ndarray) -> Array:
    """Transform canonical motions to world coordinates: rotate about Y, then translate.

    ``(…, L, J, 3), (…), (…, 2) → (…, L, J, 3)``: heading in radians, X and Z in metres.
    """
    xp = array_namespace(positions)
    rotated = turned_about_vertical(positions, heading)
    x, z = (constant(ground[..., axis], positions) for axis in (0, 1))
    return rotated + xp.stack([x, xp.zeros_like(x), z], axis=-1)[..., None, None, :]


def rest_pose(skeleton: Skeleton, motions: list[np.ndarray]) -> np.ndarray:
    """Return rest offsets (J, 3), metres: the mean bones of motions (L, J, 3).

    Every frame is first rotated so that its left side points to +X and it faces +Z.

    Raises
    ------
    ValueError
        If there is no motion, the skeleton has no left-right pairs, or a bone has length 0.
    """
    if not motions:
        raise ValueError("motions must contain at least one motion, got none")
    pairs = skeleton.mirrored_pairs
    if not pairs:
        raise ValueError("skeleton must have left-right pairs to determine the heading, got none")
    poses = np.concatenate(motions)
    left, right = (list(side) for side in zip(*pairs, strict=True))
    across = (poses[:, left] - poses[:, right]).sum(axis=1)
    heading = np.arctan2(-across[:, 2], across[:, 0])
    upright = turned_about_vertical(poses[:, None], -heading)[:, 0]
    offsets = np.zeros((skeleton.n_joints, 3))
    for joint, parent in skeleton.bones:
        bones = upright[:, joint] - upright[:, parent]
        length, mean = np.linalg.norm(bones, axis=-1).mean(), bones.mean(axis=0)
        if not length > 0:
            name = skeleton.joint_names[joint]
            raise ValueError(f"motions must have bones longer than 0, got 0 m for {name}")
        offsets[joint] = mean * length / np.linalg.norm(mean)
    return offsets
