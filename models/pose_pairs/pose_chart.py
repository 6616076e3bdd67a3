"""Coordinates of poses relative to a seed: root poses, bone rotations and log bone lengths."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from probmotion.arrays import Array, array_namespace, constant, to_numpy
from probmotion.geometry.rotations import matrix_to_vector, vector_to_matrix
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_finite, check_positive, check_shape

__all__ = ["PoseChart"]


@dataclass(frozen=True, eq=False)
class PoseChart:
    """Chart between coordinates θ and poses of K trees, with θ = 0 at the seed.

    Bone j has rotation ``G_j = G exp(E_j α_j)`` and end joint ``x_j = x_parent + e^{λ_j} G_j b_j``,
    with the parent's rotation ``G``, the seed's bone vector ``b_j`` and a basis ``E_j`` (3, 2)
    orthogonal to it. A root has rotation ``exp(ω)`` and position ``x_seed + t``. θ contains ω of
    every root, t of every root, then (α₁, α₂, λ) of every bone in the order of ``skeleton.bones``.

    Parameters
    ----------
    seed : ndarray, (J, 3)
        Pose at θ = 0, metres.
    skeleton : Skeleton
        Skeleton of the J joints.
    bone_noise : float
        Standard deviation of the log bone lengths.
    root_noise : float
        Standard deviation of the root positions about the seed's, per axis, metres.
    """

    seed: np.ndarray
    skeleton: Skeleton
    bone_noise: float = 0.05
    root_noise: float = 1.0
    _bones: np.ndarray = field(init=False, repr=False)
    _bases: np.ndarray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        seed = np.asarray(self.seed, dtype=np.float64)
        check_shape("seed", seed, (self.skeleton.n_joints, 3))
        check_finite("seed", seed)
        check_positive("bone_noise", self.bone_noise)
        check_positive("root_noise", self.root_noise)
        ends, starts = self._ends
        bones = seed[ends] - seed[starts]
        lengths = np.linalg.norm(bones, axis=-1)
        if (lengths < 1e-6).any():
            short = self.skeleton.joint_names[ends[int(lengths.argmin())]]
            raise ValueError(
                f"seed must have bones longer than 1e-6 m, got {lengths.min():g} m for the bone "
                f"to {short}"
            )
        object.__setattr__(self, "seed", seed)
        object.__setattr__(self, "_bones", bones)
        object.__setattr__(self, "_bases", _square_to(bones / lengths[:, None]))

    @property
    def _ends(self) -> tuple[list[int], list[int]]:
        """End and start joints of the bones."""
        return [j for j, _ in self.skeleton.bones], [p for _, p in self.skeleton.bones]

    @property
    def dim(self) -> int:
        """Number of coordinates, 6 K + 3 (J − K)."""
        return 6 * len(self.skeleton.roots) + 3 * len(self.skeleton.bones)

    def positions(self, theta: Array) -> Array:
        """Return the pose at θ: ``(…, dim) → (…, J, 3)``, metres; NumPy, torch or JAX."""
        check_shape("theta", theta, ("…", self.dim))
        xp = array_namespace(theta)
        turns, translations, bends, stretches = self._parts(theta)
        local = vector_to_matrix(
            xp.sum(constant(self._bases, theta) * bends[..., None, :], axis=-1)
        )
        vectors = (xp.exp(stretches)[..., None] * constant(self._bones, theta))[..., None]
        frames = vector_to_matrix(turns)
        joints = translations + constant(self.seed[list(self.skeleton.roots)], theta)
        positions = [joints]
        # Process one generation of bones at a time: few large matrix products are faster.
        for bones, above in self._generations:
            frames = xp.matmul(frames[..., above, :, :], local[..., bones, :, :])
            joints = joints[..., above, :] + xp.matmul(frames, vectors[..., bones, :, :])[..., 0]
            positions.append(joints)
        return xp.concat(positions, axis=-2)[..., self._joint_order, :]

    def coordinates(self, positions: np.ndarray) -> np.ndarray:
        """Return coordinates θ of poses: ``(…, J, 3) → (…, dim)``.

        Root rotations are least-squares fits to the root's bones (Kabsch 1976); bones then rotate
        by the smallest angle. All bones must have a length above 1e-6 m.
        """
        positions = to_numpy(positions).astype(np.float64)
        check_shape("positions", positions, ("…", self.skeleton.n_joints, 3))
        check_finite("positions", positions)
        ends, starts = self._ends
        vectors = positions[..., ends, :] - positions[..., starts, :]
        lengths = np.linalg.norm(vectors, axis=-1)
        if (lengths < 1e-6).any():
            raise ValueError(
                f"positions must have bones longer than 1e-6 m, got {lengths.min():g} m"
            )
        rest = np.linalg.norm(self._bones, axis=-1)
        theta = np.zeros((*positions.shape[:-2], self.dim))
        turns, translations, bends, stretches = self._parts(theta)
        stretches[...] = np.log(lengths / rest)
        frames: dict[int, np.ndarray] = {}
        for k, root in enumerate(self.skeleton.roots):
            below = [bone for bone, start in enumerate(starts) if start == root]
            frames[root] = _best_rotation(self._bones[below], vectors[..., below, :])
            turns[..., k, :] = matrix_to_vector(frames[root])
            translations[..., k, :] = positions[..., root, :] - self.seed[root]
        for bone in (bone for bones, _ in self._generations for bone in bones):
            above = frames[starts[bone]]
            target = (np.swapaxes(above, -1, -2) @ vectors[..., bone, :, None])[..., 0]
            vector = _rotation_to(self._bones[bone] / rest[bone], target / lengths[..., bone, None])
            bends[..., bone, :] = vector @ self._bases[bone]
            frames[ends[bone]] = above @ vector_to_matrix(vector)
        return theta

    def log_measure(self, theta: Array) -> Array:
        """Return the log density of the base measure of poses: ``(…, dim) → (…)``, NumPy.

        Root rotations (Haar) and bone directions are uniform, root positions and log lengths
        Gaussian, all normalised. Rotations beyond π have density 0, so each direction counts once.
        """
        theta = to_numpy(theta)
        _, translations, _, stretches = self._parts(theta)
        total = self._log_directions(theta) + _log_normal(stretches, self.bone_noise)
        return total + _log_normal(translations.reshape(*theta.shape[:-1], -1), self.root_noise)

    def log_volume(self, theta: np.ndarray) -> np.ndarray:
        """Return the log density of θ for uniform positions (Lebesgue measure): ``(…, dim) → (…)``.

        The volume element of a bone of length l is l³ d(log l) d(direction). Root rotations, on
        which positions do not depend, are uniform.
        """
        stretches = self._parts(theta)[-1]
        lengths = np.linalg.norm(self._bones, axis=-1)
        return self._log_directions(theta) + 3 * (stretches + np.log(lengths)).sum(axis=-1)

    def _log_directions(self, theta: np.ndarray) -> np.ndarray:
        """Return the log density of uniform rotations of the roots and directions of the bones."""
        turns, _, bends, _ = self._parts(theta)
        angle = np.linalg.norm(turns, axis=-1)
        bend = np.linalg.norm(bends, axis=-1)
        inside = (angle < np.pi).all(axis=-1) & (bend < np.pi).all(axis=-1)
        # (1 − cos ω)/ω² = 2 (sin(ω/2)/ω)², and np.sinc(x) = sin(πx)/(πx).
        haar = 2 * np.log(np.sinc(angle / (2 * np.pi)) / 2) + np.log(1 / (2 * np.pi**2))
        with np.errstate(divide="ignore", invalid="ignore"):
            area = np.log(np.sinc(bend / np.pi) / (4 * np.pi))
        return np.where(inside, haar.sum(axis=-1) + area.sum(axis=-1), -np.inf)

    def speeds(self, turn: np.ndarray, stretch: np.ndarray) -> np.ndarray:
        """Return mean squared steps of the coordinates, (…, dim), from those of joints (eq. 12).

        Parameters
        ----------
        turn : ndarray, (…, J)
            Squared change of the bone's direction (at a root: of the backbone), radians².
        stretch : ndarray, (…, J)
            Squared change of the bone's length (at a root: of its position), metres².
        """
        speeds = np.empty((*turn.shape[:-1], self.dim))
        turns, translations, bends, stretches = self._parts(speeds)
        roots, ends = list(self.skeleton.roots), self._ends[0]
        turns[...] = turn[..., roots, None]
        translations[...] = stretch[..., roots, None]
        bends[...] = turn[..., ends, None]
        stretches[...] = stretch[..., ends] / (self._bones**2).sum(axis=-1)
        return speeds

    def _parts(self, theta: Array) -> tuple[Array, Array, Array, Array]:
        """Return views of ω (…, K, 3), t (…, K, 3), α (…, bones, 2) and λ (…, bones)."""
        n_roots, n_bones = len(self.skeleton.roots), len(self.skeleton.bones)
        batch = theta.shape[:-1]
        turns = theta[..., : 3 * n_roots].reshape((*batch, n_roots, 3))
        translations = theta[..., 3 * n_roots : 6 * n_roots].reshape((*batch, n_roots, 3))
        bones = theta[..., 6 * n_roots :].reshape((*batch, n_bones, 3))
        return turns, translations, bones[..., :2], bones[..., 2]

    @cached_property
    def _generations(self) -> list[tuple[list[int], list[int]]]:
        """Bones by depth, with the index of each parent in the previous generation."""
        before, generations = list(self.skeleton.roots), []
        while bones := [k for k, (_, parent) in enumerate(self.skeleton.bones) if parent in before]:
            above = [before.index(self.skeleton.bones[k][1]) for k in bones]
            generations.append((bones, above))
            before = [self.skeleton.bones[k][0] for k in bones]
        return generations

    @cached_property
    def _joint_order(self) -> list[int]:
        """Index of each joint in the order of generations."""
        order = list(self.skeleton.roots)
        order += [self.skeleton.bones[k][0] for bones, _ in self._generations for k in bones]
        return [order.index(joint) for joint in range(self.skeleton.n_joints)]


def _square_to(directions: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis of the plane orthogonal to each vector: (n, 3) → (n, 3, 2)."""
    other = np.eye(3)[np.abs(directions).argmin(axis=-1)]
    first = np.cross(directions, other)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(directions, first)], axis=-1)


def _best_rotation(rest: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return the least-squares rotations of ``rest`` (C, 3) to ``vectors`` (…, C, 3)."""
    left, _, right = np.linalg.svd(np.einsum("...ci,cj->...ij", vectors, rest))
    signs = np.ones((*vectors.shape[:-2], 1, 3))
    signs[..., 0, 2] = np.sign(np.linalg.det(left @ right))
    return (left * signs) @ right


def _rotation_to(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the shortest rotation vectors from unit ``start`` (3,) to ``end``, (…, 3)."""
    axis = np.cross(start, end)
    sine = np.linalg.norm(axis, axis=-1, keepdims=True)
    angle = np.arctan2(sine, (end @ start)[..., None])
    # For opposite directions, any orthogonal axis is valid.
    opposite = _square_to(start[None])[0, :, 0]
    return angle * np.where(sine > 1e-12, axis / np.where(sine > 0, sine, 1.0), opposite)


def _log_normal(values: np.ndarray, scale: float) -> np.ndarray:
    size = values.shape[-1]
    return -0.5 * (values**2).sum(axis=-1) / scale**2 - size * np.log(scale * np.sqrt(2 * np.pi))
