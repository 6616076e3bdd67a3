"""Scaling of 2D tracks to metres by bone lengths, or to body lengths.

A bone's projection is as long as the bone where it is perpendicular to the view, and shorter
elsewhere. The 90 % quantile over a motion therefore estimates its length robustly.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from probmotion.data.tracks.step_reports import StepReport, seen
from probmotion.motion.motion import KeypointTrack
from probmotion.validation import check_positive

__all__ = ["body_extent", "bone_sizes", "per_track_scales", "scale_to_bones"]

_QUANTILE = 0.9


def bone_sizes(tracks: Sequence[KeypointTrack]) -> dict[str, float]:
    """Return the apparent size of each bone: the 90 % quantile of its projected length.

    Parameters
    ----------
    tracks : sequence of KeypointTrack
        At least one track, all of one skeleton.

    Returns
    -------
    sizes : dict of str to float
        By the name of the bone's lower joint, in the tracks' unit, over the frames in which both
        ends are seen; without bones that are never seen.

    Raises
    ------
    ValueError
        If there is no track, or the tracks have several skeletons.
    """
    if not tracks:
        raise ValueError("tracks must contain at least one, got none")
    skeleton = tracks[0].skeleton
    for number, track in enumerate(tracks):
        if track.skeleton != skeleton:
            raise ValueError(f"tracks must have one skeleton, but tracks[{number}] has another")
    sizes = {}
    for joint, parent in skeleton.bones:
        lengths = np.concatenate([_lengths(track, joint, parent) for track in tracks])
        if len(lengths):
            sizes[skeleton.joint_names[joint]] = float(np.quantile(lengths, _QUANTILE))
    return sizes


def scale_to_bones(
    tracks: Sequence[KeypointTrack], sizes: Mapping[str, float]
) -> tuple[list[KeypointTrack], StepReport]:
    """Scale each track by the median ratio of reference and own bone sizes.

    Parameters
    ----------
    tracks : sequence of KeypointTrack
        Tracks in any unit.
    sizes : mapping of str to float
        Reference sizes (:func:`bone_sizes`), metres.

    Returns
    -------
    tracks : list of KeypointTrack
        Tracks in the unit of ``sizes``, without those that show no bone of ``sizes``.
    report : StepReport
        With the range of the factors.

    Raises
    ------
    ValueError
        If ``sizes`` is empty, a size is not positive, or a skeleton has none of its bones.
    """
    if not sizes:
        raise ValueError("sizes must contain the size of at least one bone, got none")
    for name, size in sizes.items():
        check_positive(f"sizes[{name!r}]", size)
    scaled, factors = [], []
    for track in tracks:
        names = {track.skeleton.joint_names[joint] for joint, _ in track.skeleton.bones}
        if not names & sizes.keys():
            raise ValueError(
                f"sizes must contain bones of track {track.name!r} "
                f"({', '.join(sorted(names)) or 'which has none'}), got {', '.join(sizes)}"
            )
        own = bone_sizes([track])
        ratios = [sizes[name] / size for name, size in own.items() if name in sizes and size > 0]
        if ratios:
            factors.append(float(np.median(ratios)))
            scaled.append(replace(track, keypoints=track.keypoints * factors[-1]))
    lost = len(tracks) - len(scaled)
    between = f" by {min(factors):.4g} to {max(factors):.4g}" if factors else ""
    why = f"scaled to the reference bones{between}; {lost} tracks never show one"
    return scaled, StepReport.of("scale", tracks, scaled, why)


def _lengths(track: KeypointTrack, joint: int, parent: int) -> np.ndarray:
    """Return a bone's projected lengths over the frames in which both ends are seen."""
    both = seen(track)[:, joint] & seen(track)[:, parent]
    return np.linalg.norm(track.keypoints[both, joint] - track.keypoints[both, parent], axis=-1)


def body_extent(track: KeypointTrack) -> float:
    """Return the median diagonal of the body's bounding box, 0 if no frame shows two joints.

    Only joints at the end of a bone belong to the body; a ball does not.
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
    """Return bone sizes for scaling a body of unknown size, with the body length as the unit.

    Proportions are the median over tracks of each bone's size relative to the track's
    :func:`body_extent`. Scaled by :func:`scale_to_bones`, the tracks have a median extent of 1.

    Parameters
    ----------
    tracks : sequence of KeypointTrack
        Tracks of one skeleton.

    Returns
    -------
    sizes : dict of str to float
        As :func:`bone_sizes`.

    Raises
    ------
    ValueError
        If no track shows a bone.
    """
    ratios: dict[str, list[float]] = {}
    for track in tracks:
        extent = body_extent(track)
        for name, size in bone_sizes([track]).items():
            if size > 0 and extent > 0:
                ratios.setdefault(name, []).append(size / extent)
    if not ratios:
        raise ValueError("tracks must show at least one bone, got none; pass sizes")
    sizes = {name: float(np.median(values)) for name, values in ratios.items()}
    scaled, _ = scale_to_bones(tracks, sizes)
    unit = float(np.median([body_extent(track) for track in scaled]))
    return {name: size / unit for name, size in sizes.items()}
