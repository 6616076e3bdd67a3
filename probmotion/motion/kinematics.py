"""From joint rotations to positions, and back."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from array_api_compat import device, is_jax_array

from probmotion.arrays import Array, array_namespace
from probmotion.geometry.rotations import vector_to_matrix
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_finite, check_shape

__all__ = ["fit_rotations", "forward_kinematics"]

# Rest offsets and rotations are fitted in turn; the first rest pose is already near.
_PASSES = 3
# Weight of "turn with the parent", relative to the bones: decides only what they leave open.
_TIE = 1e-12


def forward_kinematics(
    skeleton: Skeleton, rotations: Array, root_translations: Array, rest_offsets: Array
) -> tuple[Array, Array]:
    """Return where the joints are, and how they are turned in the world.

    ``G_j = G_parent R_j`` and ``p_j = p_parent + G_parent o_j``; at a root ``G_j = R_j`` and p_j
    is its translation. NumPy, torch and JAX arrays alike.

    Parameters
    ----------
    skeleton : Skeleton
        J joints, R of them roots. Parents may come after their children.
    rotations : Array, (…, L, J, 3, 3)
        Each joint's rotation in its parent's frame.
    root_translations : Array, (…, L, R, 3)
        Positions of the roots in the order of ``skeleton.roots``, metres.
    rest_offsets : Array, (…, J, 3)
        Each joint's offset from its parent in the rest pose, metres. A root's is not used. Batch
        axes broadcast: one body for all motions, or one for each.

    Returns
    -------
    positions : Array, (…, L, J, 3)
        Metres.
    global_rotations : Array, (…, L, J, 3, 3)
        From each joint's frame to the world.

    Raises
    ------
    ValueError
        If a shape does not fit the skeleton.
    """
    check_shape("rotations", rotations, ("…", "L", skeleton.n_joints, 3, 3))
    check_shape("root_translations", root_translations, ("…", "L", len(skeleton.roots), 3))
    check_shape("rest_offsets", rest_offsets, ("…", skeleton.n_joints, 3))
    xp = array_namespace(rotations, root_translations, rest_offsets)
    levels = _levels(skeleton)
    # Joints equally far from a root are one step: a body has many joints and few such steps.
    turns = [_at(xp, rotations, levels[0], -3)]
    positions = [root_translations]
    for above, level in pairwise(levels):
        parents = [above.index(skeleton.parents[joint]) for joint in level]
        over = _at(xp, turns[-1], parents, -3)
        offsets = _at(xp, rest_offsets, level, -2)[..., None, :, None, :]
        positions.append(_at(xp, positions[-1], parents, -2) + xp.sum(over * offsets, axis=-1))
        turns.append(_product(xp, over, _at(xp, rotations, level, -3)))
    order = [joint for level in levels for joint in level]
    back = [order.index(joint) for joint in range(skeleton.n_joints)]
    return (
        _at(xp, xp.concat(positions, axis=-2), back, -2),
        _at(xp, xp.concat(turns, axis=-3), back, -3),
    )


def _levels(skeleton: Skeleton) -> list[list[int]]:
    """Return the joints by how many bones they are from a root; roots in their own order."""
    depths = [len(skeleton.ancestors(joint)) for joint in range(skeleton.n_joints)]
    return [
        [joint for joint, depth in enumerate(depths) if depth == level]
        for level in range(max(depths) + 1)
    ]


def _product(xp: Any, first: Array, second: Array) -> Array:
    if is_jax_array(first):
        # XLA cannot compile a batch of matrix products behind a choice of joints.
        return xp.sum(first[..., None] * second[..., None, :, :], axis=-2)
    return xp.matmul(first, second)


def _at(xp: Any, values: Array, joints: list[int], axis: int) -> Array:
    """Return the entries of some joints along an axis of joints."""
    where = {} if is_jax_array(values) else {"device": device(values)}
    return xp.take(values, xp.asarray(joints, **where), axis=axis)


def fit_rotations(
    skeleton: Skeleton, positions: np.ndarray, rest_offsets: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return joint rotations and a rest pose that reproduce positions as well as they can.

    With the roots' positions as translations, :func:`forward_kinematics` of the result gives the
    positions back exactly where every bone keeps its length and the children of each joint keep
    their angles to each other. Elsewhere something is lost: a bone's change of length over time
    (the rest pose has its mean), and the movement of siblings against each other (their joint
    has one rotation, the best in least squares: Kabsch 1976). The error of a joint is not passed
    on: the next bone aims at its own end from where the last one really ended.

    Positions do not say how a bone turns about itself. A joint with one child, or with none, or
    with children in line, gets the least rotation against its parent, without that twist.

    Parameters
    ----------
    skeleton : Skeleton
        J joints.
    positions : ndarray, (L, J, 3)
        Metres.
    rest_offsets : ndarray, (J, 3), optional
        The rest pose that rotations are from; by default one is fitted, near the first frame.

    Returns
    -------
    rotations : ndarray, (L, J, 3, 3)
        Each joint's rotation in its parent's frame.
    rest_offsets : ndarray, (J, 3)
        Each joint's offset from its parent in the rest pose, metres; of a fitted one 0 for roots.

    Raises
    ------
    ValueError
        If the shape does not fit, there is no frame, or a value is not finite.
    """
    positions = np.asarray(positions, dtype=np.float64)
    check_shape("positions", positions, ("L", skeleton.n_joints, 3))
    if len(positions) == 0:
        raise ValueError("positions has no frame, expected at least one")
    check_finite("positions", positions)
    children: dict[int, list[int]] = {}
    for joint, parent in skeleton.bones:
        children.setdefault(parent, []).append(joint)
    if rest_offsets is None:
        offsets = np.zeros((skeleton.n_joints, 3))
        for joint, below in children.items():
            offsets[below] = _rest_offsets(positions[:, below] - positions[:, joint, None])
    else:
        check_shape("rest_offsets", rest_offsets, (skeleton.n_joints, 3))
        offsets = np.asarray(rest_offsets, dtype=np.float64)

    frames = len(positions)
    turns = np.zeros((frames, skeleton.n_joints, 3, 3))
    rotations = np.zeros_like(turns)
    reached = positions.copy()
    for joint in skeleton.topological_order:
        parent = skeleton.parents[joint]
        above = np.broadcast_to(np.eye(3), (frames, 3, 3)) if parent < 0 else turns[:, parent]
        if parent >= 0:
            reached[:, joint] = reached[:, parent] + turns[:, parent] @ offsets[joint]
        below = children.get(joint, [])
        bones = positions[:, below] - reached[:, joint, None]
        turns[:, joint] = _best_turns(offsets[below], bones, above)
        rotations[:, joint] = np.swapaxes(above, -1, -2) @ turns[:, joint]
    return rotations, offsets


def _rest_offsets(bones: np.ndarray) -> np.ndarray:
    """Return the rigid set of bones (C, 3) that best fits those of all frames, (L, C, 3)."""
    lengths = np.linalg.norm(bones, axis=-1).mean(axis=0)
    rest = _of_lengths(bones[0], lengths)
    upright = np.broadcast_to(np.eye(3), (len(bones), 3, 3))
    for _ in range(_PASSES if len(lengths) > 1 else 0):
        turns = _best_turns(rest, bones, upright)
        rest = _of_lengths(np.einsum("lij,lci->cj", turns, bones), lengths)
    return rest


def _of_lengths(vectors: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Return vectors (C, 3) scaled to lengths (C,); one of length 0 points upwards."""
    norms = np.linalg.norm(vectors, axis=-1)
    directions = np.where(
        norms[:, None] > 0, vectors / np.where(norms > 0, norms, 1.0)[:, None], [0.0, 1.0, 0.0]
    )
    return directions * lengths[:, None]


def _best_turns(rest: np.ndarray, bones: np.ndarray, above: np.ndarray) -> np.ndarray:
    """Return the rotations (L, 3, 3) that take ``rest`` (C, 3) nearest to ``bones`` (L, C, 3).

    What the bones leave open is as in ``above``, (L, 3, 3), the parent's rotation.
    """
    if len(rest) == 0:
        return above.copy()
    if len(rest) == 1:
        return _least_turns(above @ rest[0], bones[:, 0]) @ above
    products = np.einsum("lci,cj->lij", bones, rest)
    scale = np.linalg.norm(products, axis=(-2, -1))
    weight = _TIE * np.where(scale > 0, scale, 1.0)
    left, _, right = np.linalg.svd(products + weight[:, None, None] * above)
    signs = np.ones((len(bones), 1, 3))
    signs[:, 0, 2] = np.sign(np.linalg.det(left @ right))
    return (left * signs) @ right


def _least_turns(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the least rotations that turn each ``start`` (L, 3) to point along ``end``."""
    lengths = np.linalg.norm(start, axis=-1), np.linalg.norm(end, axis=-1)
    known = (lengths[0] > 0) & (lengths[1] > 0)
    start = start / np.where(known, lengths[0], 1.0)[:, None]
    end = end / np.where(known, lengths[1], 1.0)[:, None]
    axis = np.cross(start, end)
    # Opposite directions leave the axis open: any that is square to ``start`` will do.
    parallel = np.linalg.norm(axis, axis=-1) < 1e-12
    other = np.cross(start, np.eye(3)[np.abs(start).argmin(axis=-1)])
    axis = np.where(parallel[:, None], other, axis)
    axis = axis - (axis * start).sum(axis=-1, keepdims=True) * start
    norms = np.linalg.norm(axis, axis=-1, keepdims=True)
    axis = axis / np.where(norms > 0, norms, 1.0)
    cosine = (start * end).sum(axis=-1)
    sine = (np.cross(axis, start) * end).sum(axis=-1)
    angle = np.where(known, np.arctan2(sine, cosine), 0.0)
    return vector_to_matrix(angle[:, None] * axis)
