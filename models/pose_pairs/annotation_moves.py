"""Compiled proposals that move pose pairs towards, or between, annotations of a view."""

from __future__ import annotations

import numpy as np

from probmotion.extras import NO_ALLOCATION, numba
from probmotion.models.pose_pairs.joint_limits_frames import (
    Vector,
    between,
    dot,
    from_frame,
    in_frame,
    least_rotation,
    length_of,
    overwrite,
)
from probmotion.models.pose_pairs.pair_densities import ViewAnnotations, image_axes, write_image
from probmotion.models.pose_pairs.pair_moves import Body

__all__ = ["approach", "draw_sides", "log_side_probability", "scaled_depths", "transfer"]

_SIDE_SCALE = 0.2
"""Sine of a bone's angle to the image plane at which its own side has probability .73."""
_MAX_SCALE = 100.0
"""Maximum ratio of the distances between two roots in two annotations."""


@numba.njit(**NO_ALLOCATION)
def approach(
    pose: np.ndarray,
    root: int,
    ratio: float,
    view: int,
    annotation: int,
    body: Body,
    views: ViewAnnotations,
    image: np.ndarray,
    proposed: np.ndarray,
) -> float:
    """Move bones towards or away from those of an annotation; return the log ratio of volumes.

    The angle of each bone of a person, or of all people if ``root`` is −1, to the annotation's bone
    is multiplied by ``ratio``. That bone has the length of the pose's and is on the same side of
    the image plane, or in it if it is too long. The inverse move has the ratio 1/``ratio``; −∞ if
    there is none, because a bone would change sides. The annotation is rotated in the image to fit
    the joints that define the local frame. Their bones stay, so the view and the rotation stay too.
    ``image`` (2, J) is a workspace array.
    """
    right, up, towards = image_axes(pose, view, body, views)
    joints, n_joints = views.prepared.joints[annotation], len(pose)
    write_image(pose, right, up, image)
    cosine, sine = _rotation_to_frame(image, joints, body)
    log_volume = 0.0
    overwrite(proposed, pose)
    for joint in range(n_joints):
        parent = body.parents[joint]
        if body.framing[joint] or parent < 0:
            continue
        bone = between(pose, parent, joint)
        if root < 0 or body.below[root, joint]:
            x = image[0, joint] - image[0, parent]
            y = image[1, joint] - image[1, parent]
            z = dot(bone, towards)
            u, v = joints[0, joint] - joints[0, parent], joints[1, joint] - joints[1, parent]
            length = length_of(bone)
            goal = _lifted(cosine * u - sine * v, sine * u + cosine * v, z, length)
            (x, y, new_z), log_area = _scaled_angle((x, y, z), goal, ratio)
            if log_area == -np.inf or (new_z > 0) != (z > 0):
                return -np.inf
            log_volume += log_area
            bone = from_frame((right, up, towards), (x, y, new_z))
        for axis in range(3):
            proposed[joint, axis] = proposed[parent, axis] + bone[axis]
    return log_volume


@numba.njit(**NO_ALLOCATION)
def transfer(
    pose: np.ndarray,
    sides: np.ndarray,
    view: int,
    start: int,
    end: int,
    body: Body,
    views: ViewAnnotations,
    image: np.ndarray,
    proposed: np.ndarray,
) -> float:
    """Move a pose from annotation ``start`` to ``end``; return the log ratio of volumes.

    Each bone is turned by the least rotation from the first annotation's bone to the second's. Both
    have the length of the pose's bone and lie on the given side of the image plane, ``sides`` (J,),
    −1 or 1, or in it if they are too long. Distances to the first root are scaled as in the
    annotations. As in :func:`approach`, the local frame and its bones stay. The inverse exchanges
    the annotations and keeps the sides; −∞ if roots of an annotation (almost) coincide. ``image``
    (2, J) is a workspace array.
    """
    frame = image_axes(pose, view, body, views)
    right, up, _ = frame
    old, new, n_joints = views.prepared.joints[start], views.prepared.joints[end], len(pose)
    write_image(pose, right, up, image)
    cosine, sine = _rotation_to_frame(image, old, body)
    first, log_volume = body.roots[0], 0.0
    overwrite(proposed, pose)
    for root in body.roots[1:]:
        before, after = _distance(old, first, root), _distance(new, first, root)
        if before == 0 or after > _MAX_SCALE * before or before > _MAX_SCALE * after:
            return -np.inf
        scale = after / before
        log_volume += 3.0 * np.log(scale)
        for joint in range(n_joints):
            if body.below[root, joint]:
                for axis in range(3):
                    proposed[joint, axis] += (scale - 1.0) * (pose[root, axis] - pose[first, axis])
    write_image(proposed, right, up, image)
    new_cosine, new_sine = _rotation_to_frame(image, new, body)
    for joint in range(n_joints):
        parent, side = body.parents[joint], sides[joint]
        if body.framing[joint] or parent < 0:
            continue
        bone = between(pose, parent, joint)
        length = length_of(bone)
        u, v = old[0, joint] - old[0, parent], old[1, joint] - old[1, parent]
        start_bone = _lifted(cosine * u - sine * v, sine * u + cosine * v, side, length)
        u, v = new[0, joint] - new[0, parent], new[1, joint] - new[1, parent]
        x, y = new_cosine * u - new_sine * v, new_sine * u + new_cosine * v
        turn = least_rotation(start_bone, _lifted(x, y, side, length))
        bone = from_frame(frame, from_frame(turn, in_frame(frame, bone)))
        for axis in range(3):
            proposed[joint, axis] = proposed[parent, axis] + bone[axis]
    return log_volume


@numba.njit(cache=True, nogil=True)
def draw_sides(depths: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw a side of the image plane for each bone, given its :func:`scaled_depths`."""
    sides = np.empty_like(depths)
    for joint in range(len(depths)):
        sides[joint] = 1.0 if rng.random() * (1.0 + np.exp(-depths[joint])) < 1.0 else -1.0
    return sides


@numba.njit(cache=True, nogil=True)
def log_side_probability(sides: np.ndarray, depths: np.ndarray) -> float:
    """Return the log probability that :func:`draw_sides` draws ``sides``."""
    return -np.log1p(np.exp(-sides * depths)).sum()


@numba.njit(cache=True, nogil=True)
def scaled_depths(pose: np.ndarray, view: int, body: Body, views: ViewAnnotations) -> np.ndarray:
    """Return sin φ / _SIDE_SCALE, φ the angle of bone and image plane, (J,); 0 for roots."""
    _, _, towards = image_axes(pose, view, body, views)
    depths = np.zeros(len(pose))
    for joint in range(len(pose)):
        parent = body.parents[joint]
        if parent >= 0:
            bone = between(pose, parent, joint)
            depths[joint] = dot(bone, towards) / length_of(bone) / _SIDE_SCALE
    return depths


@numba.njit(**NO_ALLOCATION)
def _rotation_to_frame(image: np.ndarray, joints: np.ndarray, body: Body) -> tuple[float, float]:
    """Return cosine and sine of an annotation's least-squares rotation to an image.

    Only the joints that define the local frame are used.
    """
    n_joints, middle_x, middle_y, along, across = 0, 0.0, 0.0, 0.0, 0.0
    for joint in range(image.shape[1]):
        if body.framing[joint]:
            n_joints += 1
            middle_x, middle_y = middle_x + image[0, joint], middle_y + image[1, joint]
    middle_x, middle_y = middle_x / n_joints, middle_y / n_joints
    for joint in range(image.shape[1]):
        if body.framing[joint]:
            # The annotation need not be centred.
            x, y = image[0, joint] - middle_x, image[1, joint] - middle_y
            u, v = joints[0, joint], joints[1, joint]
            along += u * x + v * y
            across += u * y - v * x
    size = np.sqrt(along * along + across * across)
    return (along / size, across / size) if size > 0 else (1.0, 0.0)


@numba.njit(**NO_ALLOCATION)
def _distance(joints: np.ndarray, first: int, second: int) -> float:
    """Return the distance between two joints of an annotation (2, J)."""
    return np.hypot(joints[0, first] - joints[0, second], joints[1, first] - joints[1, second])


@numba.njit(**NO_ALLOCATION)
def _lifted(x: float, y: float, side: float, length: float) -> Vector:
    """Return the direction of a bone of given image and length; ``side`` is its depth's sign."""
    x, y = x / length, y / length
    square = x * x + y * y
    if square >= 1.0:
        return x / np.sqrt(square), y / np.sqrt(square), 0.0
    return x, y, np.copysign(np.sqrt(1.0 - square), side)


@numba.njit(**NO_ALLOCATION)
def _scaled_angle(vector: Vector, goal: Vector, ratio: float) -> tuple[Vector, float]:
    """Return a vector with its angle to a direction scaled, and the log ratio of solid angles."""
    length = length_of(vector)
    x, y, z = vector[0] / length, vector[1] / length, vector[2] / length
    cosine = x * goal[0] + y * goal[1] + z * goal[2]
    x, y, z = x - cosine * goal[0], y - cosine * goal[1], z - cosine * goal[2]
    sine = np.sqrt(x * x + y * y + z * z)
    angle = ratio * np.arctan2(sine, cosine)
    if sine < 1e-12 or angle >= np.pi:
        return vector, -np.inf
    along, across = length * np.cos(angle), length * np.sin(angle) / sine
    new = (
        along * goal[0] + across * x,
        along * goal[1] + across * y,
        along * goal[2] + across * z,
    )
    return new, np.log(ratio * np.sin(angle) / sine)
