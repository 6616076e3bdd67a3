"""Bone sizes of bodies of which nothing is known but their pictures: their length is the unit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from probmotion.data.tracks.scales import bone_sizes, scale_to_bones
from probmotion.data.tracks.step_reports import seen
from probmotion.motion.motion import KeypointTrack

__all__ = ["body_extent", "per_track_scales"]


def body_extent(track: KeypointTrack) -> float:
    """Return how large the body is in the picture: the median of its box's diagonal over frames.

    The box is that of the joints seen in a frame that are an end of a bone; a ball is none. It is
    0 where no frame shows two.
    """
    body = sorted({joint for bone in track.skeleton.bones for joint in bone})
    there = seen(track)[:, body]
    shown = there.sum(axis=1) > 1
    if not shown.any():
        return 0.0
    points, there = track.keypoints[shown][:, body], there[shown][..., np.newaxis]
    most = np.where(there, points, -np.inf).max(axis=1)
    least = np.where(there, points, np.inf).min(axis=1)
    return float(np.median(np.linalg.norm(most - least, axis=-1)))


def per_track_scales(tracks: Sequence[KeypointTrack]) -> dict[str, float]:
    """Return sizes to scale a data set by that is of no known body, each track in its own unit.

    Proportions are the median over tracks of each bone's size (:func:`bone_sizes`) in units of its
    track's :func:`body_extent`. The unit is such that tracks scaled to them
    (:func:`scale_to_bones`) have a median extent of 1: "metres" are then body lengths.

    Parameters
    ----------
    tracks : sequence of KeypointTrack
        Tracks of one skeleton.

    Returns
    -------
    sizes : dict of str to float
        As those of :func:`bone_sizes`.

    Raises
    ------
    ValueError
        If no track shows a bone.
    """
    shares: dict[str, list[float]] = {}
    for track in tracks:
        extent = body_extent(track)
        for name, size in bone_sizes([track]).items():
            if size > 0 and extent > 0:
                shares.setdefault(name, []).append(size / extent)
    if not shares:
        raise ValueError("tracks never shows a bone, expected some to scale by; or give sizes")
    sizes = {name: float(np.median(found)) for name, found in shares.items()}
    scaled, _ = scale_to_bones(tracks, sizes)
    unit = float(np.median([body_extent(track) for track in scaled]))
    return {name: size / unit for name, size in sizes.items()}
