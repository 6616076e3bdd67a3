"""A pose as numbers that a network can follow: where the root is, how each joint is turned.

The state of a frame is the root's translation (3), then six numbers of rotation (Zhou et al. 2019)
for every joint that has children, the root's first (Motion-DVAE's x_t). Bone lengths are
not in it: they are the body's.

Where a trunk leaves a joint that limbs hang on, as at the pelvis, it has a rotation of its own:
markers' skeletons without a spine's joints would else tilt the hips with every bow.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from probmotion.arrays import Array, array_namespace, constant
from probmotion.geometry.rotations import matrix_to_six_numbers, six_numbers_to_matrix
from probmotion.motion.kinematics import fit_rotations, forward_kinematics
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_finite, check_shape

__all__ = [
    "BodyStates",
    "Placement",
    "check_bones",
    "heading_of",
    "rest_pose",
    "trunk_joints",
    "turned_about_vertical",
]

_GUIDE = 0.07
"""How far up a trunk its guide is, as a share of the trunk."""
_LONGEST = 3.0
# A millionth of a metre: less points nowhere.
_SHORTEST = 1e-6
"""Metres: longer bones are in another unit."""


@dataclass(frozen=True, eq=False)
class Placement:
    """Where a canonical motion stands in the world: turned about the vertical, then moved.

    Parameters
    ----------
    heading : ndarray, (…)
        Radians about Y.
    ground : ndarray, (…, 2)
        X and Z of the origin, metres.
    """

    heading: np.ndarray
    ground: np.ndarray

    def to_world(self, positions: Array) -> Array:
        """Return canonical positions in the world, ``(…, L, J, 3) → (…, L, J, 3)``."""
        xp = array_namespace(positions)
        turned = turned_about_vertical(positions, self.heading)
        ground = constant(self.ground, positions)
        zero = xp.zeros_like(ground[..., 0])
        return (
            turned + xp.stack([ground[..., 0], zero, ground[..., 1]], axis=-1)[..., None, None, :]
        )

    def to_canonical(self, positions: Array) -> Array:
        """Return world positions in the canonical frame; the inverse of :meth:`to_world`."""
        xp = array_namespace(positions)
        ground = constant(self.ground, positions)
        zero = xp.zeros_like(ground[..., 0])
        moved = (
            positions
            - xp.stack([ground[..., 0], zero, ground[..., 1]], axis=-1)[..., None, None, :]
        )
        return turned_about_vertical(moved, -self.heading)


@dataclass(frozen=True, eq=False)
class BodyStates:
    """States of one skeleton, seen from one rest pose; the root's rotation is the first.

    Parameters
    ----------
    skeleton : Skeleton
        J joints, one root.
    rest : ndarray, (J, 3)
        Each joint's offset from its parent in the rest pose, metres: which way bones point where
        nothing is turned, and how long those of the usual body are.

    Raises
    ------
    ValueError
        If the skeleton has several roots, a shape does not fit, or a bone has no length or one
        that no bone has in metres.
    """

    skeleton: Skeleton
    rest: np.ndarray

    def __post_init__(self) -> None:
        if len(self.skeleton.roots) != 1:
            raise ValueError(
                f"skeleton has {len(self.skeleton.roots)} roots, expected one: a state is one body"
            )
        rest = np.asarray(self.rest, dtype=np.float64)
        check_bones("rest", rest, self.skeleton)
        object.__setattr__(self, "rest", rest)

    @cached_property
    def _trunks(self) -> tuple[int, ...]:
        return trunk_joints(self.skeleton)

    @cached_property
    def _rig(self) -> Skeleton:
        """The skeleton with two joints more per trunk.

        One that turns the trunk, at its lower joint, and one a little way up that turns with the
        limbs: it says how the lower joint is pitched where the limbs are in line with it.
        """
        names, parents = list(self.skeleton.joint_names), list(self.skeleton.parents)
        for joint in self._trunks:
            names += [f"{names[joint]} trunk", f"{names[joint]} guide"]
            parents += [self.skeleton.parents[joint]] * 2
            parents[joint] = len(names) - 2
        return Skeleton(names, parents)

    def _rigged(self, offsets: Array) -> Array:
        """Return offsets (…, J, 3) with those of the rig's joints."""
        xp = array_namespace(offsets)
        parts = [offsets]
        for joint in self._trunks:
            trunk = offsets[..., joint : joint + 1, :]
            parts += [0 * trunk, _GUIDE * trunk]
        return xp.concat(parts, axis=-2)

    def _rig_positions(self, positions: np.ndarray) -> np.ndarray:
        below = positions[:, [self.skeleton.parents[joint] for joint in self._trunks]]
        guides = below + _GUIDE * (positions[:, list(self._trunks)] - below)
        more = np.stack([below, guides], axis=2).reshape(len(positions), -1, 3)
        return np.concatenate([positions, more], axis=1)

    @cached_property
    def turning(self) -> tuple[int, ...]:
        """Joints that have children, the root first and trunks' own at the end.

        The others turn nothing.
        """
        root = self.skeleton.roots[0]
        below = set(self._rig.parents) - {root}
        return (root, *(joint for joint in range(self._rig.n_joints) if joint in below))

    @property
    def dim(self) -> int:
        """Numbers of a state."""
        return 3 + 6 * len(self.turning)

    @property
    def groups(self) -> tuple[tuple[str, int, int], ...]:
        """Name, first and end of the state's parts: translation, orientation, joints' rotations.

        Orientation is the root's rotation.
        """
        return (("translation", 0, 3), ("orientation", 3, 9), ("rotations", 9, self.dim))

    def body(self, positions: np.ndarray) -> np.ndarray:
        """Return the body that moves, its rest offsets (J, 3), metres: the design's β.

        Bones' mean lengths; where a joint has several children, their mean directions too, since
        bodies differ in how wide hips and shoulders are.

        Parameters
        ----------
        positions : ndarray, (L, J, 3)
            Metres.
        """
        lengths = np.zeros(self.skeleton.n_joints)
        for joint, parent in self.skeleton.bones:
            bones = positions[:, joint] - positions[:, parent]
            lengths[joint] = np.linalg.norm(bones, axis=-1).mean()
        # Of its own size: in bones of other lengths no joint would be where the next begins.
        offsets = self.of_lengths(lengths)
        turns = self._turns(positions, offsets)
        parents = self._rig.parents
        for joint, parent in self.skeleton.bones:
            if parents.count(parents[joint]) > 1:
                bones = positions[:, joint] - positions[:, parent]
                direction = np.einsum("lji,lj->i", turns[:, parent], bones)
                offsets[joint] = direction * lengths[joint] / np.linalg.norm(direction)
        return offsets

    def of_lengths(self, lengths: np.ndarray) -> np.ndarray:
        """Return the body whose bones point as in the rest pose and are so long, (J,) → (J, 3)."""
        check_shape("lengths", lengths, (self.skeleton.n_joints,))
        bones = np.linalg.norm(self.rest, axis=-1, keepdims=True)
        return self.rest * (np.asarray(lengths)[:, None] / np.where(bones > 0, bones, 1.0))

    def states(self, positions: np.ndarray, body: np.ndarray) -> np.ndarray:
        """Return the states that are nearest to positions, ``(L, J, 3), (J, 3) → (L, dim)``.

        How a limb turns about itself is not seen in positions: see
        :func:`~probmotion.motion.kinematics.fit_rotations`.
        """
        rotations, _ = fit_rotations(self._rig, self._rig_positions(positions), self._rigged(body))
        numbers = matrix_to_six_numbers(rotations[:, list(self.turning)])
        root = positions[:, self.skeleton.roots[0]]
        return np.concatenate([root, numbers.reshape(len(positions), -1)], axis=-1)

    def positions(self, states: Array, body: Array) -> Array:
        """Return M_β(x), where the joints are: ``(…, L, dim) → (…, L, J, 3)``, metres.

        Parameters
        ----------
        states : Array, (…, L, dim)
            x.
        body : Array, (…, J, 3)
            β: rest offsets of one body for all motions, or of one for each.
        """
        check_shape("states", states, ("…", "L", self.dim))
        xp = array_namespace(states)
        numbers = xp.reshape(states[..., 3:], (*states.shape[:-1], len(self.turning), 6))
        matrices = six_numbers_to_matrix(numbers)
        still = xp.zeros_like(matrices[..., 0, :, :]) + constant(np.eye(3), states)
        which = {joint: at for at, joint in enumerate(self.turning)}
        joints = range(self._rig.n_joints)
        rotations = [matrices[..., which[j], :, :] if j in which else still for j in joints]
        offsets = self._rigged(constant(body, states) if isinstance(body, np.ndarray) else body)
        found, _ = forward_kinematics(
            self._rig, xp.stack(rotations, axis=-3), states[..., None, :3], offsets
        )
        return found[..., : self.skeleton.n_joints, :]

    def canonical(self, states: np.ndarray) -> tuple[np.ndarray, Placement]:
        """Return states whose first frame stands at the origin and looks ahead, and where it was.

        The root of frame 0 is above the origin and its heading is 0 (Motion-DVAE, A.4): ``(L, dim)
        → (L, dim)``.
        """
        check_shape("states", states, ("L", self.dim))
        root = six_numbers_to_matrix(states[..., 3:9])
        place = Placement(heading_of(root[0]), states[0, [0, 2]])
        back = _about_vertical(-place.heading)
        moved = states.copy()
        moved[:, :3] -= np.array([place.ground[0], 0.0, place.ground[1]])
        moved[:, :3] = moved[:, :3] @ back.T
        moved[:, 3:9] = matrix_to_six_numbers(back @ root)
        return moved, place

    def _turns(self, positions: np.ndarray, body: np.ndarray) -> np.ndarray:
        """Return the rotations in the world of joints of a body, (L, J', 3, 3)."""
        rest = self._rigged(body)
        rotations, _ = fit_rotations(self._rig, self._rig_positions(positions), rest)
        still = np.zeros((len(positions), 1, 3))
        return forward_kinematics(self._rig, rotations, still, rest)[1]


def trunk_joints(skeleton: Skeleton) -> tuple[int, ...]:
    """Return joints at the end of a trunk: unpaired, on a joint that has paired children too."""
    paired = {joint for pair in skeleton.mirrored_pairs for joint in pair}
    limbed = {parent for joint, parent in skeleton.bones if joint in paired}
    return tuple(j for j, parent in skeleton.bones if parent in limbed and j not in paired)


def check_bones(name: str, offsets: np.ndarray, skeleton: Skeleton) -> None:
    """Raise ``ValueError`` unless offsets (J, 3) from parents are those of a body, in metres."""
    check_shape(name, offsets, (skeleton.n_joints, 3))
    check_finite(name, offsets)
    lengths = np.linalg.norm(offsets, axis=-1)
    for joint, _ in skeleton.bones:
        if not lengths[joint] > _SHORTEST:
            raise ValueError(
                f"{name} has a bone of no length, to {skeleton.joint_names[joint]}, expected all "
                "bones to point somewhere"
            )
        if lengths[joint] > _LONGEST:
            raise ValueError(
                f"{name} has a bone of length {lengths[joint]:.4g}, to "
                f"{skeleton.joint_names[joint]}, expected metres, at most {_LONGEST:g}"
            )


def heading_of(matrix: np.ndarray) -> np.ndarray:
    """Return the angle about Y that is nearest to a rotation, ``(…, 3, 3) → (…)``, radians.

    It is unstable only near half turns about horizontal axes, where no heading is nearest.
    """
    return np.arctan2(matrix[..., 0, 2] - matrix[..., 2, 0], matrix[..., 0, 0] + matrix[..., 2, 2])


def turned_about_vertical(positions: Array, angle: Array) -> Array:
    """Return motions turned about Y by one angle each: ``(…, L, J, 3), (…) → (…, L, J, 3)``."""
    xp = array_namespace(positions)
    angle = constant(angle, positions) if isinstance(angle, np.ndarray | float) else angle
    cosine, sine = xp.cos(angle)[..., None, None], xp.sin(angle)[..., None, None]
    x, y, z = positions[..., 0], positions[..., 1], positions[..., 2]
    return xp.stack([cosine * x + sine * z, y, cosine * z - sine * x], axis=-1)


def rest_pose(skeleton: Skeleton, motions: list[np.ndarray]) -> np.ndarray:
    """Return the rest pose of a kind of body: bones as they point on average.

    Every frame is turned so that what is left of the body is at +X (so it looks along +Z); bones'
    mean directions there, and mean lengths, are the rest offsets (J, 3), metres.

    Parameters
    ----------
    skeleton : Skeleton
        J joints, some of them left-right pairs.
    motions : list of ndarray, (L, J, 3)
        Metres.

    Raises
    ------
    ValueError
        If there is no motion, or the skeleton has no left-right pairs: no side, no heading.
    """
    if not motions:
        raise ValueError("motions must contain at least one, got none")
    pairs = skeleton.mirrored_pairs
    if not pairs:
        raise ValueError("skeleton has no left-right pairs, expected some, to tell where it looks")
    poses = np.concatenate(motions)
    left, right = (list(side) for side in zip(*pairs, strict=True))
    across = (poses[:, left] - poses[:, right]).sum(axis=1)
    heading = np.arctan2(-across[:, 2], across[:, 0])
    upright = turned_about_vertical(poses[:, None], -heading)[:, 0]
    offsets = np.zeros((skeleton.n_joints, 3))
    for joint, parent in skeleton.bones:
        bones = upright[:, joint] - upright[:, parent]
        length = np.linalg.norm(bones, axis=-1).mean()
        mean = bones.mean(axis=0)
        if not length > 0:
            raise ValueError(
                f"motions has a bone of no length, to {skeleton.joint_names[joint]}, expected all "
                "bones to point somewhere"
            )
        offsets[joint] = mean * length / np.linalg.norm(mean)
    return offsets


def _about_vertical(angle: np.ndarray | float) -> np.ndarray:
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
