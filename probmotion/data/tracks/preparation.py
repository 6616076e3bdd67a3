"""Preparation of raw 2D tracks as a data set, with a report per step.

The steps follow *MAS*, section 6.1. The table gives the reason for their order:

============  ==================================================================================
step          reason
============  ==================================================================================
uncertain     first, because later steps only distinguish seen and unseen detections
crowds        requires uncut tracks over the same frames, with all joints
joints        before quality, which is computed over the joints used
segments      before interpolation, which must not cross jumps
outliers      per segment, before gaps are filled from neighbouring detections
quality       per segment and before gaps are filled, so that only detections count
gaps          before smoothing, which requires runs, and centring, which requires the root
smooth        before resampling, which would alias jitter
resample      to the frame rate of the data set
short         after all steps that change the duration of a track
scale         to metres, with one factor per track
centre        after smoothing, because jitter of the root would move every joint
quality       again, because centring marks frames without a root as unseen
============  ==================================================================================
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from probmotion.data.tracks.filters import (
    drop_crowds,
    drop_low_quality,
    drop_short,
    mask_outliers,
    mask_uncertain,
)
from probmotion.data.tracks.joints import retarget_track
from probmotion.data.tracks.poses import centre_tracks
from probmotion.data.tracks.scales import scale_to_bones
from probmotion.data.tracks.segments import split_discontinuities
from probmotion.data.tracks.smoothing import fill_gaps, resample_tracks, smooth_tracks
from probmotion.data.tracks.step_reports import Step, StepReport
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_positive

__all__ = ["PreparedTracks", "prepare_tracks"]


@dataclass(frozen=True, eq=False)
class PreparedTracks:
    """Prepared tracks, all with the same skeleton and frame rate, and a report per step."""

    tracks: tuple[KeypointTrack, ...]
    reports: tuple[StepReport, ...]

    def __str__(self) -> str:
        head = ("step", "tracks", "frames", "dropped", "", "changed", "")
        rows = [head] + [
            (
                report.step,
                f"{report.tracks_before} → {report.tracks_after}",
                f"{report.frames_before} → {report.frames_after}",
                f"{report.tracks_dropped} tracks",
                f"{report.frames_dropped} frames",
                f"{report.entries_changed}",
                report.why,
            )
            for report in self.reports
        ]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        return "\n".join(
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
            for row in rows
        )


def prepare_tracks(
    tracks: Sequence[KeypointTrack],
    *,
    fps: float,
    skeleton: Skeleton | None = None,
    sizes: Mapping[str, float] | None = None,
    videos: Sequence[str] | None = None,
    threshold: float = 0.3,
    shortest: float = 1.0,
    centre: str = "frame",
) -> PreparedTracks:
    """Prepare raw tracks by the steps in this module's table, with their default limits.

    Parameters
    ----------
    tracks : sequence of KeypointTrack
        Raw tracks, of one skeleton unless ``skeleton`` is given.
    fps : float
        Frames per second of the data set.
    skeleton : Skeleton, optional
        Target skeleton, with pelvis and neck derived if missing
        (:func:`~probmotion.data.tracks.joints.retarget_track`); by default that of the tracks.
    sizes : mapping of str to float, optional
        Bone sizes to scale tracks to (:func:`~probmotion.data.tracks.scales.scale_to_bones`); no
        scaling by default.
    videos : sequence of str, optional
        See :func:`~probmotion.data.tracks.filters.drop_crowds`.
    threshold : float
        Minimum confidence of a detection: 0.3 for people, 0.5 for horses, 0.01 with a ball.
    shortest : float
        Minimum duration of a track, seconds.
    centre : {"frame", "sequence"}
        See :func:`~probmotion.data.tracks.poses.centre_tracks`.

    Raises
    ------
    ValueError
        If there is no track, tracks have several skeletons, a number is out of range, or no track
        remains after a step.
    """
    check_positive("fps", fps)
    result = list(tracks)
    if not result:
        raise ValueError("tracks must contain at least one, got none")
    if skeleton is None and any(track.skeleton != result[0].skeleton for track in result):
        raise ValueError("tracks must have one skeleton, got several; pass skeleton")
    steps: list[Callable[[Sequence[KeypointTrack]], Step]] = [
        partial(mask_uncertain, threshold=threshold),
        partial(drop_crowds, videos=videos),
        *([] if skeleton is None else [partial(_retargeted, skeleton=skeleton)]),
        split_discontinuities,
        mask_outliers,
        partial(drop_low_quality, threshold=threshold),
        fill_gaps,
        smooth_tracks,
        partial(resample_tracks, fps=fps),
        partial(drop_short, seconds=shortest),
        *([] if sizes is None else [partial(scale_to_bones, sizes=sizes)]),
        partial(centre_tracks, per=centre),
        partial(drop_low_quality, threshold=threshold),
    ]
    reports = []
    for step in steps:
        result, report = step(result)
        reports.append(report)
        if not result:
            raise ValueError(f"no track remains after step {report}")
    return PreparedTracks(tuple(result), tuple(reports))


def _retargeted(tracks: Sequence[KeypointTrack], skeleton: Skeleton) -> Step:
    try:
        retargeted = [retarget_track(track, skeleton, derive=True) for track in tracks]
    except ValueError as error:
        names = ", ".join(tracks[0].skeleton.joint_names)
        raise ValueError(
            f"tracks of {names} cannot be retargeted: {error}; pass a skeleton with these joints, "
            "or None (own on the command line)"
        ) from error
    why = f"retargeted to the {skeleton.n_joints} joints {skeleton.joint_names[0]}, …"
    return retargeted, StepReport.of("joints", tracks, retargeted, why)
