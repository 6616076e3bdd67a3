"""Keypoints of a detector on the joints of the prior, with swapped sides repaired."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import median_filter

from probmotion.models.unseen_depth.pose_depth import BONES, KEYPOINTS
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.retargeting import counterpart
from probmotion.motion.skeleton import Skeleton

__all__ = [
    "ANKLES", "HIPS", "LIMBS", "SHOULDERS", "SIDED", "BodyPath", "PersonKeypoints", "averaged",
    "body_path", "from_hips", "person_keypoints", "smooth_size",
]  # fmt: skip

PERSON = Skeleton.preset("person14")
# Neck and pelvis of detectors are midpoints of shoulders and hips, which motion capture has not.
_TRUNK = ("neck", "pelvis")
HIPS, ANKLES, SHOULDERS = (
    [PERSON.joint_names.index(f"{side}_{part}") for side in ("left", "right")]
    for part in ("hip", "ankle", "shoulder")
)
LIMBS = list(KEYPOINTS)
"""Joints of arms and legs."""
SIDED = (("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle"))
"""Joints of an arm and of a leg."""
_SWAP_COST = 1.5  # of a second with exchanged sides, in units of a frame's typical motion
_CAPPED = 5.0  # largest cost of a step, in the same units
_FILTERED = 5  # frames
_SPREAD = 0.1  # of the logarithm of a frame's size


def from_hips(positions: np.ndarray) -> np.ndarray:
    """Return positions relative to the middle of the hips: ``(…, J, 3) → (…, J, 3)``.

    Keypoints show the hips, not the pelvis.
    """
    relative: np.ndarray = positions - positions[..., HIPS, :].mean(axis=-2, keepdims=True)
    return relative


class PersonKeypoints(NamedTuple):
    """Keypoints of ``person14``.

    ``points``, (L, 14, 2), pixels, 0 where missing; ``weight``, (L, 14), multiplier of the
    precision, 1 for the median confidence; ``swapped``, share of arms and legs whose sides were
    exchanged.
    """

    points: np.ndarray
    weight: np.ndarray
    swapped: float

    def mirrored(self) -> PersonKeypoints:
        """Return the keypoints with left and right exchanged."""
        order = list(PERSON.mirrored_order)
        return self._replace(points=self.points[:, order], weight=self.weight[:, order])


def person_keypoints(track: KeypointTrack) -> PersonKeypoints:
    """Return a track's keypoints of arms and legs; raises ``ValueError`` if there are too few."""
    source = track.skeleton
    names = PERSON.joint_names
    same = source == PERSON
    found = [
        None
        if name in _TRUNK and not same
        else counterpart(source, name, PERSON.canonical_names[joint])
        for joint, name in enumerate(names)
    ]
    lacking = [name for name, joint in zip(names, found, strict=True) if joint is None]
    lacking = [name for name in lacking if name not in _TRUNK]
    if lacking:
        raise ValueError(
            f"track must have shoulders, elbows, wrists, hips, knees and ankles, got "
            f"{source.n_joints} keypoints without {', '.join(lacking)}; name the layout with "
            "skeleton"
        )
    points = np.zeros((track.frames, len(names), 2))
    weight = np.zeros(points.shape[:2])
    for joint, origin in enumerate(found):
        if origin is not None:
            seen = track.confidence[:, origin] > 0
            points[seen, joint] = track.keypoints[seen, origin]
            weight[:, joint] = track.confidence[:, origin]
    if weight.any():
        weight /= np.median(weight[weight > 0])
    return _unswapped(points, weight, _SWAP_COST / track.fps)


def _unswapped(points: np.ndarray, weight: np.ndarray, cost: float) -> PersonKeypoints:
    """Return keypoints whose left and right limbs do not jump to the other side.

    For arms and legs, the cheapest sequence of ordinary and exchanged frames (Viterbi) has the
    smallest sum of joints' steps between frames.
    """
    points, weight = points.copy(), weight.copy()
    swapped = []
    for group in SIDED:
        left, right = (
            [PERSON.joint_names.index(f"{side}_{name}") for name in group]
            for side in ("left", "right")
        )
        both = [left + right, right + left]
        costs = np.empty((2, 2, len(points) - 1))
        for i, before in enumerate(both):
            for j, after in enumerate(both):
                step = np.linalg.norm(points[1:, after] - points[:-1, before], axis=-1)
                known = (weight[1:, after] > 0) & (weight[:-1, before] > 0)
                costs[i, j] = np.where(known, step, 0.0).sum(axis=1)
        moving = costs[0, 0][costs[0, 0] > 0]
        typical = np.median(moving) if len(moving) else 1.0
        exchanged = _cheapest(np.minimum(costs / typical, _CAPPED), cost)
        for frame in np.flatnonzero(exchanged):
            points[frame, left + right] = points[frame, right + left]
            weight[frame, left + right] = weight[frame, right + left]
        swapped.append(exchanged.mean())
    return PersonKeypoints(points, weight, float(np.mean(swapped)))


def _cheapest(costs: np.ndarray, cost: float) -> np.ndarray:
    """Return which frames are exchanged, (L,), for costs (2, 2, L − 1) of steps."""
    frames = costs.shape[2] + 1
    total = np.array([0.0, cost])
    origins = np.zeros((frames, 2), dtype=int)
    for frame in range(1, frames):
        ways = total[:, None] + costs[:, :, frame - 1]
        origins[frame] = ways.argmin(axis=0)
        total = ways.min(axis=0) + np.array([0.0, cost])
    state = int(total.argmin())
    out = np.zeros(frames, dtype=bool)
    for frame in range(frames - 1, -1, -1):
        out[frame] = bool(state)
        state = origins[frame, state]
    return out


def averaged(keypoints: PersonKeypoints, step: int) -> PersonKeypoints:
    """Return weighted means of every ``step`` frames; an incomplete last group is left out."""
    n = len(keypoints.points) // step
    joints = keypoints.weight.shape[1]
    weight = keypoints.weight[: n * step].reshape(n, step, joints)
    points = keypoints.points[: n * step].reshape(n, step, joints, 2)
    total = weight.sum(axis=1)
    mean = (weight[..., None] * points).sum(axis=1) / np.maximum(total, 1e-12)[..., None]
    return PersonKeypoints(mean, total, keypoints.swapped)


class BodyPath(NamedTuple):
    """Middle of the body in the image, (L, 2), pixels, and its size, (L,), pixels per metre.

    Frames without a visible body are interpolated.
    """

    middle: np.ndarray
    size: np.ndarray


def body_path(keypoints: PersonKeypoints) -> BodyPath:
    """Return the path of a body in the image.

    In every frame some bone is nearly parallel to the image: the size is the second largest ratio
    of a bone's size in the image to its length, which is safe from one outlier.
    """
    points, weight, _ = keypoints
    ratios = np.zeros((len(points), 0))
    for end, (start, length) in BONES.items():
        joint, parent = PERSON.joint_names.index(end), PERSON.joint_names.index(start)
        size = np.linalg.norm(points[:, joint] - points[:, parent], axis=-1) / length
        known = (weight[:, joint] > 0) & (weight[:, parent] > 0)
        # Outliers last for single frames.
        size = median_filter(np.where(known, size, 0.0), _FILTERED, mode="nearest")
        ratios = np.column_stack([ratios, size])
    sizes = np.sort(ratios, axis=1)[:, -2]
    frames = np.arange(len(points))
    seen = np.flatnonzero(sizes > 0)
    if len(seen) < 2:
        raise ValueError(
            f"track must show two bones of the arms or legs in several frames, got {len(seen)} of "
            f"{len(points)} (averaged) frames"
        )
    size = np.exp(np.interp(frames, seen, np.log(sizes[seen])))
    visible = np.flatnonzero((weight > 0).any(axis=1))
    shown = np.where(weight[..., None] > 0, points, np.nan)[visible]
    median = np.nanmedian(shown, axis=1)
    middle = [np.interp(frames, visible, median[:, i]) for i in range(2)]
    return BodyPath(np.stack(middle, axis=-1), size)


def smooth_size(size: np.ndarray) -> np.ndarray:
    """Return sizes whose logarithms are a straight line over time, fitted robustly, (L,)."""
    times = np.arange(len(size)) - (len(size) - 1) / 2
    logs, robust = np.log(size), np.ones(len(size))
    slope, level = 0.0, float(np.median(logs))
    for _ in range(10):
        slope, level = np.polyfit(times, logs, 1, w=np.sqrt(robust))
        robust = 1 / (1 + ((logs - slope * times - level) / _SPREAD) ** 2)
    line: np.ndarray = np.exp(slope * times + level)
    return line
