"""Filters of tracks in hand-computed cases."""

from dataclasses import replace

import numpy as np
import pytest

from probmotion.data.tracks.filters import (
    drop_crowds,
    drop_low_quality,
    drop_short,
    mask_outliers,
    mask_uncertain,
)
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton

SQUARE = Skeleton(["a", "b", "c", "d"], [-1, 0, 0, 0])
CORNERS = np.array([[0.0, 0], [1, 0], [0, 1], [1, 1]])


def square(frames=10, at=(0, 0), side=1.0, **more):
    """Return a static square with the corner of least x and y at ``at``."""
    keypoints = np.tile(CORNERS * side + at, (frames, 1, 1))
    settings = {"fps": 10.0, "name": "square"} | more
    return KeypointTrack(keypoints, np.full((frames, 4), 0.9), SQUARE, **settings)


def test_uncertain_detections_are_dropped():
    confidence = np.full((10, 4), 0.9)
    confidence[0], confidence[1, 2] = 0.3, 0.29
    (track,), report = mask_uncertain([replace(square(), confidence=confidence)], threshold=0.3)
    masked = np.zeros((10, 4), dtype=bool)
    masked[1, 2] = True
    np.testing.assert_array_equal(np.isnan(track.keypoints).all(-1), masked)
    np.testing.assert_array_equal(track.confidence, np.where(masked, 0, confidence))
    assert report.entries_changed == 1


def test_short_tracks_are_dropped_by_duration():
    tracks = [square(9), square(10), square(15, fps=15.0), square(14, fps=15.0), square(30, fps=60)]
    result, report = drop_short(tracks, seconds=1.0)
    assert result == [tracks[1], tracks[2]]
    assert (report.tracks_dropped, report.frames_dropped) == (3, 9 + 14 + 30)
    # Rounded frame rates are tolerated.
    assert drop_short([square(60, fps=1 / 0.016666)], seconds=1.0)[0]


def test_quality_is_the_fraction_of_confident_detections():
    confidence = np.full((10, 4), 0.9)
    confidence[:4] = 0.2  # 16 of 40 entries
    tracks = [replace(square(), confidence=confidence), square()]
    assert drop_low_quality(tracks, threshold=0.3, share=0.6)[0] == tracks
    result, report = drop_low_quality(tracks, threshold=0.3, share=0.61)
    assert result == tracks[1:]
    assert (report.tracks_dropped, report.frames_dropped) == (1, 10)
    assert drop_low_quality(tracks, threshold=0.2, share=1.0)[0] == tracks
    with pytest.raises(ValueError, match=r"share must be at most 1, got 1.5"):
        drop_low_quality(tracks, share=1.5)


def test_crowd_keeps_the_large_person():
    large = square(side=4, name="video 0")
    inside = square(at=(1, 1), name="video 1")  # a sixteenth of the large one
    beside = square(at=(3.75, 0), name="video 2")  # a quarter inside
    other = square(at=(1, 1), name="another 0")
    undetected = replace(square(name="video 3"), confidence=np.zeros((10, 4)))
    tracks = [large, inside, beside, other, undetected]
    assert drop_crowds(tracks, overlap=0.3)[0] == [large, beside, other, undetected]
    assert drop_crowds(tracks, overlap=1.0)[0] == tracks
    # The order does not matter.
    assert drop_crowds(tracks[::-1], overlap=0.2)[0] == [undetected, other, large]


def test_crowd_of_twins_is_dropped_and_views_are_not():
    twins = [square(name="walk 0"), square(name="walk 1")]
    assert drop_crowds(twins)[0] == []
    views = [square(name="walk/0"), square(name="walk/1")]
    assert drop_crowds(views)[0] == views
    assert drop_crowds(views, videos=["same", "same"])[0] == []
    assert drop_crowds([twins[0], square(11, name="walk 1")])[1].tracks_dropped == 0


def test_overlap_is_averaged_over_frames_with_detections():
    """The first track has detections in 4 frames, the second in 1 of them: the overlap is 1/4."""
    first, second = np.zeros((2, 10, 4))
    first[:4], second[3:] = 0.9, 0.9
    tracks = [replace(square(name=f"v {c[0, 0]}"), confidence=c) for c in (first, second)]
    assert drop_crowds(tracks, overlap=0.26)[0] == tracks
    assert drop_crowds(tracks, overlap=0.24)[0] == tracks[1:]
    with pytest.raises(ValueError, match="videos must have one name per track, 2, got 1"):
        drop_crowds(tracks, videos=["v"])
    with pytest.raises(ValueError, match=r"video 'v' must have equal lengths, got \[10, 12\]"):
        drop_crowds([tracks[0], square(12)], videos=["v", "v"])


def test_outliers_are_dropped_and_fast_joints_are_not():
    track = square(30, fps=30)
    track.keypoints[:, 1, 0] += 0.5 * np.arange(30)  # fast in one direction
    track.keypoints[12, 2] += (0, 3.0)
    track.keypoints[20:22, 3] -= (5.0, 0)
    (result,), report = mask_outliers([track], distance=0.15, window=0.25)
    assert np.argwhere(result.confidence == 0).tolist() == [[12, 2], [20, 3], [21, 3]]
    assert np.isnan(result.keypoints[12, 2]).all()
    assert report.entries_changed == 3
    assert mask_outliers([result], distance=0.15, window=0.25)[1].entries_changed == 0


def test_outliers_need_three_detections():
    confidence = np.full((10, 4), 0.9)
    confidence[:, 1] = 0
    for frames, changed in (((4, 5), 0), ((4, 5, 6), 1)):
        confidence[frames, 1] = 0.9
        track = replace(square(), confidence=confidence)
        track.keypoints[5, 1] = 50.0
        assert mask_outliers([track], distance=0.1, window=1.0)[1].entries_changed == changed


def test_empty_input_and_single_joints():
    for step in (mask_uncertain, mask_outliers, drop_short, drop_low_quality, drop_crowds):
        assert step([])[0] == []
    track = replace(square(), confidence=np.tile([0.9, 0, 0, 0], (10, 1)))
    track.keypoints[5, 0] = 50.0  # a single joint has no size
    assert mask_outliers([track])[1].entries_changed == 0
