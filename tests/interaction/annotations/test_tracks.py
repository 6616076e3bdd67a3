"""2D annotations from keypoint tracks of detectors."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from probmotion import KeypointTrack, Skeleton
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.interaction.annotations.tracks import (
    annotations_of_tracks,
    keypoints_of_tracks,
    running_median,
)
from probmotion.io.keypoints.files import read_keypoints

PAIR = Skeleton.preset("pair17")
TRUNK = ("spine", "left_hip", "right_hip", "left_shoulder", "right_shoulder")
DANCE = synthetic_dances(1, frames=40)[0]
SEED = DANCE.positions[0]


def detections(layout, scale=300.0):
    """Return exact detections of a synthetic dance from the front, in pixels."""
    skeleton = Skeleton.preset(layout)
    tracks = []
    for person, joints in enumerate(np.split(DANCE.positions[..., :2], 2, axis=1)):
        names = Skeleton.preset("person17").joint_names
        pose = dict(zip(names, np.moveaxis(joints, 1, 0), strict=True))
        pose["pelvis"] = (pose["left_hip"] + pose["right_hip"]) / 2
        pose["neck"] = (pose["left_shoulder"] + pose["right_shoulder"]) / 2
        pose["nose"] = pose["head"]
        pose |= {f"{side}_ear": pose["head"] + [x, 0] for side, x in (("left", 1), ("right", -1))}
        points = np.full((DANCE.frames, skeleton.n_joints, 2), np.nan)
        for joint, name in enumerate(skeleton.canonical_names):
            if name in pose:
                points[:, joint] = (pose[name] * [1, -1] + [1.0, 3.0]) * scale
        confidence = np.isfinite(points).all(axis=-1) * 0.9
        tracks.append(KeypointTrack(points, confidence, skeleton, 30.0, name=f"{layout} {person}"))
    return tracks


def annotations(tracks, **options):
    return annotations_of_tracks(tracks, SEED, **{"metres_per_pixel": 1 / 300} | options)


@pytest.mark.parametrize("layout", ["body25", "coco17", "body25b", "openpose18", "halpe26"])
def test_keypoints_are_converted_to_metres_with_y_up(layout):
    result = annotations(detections(layout))
    assert len(result) == 40
    assert result.skeleton == PAIR
    assert result.visible.all()
    truth = DANCE.positions[..., :2] + np.array([1.0, -3.0])
    limbs = [k for k, name in enumerate(PAIR.joint_names) if "left_" in name or "right_" in name]
    np.testing.assert_allclose(result.keypoints[:, limbs], truth[:, limbs], atol=1e-9)
    trunk = [joint for joint in range(34) if joint not in limbs]
    assert np.abs(result.keypoints[:, trunk] - truth[:, trunk]).max() < 0.08
    for person in range(2):
        # The spine divides the line from hips to shoulders as in the seed.
        spine, *limbs = (PAIR.index(f"person{person}:{name}") for name in TRUNK)
        (low, high), (seed_low, seed_high) = (
            (pose[..., limbs[:2], :].mean(axis=-2), pose[..., limbs[2:], :].mean(axis=-2))
            for pose in (result.keypoints, SEED)
        )
        line = seed_high - seed_low
        fraction = (SEED[spine] - seed_low) @ line / (line @ line)
        np.testing.assert_allclose(result.keypoints[:, spine], low + fraction * (high - low))
    np.testing.assert_allclose(result.neighbours[1:, 0], result.keypoints[:-1])
    np.testing.assert_allclose(result.neighbours[:-1, 1], result.keypoints[1:])
    assert np.isnan(result.neighbours[0, 0]).all()
    assert np.isnan(result.neighbours[-1, 1]).all()


def test_annotations_from_keypoint_json_of_two_people(tmp_path):
    tracks = detections("coco17")
    people = []
    for frame in range(40):
        for person, track in enumerate(tracks):
            rows = np.column_stack([track.keypoints[frame], track.confidence[frame]])
            keypoints = np.nan_to_num(rows).ravel().tolist()
            people.append({"image_id": f"{frame}.jpg", "idx": person, "keypoints": keypoints})
    (tmp_path / "video.json").write_text(json.dumps(people))
    read = annotations_of_tracks(read_keypoints(tmp_path / "video.json", fps=30.0), SEED)
    np.testing.assert_allclose(read.keypoints, annotations_of_tracks(tracks, SEED).keypoints)


@pytest.mark.parametrize("scale", [300.0, 75.0])
def test_scale_is_estimated_from_limb_lengths(scale):
    result = annotations_of_tracks(detections("body25", scale), SEED)
    knee, ankle = (PAIR.index(f"person0:left_{joint}") for joint in ("knee", "ankle"))
    shin = np.linalg.norm(result.keypoints[:, knee] - result.keypoints[:, ankle], axis=-1).max()
    assert shin == pytest.approx(np.linalg.norm(SEED[knee] - SEED[ankle]), rel=0.1)


def test_noise_and_outliers_hardly_change_the_scale():
    rng = np.random.default_rng(0)
    noisy = []
    for track in detections("coco17"):
        points = track.keypoints + 6.0 * rng.standard_normal(track.keypoints.shape)  # 2 cm
        wrong = rng.random(points.shape[:2]) < 0.05
        points[wrong] += 60.0 * rng.standard_normal((int(wrong.sum()), 2))
        noisy.append(replace(track, keypoints=points))
    exact, found = (keypoints_of_tracks(each, SEED) for each in (detections("coco17"), noisy))
    joint = PAIR.index("person0:left_ankle")
    ratio = np.nanmedian(found[:, joint, 1]) / np.nanmedian(exact[:, joint, 1])
    assert ratio == pytest.approx(1.0, abs=0.05)


def test_running_medians_ignore_gaps_and_single_outliers():
    values = np.array([0.0, 1.0, 90.0, np.nan, 4.0, 5.0, np.nan, np.nan, np.nan])
    expected = [0.0, 1.0, 1.0, 4.0, 4.0, 4.0, 5.0, np.nan, np.nan]
    np.testing.assert_array_equal(running_median(values, 1), expected)


def test_frames_with_a_missing_person_are_dropped():
    first, second = detections("coco17")
    keypoints, confidence = second.keypoints.copy(), second.confidence.copy()
    confidence[10:13] = np.minimum(confidence[10:13], 0.1)  # below the threshold
    keypoints[20], confidence[20] = np.nan, 0
    confidence[30, 9] = 0.1  # a wrist
    result = annotations([first, replace(second, keypoints=keypoints, confidence=confidence)])
    assert len(result) == 36
    assert result.dropped == {"one person missing": 4}
    assert result.describe() == (
        "36 annotations, 1 of 1224 joints occluded, frames dropped: 4 (one person missing)"
    )
    # In the frame after the gap, only the second person has no previous position.
    assert np.isnan(result.neighbours[10, 0, 17:]).all()
    assert np.isfinite(result.neighbours[10, 0, :17]).all()


def test_occluded_shoulder_occludes_the_interpolated_trunk():
    first, second = detections("coco17")
    confidence = first.confidence.copy()
    confidence[4, first.skeleton.index("left_shoulder")] = 0
    result = annotations([replace(first, confidence=confidence), second])
    occluded = {PAIR.joint_names[joint] for joint in np.flatnonzero(~result.visible[4])}
    trunk = ("pelvis", "spine", "chest", "neck", "left_shoulder")
    assert occluded == {f"person0:{name}" for name in trunk}


def test_tracks_with_every_joint_are_used_directly():
    person = Skeleton.preset("person17")
    tracks = [
        KeypointTrack(part[..., :2] * [100, -100], np.ones((40, 17)), person, 30.0)
        for part in np.split(DANCE.positions, 2, axis=1)
    ]
    result = annotations(tracks, metres_per_pixel=0.01)
    np.testing.assert_allclose(result.keypoints, DANCE.positions[..., :2], atol=1e-12)


FIRST, SECOND = detections("coco17")
SHORT = replace(SECOND, keypoints=SECOND.keypoints[:39], confidence=SECOND.confidence[:39])
LIMBS = ("elbow", "wrist", "knee", "ankle")
SEEN = [not name.endswith(LIMBS) for name in SECOND.skeleton.canonical_names]
LIMBLESS = [replace(track, confidence=track.confidence * SEEN) for track in (FIRST, SECOND)]
BALL = KeypointTrack(np.zeros((40, 1, 2)), np.ones((40, 1)), Skeleton(["ball"], [-1]), 30.0)


@pytest.mark.parametrize(
    ("second", "options", "message"),
    [
        ([], {}, "tracks must contain 2 tracks, one per person, got 1"),
        ([SHORT], {}, r"tracks\[1\] must have 40 frames at 30 .*, got 39 at 30"),
        ([replace(SECOND, fps=25.0)], {}, r"tracks\[1\] must have 40 .*, got 40 at 25"),
        (
            [replace(SECOND, confidence=0 * SECOND.confidence)],
            {},
            r"all 2 people are visible with a confidence of at least 0\.3, got none",
        ),
        ([BALL], {}, "all limb keypoints, got a track without left_shoulder, left_elbow"),
        ([SECOND], {"metres_per_pixel": -1}, "metres_per_pixel must be a finite number above 0"),
    ],
)
def test_invalid_tracks_are_rejected(second, options, message):
    with pytest.raises(ValueError, match=message):
        annotations_of_tracks([FIRST, *second], SEED, **options)


def test_tracks_without_limbs_have_no_scale():
    with pytest.raises(ValueError, match=r"ends of a forearm, .* takes metres_per_pixel instead"):
        annotations_of_tracks(LIMBLESS, SEED)
    assert len(annotations(LIMBLESS)) == 40
