"""Preparation of raw 2D tracks as a data set, with a report per step.

Source: *MAS*, section 6.1. The steps, with the reason for their order:

============  ==================================================================================
step          reason
============  ==================================================================================
uncertain     first: later steps only distinguish seen from unseen
crowds        needs whole tracks, side by side in time, with all joints
joints        before quality, which concerns the joints used
segments      before interpolation, which must not cross jumps
outliers      per segment, before gaps are filled
quality       per segment, on detections alone: before gaps are filled
gaps          before smoothing, which needs runs, and centring, which needs the root
smooth        before resampling, which would alias jitter
resample      to the frame rate of the data set
short         after everything that changes durations
scale         to metres: one factor per track
centre        after smoothing: jitter of the root would move every joint
quality       again: centring drops frames without a root
============  ==================================================================================
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

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
from probmotion.data.tracks.step_reports import StepReport
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_positive

__all__ = ["PreparedTracks", "prepare_tracks"]


@dataclass(frozen=True, eq=False)
class PreparedTracks:
    """A data set of at least one track with one skeleton and frame rate, and a report per step."""

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
        widths = [max(len(row[column]) for row in rows) for column in range(len(head))]
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
    overlap: float = 0.3,
    share: float = 0.6,
    jump: float = 0.5,
    unseen: float = 0.5,
    outlier: float = 0.15,
    longest_gap: float = 0.25,
    window: float = 0.25,
    shortest: float = 1.0,
    centre: str = "frame",
) -> PreparedTracks:
    """Run the steps of this module's table over raw tracks.

    Parameters
    ----------
    tracks : sequence of KeypointTrack
        Raw tracks, of one skeleton unless ``skeleton`` is given.
    fps : float
        Frames per second of the data set.
    skeleton : Skeleton, optional
        Target skeleton, with pelvis and neck derived if missing
        (:func:`~probmotion.data.tracks.joints.retarget_track`); the tracks' own by default.
    sizes : mapping of str to float, optional
        Bone sizes to scale tracks to (:func:`~probmotion.data.tracks.scales.scale_to_bones`); no
        scaling by default.
    videos, overlap
        See :func:`~probmotion.data.tracks.filters.drop_crowds`.
    threshold : float
        Least confidence of a detection: 0.3 for people, 0.5 for horses, 0.01 with a ball.
    share : float
        See :func:`~probmotion.data.tracks.filters.drop_low_quality`.
    jump, unseen : float
        See :func:`~probmotion.data.tracks.segments.split_discontinuities`.
    outlier : float
        See :func:`~probmotion.data.tracks.filters.mask_outliers`.
    longest_gap, window, shortest : float
        Seconds: longest gap to fill, window of smoothing and outlier detection, shortest track.
    centre : {"frame", "sequence"}
        See :func:`~probmotion.data.tracks.poses.centre_tracks`.

    Raises
    ------
    ValueError
        If there is no track, tracks have several skeletons, a number is out of range, or a step
        leaves no track.
    """
    check_positive("fps", fps)
    left = list(tracks)
    if not left:
        raise ValueError("tracks must contain at least one, got none")
    if skeleton is None and any(track.skeleton != left[0].skeleton for track in left):
        raise ValueError("tracks must have one skeleton, got several; pass skeleton")
    reports: list[StepReport] = []

    def take(step: tuple[list[KeypointTrack], StepReport]) -> list[KeypointTrack]:
        reports.append(step[1])
        if not step[0]:
            raise ValueError(f"no track is left after step {step[1]}")
        return step[0]

    left = take(mask_uncertain(left, threshold=threshold))
    left = take(drop_crowds(left, overlap=overlap, videos=videos))
    if skeleton is not None:
        left = take(_retargeted(left, skeleton))
    left = take(split_discontinuities(left, jump=jump, unseen=unseen))
    left = take(mask_outliers(left, distance=outlier, window=window))
    left = take(drop_low_quality(left, threshold=threshold, share=share))
    left = take(fill_gaps(left, longest=longest_gap))
    left = take(smooth_tracks(left, window=window))
    left = take(resample_tracks(left, fps=fps))
    left = take(drop_short(left, seconds=shortest))
    if sizes is not None:
        left = take(scale_to_bones(left, sizes))
    left = take(centre_tracks(left, per=centre))
    left = take(drop_low_quality(left, threshold=threshold, share=share))
    return PreparedTracks(tuple(left), tuple(reports))


def _retargeted(
    tracks: list[KeypointTrack], skeleton: Skeleton
) -> tuple[list[KeypointTrack], StepReport]:
    try:
        moved = [retarget_track(track, skeleton, derive=True) for track in tracks]
    except ValueError as error:
        own = ", ".join(tracks[0].skeleton.joint_names)
        raise ValueError(
            f"tracks of {own} cannot be retargeted: {error}; pass a skeleton with these joints, or "
            "None (own on the command line)"
        ) from error
    why = f"retargeted to the {skeleton.n_joints} joints {skeleton.joint_names[0]}, …"
    return moved, StepReport.of("joints", tracks, moved, why)
