"""Steps that place the bodies of tracks: centred on their root, and mirrored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from probmotion.data.tracks.step_reports import StepReport, entries_of, frames_of, seen
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.splits import name_within_clip

__all__ = ["centre_tracks", "mirror_tracks", "mirrored_track"]

Step = tuple[list[KeypointTrack], StepReport]
_MIRRORED = "mirrored"


def centre_tracks(tracks: Sequence[KeypointTrack], *, per: str = "frame") -> Step:
    """Put the first root at the origin.

    Parameters
    ----------
    tracks : sequence of KeypointTrack
        Tracks of any skeletons.
    per : str
        ``"frame"``: the root's place in every frame; all joints of a frame without it are hidden,
        because nothing says where they are about it. (Where the root was unseen for short,
        :func:`~probmotion.data.tracks.smoothing.fill_gaps` gives it back before.)
        ``"sequence"``: its mean over the frames in which it was seen, so that the path stays.

    Returns
    -------
    tracks : list of KeypointTrack
        Tracks whose root was never seen are dropped.
    report : StepReport
        ``entries_changed`` counts what was hidden.

    Raises
    ------
    ValueError
        If ``per`` is another word.
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
    lost = len(tracks) - len(rooted)
    roots = ", ".join(sorted({t.skeleton.joint_names[t.skeleton.roots[0]] for t in tracks}))
    why = f"root at the origin per {per}; {lost} tracks never showed it ({roots})"
    return centred, StepReport.of(
        "centre",
        tracks,
        centred,
        why,
        tracks_dropped=lost,
        frames_dropped=frames_of(tracks) - frames_of(rooted),
        entries_changed=entries_of(rooted) - entries_of(centred),
    )


def mirror_tracks(tracks: Sequence[KeypointTrack]) -> Step:
    """Return the tracks and, after them, their mirrored copies (:func:`mirrored_track`)."""
    both = [*tracks, *(mirrored_track(track) for track in tracks)]
    return both, StepReport.of("mirror", tracks, both, "added each track's mirror image")


def mirrored_track(track: KeypointTrack) -> KeypointTrack:
    """Return a track seen in a mirror: x becomes -x, and left joints are right ones.

    Its name ends in ``mirrored`` and is one of the same clip. The mirror image of the mirror image
    is the track itself.
    """
    order = list(track.skeleton.mirrored_order)
    twice = track.name.endswith(_MIRRORED)
    return replace(
        track,
        keypoints=track.keypoints[:, order] * np.array([-1.0, 1.0]),
        confidence=track.confidence[:, order],
        name=track.name[: -len(_MIRRORED) - 1]
        if twice
        else name_within_clip(track.name, _MIRRORED),
    )
