"""Keypoints of MMPose and of RTMPose (rtmlib) in JSON: layouts, numbering, scores and defects."""

import json

import numpy as np
import pytest

from probmotion.io.errors import MotionFileError
from probmotion.io.keypoints.files import open_keypoints, read_keypoints
from probmotion.motion.presets import PRESETS
from probmotion.motion.skeleton import Skeleton

RNG = np.random.default_rng(5)
POINTS = RNG.uniform(1, 99, size=(4, 2, 17, 2)).round(2)  # frames, people
SCORES = RNG.uniform(0.1, 1, size=(4, 2, 17)).round(3)
P, S = POINTS.tolist(), SCORES.tolist()


def instance(points, scores, **more):
    return {"keypoints": points, "keypoint_scores": scores, "bbox": [[0, 0, 9, 9]]} | more


def written(folder, content, name="clip.json"):
    path = folder / name
    path.write_text(json.dumps(content))
    return path


# One person in four frames.
INSTANCES = [{"frame_id": k, "instances": [instance(P[k][0], S[k][0])]} for k in range(4)]
DEMO = [frame | {"frame_id": frame["frame_id"] + 1} for frame in INSTANCES]
META = {"keypoint_id2name": {"0": "a"}}
RTMLIB = [{"keypoints": P[k][:1], "scores": S[k][:1]} for k in range(4)]
SINGLE = [{"frame": 2 * k, "keypoints": P[k][0], "scores": S[k][0]} for k in range(4)]
TRIPLES = [
    {"people": [{"keypoints": np.c_[POINTS[k, 0], SCORES[k, 0]].tolist()}]} for k in range(4)
]


@pytest.mark.parametrize(
    ("content", "name", "fps", "frames"),
    [
        (INSTANCES, "MMPose", None, [0, 1, 2, 3]),
        ({"meta_info": {}, "instance_info": DEMO}, "MMPose", None, [0, 1, 2, 3]),
        (RTMLIB, "RTMPose (rtmlib)", None, [0, 1, 2, 3]),
        ({"fps": 25, "frames": RTMLIB}, "RTMPose (rtmlib)", 25, [0, 1, 2, 3]),
        (SINGLE, "RTMPose (rtmlib)", None, [0, 2, 4, 6]),
        (TRIPLES, "RTMPose (rtmlib)", None, [0, 1, 2, 3]),
        (
            {"keypoints": POINTS[:, :1].tolist(), "scores": SCORES[:, :1].tolist()},
            "RTMPose (rtmlib)",
            None,
            [0, 1, 2, 3],
        ),
    ],
)
def test_layouts_are_recognised(tmp_path, content, name, fps, frames):
    file = open_keypoints(written(tmp_path, content))
    assert (file.format, file.fps) == (name, fps)
    (track,) = file.tracks
    assert track.skeleton == Skeleton.preset("coco17")
    np.testing.assert_array_equal(track.keypoints[frames], POINTS[:, 0])
    np.testing.assert_array_equal(track.confidence[frames], SCORES[:, 0])
    others = np.setdiff1d(range(track.frames), frames)
    assert track.frames == frames[-1] + 1
    assert np.isnan(track.keypoints[others]).all()


def test_several_people_need_their_number(tmp_path):
    content = [{"keypoints": P[k], "scores": S[k]} for k in range(4)]
    path = written(tmp_path, content)
    with pytest.raises(MotionFileError, match="two people without track ids in frame 0; set peop"):
        read_keypoints(path, 30)
    assert len(read_keypoints(path, 30, people=2)) == 2
    content = [
        {"frame_id": k, "instances": [instance(P[k][i], S[k][i], track_id=i) for i in (0, 1)]}
        for k in range(4)
    ]
    for person, track in enumerate(read_keypoints(written(tmp_path, content), 30)):
        np.testing.assert_array_equal(track.keypoints, POINTS[:, person])


def test_images_of_the_inferencer(tmp_path):
    """The inferencer writes a file per image, with the people of the image only."""
    folder = tmp_path / "clip"
    folder.mkdir()
    for k in range(4):
        content = [instance(P[k][0], S[k][0])] if k != 2 else []
        written(folder, content, f"img{k:03}.json")
    file = open_keypoints(folder)
    assert file.format == "MMPose"
    np.testing.assert_array_equal(file.tracks[0].keypoints[[0, 1, 3]], POINTS[[0, 1, 3], 0])
    assert (file.tracks[0].confidence[2] == 0).all()
    (single,) = read_keypoints(folder / "img003.json", 30)
    np.testing.assert_array_equal(single.keypoints, POINTS[3:, 0])


def test_scores_outside_0_to_1_and_nan(tmp_path):
    points, scores = [[1, 2], [None, 3], [-1, -1]] + [[5, 6]] * 14, [7.5, 0.5, -0.2] + [0] * 14
    path = written(tmp_path, [{"frame_id": 0, "instances": [instance(points, scores)]}])
    (track,) = read_keypoints(path, 30)
    assert track.confidence[0].tolist() == [1] + [0] * 16
    assert np.isnan(track.keypoints[0, 1:]).all()


def test_names_define_the_skeleton(tmp_path):
    names = ["nose", "tail", "left_paw", "right_paw"]
    content = {
        "meta_info": {
            "keypoint_id2name": {str(k): name for k, name in enumerate(names)},
            "skeleton_links": [[1, 0], [1, 2], [1, 3]],
        },
        "instance_info": [{"frame_id": 1, "instances": [instance(P[0][0][:4], S[0][0][:4])]}],
    }
    (track,) = read_keypoints(written(tmp_path, content), 30)
    assert track.skeleton == Skeleton(names, [-1, 0, 1, 1])
    halpe = ["head" if name == "head_top" else name for name in PRESETS["halpe26"].joint_names]
    content["meta_info"] = {"keypoint_id2name": {str(k): name for k, name in enumerate(halpe)}}
    content["instance_info"][0]["instances"] = [instance([[1, 2]] * 26, [1] * 26)]
    (track,) = read_keypoints(written(tmp_path, content), 30)
    assert track.skeleton == Skeleton.preset("halpe26")


@pytest.mark.parametrize(("count", "body"), [(133, "coco17"), (136, "halpe26")])
def test_only_the_body_of_whole_body_keypoints_is_read(tmp_path, count, body):
    points = RNG.uniform(1, 99, size=(count, 2))
    path = written(tmp_path, [{"keypoints": [points.tolist()], "scores": [[1] * count]}])
    (track,) = read_keypoints(path, 30)
    assert track.skeleton == Skeleton.preset(body)
    np.testing.assert_array_equal(track.keypoints[0], points[: track.skeleton.n_joints])
    whole = Skeleton([f"k{k}" for k in range(count)], [-1] * count)
    assert read_keypoints(path, 30, whole)[0].keypoints.shape == (1, count, 2)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([{"instances": 3}], "frame 0: expected a list of people, got 3"),
        ([{"instances": []}], "expected at least one person, got none"),
        ([*INSTANCES, 7], "frame 4 must be an object, got 7"),
        ([{"instances": [{"keypoints": P[0][0]}]}], "person 0: expected keypoint_scores or scores"),
        ([{"instances": [instance(P[0][0], [1])]}], "of 1 keypoints, as many as scores, got shape"),
        ([{"instances": [instance([[1, 2, 3]] * 17, [1] * 17)]}], r"got shape \(17, 3\)"),
        (
            [{"instances": [instance([[1, "2"]], [1])]}],
            r"expected numbers between .* got \[\[1, '2",
        ),
        ([{"instances": [instance([[1, 1e99]], [1])]}], "expected numbers between -1e9 and 1e9"),
        ([{"keypoints": P[0], "scores": [1]}], "expected scores of 2 people, got "),
        ({"keypoints": P, "scores": 1}, "expected scores of 4 frames, got 1"),
        (INSTANCES[::-1], "expected increasing frame numbers, .* got frames 3 and 2"),
        (
            [INSTANCES[0] | {"frame_id": "a"}],
            "a frame number of at least 0 in every frame, got 'a'",
        ),
        ([INSTANCES[0] | {"frame_id": 10**30}], "expected a frame number of at least 0 in every"),
        ([INSTANCES[0] | {"frame_id": True}], "in every frame, got True"),
        (
            {"meta_info": {"keypoint_id2name": {"1": "a"}}, "instance_info": INSTANCES},
            "meta_info: expected names of keypoints",
        ),
        (
            {"meta_info": META, "instance_info": INSTANCES},
            "expected 1 keypoints as in skel.* got 17",
        ),
        ({"fps": "x", "frames": RTMLIB}, "fps must be a number above 0, got 'x'"),
        ([{"keypoints": [[[1, 2]] * 5], "scores": [[1] * 5]}], "skeleton must be given for 5 keyp"),
    ],
)
def test_defects_are_reported(tmp_path, content, message):
    with pytest.raises(MotionFileError, match=message):
        read_keypoints(written(tmp_path, content), 30)
