"""Joints of tracks: retargeting, midpoints and additional joints."""

import numpy as np
import pytest

from probmotion.data.tracks.joints import nearest_object, retarget_track, with_joint, with_midpoint
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton

PERSON = Skeleton.preset("person14")


def detections(layout, frames=6):
    """Return random detections, without the left hip in frame 2."""
    skeleton = Skeleton.preset(layout)
    rng = np.random.default_rng(0)
    keypoints = rng.uniform(0, 100, size=(frames, skeleton.n_joints, 2))
    confidence = rng.uniform(0.2, 1, size=keypoints.shape[:2])
    keypoints[2, skeleton.index("left_hip")] = np.nan
    confidence[2, skeleton.index("left_hip")] = 0
    return KeypointTrack(keypoints, confidence, skeleton, 30, layout)


@pytest.mark.parametrize(
    ("layout", "derived"),
    [("body25b", {"pelvis"}), ("coco17", {"pelvis", "neck"}), ("body25", set()),
     ("halpe26", set()), ("openpose18", {"pelvis"}), ("alphapose16", set())],
)  # fmt: skip
def test_retargeting_detector_layouts(layout, derived):
    track = detections(layout)
    person = retarget_track(track, PERSON, derive=True)
    assert person.skeleton == PERSON
    for joint, name in enumerate(PERSON.joint_names):
        names = [name]
        if name in derived:
            part = {"pelvis": "hip", "neck": "shoulder"}[name]
            names = [f"left_{part}", f"right_{part}"]
        sources = [track.skeleton.index(source) for source in names]
        middle = track.keypoints[:, sources].mean(axis=1)
        lowest = track.confidence[:, sources].min(axis=1)
        np.testing.assert_allclose(person.keypoints[:, joint], middle)
        np.testing.assert_array_equal(person.confidence[:, joint], lowest)


def test_joint_names_take_precedence_over_canonical_names():
    track = detections("coco17")
    assert retarget_track(track, track.skeleton) is track
    names = track.skeleton.joint_names[::-1]
    reordered = retarget_track(track, Skeleton(names, [-1] * 17))
    np.testing.assert_array_equal(reordered.keypoints, track.keypoints[:, ::-1])
    ambiguous = Skeleton(["LKnee", "left_knee"], [-1, 0])
    pair = KeypointTrack(track.keypoints[:, :2], track.confidence[:, :2], ambiguous, 30)
    for joint, name in enumerate(ambiguous.joint_names):
        (chosen,) = retarget_track(pair, Skeleton([name], [-1])).keypoints.swapaxes(0, 1)
        np.testing.assert_array_equal(chosen, pair.keypoints[:, joint])


def test_additional_joint():
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
    racket = with_joint(track, "racket", points, confidence, parent="right_wrist")
    assert racket.skeleton.parents[17] == track.skeleton.index("right_wrist")


def test_nearest_ball_is_close_to_a_joint():
    keypoints = np.tile([[0.0, 0], [10, 0]], (5, 1, 1))
    confidence = np.ones((5, 2))
    confidence[3], confidence[4, 1] = 0, 0
    track = KeypointTrack(keypoints, confidence, Skeleton(["head", "hand"], [-1, 0]), 30)
    near = [11, -1, 13, 1, 0.4]  # centre (12, 0), 2 from the hand
    far = [2, 2, 4, 4, 0.9]  # centre (3, 3), 4.2 from the head
    boxes = [np.array(b) for b in ([far, near], [near, far], [], [near], [near, far])]
    points, weights = nearest_object(track, boxes)
    np.testing.assert_array_equal(weights, [0.4, 0.4, 0, 0, 0.9])
    np.testing.assert_array_equal(points[[0, 1, 4]], [[12, 0], [12, 0], [3, 3]])
    assert np.isnan(points[[2, 3]]).all()


ZEROS, TAIL = np.zeros((6, 2)), Skeleton(["nose", "tail"], [-1, 0])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda t: retarget_track(t, PERSON), "got 'pelvis'; use derive=True"),
        (lambda t: retarget_track(t, TAIL, derive=True), "track 'coco17' .*, got 'tail'$"),
        (lambda t: with_midpoint(t, "middle", ["nose"]), "joints must name at least two"),
        (lambda t: nearest_object(t, [[], []]), "boxes must have one entry per frame, 6, got 2"),
        (lambda t: nearest_object(t, [[], [[0, 0, 1, 1]], *[[]] * 4]), "must have shape"),
        (lambda t: nearest_object(t, [[[0, 0, 1, np.nan, 1]], *[[]] * 5]), "must be finite"),
        (lambda t: with_joint(t, "ball", ZEROS[1:], ZEROS[:, 0]), "keypoints must have shape"),
        (lambda t: with_joint(t, "nose", ZEROS, ZEROS[:, 0]), "joint_names must be unique"),
        (lambda t: with_joint(t, "ball", ZEROS, ZEROS[:, 0], parent="fin"), "fin"),
    ],
)
def test_invalid_input(call, message):
    with pytest.raises(ValueError, match=message):
        call(detections("coco17"))
