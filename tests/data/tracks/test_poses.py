"""Centring and mirroring of tracks."""

import numpy as np
import pytest

from probmotion.data.synthetic.gaits import make_gait
from probmotion.data.tracks.poses import centre_tracks, mirrored_track
from probmotion.geometry.cameras import Cameras
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton
from probmotion.motion.splits import clip_of

PERSON = Skeleton.preset("person14")


def random_track(frames=12, name="walk/left", seed=0):
    rng = np.random.default_rng(seed)
    keypoints = rng.normal(size=(frames, 14, 2)) + np.linspace(0, 50, frames)[:, None, None]
    confidence = rng.uniform(0.3, 1, size=(frames, 14))
    confidence[3, 5] = 0
    keypoints[3, 5] = np.nan
    return KeypointTrack(keypoints, confidence, PERSON, 20, name)


def without_root(track, frames):
    track.confidence[frames, 0], track.keypoints[frames, 0] = 0, np.nan
    return track


def test_centring_per_frame_is_a_translation():
    track = random_track()
    (centred,), report = centre_tracks([track])
    np.testing.assert_array_equal(centred.keypoints[:, 0], np.zeros((12, 2)))
    np.testing.assert_allclose(np.diff(centred.keypoints, axis=1), np.diff(track.keypoints, axis=1))
    np.testing.assert_array_equal(centred.confidence, track.confidence)
    assert report.entries_changed == report.tracks_dropped == 0


def test_frames_without_a_root():
    track = without_root(random_track(), slice(5, 8))
    (per_frame,), report = centre_tracks([track], per="frame")
    assert (per_frame.confidence[5:8] == 0).all()
    assert np.isnan(per_frame.keypoints[5:8]).all()
    assert (per_frame.frames, report.entries_changed) == (12, 3 * 13)
    (per_sequence,), report = centre_tracks([track], per="sequence")
    np.testing.assert_array_equal(per_sequence.confidence, track.confidence)
    np.testing.assert_allclose(np.nanmean(per_sequence.keypoints[:, 0], axis=0), 0, atol=1e-12)
    steps = np.diff(track.keypoints, axis=0)
    np.testing.assert_allclose(np.diff(per_sequence.keypoints, axis=0), steps)
    assert report.entries_changed == 0


def test_tracks_without_a_root_are_dropped():
    tracks = [without_root(random_track(), slice(0, 12)), random_track(7)]
    for per in ("frame", "sequence"):
        result, report = centre_tracks(tracks, per=per)
        assert [track.frames for track in result] == [7]
        assert (report.tracks_dropped, report.frames_dropped) == (1, 12)
        assert "; tracks without the root (pelvis): 1" in report.why
        assert report.frames_before == report.frames_after + report.frames_dropped
    with pytest.raises(ValueError, match="per must be 'frame' or 'sequence', got 'clip'"):
        centre_tracks(tracks, per="clip")
    assert centre_tracks([])[0] == []


def test_mirrored_track_is_the_image_of_the_mirrored_body():
    """For a camera along z, the mirrored track equals the projection of the mirrored body."""
    motion = make_gait("walk", frames=10)
    joints = motion.positions
    order = list(motion.skeleton.mirrored_order)
    camera = Cameras.around([0.0], 0.2)
    image, expected = (
        np.asarray(camera.project(body))[0] for body in (joints, joints[:, order] * [-1, 1, 1])
    )
    confidence = np.random.default_rng(0).uniform(0.3, 1, size=image.shape[:2])
    mirrored = mirrored_track(KeypointTrack(image, confidence, motion.skeleton, 30, "walk/left"))
    np.testing.assert_allclose(mirrored.keypoints, expected, atol=1e-12)
    np.testing.assert_array_equal(mirrored.confidence, confidence[:, order])
    assert mirrored.name == "walk/left mirrored"
    np.testing.assert_array_equal(mirrored_track(mirrored).keypoints, image)
    for name in ("walk/left", "walk", ""):
        assert mirrored_track(mirrored_track(random_track(name=name))).name == name
    assert clip_of(mirrored_track(random_track(name="walk")).name) == "walk"
