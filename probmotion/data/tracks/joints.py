"""Joints of 2D tracks: retargeting, midpoints and additional joints such as a ball.

Source: *MAS*, section 6.1 (the ball closest to the athlete becomes an additional joint).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from probmotion.data.tracks.step_reports import seen
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_finite, check_shape

__all__ = ["nearest_object", "retarget_track", "with_joint", "with_midpoint"]

_MIDPOINTS = {"pelvis": ("left_hip", "right_hip"), "neck": ("left_shoulder", "right_shoulder")}


def with_joint(
    track: KeypointTrack,
    name: str,
    keypoints: np.ndarray,
    confidence: np.ndarray,
    parent: str | None = None,
) -> KeypointTrack:
    """Return the track with an additional last joint ``name``, such as ``"ball"``.

    Parameters
    ----------
    keypoints : ndarray, (L, 2)
        Positions, in the track's unit; ignored where the confidence is 0.
    confidence : ndarray, (L,)
        Confidences of the positions, 0 for unseen ones.
    parent : str, optional
        Name of the parent joint; by default the new joint is a root.

    Raises
    ------
    ValueError
        If a shape is wrong, the name exists, or ``parent`` is unknown.
    """
    points = np.asarray(keypoints, dtype=np.float64)
    weights = np.asarray(confidence, dtype=np.float64)
    check_shape("keypoints", points, (track.frames, 2))
    check_shape("confidence", weights, (track.frames,))
    source = track.skeleton
    parent_index = -1 if parent is None else source.index(parent)
    points = np.where((weights > 0)[:, np.newaxis], points, np.nan)
    return replace(
        track,
        keypoints=np.concatenate([track.keypoints, points[:, np.newaxis]], axis=1),
        confidence=np.concatenate([track.confidence, weights[:, np.newaxis]], axis=1),
        skeleton=Skeleton([*source.joint_names, name], [*source.parents, parent_index]),
    )


def with_midpoint(
    track: KeypointTrack, name: str, joints: Sequence[str], parent: str | None = None
) -> KeypointTrack:
    """Return the track with an additional joint ``name`` at the mean position of ``joints``.

    The confidence is the minimum over ``joints``. Raises ``ValueError`` if an argument is invalid.
    """
    if isinstance(joints, str) or len(joints) < 2:
        raise ValueError(f"joints must name at least two joints, got {joints!r}")
    indices = [track.skeleton.index(joint) for joint in joints]
    middle = track.keypoints[:, indices].mean(axis=1)
    return with_joint(track, name, middle, track.confidence[:, indices].min(axis=1), parent)


def retarget_track(track: KeypointTrack, skeleton: Skeleton, derive: bool = False) -> KeypointTrack:
    """Return the track on another skeleton, with joints matched by name or canonical name.

    ``derive`` replaces a missing ``pelvis`` by the midpoint of the hips and a missing ``neck`` by
    the midpoint of the shoulders. Raises ``ValueError`` if a joint has no counterpart.
    """
    if track.skeleton == skeleton:
        return track
    chosen = []
    for name, canonical in zip(skeleton.joint_names, skeleton.canonical_names, strict=True):
        target = name if name in track.skeleton.joint_names else canonical
        known = target in track.skeleton.joint_names or target in track.skeleton.canonical_names
        if not known and derive and canonical in _MIDPOINTS:
            track = with_midpoint(track, canonical, _MIDPOINTS[canonical])
        elif not known:
            hint = "; use derive=True" if canonical in _MIDPOINTS else ""
            raise ValueError(
                f"skeleton must have joints of track {track.name!r} "
                f"({', '.join(track.skeleton.joint_names)}), got {name!r}{hint}"
            )
        chosen.append(track.skeleton.index(target))
    return replace(
        track,
        keypoints=track.keypoints[:, chosen],
        confidence=track.confidence[:, chosen],
        skeleton=skeleton,
    )


def nearest_object(
    track: KeypointTrack, boxes: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the centre of the detected box closest to the athlete in each frame.

    The distance of a box is measured from its centre to the closest seen joint.

    Parameters
    ----------
    track : KeypointTrack
        Track of the athlete.
    boxes : sequence of ndarray, (n, 5)
        Boxes detected in each frame: left, top, right and bottom in the track's unit, and
        confidence; all finite.

    Returns
    -------
    keypoints : ndarray, (L, 2)
        Centres; NaN in frames without a box or a seen joint.
    confidence : ndarray, (L,)
        Confidences of the boxes, 0 where the centre is NaN; see :func:`with_joint`.
    """
    if len(boxes) != track.frames:
        raise ValueError(f"boxes must have one entry per frame, {track.frames}, got {len(boxes)}")
    keypoints = np.full((track.frames, 2), np.nan)
    confidence = np.zeros(track.frames)
    for frame, values in enumerate(boxes):
        detected = np.asarray(values, dtype=np.float64)
        if not detected.size:
            continue
        check_shape(f"boxes[{frame}]", detected, ("n", 5))
        check_finite(f"boxes[{frame}]", detected)
        joints = track.keypoints[frame, seen(track)[frame]]
        if not len(joints):
            continue
        centres = (detected[:, :2] + detected[:, 2:4]) / 2
        distances = np.linalg.norm(centres[:, np.newaxis] - joints, axis=-1).min(axis=1)
        nearest = int(np.argmin(distances))
        confidence[frame] = detected[nearest, 4]
        if confidence[frame] > 0:
            keypoints[frame] = centres[nearest]
    return keypoints, confidence
