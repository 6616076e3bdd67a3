"""Forward kinematics and least-squares fits of joint rotations to positions."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from array_api_compat import device, is_jax_array

from probmotion.arrays import Array, array_namespace
from probmotion.geometry.rotations import vector_to_matrix
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_finite, check_shape

__all__ = [
    "best_rotations",
    "fit_rotations",
    "forward_kinematics",
    "least_rotations",
    "mean_shape",
]

# Number of iterations of the alternating fit of rest offsets and rotations.
_FITS = 3
# Relative weight of the parent's rotation in a fit; it affects only undetermined twists.
_TIE = 1e-12


def forward_kinematics(
    skeleton: Skeleton, rotations: Array, root_translations: Array, rest_offsets: Array
) -> tuple[Array, Array]:
    """Return joint positions and global rotations from local rotations.

    Joint j with local rotation R_j and rest offset o_j has global rotation ``G_j = G_parent R_j``
    and position ``p_j = p_parent + G_parent o_j``; for a root, ``G_j = R_j`` and p_j is given.

    Parameters
    ----------
    skeleton : Skeleton
        J joints with R roots. Parents may follow their children.
    rotations : Array, (…, L, J, 3, 3)
        Rotation of each joint in its parent's frame.
    root_translations : Array, (…, L, R, 3)
        Root positions in the order of ``skeleton.roots``, metres.
    rest_offsets : Array, (…, J, 3)
        Offset of each joint from its parent in the rest pose, metres; ignored for roots. Batch axes
        broadcast. All arrays may be NumPy, torch or JAX arrays.

    Returns
    -------
    positions : Array, (…, L, J, 3)
        Joint positions, metres.
    global_rotations : Array, (…, L, J, 3, 3)
        Rotation from each joint's frame to the world.

    Raises
    ------
    ValueError
        If a shape does not match the skeleton.
    """
    check_shape("rotations", rotations, ("…", "L", skeleton.n_joints, 3, 3))
    check_shape("root_translations", root_translations, ("…", "L", len(skeleton.roots), 3))
    check_shape("rest_offsets", rest_offsets, ("…", skeleton.n_joints, 3))
    xp = array_namespace(rotations, root_translations, rest_offsets)
    levels = _levels(skeleton)
    # All joints at the same depth are computed in one step.
    global_rotations = [_at(xp, rotations, levels[0], -3)]
    positions = [root_translations]
    for above, level in pairwise(levels):
        parents = [above.index(skeleton.parents[joint]) for joint in level]
        to_world = _at(xp, global_rotations[-1], parents, -3)
        offsets = _at(xp, rest_offsets, level, -2)[..., None, :, None, :]
        positions.append(_at(xp, positions[-1], parents, -2) + xp.sum(to_world * offsets, axis=-1))
        global_rotations.append(_product(xp, to_world, _at(xp, rotations, level, -3)))
    order = [joint for level in levels for joint in level]
    inverse = [order.index(joint) for joint in range(skeleton.n_joints)]
    return (
        _at(xp, xp.concat(positions, axis=-2), inverse, -2),
        _at(xp, xp.concat(global_rotations, axis=-3), inverse, -3),
    )


def _levels(skeleton: Skeleton) -> list[list[int]]:
    """Return the joints grouped by the number of bones between joint and root."""
    depths = [len(skeleton.ancestors(joint)) for joint in range(skeleton.n_joints)]
    return [
        [joint for joint, depth in enumerate(depths) if depth == level]
        for level in range(max(depths) + 1)
    ]


def _product(xp: Any, first: Array, second: Array) -> Array:
    if is_jax_array(first):
        # XLA fails to compile a batched matrix product of gathered joints.
        return xp.sum(first[..., None] * second[..., None, :, :], axis=-2)
    return xp.matmul(first, second)


def _at(xp: Any, values: Array, joints: list[int], axis: int) -> Array:
    """Return the entries of ``joints`` along ``axis``."""
    where = {} if is_jax_array(values) else {"device": device(values)}
    return xp.take(values, xp.asarray(joints, **where), axis=axis)


def fit_rotations(
    skeleton: Skeleton, positions: np.ndarray, rest_offsets: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return joint rotations and a rest pose that reproduce positions in the least-squares sense.

    With the root positions as translations, :func:`forward_kinematics` of the result reproduces the
    positions exactly if bone lengths and the angles between siblings are constant. Otherwise, bones
    have their mean length, and joints with several children have their least-squares rotation
    (Kabsch 1976). Errors do not accumulate, since each bone starts at the fitted end of its parent.

    Positions do not determine the twist about a bone. A joint with at most one child, or with
    collinear children, is rotated minimally relative to its parent.

    Parameters
    ----------
    skeleton : Skeleton
        J joints.
    positions : ndarray, (L, J, 3)
        Joint positions, metres.
    rest_offsets : ndarray, (J, 3), optional
        Rest pose, metres. By default, it is fitted, in an orientation close to the first frame.

    Returns
    -------
    rotations : ndarray, (L, J, 3, 3)
        Rotation of each joint in its parent's frame.
    rest_offsets : ndarray, (J, 3)
        Offset of each joint from its parent in the rest pose, metres; 0 for roots if fitted.

    Raises
    ------
    ValueError
        If a shape does not match, ``positions`` is empty, or a value is not finite.
    """
    positions = np.asarray(positions, dtype=np.float64)
    check_shape("positions", positions, ("L", skeleton.n_joints, 3))
    if len(positions) == 0:
        raise ValueError("positions must contain at least one frame, got none")
    check_finite("positions", positions)
    children: dict[int, list[int]] = {}
    for joint, parent in skeleton.bones:
        children.setdefault(parent, []).append(joint)
    if rest_offsets is None:
        offsets = np.zeros((skeleton.n_joints, 3))
        for joint, below in children.items():
            offsets[below] = mean_shape(positions[:, below] - positions[:, joint, None])
    else:
        check_shape("rest_offsets", rest_offsets, (skeleton.n_joints, 3))
        offsets = np.asarray(rest_offsets, dtype=np.float64)

    frames = len(positions)
    world = np.zeros((frames, skeleton.n_joints, 3, 3))
    rotations = np.zeros_like(world)
    fitted = positions.copy()
    for joint in skeleton.topological_order:
        parent = skeleton.parents[joint]
        above = np.broadcast_to(np.eye(3), (frames, 3, 3)) if parent < 0 else world[:, parent]
        if parent >= 0:
            fitted[:, joint] = fitted[:, parent] + world[:, parent] @ offsets[joint]
        below = children.get(joint, [])
        bones = positions[:, below] - fitted[:, joint, None]
        world[:, joint] = best_rotations(offsets[below], bones, above)
        rotations[:, joint] = np.swapaxes(above, -1, -2) @ world[:, joint]
    return rotations, offsets


def mean_shape(bones: np.ndarray) -> np.ndarray:
    """Return the rigid set of bones (C, 3) that best fits the bones (L, C, 3) of all frames."""
    lengths = np.linalg.norm(bones, axis=-1).mean(axis=0)
    rest = _of_lengths(bones[0], lengths)
    identity = np.broadcast_to(np.eye(3), (len(bones), 3, 3))
    for _ in range(_FITS if len(lengths) > 1 else 0):
        rotations = best_rotations(rest, bones, identity)
        rest = _of_lengths(np.einsum("lij,lci->cj", rotations, bones), lengths)
    return rest


def _of_lengths(vectors: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Return vectors (C, 3) scaled to lengths (C,); zero vectors point upwards."""
    norms = np.linalg.norm(vectors, axis=-1)
    directions = np.where(
        norms[:, None] > 0, vectors / np.where(norms > 0, norms, 1.0)[:, None], [0.0, 1.0, 0.0]
    )
    return directions * lengths[:, None]


def best_rotations(rest: np.ndarray, bones: np.ndarray, above: np.ndarray) -> np.ndarray:
    """Return the rotations (L, 3, 3) that best align ``rest`` (C, 3) with ``bones`` (L, C, 3).

    Where bones do not determine a rotation, it follows that of the parent, ``above`` (L, 3, 3).
    """
    if len(rest) == 0:
        return above.copy()
    if len(rest) == 1:
        return least_rotations(above @ rest[0], bones[:, 0]) @ above
    products = np.einsum("lci,cj->lij", bones, rest)
    scale = np.linalg.norm(products, axis=(-2, -1))
    weight = _TIE * np.where(scale > 0, scale, 1.0)
    left, _, right = np.linalg.svd(products + weight[:, None, None] * above)
    signs = np.ones((len(bones), 1, 3))
    signs[:, 0, 2] = np.sign(np.linalg.det(left @ right))
    return (left * signs) @ right


def least_rotations(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the smallest rotations that align each ``start`` (L, 3) with ``end``."""
    lengths = np.linalg.norm(start, axis=-1), np.linalg.norm(end, axis=-1)
    nonzero = (lengths[0] > 0) & (lengths[1] > 0)
    start = start / np.where(nonzero, lengths[0], 1.0)[:, None]
    end = end / np.where(nonzero, lengths[1], 1.0)[:, None]
    axis = np.cross(start, end)
    # Opposite directions are rotated about any axis orthogonal to ``start``.
    parallel = np.linalg.norm(axis, axis=-1) < 1e-12
    fallback = np.cross(start, np.eye(3)[np.abs(start).argmin(axis=-1)])
    axis = np.where(parallel[:, None], fallback, axis)
    axis = axis - (axis * start).sum(axis=-1, keepdims=True) * start
    norms = np.linalg.norm(axis, axis=-1, keepdims=True)
    axis = axis / np.where(norms > 0, norms, 1.0)
    cosine = (start * end).sum(axis=-1)
    sine = (np.cross(axis, start) * end).sum(axis=-1)
    angle = np.where(nonzero, np.arctan2(sine, cosine), 0.0)
    return vector_to_matrix(angle[:, None] * axis)
