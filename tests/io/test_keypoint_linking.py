"""People without track ids are followed through a video."""

from __future__ import annotations

import json

import numpy as np
import pytest

from probmotion.io.files import read_keypoints
from probmotion.io.keypoint_linking import link_people
from probmotion.io.keypoint_tracks import Detection

RNG = np.random.default_rng(0)
BODY = RNG.random((17, 2)) * 40


def person_at(x: float, confidence: float = 0.9) -> np.ndarray:
    return np.column_stack([BODY + np.array([x, 50.0]), np.full(17, confidence)])


def shuffled(*people: np.ndarray, frame: int) -> list[Detection]:
    order = np.random.default_rng(frame).permutation(len(people))
    return [Detection("", frame, None, people[k], f"frame {frame}") for k in order]


def test_two_people_who_pass_each_other_keep_their_names():
    """Where they cross, each comes nearer to the place of the other than to their own."""
    detections = []
    for frame in range(12):
        left, right = person_at(100 + 25 * frame), person_at(412 - 25 * frame)
        detections += shuffled(left, right, frame=frame)
    linked = link_people(detections, 2)
    for found in linked:
        x = found.values[:, 0].mean() - BODY[:, 0].mean()
        expected = 100 + 25 * found.frame if found.person == "0" else 412 - 25 * found.frame
        assert x == pytest.approx(expected)
    assert len(linked) == 24


def test_the_video_begins_with_the_first_full_image_and_bystanders_are_left_out():
    detections = shuffled(person_at(300), frame=0)
    detections += shuffled(person_at(100), person_at(300), person_at(900, 0.2), frame=1)
    detections += shuffled(person_at(110), person_at(905, 0.99), person_at(290), frame=2)
    detections += shuffled(person_at(280), frame=3)
    linked = link_people(detections, 2)
    assert [(found.frame, found.person) for found in linked] == [
        (0, "1"),
        (1, "0"),
        (1, "1"),
        (2, "0"),
        (2, "1"),
        (3, "1"),
    ]


def test_a_file_without_ids_is_read_when_told_how_many(tmp_path):
    frames = [
        {"people": [{"pose_keypoints_2d": found.values.ravel().tolist()} for found in one]}
        for one in (shuffled(person_at(100 + k), person_at(300 - k), frame=k) for k in range(5))
    ]
    path = tmp_path / "video.json"
    path.write_text(json.dumps(frames))
    first, second = read_keypoints(path, 30.0, people=2)
    assert np.allclose(np.diff(first.keypoints[:, 0, 0]), 1)
    assert np.allclose(np.diff(second.keypoints[:, 0, 0]), -1)
    with pytest.raises(ValueError, match="two people without a track id"):
        read_keypoints(path, 30.0)
    with pytest.raises(ValueError, match="people must be at most the 2 of one image, got 3"):
        read_keypoints(path, 30.0, people=3)
    with pytest.raises(ValueError, match="people is 0"):
        read_keypoints(path, 30.0, people=0)
