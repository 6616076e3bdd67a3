"""Tracks cut at jumps and gaps: nothing is lost but the gap."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion.data.tracks.segments import split_discontinuities, track_size
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton
from probmotion.motion.splits import clip_of

SKELETON = Skeleton(["a", "b", "c"], [-1, 0, 1])
BODY = np.array([[0.0, 0], [3, 0], [3, 4]])  # a box with a diagonal of 5


def walking(frames: int, speed: float = 0.5, name: str = "walk") -> KeypointTrack:
    keypoints = BODY + speed * np.arange(frames)[:, None, None] * np.array([1.0, 0])
    return KeypointTrack(keypoints, np.ones((frames, 3)), SKELETON, 10.0, name)


def unseen(track: KeypointTrack, frames: slice) -> KeypointTrack:
    confidence = track.confidence.copy()
    confidence[frames] = 0
    keypoints = np.where(confidence[..., None] > 0, track.keypoints, np.nan)
    return KeypointTrack(keypoints, confidence, track.skeleton, track.fps, track.name)


def test_the_size_is_the_diagonal_of_the_seen_box() -> None:
    assert track_size(walking(5)) == pytest.approx(5)
    assert track_size(unseen(walking(7), slice(0, 3))) == pytest.approx(5)
    with pytest.raises(ValueError, match="track 'walk' has no seen joint, expected at least one"):
        track_size(unseen(walking(5), slice(0, 5)))


def test_a_track_that_moves_steadily_stays_whole() -> None:
    track = walking(20, speed=2.4)  # just below half of its size per frame
    (whole,), report = split_discontinuities([track], jump=0.5)
    assert whole.name == "walk"
    np.testing.assert_array_equal(whole.keypoints, track.keypoints)
    assert (report.tracks_after, report.frames_dropped) == (1, 0)
    assert len(split_discontinuities([walking(20, speed=2.6)], jump=0.5)[0]) == 20


def test_a_jump_cuts_and_loses_nothing() -> None:
    track = walking(20)
    track.keypoints[8:] += 100.0
    pieces, report = split_discontinuities([track])
    assert [piece.frames for piece in pieces] == [8, 12]
    assert [piece.name for piece in pieces] == ["walk/0", "walk/1"]
    np.testing.assert_array_equal(
        np.concatenate([piece.keypoints for piece in pieces]), track.keypoints
    )
    assert (report.tracks_before, report.tracks_after, report.frames_dropped) == (1, 2, 0)
    assert "cut at 1 jumps" in report.why


def test_a_long_gap_cuts_and_loses_the_gap_alone() -> None:
    track = unseen(walking(30, 0.3, "walk/left"), slice(10, 16))  # six frames of 10 a second
    (whole,), report = split_discontinuities([track], unseen=0.6)
    assert (whole.frames, report.frames_dropped) == (30, 0)
    pieces, report = split_discontinuities([track], unseen=0.5)
    assert [piece.name for piece in pieces] == ["walk/left 0", "walk/left 1"]
    assert {clip_of(piece.name) for piece in pieces} == {"walk"}
    np.testing.assert_array_equal(pieces[0].keypoints, track.keypoints[:10])
    np.testing.assert_array_equal(pieces[1].keypoints, track.keypoints[16:])
    assert (report.frames_dropped, report.frames_after) == (6, 24)
    assert "at 1 gaps" in report.why


def test_a_jump_across_a_short_gap_is_one_and_the_ends_are_trimmed() -> None:
    track = unseen(unseen(unseen(walking(30), slice(0, 4)), slice(27, 30)), slice(10, 12))
    (whole,), report = split_discontinuities([track])
    assert (whole.frames, report.frames_dropped) == (23, 7)
    track.keypoints[12:] -= 50.0
    pieces, report = split_discontinuities([track])
    assert [piece.frames for piece in pieces] == [6, 15]
    assert report.frames_before == report.frames_after + report.frames_dropped == 30


def test_one_wild_joint_is_no_jump_nor_is_one_that_appears() -> None:
    track = walking(20)
    track.keypoints[9, 1] += 500.0
    assert len(split_discontinuities([track])[0]) == 1
    far = np.concatenate([walking(20).keypoints, np.full((20, 1, 2), 40.0)], axis=1)
    confidence = np.ones((20, 4))
    confidence[:10, 3] = 0  # its appearance moves the centre by two sizes
    skeleton = Skeleton(["a", "b", "c", "d"], [-1, 0, 1, 2])
    (whole,), _ = split_discontinuities([KeypointTrack(far, confidence, skeleton, 10.0)])
    assert whole.frames == 20


def test_without_a_common_joint_centres_are_compared() -> None:
    confidence = np.zeros((6, 3))
    confidence[:3, :2], confidence[3:, 2] = 1, 1
    base = walking(6, speed=0.0)
    for offset, pieces in ((0.0, 2), (-4.0, 1)):  # centres (1.5, 0) and (3, 4 + offset)
        keypoints = base.keypoints + np.array([0, offset]) * (np.arange(6) > 2)[:, None, None]
        track = KeypointTrack(keypoints, confidence, SKELETON, 10.0)
        assert track_size(track) == pytest.approx(1.5)  # three frames of 3, three of a point
        assert len(split_discontinuities([track], jump=1.1)[0]) == pieces


def test_a_track_that_was_never_seen_is_dropped_and_reported() -> None:
    kept, report = split_discontinuities([unseen(walking(5), slice(0, 5)), walking(5)])
    assert len(kept) == 1
    assert (report.tracks_dropped, report.frames_dropped) == (1, 5)
    assert "1 tracks were never seen" in report.why
    assert split_discontinuities([])[0] == []


def test_a_single_joint_has_no_size_and_no_jumps() -> None:
    ball = KeypointTrack(
        np.arange(10.0)[:, None, None] * np.ones(2), np.ones((10, 1)), Skeleton(["ball"], [-1]), 10
    )
    assert len(split_discontinuities([ball])[0]) == 1
