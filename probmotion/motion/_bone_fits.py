"""Steps of inverse kinematics: constant bone lengths, standing feet and smooth twists."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from probmotion.geometry.rotations import vector_to_matrix
from probmotion.motion.kinematics import least_rotations
from probmotion.motion.skeleton import Skeleton
from probmotion.motion.t_pose import FEET

__all__ = ["Distances", "fade", "nearest_rigid", "stance_targets", "twisted"]

_STEPS = 8  # Newton steps; three suffice for bones that vary by a tenth
_PRECISE = 1e-7  # metres
_CHUNK = 512  # frames at once
_HELD = 30.0  # weight of a foot on the floor relative to other joints
_SLOW, _FAST = 0.2, 0.4  # metres per second: a foot stands, or does not
_LOW, _HIGH = 0.03, 0.06  # metres from the level at which a foot stands, likewise
_BAND = 0.01  # metres from that level in which a standing foot may move
_LEVEL = 0.05  # metres above the lowest standing position that count as the same level
_TIME = 0.05  # seconds over which twists are smoothed
_MINIMAL = 0.01  # weight of the minimal twist relative to an observed one


class Distances(NamedTuple):
    """Distances between pairs of joints that are constant: C pairs, in metres."""

    first: np.ndarray
    second: np.ndarray
    values: np.ndarray

    def deviations(self, positions: np.ndarray) -> np.ndarray:
        """Return how much longer the distances of positions (L, J, 3) are, (L, C)."""
        gaps = positions[:, self.first] - positions[:, self.second]
        return np.linalg.norm(gaps, axis=-1) - self.values


def nearest_rigid(
    positions: np.ndarray, distances: Distances, weights: np.ndarray | None = None
) -> np.ndarray:
    """Return the positions closest to given ones with constant distances.

    Minimises Σ_j w_j ‖q_j − p_j‖² in every frame with the distances linearised at the last q
    (Newton's method for the Lagrangian, without curvature).

    Parameters
    ----------
    positions : ndarray, (L, J, 3)
        Joint positions p, metres.
    distances : Distances
        Distances between joints.
    weights : ndarray, (L, J), optional
        Weights w of the joints, 1 by default.

    Returns
    -------
    ndarray, (L, J, 3)
        Positions q. If no positions have these distances, they are approximate.
    """
    mass = np.ones(positions.shape[:2]) if weights is None else weights
    result = positions.copy()
    for start in range(0, len(positions) if len(distances.values) else 0, _CHUNK):
        part = slice(start, start + _CHUNK)
        result[part] = _newton(positions[part], distances, 1 / mass[part])
    return result


def _newton(positions: np.ndarray, distances: Distances, mobility: np.ndarray) -> np.ndarray:
    first, second, values = distances
    pairs = np.arange(len(values))
    # incidence[c] is +1 and -1 at the two joints of pair c.
    incidence = np.zeros((len(values), positions.shape[1]))
    incidence[pairs, first], incidence[pairs, second] = 1.0, -1.0
    coupling = np.einsum("cj,lj,dj->lcd", incidence, mobility, incidence, optimize=True)
    found = positions
    for _ in range(_STEPS):
        gaps = found[:, first] - found[:, second]
        lengths = np.linalg.norm(gaps, axis=-1)
        error = lengths - values
        if np.abs(error).max() < _PRECISE:
            break
        units = gaps / np.where(lengths > 0, lengths, 1.0)[..., None]
        moved = (positions - found)[:, first] - (positions - found)[:, second]
        right = error + (units * moved).sum(axis=-1)
        matrix = coupling * (units @ np.swapaxes(units, -1, -2))
        # Redundant distances, such as those of four joints in a plane, have no own multiplier.
        matrix[:, pairs, pairs] += 1e-9
        forces = np.linalg.solve(matrix, right[..., None]) * units
        found = positions - mobility[..., None] * np.einsum("cj,lcx->ljx", incidence, forces)
    return found


def stance_targets(
    positions: np.ndarray, skeleton: Skeleton, fps: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return positions with standing feet at their level on the floor, and weights of the joints.

    A foot joint stands where it moves slower than 0.2 m/s within 3 cm of its level, which is the
    median height of its slow frames within 5 cm of their lowest. Left and right share a level. A
    standing joint is moved to within 1 cm of its level; the displacement fades in and out with
    speed and height.

    Returns
    -------
    positions : ndarray, (L, J, 3)
        Positions, metres.
    weights : ndarray, (L, J)
        1, and up to 31 for standing joints.
    """
    targets, weights = positions.copy(), np.ones(positions.shape[:2])
    groups: dict[str, list[int]] = {}
    for joint, name in enumerate(skeleton.canonical_names):
        person, _, bare = name.rpartition(":")
        part = bare.removeprefix("left_").removeprefix("right_")
        if part in FEET:
            groups.setdefault(f"{person}:{part}", []).append(joint)
    if len(positions) < 2:
        return targets, weights
    for joints in groups.values():
        feet = positions[:, joints]
        speed = np.linalg.norm(np.gradient(feet, 1 / fps, axis=0), axis=-1)
        slow = feet[..., 1][speed < _SLOW]
        if len(slow) == 0:
            continue
        level = np.median(slow[slow <= np.quantile(slow, 0.05) + _LEVEL])
        above = feet[..., 1] - level
        stance = (1 - fade(speed, _SLOW, _FAST)) * (1 - fade(np.abs(above), _LOW, _HIGH))
        targets[:, joints, 1] -= stance * (above - np.clip(above, -_BAND, _BAND))
        weights[:, joints] += _HELD * stance
    return targets, weights


def twisted(
    axis: np.ndarray,
    directions: np.ndarray,
    observed: np.ndarray,
    weights: np.ndarray,
    reference: np.ndarray,
    fps: float,
) -> np.ndarray:
    """Return rotations that align an axis with directions, with smooth twists.

    The twist is the angle of the complex numbers z_t that minimise

        Σ_t w_t |z_t − exp(iθ_t)|² + m_t |z_t − exp(iφ_t)|² + λ Σ_t |z_{t+1} − z_t|²

    where θ_t is the observed twist, φ_t that of the smallest rotation from the rest pose, all
    relative to a frame transported along the directions without twist. The smallest rotation is
    undefined for a half turn; its weight m_t vanishes there, so that the joint does not flip.

    Parameters
    ----------
    axis : ndarray, (3,)
        Unit vector in the rest pose.
    directions : ndarray, (L, 3)
        Unit vectors in the parent's frame.
    observed : ndarray, (L, 3)
        Vectors in the parent's frame that show the twist of ``reference``.
    weights : ndarray, (L,)
        Weights w_t of the observed twist, 0 to 1.
    reference : ndarray, (3,)
        Vector in the rest pose that ``observed`` corresponds to.
    fps : float
        Frames per second.

    Returns
    -------
    ndarray, (L, 3, 3)
        Rotation of the joint in its parent's frame.
    """
    frames = len(directions)
    swing = least_rotations(np.broadcast_to(axis, directions.shape), directions)
    minimal = _MINIMAL * ((1 + directions @ axis) / 2) ** 2 + 1e-9
    transport = least_rotations(directions[:-1], directions[1:])
    steps = twist_angles(axis, _inverse(swing[1:]) @ transport @ swing[:-1])
    gauge = np.concatenate([[0.0], np.cumsum(steps)])
    local = np.einsum("lji,lj->li", swing, observed)
    angle = _angle_about(axis, reference, local)
    right = minimal * np.exp(-1j * gauge) + weights * np.exp(1j * (angle - gauge))
    twist = np.angle(_smoothed(right, minimal + weights, fps))
    # Where the weighted mean passes close to 0, its angle jumps.
    twist = _smoothed(np.unwrap(twist), np.ones(frames), fps)
    return swing @ vector_to_matrix((twist + gauge)[:, None] * axis)


def _smoothed(right: np.ndarray, weights: np.ndarray, fps: float) -> np.ndarray:
    """Return the minimiser z of Σ_t w_t |z_t|² − 2 Re r̄_t z_t + λ |z_{t+1} − z_t|²."""
    if len(right) == 1:  # refused by solveh_banded
        return right / weights
    stiffness = (_TIME * fps) ** 2
    bands = np.zeros((2, len(right)))
    bands[0, 1:] = -stiffness
    bands[1] = weights
    bands[1, 1:] += stiffness
    bands[1, :-1] += stiffness
    from scipy.linalg import solveh_banded  # slow, and not needed by `--help`

    return solveh_banded(bands, right)


def twist_angles(axis: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Return the angles (L,) of rotations (L, 3, 3) about a unit axis (3,)."""
    across = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    across /= np.linalg.norm(across)
    return _angle_about(axis, across, rotations @ across)


def _angle_about(axis: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the angles about ``axis`` from ``start`` to ``end``, projected across it."""
    along = (start @ axis) * (end @ axis)
    return np.arctan2(
        np.cross(np.broadcast_to(start, end.shape), end) @ axis, (start * end).sum(axis=-1) - along
    )


def _inverse(rotations: np.ndarray) -> np.ndarray:
    return np.swapaxes(rotations, -1, -2)


def fade(values: np.ndarray, none: float, full: float) -> np.ndarray:
    """Return weights that rise smoothly from 0 at ``none`` to 1 at ``full``."""
    part = np.clip((values - none) / (full - none), 0.0, 1.0)
    return part**2 * (3 - 2 * part)
