"""Tracks in metres: each scaled until its bones are as long as those of a reference.

A bone's projection is as long as the bone where it lies across the view and shorter elsewhere. Over
a motion the 90 % quantile of its lengths in the picture is therefore near its length, times the
image's units per metre at the subject; not the greatest, which errors of detection lengthen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from probmotion.data.tracks.step_reports import StepReport, frames_of, seen
from probmotion.motion.motion import KeypointTrack
from probmotion.validation import check_positive

__all__ = ["bone_sizes", "scale_to_bones"]

_QUANTILE = 0.9


def bone_sizes(tracks: Sequence[KeypointTrack]) -> dict[str, float]:
    """Return how long each bone is in the pictures: the 90 % quantile over all frames.

    Parameters
    ----------
    tracks : sequence of KeypointTrack
        Tracks of one skeleton, at least one.

    Returns
    -------
    sizes : dict of str to float
        By the name of the bone's joint (the end that is not its parent), in the tracks' unit, over
        the frames in which both ends are seen; bones that are never seen are left out.

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
            raise ValueError(
                f"tracks[{number}] has another skeleton than tracks[0], expected one for all"
            )
    sizes = {}
    for joint, parent in skeleton.bones:
        lengths = np.concatenate([_lengths(track, joint, parent) for track in tracks])
        if len(lengths):
            sizes[skeleton.joint_names[joint]] = float(np.quantile(lengths, _QUANTILE))
    return sizes


def scale_to_bones(
    tracks: Sequence[KeypointTrack], sizes: Mapping[str, float]
) -> tuple[list[KeypointTrack], StepReport]:
    """Scale each track by one factor: the median over bones of the reference's size over its own.

    The median, because proportions differ from body to body, and a bone that never lies across the
    view is short.

    Parameters
    ----------
    tracks : sequence of KeypointTrack
        Tracks in any unit, each its own.
    sizes : mapping of str to float
        What :func:`bone_sizes` says of a data set in metres.

    Returns
    -------
    tracks : list of KeypointTrack
        Tracks in the unit of ``sizes``; those that show no bone of ``sizes`` are dropped.
    report : StepReport
        Says the range of the factors.

    Raises
    ------
    ValueError
        If ``sizes`` is empty, a size is not above 0, or a skeleton has none of its bones.
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
                f"sizes has the bones {', '.join(sizes)}, of which track {track.name!r} has none, "
                f"expected some of {', '.join(sorted(names)) or 'none: its joints are all roots'}"
            )
        own = bone_sizes([track])
        ratios = [sizes[name] / size for name, size in own.items() if name in sizes and size > 0]
        if ratios:
            factors.append(float(np.median(ratios)))
            scaled.append(replace(track, keypoints=track.keypoints * factors[-1]))
    lost = len(tracks) - len(scaled)
    between = f" by {min(factors):.4g} to {max(factors):.4g}" if factors else ""
    why = f"scaled to the reference's bones{between}; {lost} tracks never showed one"
    return scaled, StepReport.of(
        "scale",
        tracks,
        scaled,
        why,
        tracks_dropped=lost,
        frames_dropped=frames_of(tracks) - frames_of(scaled),
    )


def _lengths(track: KeypointTrack, joint: int, parent: int) -> np.ndarray:
    """Return a bone's lengths in the picture over the frames in which both ends are seen."""
    both = seen(track)[:, joint] & seen(track)[:, parent]
    return np.linalg.norm(track.keypoints[both, joint] - track.keypoints[both, parent], axis=-1)
