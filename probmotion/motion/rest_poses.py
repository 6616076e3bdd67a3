"""The mean pose of a kind of body from 2D tracks alone, filmed from all around.

A picture of a body that is turned by the azimuth φ about the vertical shows of a bone (X, Y, Z)

    x = X cos φ + Z sin φ,    y = Y.

Where azimuths are uniform, E[y] is the mean bone's Y and 2 E[x_a x_b] = X_a X_b + Z_a Z_b for two
bones of a rigid body. How two bones of a moving one move together adds to it, most where a is b.
Symmetry tells the mean pose from that: its X are odd (the left has the opposite of the right) and
in line with how wide hips and shoulders are, its Z are even.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton

__all__ = ["estimate_rest_pose", "is_four_legged"]

_PASSES = 5000
"""Of filling a Gram matrix's diagonal in, at most; where one bone moves most it takes 1000."""
_SETTLED = 1e-8
"""Change of the diagonal, of its greatest, at which it is filled in."""
_TOLD = 0.01
"""Metres: what is less far ahead does not say where the front is."""
_SHORT = 1e-6
"""Metres: below, a bone has no length, or no direction."""
_HEADS = ("nose", "head_top", "head", "neck")
_AHEAD = (("foot", "ankle"), ("toe", "ankle"), ("big_toe", "ankle"), ("nose", "neck"))
"""Joints of people that are in front of others, besides knees."""


def estimate_rest_pose(
    tracks: Sequence[KeypointTrack], threshold: float = 0.3, front: str | None = None
) -> np.ndarray:
    """Return the rest pose of the body that tracks show: bones as they point on average.

    It is what :func:`~probmotion.models.bodies.body_states.rest_pose` finds from 3D motions,
    without them. Bones' heights are means over frames; their X and Z are factors of 2 E[x_a x_b],
    see this module, the Z from pairs of different bones alone. The square of a length is
    2 E[x²] + E[y²].

    What is ignored: the cameras' elevation, of which heights are the cosine too short (2 % at the
    usual π/16); that pictures are in perspective; a detector's errors, by six times the variance
    of a coordinate in the square of a length; that N tracks, one azimuth each, are not all
    azimuths, about 1/√(2N) of a length.

    Depth has two solutions, which are each other's mirror image, front and back exchanged. People
    have their knees, toes and noses in front, four-legged animals their heads; for others
    ``front`` must say. A body without left-right pairs may come out as its mirror image: pictures
    are the same. Its joint that is farthest from the middle is then at +X.

    Parameters
    ----------
    tracks : sequence of KeypointTrack
        Of one skeleton with one root, from random azimuths at low elevation; metres.
    threshold : float
        Joints of less confidence are left out, frame by frame.
    front : str, optional
        A joint that is ahead of the root in the mean pose.

    Returns
    -------
    ndarray, (J, 3)
        Each joint's offset from its parent, metres, the root's 0; +Y is up, the body looks along
        +Z and its left is at +X. Left and right are mirror images.

    Raises
    ------
    ValueError
        If there is no track, skeletons differ, have several roots or are not their own mirror
        image, bones are not seen or have no length or direction, or nothing tells where the front
        is.
    """
    skeleton = _shared_skeleton(tracks)
    across, up, seen = _pictured_bones(tracks, skeleton, threshold)
    together = seen.T.astype(np.float64) @ seen
    _check_seen(together, skeleton)
    gram = 2 * (across.T @ across) / together
    count = np.diag(together)
    height = up.sum(axis=0) / count
    length = np.sqrt(np.diag(gram) + (up**2).sum(axis=0) / count)
    if skeleton.mirrored_pairs:
        even, odd = _sides(skeleton)
        x, z = _halves(gram, even, odd, _trunk_pairs(skeleton))
        # In the mean of a pair a healthy side hides its degenerate mirror image.
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


def is_four_legged(skeleton: Skeleton) -> bool:
    """Tell from the joints' names whether they are those of a four-legged animal."""
    return any(name == "tail" or name.endswith("_paw") for name in skeleton.canonical_names)


def _shared_skeleton(tracks: Sequence[KeypointTrack]) -> Skeleton:
    if not tracks:
        raise ValueError("tracks must contain at least one, got none")
    skeleton = tracks[0].skeleton
    for track in tracks:
        if track.skeleton != skeleton:
            raise ValueError(
                f"tracks has {track.name!r} of other joints than the first, expected one skeleton"
            )
    if len(skeleton.roots) != 1:
        raise ValueError(f"tracks has {len(skeleton.roots)} roots, expected one: it is one body")
    if not skeleton.bones:
        raise ValueError(f"tracks has the one joint {skeleton.joint_names[0]}, expected bones")
    order, parents = skeleton.mirrored_order, skeleton.parents
    for joint, parent in enumerate(parents):
        mirrored = order[parent] if parent >= 0 else -1
        if parents[order[joint]] != mirrored:
            raise ValueError(
                f"tracks has {skeleton.joint_names[joint]} on another joint than its mirror image "
                "is, expected a skeleton that is its own mirror image, or a rest pose that is given"
            )
    return skeleton


def _pictured_bones(
    tracks: Sequence[KeypointTrack], skeleton: Skeleton, threshold: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return x, y (up) and whether they are seen of all frames' bones, (frames, bones) each."""
    joints, parents = (list(ends) for ends in zip(*skeleton.bones, strict=True))
    keypoints = np.concatenate([track.keypoints for track in tracks])
    confidence = np.concatenate([track.confidence for track in tracks])
    visible = (confidence >= threshold) & np.isfinite(keypoints).all(axis=-1)
    seen = visible[:, joints] & visible[:, parents]
    bones = np.where(seen[..., None], keypoints[:, joints] - keypoints[:, parents], 0.0)
    return bones[..., 0], -bones[..., 1], seen


def _check_seen(together: np.ndarray, skeleton: Skeleton) -> None:
    """Refuse bones, or pairs of bones, that no frame has; frames' numbers (bones, bones)."""
    names = [skeleton.joint_names[joint] for joint, _ in skeleton.bones]
    for at, name in enumerate(names):
        if together[at, at] == 0:
            parent = skeleton.joint_names[skeleton.bones[at][1]]
            raise ValueError(
                f"tracks show {name} and {parent} together in no frame with confidence, expected "
                "every bone in some"
            )
    if (together == 0).any():
        first, second = (names[at] for at in np.argwhere(together == 0)[0])
        raise ValueError(
            f"tracks show the bones to {first} and to {second} together in no frame with "
            "confidence, expected every two bones in some"
        )


def _check_long(sizes: np.ndarray, skeleton: Skeleton) -> None:
    """Refuse bones, (bones,), of no length or direction, metres."""
    for (joint, _), size in zip(skeleton.bones, sizes, strict=True):
        if not size > _SHORT:
            raise ValueError(
                f"tracks show no length or direction of the bone to {skeleton.joint_names[joint]}, "
                "expected all bones to point somewhere on average"
            )


def _sides(skeleton: Skeleton) -> tuple[np.ndarray, np.ndarray]:
    """Return bones' memberships: (E, bones) in what is even, ±1 (O, bones) in what is odd.

    A central bone is an even one of its own; a pair is one even and one odd, the left its plus.
    """
    joints = [joint for joint, _ in skeleton.bones]
    one = {joint: np.eye(len(joints))[at] for at, joint in enumerate(joints)}
    pairs = skeleton.mirrored_pairs
    paired = {joint for pair in pairs for joint in pair}
    even = [one[joint] for joint in joints if joint not in paired]
    even += [one[left] + one[right] for left, right in pairs]
    return np.array(even), np.array([one[left] - one[right] for left, right in pairs])


def _trunk_pairs(skeleton: Skeleton) -> np.ndarray:
    """Return which pairs leave one joint, as hips and shoulders do: they say what is left."""
    parents = skeleton.parents
    return np.array([float(parents[a] == parents[b]) for a, b in skeleton.mirrored_pairs])


def _halves(
    gram: np.ndarray, even: np.ndarray, odd: np.ndarray, trunk: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return X and Z of a symmetric body's bones; Z or −Z.

    X is what goes with the width of the trunk; legs that swing in turn are odd too, but not
    sideways, so that a factor would take them for X.
    """
    half = odd / 2
    odds = half @ gram @ half.T
    width = trunk @ odds @ trunk
    if not width > _SHORT**2:
        raise ValueError(
            "tracks show left and right in one place, expected hips or shoulders of some width"
        )
    lateral = odds @ trunk / np.sqrt(width)
    mean = even / even.sum(axis=1, keepdims=True)
    (forward,) = _factor(mean @ gram @ mean.T, 1).T
    return odd.T @ lateral, even.T @ forward


def _factor(gram: np.ndarray, rank: int) -> np.ndarray:
    """Return F (n, rank) with F Fᵀ nearest to the matrix off its diagonal (principal factors).

    The diagonal has what bones move by themselves: it is only a bound.
    """
    filled, bound = gram.copy(), np.diag(gram)
    for _ in range(_PASSES):
        values, vectors = np.linalg.eigh(filled)
        factor = vectors[:, -rank:] * np.sqrt(np.maximum(values[-rank:], 0.0))
        diagonal = np.minimum((factor**2).sum(axis=1), bound)
        change = abs(diagonal - np.diag(filled)).max()
        np.fill_diagonal(filled, diagonal)
        if change <= _SETTLED * bound.max():
            break
    # Of fewer bones than axes there is nothing along the others.
    return np.pad(factor, ((0, 0), (0, rank - factor.shape[1])))


def _facing(rest: np.ndarray, skeleton: Skeleton, front: str | None) -> np.ndarray:
    """Return the solution that looks along +Z, of a body that may look along −Z or anywhere."""
    place = np.zeros_like(rest)
    for joint in skeleton.topological_order:
        if skeleton.parents[joint] >= 0:
            place[joint] = place[skeleton.parents[joint]] + rest[joint]
    ahead = _ahead(place, skeleton, front)
    if skeleton.mirrored_pairs:
        ahead = np.array([0.0, ahead[1]])
    size = float(np.linalg.norm(ahead))
    if size < _TOLD:
        raise ValueError(
            f"front is {front!r}, and no joint of the mean pose tells front from back, expected a "
            "joint that is ahead of the root"
        )
    if skeleton.mirrored_pairs:
        return rest * [1.0, 1.0, np.sign(ahead[1])]
    x, z = ahead / size
    turn = np.array([[z, 0.0, -x], [0.0, 1.0, 0.0], [x, 0.0, z]])
    side = (place @ turn.T)[:, 0]
    return rest @ turn.T * [1.0 if side[abs(side).argmax()] >= 0 else -1.0, 1.0, 1.0]


def _ahead(place: np.ndarray, skeleton: Skeleton, front: str | None) -> np.ndarray:
    """Return X and Z of a way that points ahead, (2,), metres; 0 where nothing tells it."""
    names, flat = list(skeleton.canonical_names), place[:, [0, 2]]
    if front is not None:
        if front not in {*skeleton.joint_names, *names}:
            raise ValueError(
                f"front must be one of {', '.join(skeleton.joint_names)}, got {front!r}"
            )
        return flat[skeleton.index(front)] - flat[skeleton.roots[0]]
    if is_four_legged(skeleton):
        heads = [flat[names.index(name)] for name in _HEADS if name in names]
        hips = [flat[at] for at, name in enumerate(names) if name.endswith("_hip")]
        behind = np.mean(hips, axis=0) if hips else flat[skeleton.roots[0]]
        return heads[0] - behind if heads else np.zeros(2)
    total = np.zeros(2)
    for side in ("left_", "right_"):
        at = {name.removeprefix(side): joint for joint, name in enumerate(names)}
        if {"hip", "knee", "ankle"} <= set(at):
            hip, knee, ankle = (place[at[name]] for name in ("hip", "knee", "ankle"))
            leg = ankle - hip
            total += (knee - hip - leg * ((knee - hip) @ leg) / (leg @ leg))[[0, 2]]
        for one, other in _AHEAD:
            if one in at and other in at:
                total += flat[at[one]] - flat[at[other]]
    return total
