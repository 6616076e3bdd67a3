"""Raw 2D tracks → a data set: the steps of preparation in their order, each with its report.

Source: *MAS*, section 6.1. The order, and why:

============  ==================================================================================
step          why here
============  ==================================================================================
uncertain     first: everything after it asks only what is seen
crowds        needs whole tracks, side by side in time, with all of their joints
joints        before quality, which is that of the joints that will be used
pieces        before anything is interpolated: never across a jump; before centring, which hides
              jumps
strays        per piece: a jump is none; before gaps are filled, which closes what it opens
quality       per piece, and of detections alone: before gaps are filled
gaps          before smoothing, which works on runs; before centring, which needs the root
smooth        before resampling: decimation would fold jitter into slow movement
resample      to the one frame rate of the data set
short         after all that changes durations
scale         to metres: one factor per track
centre        after smoothing: the root's jitter would move every joint
quality       again: what was hidden for want of the root may be most of a track
mirror        last: about the root
============  ==================================================================================
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from probmotion.data.tracks.filters import (
    drop_crowds,
    drop_low_quality,
    drop_short,
    hide_strays,
    hide_uncertain,
)
from probmotion.data.tracks.joints import retarget_track
from probmotion.data.tracks.poses import centre_tracks, mirror_tracks
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
    """A data set of tracks with one skeleton and frame rate, and how it came about.

    Attributes
    ----------
    tracks : tuple of KeypointTrack
        What is left, at least one.
    reports : tuple of StepReport
        One per step that was taken, in order.
    """

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
    stray: float = 0.15,
    longest_gap: float = 0.25,
    window: float = 0.25,
    shortest: float = 1.0,
    centre: str = "frame",
    mirror: bool = False,
) -> PreparedTracks:
    """Run the steps of this module's table over raw tracks.

    Parameters
    ----------
    tracks : sequence of KeypointTrack
        Raw tracks, of one skeleton unless ``skeleton`` is given.
    fps : float
        Frames per second of the data set.
    skeleton : Skeleton, optional
        Bring tracks to these joints, pelvis and neck derived where they lack them
        (:func:`~probmotion.data.tracks.joints.retarget_track`); their own by default.
    sizes : mapping of str to float, optional
        Scale tracks to these bones (:func:`~probmotion.data.tracks.scales.scale_to_bones`); by
        default they keep their unit.
    videos, overlap
        See :func:`~probmotion.data.tracks.filters.drop_crowds`.
    threshold : float
        The least confidence that counts: 0.3 for people, 0.5 for horses, 0.01 with a ball.
    share : float
        See :func:`~probmotion.data.tracks.filters.drop_low_quality`.
    jump, unseen : float
        See :func:`~probmotion.data.tracks.segments.split_discontinuities`.
    stray : float
        See :func:`~probmotion.data.tracks.filters.hide_strays`.
    longest_gap, window, shortest : float
        Seconds: the longest gap to fill, the window of smoothing and of the search for strays, the
        shortest track.
    centre : str
        ``"frame"`` or ``"sequence"``; see :func:`~probmotion.data.tracks.poses.centre_tracks`.
    mirror : bool
        Whether mirrored copies are added. Off by default: training mirrors at random as it goes,
        and held-out tracks should be those that were seen.

    Raises
    ------
    ValueError
        If there is no track, tracks have several skeletons, a number is out of range, or a step
        leaves no track; the message says which, and what it dropped.
    """
    check_positive("fps", fps)
    left = list(tracks)
    if not left:
        raise ValueError("tracks must contain at least one, got none")
    if skeleton is None and any(track.skeleton != left[0].skeleton for track in left):
        raise ValueError(
            "tracks have several skeletons, expected one, or skeleton to bring them to"
        )
    reports: list[StepReport] = []

    def take(step: tuple[list[KeypointTrack], StepReport]) -> list[KeypointTrack]:
        reports.append(step[1])
        if not step[0]:
            raise ValueError(f"tracks has none left, expected at least one, after {step[1]}")
        return step[0]

    left = take(hide_uncertain(left, threshold=threshold))
    left = take(drop_crowds(left, overlap=overlap, videos=videos))
    if skeleton is not None:
        left = take(_retargeted(left, skeleton))
    left = take(split_discontinuities(left, jump=jump, unseen=unseen))
    left = take(hide_strays(left, distance=stray, window=window))
    left = take(drop_low_quality(left, threshold=threshold, share=share))
    left = take(fill_gaps(left, longest=longest_gap))
    left = take(smooth_tracks(left, window=window))
    left = take(resample_tracks(left, fps=fps))
    left = take(drop_short(left, seconds=shortest))
    if sizes is not None:
        left = take(scale_to_bones(left, sizes))
    left = take(centre_tracks(left, per=centre))
    left = take(drop_low_quality(left, threshold=threshold, share=share))
    if mirror:
        left = take(mirror_tracks(left))
    return PreparedTracks(tuple(left), tuple(reports))


def _retargeted(
    tracks: list[KeypointTrack], skeleton: Skeleton
) -> tuple[list[KeypointTrack], StepReport]:
    try:
        moved = [retarget_track(track, skeleton, derive=True) for track in tracks]
    except ValueError as error:
        own = ", ".join(tracks[0].skeleton.joint_names)
        raise ValueError(
            f"skeleton has joints that tracks of {own} do not say: {error}; expected one that fits "
            "them, or the tracks' own (None, on the command line own)"
        ) from error
    why = f"brought to the {skeleton.n_joints} joints {skeleton.joint_names[0]}, …"
    return moved, StepReport.of("joints", tracks, moved, why)
