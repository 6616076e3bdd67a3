"""Joints of 2D tracks: chosen and ordered by name, derived as midpoints, and added, as a ball is.

Source: *MAS*, section 6.1 (the closest ball to the athlete becomes an additional joint).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from probmotion.data.tracks.step_reports import seen
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_shape

__all__ = ["nearest_object", "retarget_track", "with_joint", "with_midpoint"]

_MIDPOINTS = {
    "pelvis": ("left_hip", "right_hip"),
    "neck": ("left_shoulder", "right_shoulder"),
}


def with_joint(
    track: KeypointTrack,
    name: str,
    keypoints: np.ndarray,
    confidence: np.ndarray,
    parent: str | None = None,
) -> KeypointTrack:
    """Return the track with one more joint, the last.

    Parameters
    ----------
    track : KeypointTrack
        The track.
    name : str
        The joint's name, such as ``"ball"``.
    keypoints : ndarray, (L, 2)
        Where it is, in the track's unit.
    confidence : ndarray, (L,)
        Its confidences; where they are 0, ``keypoints`` do not count.
    parent : str, optional
        The name of its parent; a tree of its own by default.

    Raises
    ------
    ValueError
        If shapes do not fit, the name is taken, or ``parent`` is no joint.
    """
    points = np.asarray(keypoints, dtype=np.float64)
    weights = np.asarray(confidence, dtype=np.float64)
    check_shape("keypoints", points, (track.frames, 2))
    check_shape("confidence", weights, (track.frames,))
    source = track.skeleton
    above = -1 if parent is None else source.index(parent)
    points = np.where((weights > 0)[:, np.newaxis], points, np.nan)
    return replace(
        track,
        keypoints=np.concatenate([track.keypoints, points[:, np.newaxis]], axis=1),
        confidence=np.concatenate([track.confidence, weights[:, np.newaxis]], axis=1),
        skeleton=Skeleton([*source.joint_names, name], [*source.parents, above]),
    )


def with_midpoint(
    track: KeypointTrack, name: str, joints: Sequence[str], parent: str | None = None
) -> KeypointTrack:
    """Return the track with one more joint amid others: at the mean of their places.

    Its confidence is the least of theirs, so that it is seen where all of them are.

    Parameters
    ----------
    track : KeypointTrack
        The track.
    name : str
        The joint's name, such as ``"pelvis"``.
    joints : sequence of str
        Names of at least two joints.
    parent : str, optional
        The name of its parent; a tree of its own by default.

    Raises
    ------
    ValueError
        If a joint is unknown, there are fewer than two, or the name is taken.
    """
    if isinstance(joints, str) or len(joints) < 2:
        raise ValueError(f"joints must be the names of at least two joints, got {joints!r}")
    places = [track.skeleton.index(joint) for joint in joints]
    middle = track.keypoints[:, places].mean(axis=1)
    return with_joint(track, name, middle, track.confidence[:, places].min(axis=1), parent)


def retarget_track(track: KeypointTrack, skeleton: Skeleton, derive: bool = False) -> KeypointTrack:
    """Return the track on another skeleton: its joints chosen, ordered and linked anew.

    Joints are matched by their own or else their canonical names
    (:mod:`probmotion.motion.joint_names`).

    Parameters
    ----------
    track : KeypointTrack
        The track.
    skeleton : Skeleton
        The skeleton to have.
    derive : bool
        Whether a ``pelvis`` that the track lacks may be made of its hips, and a ``neck`` of its
        shoulders (:func:`with_midpoint`). No other joint is made up, and these not unasked.

    Raises
    ------
    ValueError
        If a joint of ``skeleton`` has no counterpart; the message names it.
    """
    if track.skeleton == skeleton:
        return track
    chosen = []
    for name, canonical in zip(skeleton.joint_names, skeleton.canonical_names, strict=True):
        wanted = name if name in track.skeleton.joint_names else canonical
        known = wanted in track.skeleton.joint_names or wanted in track.skeleton.canonical_names
        if not known and derive and canonical in _MIDPOINTS:
            track = with_midpoint(track, canonical, _MIDPOINTS[canonical])
        elif not known:
            hint = ", or derive=True" if canonical in _MIDPOINTS else ""
            raise ValueError(
                f"skeleton has the joint {name!r}, which track {track.name!r} lacks, expected one "
                f"of {', '.join(track.skeleton.joint_names)}{hint}"
            )
        chosen.append(track.skeleton.index(wanted))
    return replace(
        track,
        keypoints=track.keypoints[:, chosen],
        confidence=track.confidence[:, chosen],
        skeleton=skeleton,
    )


def nearest_object(
    track: KeypointTrack, boxes: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the centre of the detected box that is nearest to the athlete, frame by frame.

    A box is as near as its centre is to the nearest seen joint: a ball may be thrown, or rolled by
    a foot, far from the body's centre.

    Parameters
    ----------
    track : KeypointTrack
        The athlete.
    boxes : sequence of ndarray, (n, 5)
        Per frame the boxes detected in it: left, top, right, bottom, in the track's unit, and
        confidence; any number, or an empty array.

    Returns
    -------
    keypoints : ndarray, (L, 2)
        Centres; NaN in frames without a box or without a seen joint.
    confidence : ndarray, (L,)
        The boxes' confidences, 0 where there is none. See :func:`with_joint`.

    Raises
    ------
    ValueError
        If there is not one array per frame, or one has another shape or is not finite.
    """
    if len(boxes) != track.frames:
        raise ValueError(f"boxes has {len(boxes)} entries, expected {track.frames}, one per frame")
    keypoints = np.full((track.frames, 2), np.nan)
    confidence = np.zeros(track.frames)
    for frame, found in enumerate(boxes):
        found = np.asarray(found, dtype=np.float64)
        there = seen(track)[frame]
        if not found.size:
            continue
        check_shape(f"boxes[{frame}]", found, ("n", 5))
        if not np.isfinite(found).all():
            raise ValueError(f"boxes[{frame}] holds NaN or infinite values, expected finite ones")
        if not there.any():
            continue
        centres = (found[:, :2] + found[:, 2:4]) / 2
        joints = track.keypoints[frame, there]
        distances = np.linalg.norm(centres[:, np.newaxis] - joints, axis=-1).min(axis=1)
        nearest = int(np.argmin(distances))
        confidence[frame] = found[nearest, 4]
        if confidence[frame] > 0:
            keypoints[frame] = centres[nearest]
    return keypoints, confidence
