"""Tracks of detected people become annotations in metres."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from probmotion import KeypointTrack, Skeleton
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.interaction.annotations.tracks import annotations_of_tracks
from probmotion.io.files import read_keypoints
from probmotion.io.keypoint_layouts import keypoint_skeleton

PAIR = Skeleton.preset("pair17")
DANCES = synthetic_dances(3, frames=40)


def detections(layout: str, scale: float = 300.0) -> list[KeypointTrack]:
    """What a detector of ``layout`` would see of a made dance from the front, in pixels."""
    dance = DANCES[0]
    skeleton = keypoint_skeleton(layout)
    tracks = []
    for person in range(2):
        pose = {
            name: dance.positions[:, PAIR.index(f"person{person}:{name}"), :2]
            for name in Skeleton.preset("person17").joint_names
        }
        middle = {
            part: (pose[f"left_{part}"] + pose[f"right_{part}"]) / 2 for part in ("hip", "shoulder")
        }
        pose |= {"pelvis": middle["hip"], "neck": middle["shoulder"], "nose": pose["head"]}
        for side, aside in (("left", 0.08), ("right", -0.08)):
            pose[f"{side}_ear"] = pose["head"] + np.array([aside, 0.0])
        points = np.full((dance.frames, skeleton.n_joints, 2), np.nan)
        for joint, name in enumerate(skeleton.canonical_names):
            if name in pose:
                points[:, joint] = (pose[name] * [1, -1] + [1.0, 3.0]) * scale
        confidence = np.isfinite(points).all(axis=-1) * 0.9
        tracks.append(KeypointTrack(points, confidence, skeleton, 30.0, name=f"{layout} {person}"))
    return tracks


@pytest.mark.parametrize("layout", ["body25", "coco17", "body25b", "openpose18", "halpe26"])
def test_tracks_become_metres_with_y_up(layout: str) -> None:
    seed = DANCES[0].positions[0]
    seen = annotations_of_tracks(detections(layout), seed, metres_per_pixel=1 / 300)
    assert len(seen) == 40
    assert seen.skeleton == PAIR
    assert seen.visible.all()
    truth = DANCES[0].positions[..., :2] + np.array([1.0, -3.0])
    limbs = [
        joint for joint, name in enumerate(PAIR.joint_names) if "left_" in name or "right_" in name
    ]
    np.testing.assert_allclose(seen.keypoints[:, limbs], truth[:, limbs] * [1, 1], atol=1e-9)
    trunk = [joint for joint in range(34) if joint not in limbs]
    assert np.abs(seen.keypoints[:, trunk] - truth[:, trunk]).max() < 0.08
    np.testing.assert_allclose(seen.neighbours[1:, 0], seen.keypoints[:-1])
    np.testing.assert_allclose(seen.neighbours[:-1, 1], seen.keypoints[1:])
    assert np.isnan(seen.neighbours[0, 0]).all()
    assert np.isnan(seen.neighbours[-1, 1]).all()


def test_keypoint_json_of_two_people_becomes_annotations(tmp_path: Path) -> None:
    tracks = detections("coco17")
    people = [
        {
            "image_id": f"{frame}.jpg",
            "idx": person,
            "keypoints": np.nan_to_num(
                np.concatenate([track.keypoints[frame], track.confidence[frame][:, None]], axis=1)
            )
            .ravel()
            .tolist(),
        }
        for frame in range(40)
        for person, track in enumerate(tracks)
    ]
    (tmp_path / "video.json").write_text(json.dumps(people))
    seed = DANCES[0].positions[0]
    read = annotations_of_tracks(read_keypoints(tmp_path / "video.json", fps=30.0), seed)
    np.testing.assert_allclose(read.keypoints, annotations_of_tracks(tracks, seed).keypoints)


def test_trunk_joints_are_where_the_seed_has_them_on_the_line_from_hips_to_shoulders() -> None:
    seed = DANCES[0].positions[0]
    seen = annotations_of_tracks(detections("coco17"), seed, metres_per_pixel=1 / 300)
    for person in ("person0", "person1"):
        at = {
            part: [PAIR.index(f"{person}:{side}_{part}") for side in ("left", "right")]
            for part in ("hip", "shoulder")
        }
        low, high = seed[at["hip"]].mean(axis=0), seed[at["shoulder"]].mean(axis=0)
        image_low, image_high = (
            seen.keypoints[:, at[part]].mean(axis=1) for part in ("hip", "shoulder")
        )
        for name in ("pelvis", "spine", "chest", "neck"):
            joint = PAIR.index(f"{person}:{name}")
            share = (seed[joint] - low) @ (high - low) / ((high - low) @ (high - low))
            wanted = image_low + share * (image_high - image_low)
            np.testing.assert_allclose(seen.keypoints[:, joint], wanted, atol=1e-9)


def test_scale_comes_from_limbs_that_lie_in_the_image_once() -> None:
    seed = DANCES[0].positions[0]
    for scale in (300.0, 75.0):
        seen = annotations_of_tracks(detections("body25", scale), seed)
        knee, ankle = (PAIR.index(f"person0:left_{joint}") for joint in ("knee", "ankle"))
        shin = np.linalg.norm(seen.keypoints[:, knee] - seen.keypoints[:, ankle], axis=-1).max()
        assert shin == pytest.approx(np.linalg.norm(seed[knee] - seed[ankle]), rel=0.1)


def test_frames_with_one_person_missing_are_dropped_and_counted() -> None:
    first, second = detections("coco17")
    keypoints, confidence = second.keypoints.copy(), second.confidence.copy()
    confidence[10:13] = np.minimum(confidence[10:13], 0.1)  # below the threshold
    keypoints[20], confidence[20] = np.nan, 0
    confidence[30, 9] = 0.1  # one wrist
    second = replace(second, keypoints=keypoints, confidence=confidence)
    seed = DANCES[0].positions[0]
    seen = annotations_of_tracks([first, second], seed, metres_per_pixel=1 / 300)
    assert len(seen) == 36
    assert seen.dropped == {"one person missing": 4}
    assert seen.describe() == (
        "36 annotations, 1 of 1224 joints hidden, frames dropped: 4 (one person missing)"
    )
    # The frame after the gap knows the second person's past no more, and the first one's still.
    assert np.isnan(seen.neighbours[10, 0, 17:]).all()
    assert np.isfinite(seen.neighbours[10, 0, :17]).all()


def test_a_hidden_shoulder_hides_the_trunk_that_is_made_of_it() -> None:
    first, second = detections("coco17")
    confidence = first.confidence.copy()
    confidence[4, first.skeleton.index("left_shoulder")] = 0
    seen = annotations_of_tracks(
        [replace(first, confidence=confidence), second],
        DANCES[0].positions[0],
        metres_per_pixel=1 / 300,
    )
    hidden = {PAIR.joint_names[joint] for joint in np.flatnonzero(~seen.visible[4])}
    names = ("pelvis", "spine", "chest", "neck", "left_shoulder")
    assert hidden == {f"person0:{name}" for name in names}


def test_tracks_with_every_joint_are_taken_as_they_are() -> None:
    positions, person = DANCES[0].positions, Skeleton.preset("person17")
    tracks = [
        KeypointTrack(part[..., :2] * [100, -100], np.ones((40, 17)), person, 30.0)
        for part in np.split(positions, 2, axis=1)
    ]
    seen = annotations_of_tracks(tracks, positions[0], metres_per_pixel=0.01)
    np.testing.assert_allclose(seen.keypoints, positions[..., :2], atol=1e-12)


def test_wrong_tracks_are_refused_in_one_sentence() -> None:
    first, second = detections("coco17")
    seed = DANCES[0].positions[0]
    shorter = replace(second, keypoints=second.keypoints[:39], confidence=second.confidence[:39])
    dark = replace(second, confidence=0 * second.confidence)
    ball = KeypointTrack(np.zeros((40, 1, 2)), np.ones((40, 1)), Skeleton(["ball"], [-1]), 30.0)
    for tracks, message in (
        ([first], r"tracks has 1 tracks \(one person missing\), expected 2"),
        ([first, second, first], "tracks has 3 tracks, expected 2"),
        ([first, shorter], r"tracks\[1\] has 39 frames and the first 40, expected the same frames"),
        ([first, replace(second, fps=25.0)], r"tracks\[1\] has 25 frames per second and the first"),
        ([first, dark], "tracks has no frame that shows all 2 persons, expected at least one"),
        (
            [first, ball],
            "tracks has a track without left_shoulder, left_elbow, .* expected the",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            annotations_of_tracks(tracks, seed)
    with pytest.raises(ValueError, match=r"seed must have shape \(34, 3\), got \(17, 3\)"):
        annotations_of_tracks([first, second], seed[:17])
    with pytest.raises(ValueError, match="metres_per_pixel must be a finite number above, got -1"):
        annotations_of_tracks([first, second], seed, metres_per_pixel=-1)


def test_two_people_of_a_real_video(real_data: Path) -> None:
    """A person and a bystander who is seen in part, OpenPose's BODY_25B."""
    folder = real_data / "pose2sim_multiview"
    path = next(folder.glob("*cam_01_bystander.npz"))
    (bystander,) = read_keypoints(path)
    (person,) = read_keypoints(path.with_name(path.name.replace("_bystander", "")))
    seen = annotations_of_tracks([person, bystander], DANCES[0].positions[0])
    assert len(seen) + seen.dropped["one person missing"] == person.frames
    assert 0.5 < seen.visible.mean() < 1
    head, ankle = (PAIR.index(f"person0:{joint}") for joint in ("head", "left_ankle"))
    both = seen.visible[:, [head, ankle]].all(axis=1)
    height = (seen.keypoints[:, head, 1] - seen.keypoints[:, ankle, 1])[both]
    assert 1.0 < np.median(height) < 2.0  # metres, upright
