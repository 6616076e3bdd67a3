"""Segmentation of tracks at jumps and gaps."""

import numpy as np
import pytest

from probmotion.data.tracks.segments import split_discontinuities, track_size
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton
from probmotion.motion.splits import clip_of

SKELETON = Skeleton(["a", "b", "c"], [-1, 0, 1])
BODY = np.array([[0.0, 0], [3, 0], [3, 4]])  # a box with a diagonal of 5


def walking(frames, speed=0.5, name="walk"):
    keypoints = BODY + speed * np.arange(frames)[:, None, None] * np.array([1.0, 0])
    return KeypointTrack(keypoints, np.ones((frames, 3)), SKELETON, 10.0, name)


def unseen(track, frames):
    track.confidence[frames], track.keypoints[frames] = 0, np.nan
    return track


def test_size_is_the_diagonal_of_the_bounding_box():
    assert track_size(walking(5)) == pytest.approx(5)
    assert track_size(unseen(walking(7), slice(0, 3))) == pytest.approx(5)
    with pytest.raises(ValueError, match="track 'walk' must have a seen joint"):
        track_size(unseen(walking(5), slice(0, 5)))


def test_tracks_are_cut_at_jumps_of_more_than_half_the_size():
    track = walking(20, speed=2.4)
    (uncut,), report = split_discontinuities([track], jump=0.5)
    assert uncut.name == "walk"
    np.testing.assert_array_equal(uncut.keypoints, track.keypoints)
    assert (report.tracks_after, report.frames_dropped) == (1, 0)
    assert len(split_discontinuities([walking(20, speed=2.6)], jump=0.5)[0]) == 20
    track.keypoints[8:] += 100.0
    segments, report = split_discontinuities([track])
    assert [segment.name for segment in segments] == ["walk/0", "walk/1"]
    assert segments[0].frames == 8
    joined = np.concatenate([segment.keypoints for segment in segments])
    np.testing.assert_array_equal(joined, track.keypoints)
    assert (report.tracks_before, report.tracks_after, report.frames_dropped) == (1, 2, 0)
    assert "track sizes: 1, " in report.why


def test_long_gap_is_cut_out():
    track = unseen(walking(30, 0.3, "walk/left"), slice(10, 16))  # six frames at 10 fps, 0.6 s
    assert len(split_discontinuities([track], unseen=0.6)[0]) == 1
    segments, report = split_discontinuities([track], unseen=0.5)
    assert [segment.name for segment in segments] == ["walk/left 0", "walk/left 1"]
    assert {clip_of(segment.name) for segment in segments} == {"walk"}
    np.testing.assert_array_equal(segments[0].keypoints, track.keypoints[:10])
    np.testing.assert_array_equal(segments[1].keypoints, track.keypoints[16:])
    assert (report.frames_dropped, report.frames_after) == (6, 24)
    assert " s: 1;" in report.why


def test_jump_across_a_short_gap_and_trimmed_ends():
    track = unseen(unseen(unseen(walking(30), slice(0, 4)), slice(27, 30)), slice(10, 12))
    (trimmed,), report = split_discontinuities([track])
    assert (trimmed.frames, report.frames_dropped) == (23, 7)
    track.keypoints[12:] -= 50.0
    segments, report = split_discontinuities([track])
    assert [segment.frames for segment in segments] == [6, 15]
    assert report.frames_before == report.frames_after + report.frames_dropped == 30


def test_single_outlier_or_appearing_joint_is_not_a_jump():
    track = walking(20)
    track.keypoints[9, 1] += 500.0
    assert len(split_discontinuities([track])[0]) == 1
    far = np.concatenate([walking(20).keypoints, np.full((20, 1, 2), 40.0)], axis=1)
    confidence = np.ones((20, 4))
    confidence[:10, 3] = 0  # its appearance moves the centre by twice the size
    skeleton = Skeleton(["a", "b", "c", "d"], [-1, 0, 1, 2])
    assert len(split_discontinuities([KeypointTrack(far, confidence, skeleton, 10.0)])[0]) == 1
    # A single joint has no size, hence no jumps.
    points = np.arange(10.0)[:, None, None] * np.ones(2)
    ball = KeypointTrack(points, np.ones((10, 1)), Skeleton(["ball"], [-1]), 10)
    assert len(split_discontinuities([ball])[0]) == 1


def test_centres_are_compared_if_no_joint_is_common():
    confidence = np.zeros((6, 3))
    confidence[:3, :2], confidence[3:, 2] = 1, 1
    base = walking(6, speed=0.0)
    for offset, segments in ((0.0, 2), (-4.0, 1)):  # centres (1.5, 0) and (3, 4 + offset)
        keypoints = base.keypoints + np.array([0, offset]) * (np.arange(6) > 2)[:, None, None]
        track = KeypointTrack(keypoints, confidence, SKELETON, 10.0)
        assert track_size(track) == pytest.approx(1.5)  # 3 in three frames, 0 in three
        assert len(split_discontinuities([track], jump=1.1)[0]) == segments


def test_unseen_track_is_dropped():
    segments, report = split_discontinuities([unseen(walking(5), slice(0, 5)), walking(5)])
    assert len(segments) == 1
    assert (report.tracks_dropped, report.frames_dropped) == (1, 5)
    assert "tracks never seen: 1" in report.why
    assert split_discontinuities([])[0] == []
