"""Estimation of a body's mean pose from 2D tracks filmed from all azimuths.

A camera at azimuth φ projects a bone (X, Y, Z) to

    x = X cos φ + Z sin φ,    y = Y.

For uniform azimuths, E[y] is the mean of Y, and 2 E[x_a x_b] = X_a X_b + Z_a Z_b for bones a and b
of a rigid body. Articulation adds a covariance, mostly for a = b. Bilateral symmetry separates the
mean pose from this covariance: X is odd under mirroring, and its covariance with the width of hips
and shoulders determines it; Z is even.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton

__all__ = ["estimate_rest_pose", "is_four_legged", "joint_positions"]

_MAX_ITERATIONS = 5000
"""Maximum principal-factor iterations; about 1000 are needed if one bone moves most."""
_TOLERANCE = 1e-8
"""Change of the diagonal at convergence, relative to its largest entry."""
_AMBIGUOUS = 0.01
"""Forward offset in metres below which the forward direction is ambiguous."""
_SHORT = 1e-6
"""Length in metres below which a bone has no direction."""
_HEADS = ("nose", "head_top", "head", "neck")  # the first that exists is a quadruped's front
_AHEAD = (("foot", "ankle"), ("toe", "ankle"), ("big_toe", "ankle"), ("nose", "neck"))
"""Pairs of human joints; the first joint is in front of the second."""


def estimate_rest_pose(
    tracks: Sequence[KeypointTrack], threshold: float = 0.3, front: str | None = None
) -> np.ndarray:
    """Estimate the rest pose, which has mean bone directions, from 2D tracks.

    This is the 2D counterpart of :func:`~probmotion.models.bodies.body_states.rest_pose`. Vertical
    components of bones are means over frames. X and Z are factors of 2 E[x_a x_b] (see the module
    docstring), Z from pairs of different bones only. The squared length is 2 E[x²] + E[y²].

    Four effects are not modelled. Camera elevation shortens heights by its cosine (2 % at π/16).
    Perspective is ignored. Detection errors add six times their coordinate variance to the squared
    length. N azimuths cause a relative error of about 1/√(2N) in a length.

    Tracks determine depth up to a reflection that exchanges front and back. Knees, toes and noses
    of people and heads of quadrupeds define the front; other bodies require ``front``. A body
    without left-right pairs may be returned as its mirror image, with the outermost joint at +X.

    Parameters
    ----------
    tracks : sequence of KeypointTrack
        Tracks in metres of one skeleton with one root, from random azimuths at low elevation.
    threshold : float
        Minimum confidence of a joint in a frame.
    front : str, optional
        Name of a joint that is in front of the root in the mean pose.

    Returns
    -------
    ndarray, (J, 3)
        Offset of each joint from its parent, metres, 0 for the root. +Y is up, the body faces +Z
        and its left side is at +X. Left and right are symmetric.

    Raises
    ------
    ValueError
        If there are no tracks, skeletons differ, a skeleton has several roots or is not bilaterally
        symmetric, a pair of bones is never detected together, a bone has no length or direction, or
        the front is ambiguous.
    """
    skeleton = _shared_skeleton(tracks)
    across, up, seen = _projected_bones(tracks, skeleton, threshold)
    together = seen.T.astype(np.float64) @ seen
    _check_seen(together, skeleton)
    gram = 2 * (across.T @ across) / together
    count = np.diag(together)
    height = up.sum(axis=0) / count
    length = np.sqrt(np.diag(gram) + (up**2).sum(axis=0) / count)
    if skeleton.mirrored_pairs:
        even, odd = _sides(skeleton)
        # Pairs with a common parent: hips and shoulders.
        parents = skeleton.parents
        trunk = [float(parents[a] == parents[b]) for a, b in skeleton.mirrored_pairs]
        x, z = _halves(gram, even, odd, np.array(trunk))
        # Check before averaging, because a degenerate bone would be averaged with its mirror image.
        _check_long(length, skeleton)
        height, length = (
            even.T @ ((even @ values) / even.sum(axis=1)) for values in (height, length)
        )
    else:
        x, z = _factor(gram, 2).T
    mean = np.stack([x, height, z], axis=-1)
    sizes = np.linalg.norm(mean, axis=-1)
    _check_long(np.minimum(sizes, length), skeleton)
    joints = [joint for joint, _ in skeleton.bones]
    rest = np.zeros((skeleton.n_joints, 3))
    rest[joints] = mean * (length / sizes)[:, None]
    return _facing(rest, skeleton, front)


def joint_positions(skeleton: Skeleton, offsets: np.ndarray) -> np.ndarray:
    """Return joint positions relative to the root (J, 3), given offsets from parents (J, 3)."""
    positions = np.zeros_like(offsets)
    for joint in skeleton.topological_order:
        if skeleton.parents[joint] >= 0:
            positions[joint] = positions[skeleton.parents[joint]] + offsets[joint]
    return positions


def is_four_legged(skeleton: Skeleton) -> bool:
    """Return whether a skeleton has a tail or paws."""
    return any(name == "tail" or name.endswith("_paw") for name in skeleton.canonical_names)


def _shared_skeleton(tracks: Sequence[KeypointTrack]) -> Skeleton:
    if not tracks:
        raise ValueError("tracks must contain at least one track, got none")
    skeleton = tracks[0].skeleton
    for track in tracks:
        if track.skeleton != skeleton:
            raise ValueError(f"tracks must share one skeleton, got another in {track.name!r}")
    if len(skeleton.roots) != 1 or not skeleton.bones:
        raise ValueError(
            f"tracks must have a skeleton with one root and bones, got {len(skeleton.roots)} roots "
            f"and {len(skeleton.bones)} bones"
        )
    order = skeleton.mirrored_order
    for joint, parent in skeleton.bones:
        if skeleton.parents[order[joint]] != order[parent]:
            raise ValueError(
                "tracks must have a bilaterally symmetric skeleton, got different parents for "
                f"{skeleton.joint_names[joint]} and its counterpart; pass a rest pose instead"
            )
    return skeleton


def _projected_bones(
    tracks: Sequence[KeypointTrack], skeleton: Skeleton, threshold: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return x, y (upwards) and visibility of all bones in all frames, (frames, bones) each."""
    joints, parents = map(list, zip(*skeleton.bones, strict=True))
    keypoints = np.concatenate([track.keypoints for track in tracks])
    confidence = np.concatenate([track.confidence for track in tracks])
    visible = (confidence >= threshold) & np.isfinite(keypoints).all(axis=-1)
    seen = visible[:, joints] & visible[:, parents]
    bones = np.where(seen[..., None], keypoints[:, joints] - keypoints[:, parents], 0.0)
    return bones[..., 0], -bones[..., 1], seen


def _check_seen(together: np.ndarray, skeleton: Skeleton) -> None:
    """Raise if two bones have no common frame, given frame counts (bones, bones) of pairs."""
    if (together == 0).any():
        bones = skeleton.bones
        first, second = (skeleton.joint_names[bones[at][0]] for at in np.argwhere(together == 0)[0])
        raise ValueError(
            "tracks must have a frame with confident keypoints for every two bones, got none for "
            f"the bones to {first} and {second}"
        )


def _check_long(sizes: np.ndarray, skeleton: Skeleton) -> None:
    """Raise if a bone has no length or direction, given lengths (bones,) in metres."""
    for (joint, _), size in zip(skeleton.bones, sizes, strict=True):
        if not size > _SHORT:
            raise ValueError(
                "tracks must have a mean direction for every bone, got none for the bone to "
                f"{skeleton.joint_names[joint]}"
            )


def _sides(skeleton: Skeleton) -> tuple[np.ndarray, np.ndarray]:
    """Return the even (E, bones) and odd (O, bones) combinations of bones under mirroring.

    Central bones and sums of left-right pairs are even; differences, left minus right, are odd.
    """
    joints = [joint for joint, _ in skeleton.bones]
    unit = {joint: np.eye(len(joints))[at] for at, joint in enumerate(joints)}
    pairs = skeleton.mirrored_pairs
    paired = {joint for pair in pairs for joint in pair}
    even = [unit[joint] for joint in joints if joint not in paired]
    even += [unit[left] + unit[right] for left, right in pairs]
    return np.array(even), np.array([unit[left] - unit[right] for left, right in pairs])


def _halves(
    gram: np.ndarray, even: np.ndarray, odd: np.ndarray, trunk: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return X and ±Z of the bones of a symmetric body.

    X is proportional to the covariance with the width of the trunk. A factor analysis of the odd
    combinations would also capture legs that move in antiphase.
    """
    half = odd / 2
    odds = half @ gram @ half.T
    width = trunk @ odds @ trunk
    if not width > _SHORT**2:
        raise ValueError(
            "tracks must have hips or shoulders of nonzero width, got coincident sides"
        )
    lateral = odds @ trunk / np.sqrt(width)
    mean = even / even.sum(axis=1, keepdims=True)
    (forward,) = _factor(mean @ gram @ mean.T, 1).T
    return odd.T @ lateral, even.T @ forward


def _factor(gram: np.ndarray, rank: int) -> np.ndarray:
    """Return principal factors F (n, rank): F Fᵀ fits the off-diagonal entries of ``gram``.

    The diagonal of ``gram`` includes the movement of single bones, so it is an upper bound.
    """
    filled, bound = gram.copy(), np.diag(gram)
    for _ in range(_MAX_ITERATIONS):
        values, vectors = np.linalg.eigh(filled)
        factor = vectors[:, -rank:] * np.sqrt(np.maximum(values[-rank:], 0.0))
        diagonal = np.minimum((factor**2).sum(axis=1), bound)
        change = abs(diagonal - np.diag(filled)).max()
        np.fill_diagonal(filled, diagonal)
        if change <= _TOLERANCE * bound.max():
            break
    # With fewer bones than factors, the remaining factors are 0.
    return np.pad(factor, ((0, 0), (0, rank - factor.shape[1])))


def _facing(rest: np.ndarray, skeleton: Skeleton, front: str | None) -> np.ndarray:
    """Return the rest pose rotated or reflected to face +Z."""
    positions = joint_positions(skeleton, rest)
    forward = _ahead(positions, skeleton, front)
    if skeleton.mirrored_pairs:
        forward = np.array([0.0, forward[1]])
    size = float(np.linalg.norm(forward))
    if size < _AMBIGUOUS:
        raise ValueError(
            f"front must be a joint in front of the root, got {front!r}; the mean pose alone does "
            "not determine front and back"
        )
    if skeleton.mirrored_pairs:
        return rest * [1.0, 1.0, np.sign(forward[1])]
    x, z = forward / size
    rotation = np.array([[z, 0.0, -x], [0.0, 1.0, 0.0], [x, 0.0, z]])
    side = (positions @ rotation.T)[:, 0]
    return rest @ rotation.T * [1.0 if side[abs(side).argmax()] >= 0 else -1.0, 1.0, 1.0]


def _ahead(positions: np.ndarray, skeleton: Skeleton, front: str | None) -> np.ndarray:
    """Return X and Z of a forward vector, (2,), metres; close to 0 if ambiguous."""
    names, horizontal = list(skeleton.canonical_names), positions[:, [0, 2]]
    if front is not None:
        if front not in {*skeleton.joint_names, *names}:
            known = ", ".join(skeleton.joint_names)
            raise ValueError(f"front must be one of {known}, got {front!r}")
        return horizontal[skeleton.index(front)] - horizontal[skeleton.roots[0]]
    if is_four_legged(skeleton):
        heads = [horizontal[names.index(name)] for name in _HEADS if name in names]
        hips = [horizontal[at] for at, name in enumerate(names) if name.endswith("_hip")]
        behind = np.mean(hips, axis=0) if hips else horizontal[skeleton.roots[0]]
        return heads[0] - behind if heads else np.zeros(2)
    total = np.zeros(2)
    for side in ("left_", "right_"):
        at = {name.removeprefix(side): joint for joint, name in enumerate(names)}
        if {"hip", "knee", "ankle"} <= set(at):
            hip, knee, ankle = (positions[at[name]] for name in ("hip", "knee", "ankle"))
            leg = ankle - hip
            total += (knee - hip - leg * ((knee - hip) @ leg) / (leg @ leg))[[0, 2]]
        for front_joint, back_joint in _AHEAD:
            if front_joint in at and back_joint in at:
                total += horizontal[at[front_joint]] - horizontal[at[back_joint]]
    return total
