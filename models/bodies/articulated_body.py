"""Articulated body: joint positions from bone rotations and a rigid pose.

The body has the parameters ξ of *Ponymation* (section 3.1), a motion VAE learnt from 2D: ξ₁ ∈ SE(3)
is its rigid pose, ξ_b ∈ SO(3) the rotation of bone b from its rest pose.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from probmotion.arrays import Array, array_namespace, constant
from probmotion.geometry.rotations import vector_to_matrix
from probmotion.models.bodies.body_states import check_bones, check_single_root, trunk_joints
from probmotion.models.bodies.joint_ranges import range_of
from probmotion.motion.kinematics import forward_kinematics
from probmotion.motion.motion import Motion
from probmotion.motion.rest_poses import is_four_legged, joint_positions
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_shape

__all__ = ["ArticulatedBody"]


@dataclass(frozen=True, eq=False)
class ArticulatedBody:
    """Skeleton with a rest pose and bones that rotate about its joints.

    Trunks rotate separately, as in :class:`~probmotion.models.bodies.body_states.BodyStates`.

    Parameters
    ----------
    skeleton : Skeleton
        J joints, one root.
    rest : ndarray, (J, 3)
        Offset of each joint from its parent in the rest pose, metres; the root's is ignored. The
        body faces +Z, +Y is up and +X its left. Joint ranges assume a mean pose, as returned by
        :func:`~probmotion.motion.rest_poses.estimate_rest_pose`.

    Raises
    ------
    ValueError
        If the skeleton has several roots, a shape is wrong, or a bone has length 0 or more than
        3 m.
    """

    skeleton: Skeleton
    rest: np.ndarray

    def __post_init__(self) -> None:
        check_single_root(self.skeleton)
        rest = np.array(self.rest, dtype=np.float64)
        check_bones("rest", rest, self.skeleton)
        rest[self.skeleton.roots[0]] = 0.0
        object.__setattr__(self, "rest", rest)

    @cached_property
    def rig(self) -> Skeleton:
        """Skeleton of the joints and an additional one for every trunk, at its lower end."""
        names, parents = list(self.skeleton.joint_names), list(self.skeleton.parents)
        for joint in trunk_joints(self.skeleton):
            names.append(f"{names[joint]} trunk")
            parents.append(parents[joint])
            parents[joint] = len(names) - 1
        return Skeleton(names, parents)

    @cached_property
    def _rotating(self) -> tuple[int, ...]:
        """Indices of the rig's joints with children, except the root."""
        below = set(self.rig.parents) - {self.skeleton.roots[0], -1}
        return tuple(joint for joint in range(self.rig.n_joints) if joint in below)

    @property
    def rig_joints(self) -> tuple[int, ...]:
        """Joint of the rig with which each bone rotates, by the bone's lower joint; J indices.

        The root has its own index.
        """
        above = self.rig.parents[: self.skeleton.n_joints]
        return tuple(joint if parent < 0 else parent for joint, parent in enumerate(above))

    @property
    def bones(self) -> tuple[str, ...]:
        """Names of the joints about which the B bones rotate; trunks last."""
        return tuple(self.rig.joint_names[joint] for joint in self._rotating)

    @cached_property
    def symmetric(self) -> bool:
        """Whether the skeleton has left-right pairs and is mirror-symmetric."""
        order, parents = self.skeleton.mirrored_order, self.skeleton.parents
        return bool(self.skeleton.mirrored_pairs) and all(
            parents[order[joint]] == order[parent] for joint, parent in self.skeleton.bones
        )

    @cached_property
    def length_groups(self) -> tuple[int, ...]:
        """Index of each joint's bone-length group, 0 to G−1, shared by mirrored bones.

        In an asymmetric skeleton, every bone has its own group. The root's group has no effect.
        """
        order = self.skeleton.mirrored_order
        n_joints = self.skeleton.n_joints
        first = [min(j, order[j]) if self.symmetric else j for j in range(n_joints)]
        return tuple(sorted(set(first)).index(joint) for joint in first)

    @property
    def n_groups(self) -> int:
        """Number of bone-length groups G."""
        return max(self.length_groups) + 1

    @property
    def rest_positions(self) -> np.ndarray:
        """Joint positions of the rest pose relative to the root, (J, 3), metres."""
        return joint_positions(self.skeleton, self.rest)

    @property
    def lower(self) -> np.ndarray:
        """Lower limits of the rotation vectors, (B, 3), radians."""
        return self._ranges[0]

    @property
    def upper(self) -> np.ndarray:
        """Upper limits of the rotation vectors, (B, 3), radians."""
        return self._ranges[1]

    @cached_property
    def _ranges(self) -> tuple[np.ndarray, np.ndarray]:
        names, parents = self.skeleton.canonical_names, self.skeleton.parents
        animal, n_joints = is_four_legged(self.skeleton), self.skeleton.n_joints
        limits = []
        for joint in self._rotating:
            if joint < n_joints:
                children = [child for child, parent in self.skeleton.bones if parent == joint]
                below = self.rest[children].mean(axis=0)
                limits.append(range_of(names[joint], animal, self.rest[joint], below))
            else:
                (end,) = (j for j, parent in enumerate(self.rig.parents) if parent == joint)
                at_root = parents[end] in self.skeleton.roots
                name = "trunk" if at_root and names[end] != "tail" else names[end]
                limits.append(range_of(name, animal, self.rest[end], self.rest[end]))
        lower, upper = np.array(limits).reshape(-1, 2, 3).swapaxes(0, 1)
        return lower, upper

    def range_excess(self, turns: Array) -> Array:
        """Return the sum of squared excesses over the limits: ``(…, B, 3) → (…)``, radians²."""
        check_shape("turns", turns, ("…", len(self.bones), 3))
        xp = array_namespace(turns)
        lower, upper = constant(self.lower, turns), constant(self.upper, turns)
        excess = xp.where(turns > upper, turns - upper, xp.zeros_like(turns))
        excess = xp.where(turns < lower, lower - turns, excess)
        return xp.sum(excess**2, axis=(-2, -1))

    def positions(
        self,
        turns: Array,
        root_rotation: Array,
        root_translation: Array,
        log_lengths: Array | None = None,
    ) -> Array:
        """Return the joint positions, (…, L, J, 3), metres.

        Differentiable. Arguments are NumPy or torch arrays of one library; batch axes broadcast.

        Parameters
        ----------
        turns : Array, (…, L, B, 3)
            Rotation vectors of :attr:`bones` in their parents' frames, radians; 0 is the rest pose.
        root_rotation : Array, (…, L, 3, 3)
            Rotation of the whole body.
        root_translation : Array, (…, L, 3)
            Position of the root, metres.
        log_lengths : Array, (…, G), optional
            Logarithm of the length of each group's bones relative to the rest pose.
        """
        joints, _ = self._posed(turns, root_rotation, root_translation, log_lengths)
        return joints[..., : self.skeleton.n_joints, :]

    def bone_frames(
        self,
        turns: Array,
        root_rotation: Array,
        root_translation: Array,
        log_lengths: Array | None = None,
    ) -> tuple[Array, Array]:
        """Return the upper end (…, L, J, 3), metres, and rotation (…, L, J, 3, 3) of every bone.

        A bone has the index of its lower joint; the root's entry is the root's own frame. Arguments
        are those of :meth:`positions`.
        """
        joints, rotations = self._posed(turns, root_rotation, root_translation, log_lengths)
        upper = list(self.rig_joints)
        return joints[..., upper, :], rotations[..., upper, :, :]

    def rig_motion(
        self,
        turns: np.ndarray,
        root_rotation: np.ndarray,
        root_translation: np.ndarray,
        log_lengths: np.ndarray,
        fps: float,
    ) -> Motion:
        """Return one motion of the rig with its rotations, whose bones are exactly rigid.

        Arguments are those of :meth:`positions` without batch axes, and the frame rate.
        """
        joints, _ = self._posed(turns, root_rotation, root_translation, log_lengths)
        rest = np.zeros((self.rig.n_joints, 3))
        rest[: self.skeleton.n_joints] = (
            self.rest * np.exp(log_lengths)[list(self.length_groups), None]
        )
        matrices = vector_to_matrix(turns)
        rotations = self._rotations(np, matrices, root_rotation, turns.shape[:1])
        return Motion(joints, self.rig, fps, rotations=rotations, rest_offsets=rest)

    def _posed(
        self,
        turns: Array,
        root_rotation: Array,
        root_translation: Array,
        log_lengths: Array | None,
    ) -> tuple[Array, Array]:
        """Return positions and rotations of the rig's J' joints."""
        check_shape("turns", turns, ("…", "L", len(self.bones), 3))
        check_shape("root_rotation", root_rotation, ("…", "L", 3, 3))
        check_shape("root_translation", root_translation, ("…", "L", 3))
        xp = array_namespace(turns, root_rotation, root_translation)
        offsets = constant(self.rest, turns)
        batch = [turns.shape[:-2], root_rotation.shape[:-2], root_translation.shape[:-1]]
        if log_lengths is not None:
            check_shape("log_lengths", log_lengths, ("…", self.n_groups))
            factors = [xp.exp(log_lengths[..., group]) for group in self.length_groups]
            offsets = offsets * xp.stack(factors, axis=-1)[..., None]
            batch.append((*log_lengths.shape[:-1], 1))
        shape = np.broadcast_shapes(*(tuple(axes) for axes in batch))
        zero = xp.zeros_like(offsets[..., :1, :])
        n_trunks = self.rig.n_joints - self.skeleton.n_joints
        rotations = self._rotations(xp, vector_to_matrix(turns), root_rotation, shape)
        return forward_kinematics(
            self.rig,
            rotations,
            xp.broadcast_to(root_translation, (*shape, 3))[..., None, :],
            xp.concat([offsets, *[zero] * n_trunks], axis=-2),
        )

    def _rotations(
        self, xp: Any, matrices: Array, root_rotation: Array, shape: tuple[int, ...]
    ) -> Array:
        """Return the rotations of the J' joints of the rig, (…, L, J', 3, 3)."""
        identity = constant(np.eye(3), matrices)
        rotations = {joint: matrices[..., at, :, :] for at, joint in enumerate(self._rotating)}
        rotations[self.skeleton.roots[0]] = root_rotation
        each = [
            xp.broadcast_to(rotations.get(joint, identity), (*shape, 3, 3))
            for joint in range(self.rig.n_joints)
        ]
        return xp.stack(each, axis=-3)
