"""Joints chosen by name, derived and added."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion.data.tracks.joints import nearest_object, retarget_track, with_joint, with_midpoint
from probmotion.io.keypoint_layouts import keypoint_skeleton
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton

PERSON = Skeleton.preset("person14")


def detections(layout: str, frames: int = 6) -> KeypointTrack:
    skeleton = keypoint_skeleton(layout)
    rng = np.random.default_rng(0)
    keypoints = rng.uniform(0, 100, size=(frames, skeleton.n_joints, 2))
    confidence = rng.uniform(0.2, 1, size=keypoints.shape[:2])
    return KeypointTrack(keypoints, confidence, skeleton, 30, layout)


def hidden(track: KeypointTrack, frame: int, joint: str) -> KeypointTrack:
    keypoints, confidence = track.keypoints.copy(), track.confidence.copy()
    place = track.skeleton.index(joint)
    keypoints[frame, place], confidence[frame, place] = np.nan, 0
    return KeypointTrack(keypoints, confidence, track.skeleton, track.fps, track.name)


@pytest.mark.parametrize(
    ("layout", "derived"),
    [("body25b", {"pelvis"}), ("coco17", {"pelvis", "neck"}), ("body25", set()),
     ("halpe26", set()), ("openpose18", {"pelvis"}), ("alphapose16", set())],
)  # fmt: skip
def test_detectors_come_onto_person14(layout: str, derived: set[str]) -> None:
    track = hidden(detections(layout), 2, "left_hip")
    person = retarget_track(track, PERSON, derive=True)
    assert person.skeleton == PERSON
    for name in PERSON.joint_names:
        place = PERSON.index(name)
        if name not in derived:
            source = track.skeleton.index(name)
            np.testing.assert_array_equal(person.keypoints[:, place], track.keypoints[:, source])
            np.testing.assert_array_equal(person.confidence[:, place], track.confidence[:, source])
            continue
        word = {"pelvis": "hip", "neck": "shoulder"}[name]
        left, right = (track.skeleton.index(f"{side}_{word}") for side in ("left", "right"))
        np.testing.assert_allclose(
            person.keypoints[:, place], (track.keypoints[:, left] + track.keypoints[:, right]) / 2
        )
        np.testing.assert_array_equal(
            person.confidence[:, place],
            np.minimum(track.confidence[:, left], track.confidence[:, right]),
        )
    if "pelvis" in derived:
        assert person.confidence[2, 0] == 0
        assert np.isnan(person.keypoints[2, 0]).all()


def test_nothing_is_derived_unasked_and_only_trunk_ends_at_all() -> None:
    with pytest.raises(
        ValueError, match=r"joint 'pelvis', which track 'coco17' lacks, .*derive=Tr"
    ):
        retarget_track(detections("coco17"), PERSON)
    tail = Skeleton(["nose", "tail"], [-1, 0])
    with pytest.raises(ValueError, match="the joint 'tail', which track 'coco17' lacks") as caught:
        retarget_track(detections("coco17"), tail, derive=True)
    assert "derive" not in str(caught.value)


def test_order_and_own_names_come_first() -> None:
    track = detections("coco17")
    assert retarget_track(track, track.skeleton) is track
    names = track.skeleton.joint_names[::-1]
    turned = retarget_track(track, Skeleton(names, [-1] * 17))
    np.testing.assert_array_equal(turned.keypoints, track.keypoints[:, ::-1])
    odd = Skeleton(["LKnee", "left_knee"], [-1, 0])  # own names win over canonical ones
    pair = KeypointTrack(track.keypoints[:, :2], track.confidence[:, :2], odd, 30)
    for place, name in enumerate(odd.joint_names):
        (chosen,) = retarget_track(pair, Skeleton([name], [-1])).keypoints.swapaxes(0, 1)
        np.testing.assert_array_equal(chosen, pair.keypoints[:, place])


def test_a_ball_is_a_tree_of_its_own() -> None:
    track = detections("coco17")
    points = np.arange(12.0).reshape(6, 2)
    confidence = np.array([0.5, 0, 1, 1, 0.01, 1])
    with_ball = with_joint(track, "ball", points, confidence)
    assert with_ball.skeleton == Skeleton.preset("gymnast-ball")
    assert with_ball.skeleton.roots == (0, 17)
    np.testing.assert_array_equal(with_ball.confidence[:, 17], confidence)
    assert np.isnan(with_ball.keypoints[1, 17]).all()
    np.testing.assert_array_equal(with_ball.keypoints[2:, 17], points[2:])
    np.testing.assert_array_equal(with_ball.keypoints[:, :17], track.keypoints)
    held = with_joint(track, "racket", points, confidence, parent="right_wrist")
    assert held.skeleton.parents[17] == track.skeleton.index("right_wrist")


def test_midpoints_are_amid_and_as_sure_as_the_least() -> None:
    track = hidden(detections("coco17"), 3, "left_hip")
    made = with_midpoint(track, "middle", ["nose", "left_hip", "right_hip"], parent="nose")
    places = [track.skeleton.index(name) for name in ("nose", "left_hip", "right_hip")]
    np.testing.assert_allclose(made.keypoints[0, 17], track.keypoints[0, places].mean(axis=0))
    np.testing.assert_array_equal(made.confidence[:, 17], track.confidence[:, places].min(axis=1))
    assert np.isnan(made.keypoints[3, 17]).all()
    for joints in ("nose", ["nose"]):
        with pytest.raises(ValueError, match="expected the names of at least two joints"):
            with_midpoint(track, "middle", joints)


def test_the_nearest_ball_is_the_one_at_a_hand() -> None:
    skeleton = Skeleton(["head", "hand"], [-1, 0])
    keypoints = np.tile([[0.0, 0], [10, 0]], (5, 1, 1))
    confidence = np.ones((5, 2))
    confidence[3], confidence[4, 1] = 0, 0
    track = KeypointTrack(keypoints, confidence, skeleton, 30)
    near = [11, -1, 13, 1, 0.4]  # centre (12, 0): 2 from the hand
    far = [2, 2, 4, 4, 0.9]  # centre (3, 3): nearer to the body's middle, 4.2 from the head
    boxes = [
        np.array([far, near]),
        np.array([near, far]),
        [],
        np.array([near]),
        np.array([near, far]),
    ]
    points, weights = nearest_object(track, boxes)
    np.testing.assert_array_equal(weights, [0.4, 0.4, 0, 0, 0.9])
    np.testing.assert_array_equal(points[[0, 1, 4]], [[12, 0], [12, 0], [3, 3]])
    assert np.isnan(points[[2, 3]]).all()
    assert with_joint(track, "ball", points, weights).skeleton.n_joints == 3


def test_bad_input_is_one_sentence() -> None:
    track = detections("coco17")
    with pytest.raises(ValueError, match="boxes has 2 entries, expected 6, one per frame"):
        nearest_object(track, [[], []])
    with pytest.raises(ValueError, match=r"boxes\[1\] has shape \(1, 4\), expected \(n, 5\)"):
        nearest_object(track, [[], [[0, 0, 1, 1]], [], [], [], []])
    with pytest.raises(ValueError, match=r"boxes\[0\] holds NaN or infinite values"):
        nearest_object(track, [[[0, 0, 1, np.nan, 1]], [], [], [], [], []])
    with pytest.raises(ValueError, match=r"keypoints must have shape \(6, 2\), got \(5, 2\)"):
        with_joint(track, "ball", np.zeros((5, 2)), np.zeros(6))
    with pytest.raises(ValueError, match=r"joint_names repeats \['nose'\]"):
        with_joint(track, "nose", np.zeros((6, 2)), np.zeros(6))
    with pytest.raises(ValueError, match="joint_name is 'fin', which names no joint"):
        with_joint(track, "ball", np.zeros((6, 2)), np.zeros(6), parent="fin")
