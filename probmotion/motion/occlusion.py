"""Joints of which some are hidden, on another skeleton and at another frame rate.

A :class:`~probmotion.motion.motion.Motion` holds no NaN, so its own ``retarget`` and ``resample``
do not serve here; what they choose, joints by name and frames by time, is the same.
"""

from __future__ import annotations

import numpy as np

from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton

__all__ = ["joints_at_rate", "joints_on_skeleton"]

_MIDPOINTS = {
    "pelvis": ("left_hip", "right_hip"),
    "neck": ("left_shoulder", "right_shoulder"),
}


def joints_on_skeleton(
    joints: np.ndarray, confidence: np.ndarray, source: Skeleton, target: Skeleton
) -> tuple[np.ndarray, np.ndarray]:
    """Return joints on another skeleton, matched by their own or else their canonical names.

    A ``pelvis`` that the source lacks is midway between the hips, and a ``neck`` between the
    shoulders. The mean of two joints with errors of precision w/σ² each has one of
    4 w_a w_b / (w_a + w_b) / σ²: so is its confidence (0 where one of the two is hidden). That its
    error is then not independent of theirs is left aside.

    Parameters
    ----------
    joints : ndarray, (L, J, 3)
        Metres; NaN where hidden.
    confidence : ndarray, (L, J)
        0 where hidden.
    source, target : Skeleton
        Of what is given, and of what is returned.

    Returns
    -------
    joints : ndarray, (L, J', 3)
        NaN where hidden.
    confidence : ndarray, (L, J')
        0 where hidden.

    Raises
    ------
    ValueError
        If joints of ``target`` cannot be taken; the message names all of them.
    """
    joints = np.where(confidence[..., None] > 0, joints, np.nan)
    if source == target:
        return joints, confidence
    all_by_own_names = set(target.joint_names) <= set(source.joint_names)
    found: list[tuple[np.ndarray, np.ndarray]] = []
    missing: list[str] = []
    for name, canonical in zip(target.joint_names, target.canonical_names, strict=True):
        ends = [_index(source, end, end) for end in _MIDPOINTS.get(canonical, ())]
        joint = source.joint_names.index(name) if all_by_own_names else None
        joint = _index(source, name, canonical) if joint is None else joint
        if joint is not None:
            found.append((joints[:, joint], confidence[:, joint]))
        elif ends and None not in ends:
            found.append(_midpoint(joints, confidence, [end for end in ends if end is not None]))
        else:
            missing.append(name)
    if missing:
        raise ValueError(
            f"skeleton lacks {', '.join(missing)}, expected the prior's joints, by these or other "
            f"common names, among {', '.join(source.joint_names)}"
        )
    points, weights = zip(*found, strict=True)
    return np.stack(points, axis=1), np.stack(weights, axis=1)


def joints_at_rate(
    joints: np.ndarray, confidence: np.ndarray, fps: float, new_fps: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return joints at another frame rate, interpolated linearly between neighbouring frames.

    A joint is hidden where a frame that it would be made of is. Where it is (1 − a) of one frame
    and a of the next, precisions w/σ² give 1 / ((1 − a)²/w₁ + a²/w₂) / σ², which is its confidence
    here. Frames are those of :meth:`Motion.resample`: the first stays, none is extrapolated.

    Parameters
    ----------
    joints : ndarray, (L, J, 3)
        Metres; not read where hidden.
    confidence : ndarray, (L, J)
        0 where hidden.
    fps, new_fps : float
        Frames per second, given and wanted.

    Returns
    -------
    joints : ndarray, (L', J, 3)
        NaN where hidden.
    confidence : ndarray, (L', J)
        0 where hidden.
    """
    frames, n_joints = confidence.shape
    # A motion whose joints are (frame, 0, 0) says of which frames each new one is made.
    clock = np.zeros((frames, 1, 3))
    clock[:, 0, 0] = np.arange(frames)
    time = Motion(clock, Skeleton(["clock"], [-1]), fps).resample(new_fps).positions[:, 0, 0]
    before = np.minimum(np.floor(time + 1e-9).astype(int), frames - 1)
    after = np.minimum(before + 1, frames - 1)
    later = np.maximum(time - before, 0.0)[:, None]
    later = np.where(later < 1e-9, 0.0, later)
    places = np.where(confidence[..., None] > 0, joints, 0.0)
    shares = ((1 - later, before), (later, after))
    mixed = sum(share[..., None] * places[frame] for share, frame in shares)
    with np.errstate(divide="ignore", invalid="ignore"):
        variance = sum(
            np.where(share > 0, share**2 / confidence[frame], 0.0) for share, frame in shares
        )
    weight = np.where(np.isfinite(variance), 1 / np.maximum(variance, 1e-300), 0.0)
    assert weight.shape == (len(time), n_joints)
    return np.where(weight[..., None] > 0, mixed, np.nan), weight


def _index(skeleton: Skeleton, name: str, canonical: str) -> int | None:
    """Return the joint that another skeleton calls ``name``, as ``retarget_motion`` has it."""
    for wanted, known in (
        (canonical, skeleton.canonical_names),
        (name, skeleton.canonical_names),
        (name, skeleton.joint_names),
    ):
        if wanted in known:
            if known.count(wanted) > 1:
                raise ValueError(
                    f"skeleton has several joints that are the prior's {name!r}, expected one"
                )
            return known.index(wanted)
    return None


def _midpoint(
    joints: np.ndarray, confidence: np.ndarray, ends: list[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the place (L, 3) and the confidence (L,) midway between two joints."""
    first, second = (confidence[:, end] for end in ends)
    total = first + second
    product = np.where((first > 0) & (second > 0), 4 * first * second, 0.0)
    weight = product / np.where(total > 0, total, 1.0)
    return joints[:, ends].mean(axis=1), weight
