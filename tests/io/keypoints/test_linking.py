"""Tracking of people without track ids."""

import json

import numpy as np
import pytest

from probmotion.io.keypoints.files import read_keypoints
from probmotion.io.keypoints.tracks import Detection, link_people

RNG = np.random.default_rng(0)
BODY = RNG.random((17, 2)) * 40


def person_at(x, confidence=0.9):
    return np.column_stack([BODY + np.array([x, 50.0]), np.full(17, confidence)])


def shuffled(*people, frame):
    order = np.random.default_rng(frame).permutation(len(people))
    return [Detection("", frame, None, people[k], f"frame {frame}") for k in order]


def test_crossing_people_keep_their_ids():
    """At the crossing, each is closer to the other's last position than to their own."""
    detections = []
    for frame in range(12):
        left, right = person_at(100 + 25 * frame), person_at(412 - 25 * frame)
        detections += shuffled(left, right, frame=frame)
    linked = link_people(detections, 2)
    for one in linked:
        x = one.values[:, 0].mean() - BODY[:, 0].mean()
        expected = 100 + 25 * one.frame if one.person == "0" else 412 - 25 * one.frame
        assert x == pytest.approx(expected)
    assert len(linked) == 24


def test_tracking_starts_at_the_first_full_image_without_bystanders():
    detections = shuffled(person_at(300), frame=0)
    detections += shuffled(person_at(100), person_at(300), person_at(900, 0.2), frame=1)
    detections += shuffled(person_at(110), person_at(905, 0.99), person_at(290), frame=2)
    detections += shuffled(person_at(280), frame=3)
    linked = [(detection.frame, detection.person) for detection in link_people(detections, 2)]
    assert linked == [(0, "1"), (1, "0"), (1, "1"), (2, "0"), (2, "1"), (3, "1")]


def test_people_are_followed_in_files_without_ids(tmp_path):
    frames = [
        {"people": [{"pose_keypoints_2d": detection.values.ravel().tolist()} for detection in one]}
        for one in (shuffled(person_at(100 + k), person_at(300 - k), frame=k) for k in range(5))
    ]
    path = tmp_path / "video.json"
    path.write_text(json.dumps(frames))
    first, second = read_keypoints(path, 30.0, people=2)
    assert np.allclose(np.diff(first.keypoints[:, 0, 0]), 1)
    assert np.allclose(np.diff(second.keypoints[:, 0, 0]), -1)
    for people, message in (
        (None, "two people without track ids in frame 0"),
        (3, "people must be at most 2, the most in any image, got 3"),
        (0, "people must be an integer of at least 1, got 0"),
    ):
        with pytest.raises(ValueError, match=message):
            read_keypoints(path, 30.0, people=people)
