"""Scaling of 2D tracks to metres or body lengths by apparent bone sizes.

The projection of a bone has full length if the bone is perpendicular to the view, and is shorter
otherwise. The 90 % quantile of projected lengths therefore estimates the bone's length robustly.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from probmotion.data.tracks.segments import track_size
from probmotion.data.tracks.step_reports import Step, StepReport, masked, seen
from probmotion.motion.motion import KeypointTrack
from probmotion.validation import check_positive

__all__ = ["body_extent", "bone_sizes", "per_track_scales", "scale_to_bones"]

_QUANTILE = 0.9


def bone_sizes(tracks: Sequence[KeypointTrack]) -> dict[str, float]:
    """Return the apparent size of each bone: the 90 % quantile of its projected length.

    Keys are names of the bones' child joints. Sizes are in the tracks' unit, over the frames in
    which both ends are seen. Bones that are never seen are omitted. Raises ``ValueError`` if
    there is no track, or the tracks have several skeletons.
    """
    if not tracks:
        raise ValueError("tracks must contain at least one, got none")
    skeleton = tracks[0].skeleton
    for number, track in enumerate(tracks):
        if track.skeleton != skeleton:
            raise ValueError(f"tracks must have one skeleton, got another in tracks[{number}]")
    sizes = {}
    for joint, parent in skeleton.bones:
        bones = [np.diff(track.keypoints[:, [parent, joint]], axis=1)[:, 0] for track in tracks]
        visible = [seen(track)[:, [parent, joint]].all(axis=1) for track in tracks]
        lengths = np.linalg.norm(np.concatenate(bones)[np.concatenate(visible)], axis=-1)
        if len(lengths):
            sizes[skeleton.joint_names[joint]] = float(np.quantile(lengths, _QUANTILE))
    return sizes


def scale_to_bones(tracks: Sequence[KeypointTrack], sizes: Mapping[str, float]) -> Step:
    """Scale each track by the median ratio of reference ``sizes`` to its :func:`bone_sizes`.

    Tracks without a seen bone of ``sizes`` are dropped. Raises ``ValueError`` if ``sizes`` is
    empty or contains no bone of a skeleton, or if a size is not positive.
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
        known = bone_sizes([track]).items()
        ratios = [sizes[name] / size for name, size in known if name in sizes and size > 0]
        if ratios:
            factors.append(float(np.median(ratios)))
            scaled.append(replace(track, keypoints=track.keypoints * factors[-1]))
    n_dropped = len(tracks) - len(scaled)
    between = f" by {min(factors):.4g} to {max(factors):.4g}" if factors else ""
    why = f"scaled to the reference bones{between}; tracks without one: {n_dropped}"
    return scaled, StepReport.of("scale", tracks, scaled, why)


def body_extent(track: KeypointTrack) -> float:
    """Return the median diagonal of the body's bounding box, 0 if no frame shows two joints.

    Only joints at the end of a bone belong to the body; a ball does not.
    """
    body = np.isin(np.arange(track.skeleton.n_joints), track.skeleton.bones)
    single = (seen(track) & body).sum(axis=1, keepdims=True) < 2
    return 0.0 if single.all() else track_size(masked(track, ~body | single))


def per_track_scales(tracks: Sequence[KeypointTrack]) -> dict[str, float]:
    """Return bone sizes for scaling a body of unknown size, with the body length as the unit.

    Proportions are the median over tracks of each bone's size relative to the track's
    :func:`body_extent`. :func:`scale_to_bones` then scales the tracks to a median extent of 1.
    Raises ``ValueError`` if no track shows a bone.
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
