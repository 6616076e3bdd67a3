"""Centring and mirroring of 2D tracks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from probmotion.data.tracks.step_reports import Step, StepReport, entries_of, seen
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.splits import name_within_clip

__all__ = ["centre_tracks", "mirrored_track"]

_MIRRORED = "mirrored"


def centre_tracks(tracks: Sequence[KeypointTrack], *, per: str = "frame") -> Step:
    """Move the first root joint to the origin and drop tracks that never show it.

    ``per`` is ``"frame"``, for the root of every frame (frames without it become unseen), or
    ``"sequence"``, for the mean root over the frames in which it is seen.
    """
    if per not in ("frame", "sequence"):
        raise ValueError(f"per must be 'frame' or 'sequence', got {per!r}")
    rooted = [track for track in tracks if seen(track)[:, track.skeleton.roots[0]].any()]
    centred = []
    for track in rooted:
        origin = track.keypoints[:, track.skeleton.roots[0]]
        known = seen(track)[:, track.skeleton.roots[0]]
        confidence = track.confidence
        if per == "frame":
            confidence = np.where(known[:, np.newaxis], confidence, 0.0)
        else:
            origin = origin[known].mean(axis=0, keepdims=True)
        keypoints = track.keypoints - origin[:, np.newaxis]
        keypoints = np.where((confidence > 0)[..., np.newaxis], keypoints, np.nan)
        centred.append(replace(track, keypoints=keypoints, confidence=confidence))
    n_dropped = len(tracks) - len(rooted)
    roots = ", ".join(sorted({t.skeleton.joint_names[t.skeleton.roots[0]] for t in tracks}))
    why = f"root at the origin per {per}; tracks without the root ({roots}): {n_dropped}"
    changed = entries_of(rooted) - entries_of(centred)
    return centred, StepReport.of("centre", tracks, centred, why, entries_changed=changed)


def mirrored_track(track: KeypointTrack) -> KeypointTrack:
    """Return the mirror image of a track: x becomes -x, and left and right joints swap.

    " mirrored" is appended to the name; mirroring twice returns the original.
    """
    order = list(track.skeleton.mirrored_order)
    name = track.name[: -len(_MIRRORED) - 1]
    if not track.name.endswith(_MIRRORED):
        name = name_within_clip(track.name, _MIRRORED)
    keypoints = track.keypoints[:, order] * np.array([-1.0, 1.0])
    return replace(track, keypoints=keypoints, confidence=track.confidence[:, order], name=name)
