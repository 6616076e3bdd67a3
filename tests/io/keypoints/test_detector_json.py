"""Keypoint JSON: all formats and their defects."""

import json

import numpy as np
import pytest

from probmotion.io.errors import MotionFileError
from probmotion.io.keypoints.files import open_keypoints, read_keypoints
from probmotion.io.keypoints.tracks import natural
from probmotion.motion.skeleton import Skeleton

J = 17
RNG = np.random.default_rng(3)
FIRST = RNG.uniform(1, 100, size=(4, J, 3))  # four frames of one person
SECOND = RNG.uniform(1, 100, size=(4, J, 3))
for values in (FIRST, SECOND):
    values[..., 2] /= 100
    values[1, 5] = 0  # a missing joint


def flat(person):
    return person.ravel().tolist()


def written(folder, content, name="tracks.json"):
    path = folder / name
    path.write_text(json.dumps(content))
    return path


def result(frame, person, **more):
    entry = {"image_id": f"{frame}.jpg", "category_id": 1, "keypoints": flat(person), "score": 3.1}
    return entry | more


def assert_track(track, person, frames, length=None):
    """Check that the track contains ``person`` in ``frames`` and nothing elsewhere."""
    expected = np.zeros((length or track.frames, J, 3))
    expected[frames] = person[: len(frames)]
    unseen = expected[..., 2] == 0
    np.testing.assert_array_equal(track.confidence, expected[..., 2])
    assert np.isnan(track.keypoints[unseen]).all()
    np.testing.assert_array_equal(track.keypoints[~unseen], expected[..., :2][~unseen])


def test_results_form_one_track_per_track_id(tmp_path):
    content = [result(frame, FIRST[i]) for i, frame in enumerate((9, 10, 12))]
    (track,) = read_keypoints(written(tmp_path, content[::-1]), fps=25)
    assert (track.fps, track.name) == (25, "tracks")
    assert_track(track, FIRST, [0, 1, 3], length=4)
    assert track.skeleton == Skeleton.preset("coco17")
    for identity in ("idx", "track_id"):
        content = [result(i, FIRST[i], **{identity: 10}) for i in range(4)]
        content += [result(i, SECOND[i - 2], **{identity: [[9.0]]}) for i in (2, 3)]
        nine, ten = read_keypoints(written(tmp_path, content), fps=25)
        assert (nine.name, ten.name) == ("tracks 9", "tracks 10")
        assert_track(nine, SECOND, [2, 3])
        assert_track(ten, FIRST, [0, 1, 2, 3])


def test_alphapose_without_tracking(tmp_path):
    """Everybody has the id 0, and merged detections have a list of ids."""
    content = [result(i, FIRST[i], idx=[[0.0], [0.0]]) for i in range(4)]
    (track,) = read_keypoints(written(tmp_path, content), fps=25)
    assert_track(track, FIRST, [0, 1, 2, 3])
    apart = SECOND + np.array([500, 0, 0])
    content += [result(i, apart[i], idx=[0.0]) for i in range(4)]
    path = written(tmp_path, content)
    with pytest.raises(MotionFileError, match="got person '0' twice in frame 0; set people"):
        read_keypoints(path, fps=25)
    left, right = read_keypoints(path, fps=25, people=2)
    assert_track(left, FIRST, [0, 1, 2, 3])
    np.testing.assert_array_equal(right.keypoints[0], apart[0, :, :2])
    tracked = written(tmp_path, [result(0, FIRST[0], idx=k) for k in (1, [[2.0], [3.0]])])
    assert [each.name for each in read_keypoints(tracked, fps=25, people=1)] == [
        "tracks 1",
        "tracks 2",
    ]


def test_tracks_of_files_that_number_frames_have_a_first_frame(tmp_path):
    results = [result(i + 22, FIRST[i], idx=0) for i in range(4)]
    (track,) = read_keypoints(written(tmp_path, results), fps=25)
    assert track.start == 22
    instance = {"keypoints": FIRST[0, :, :2].tolist(), "keypoint_scores": FIRST[0, :, 2].tolist()}
    frames = [{"people": [{"pose_keypoints_2d": flat(FIRST[i])}]} for i in range(4)]
    (track,) = read_keypoints(written(tmp_path, frames), fps=25)
    assert track.start is None
    frames = [{"frame_id": i + 7, "instances": [instance]} for i in range(4)]
    (track,) = read_keypoints(written(tmp_path, frames), fps=25)
    assert track.start == 7


def test_the_same_id_twice_is_not_tracked_anew(tmp_path):
    content = [result(i, FIRST[i], idx=k) for i in range(4) for k in (1, 2)]
    path = written(tmp_path, [*content, result(3, SECOND[3], idx=2)])
    for people in (None, 2):
        with pytest.raises(MotionFileError, match="'2' twice in frame 3; correct or remove the"):
            read_keypoints(path, fps=25, people=people)


HIGH = FIRST[0] * [1, 1, 5]
VERSION = {"version": "AlphaPose v0.3"}


@pytest.mark.parametrize(
    "content",
    [
        [result(0, HIGH, idx=0)],
        {"0.jpg": VERSION | {"people": [{"pose_keypoints_2d": flat(HIGH)}]}},
        {"0.jpg": VERSION | {"bodies": [{"joints": flat(HIGH)}]}},
        VERSION | {"people": [{"pose_keypoints_2d": flat(HIGH)}]},
    ],
)
def test_confidences_of_alphapose_are_clipped(tmp_path, content):
    (track,) = read_keypoints(written(tmp_path, content), fps=25)
    np.testing.assert_array_equal(track.confidence[0], np.minimum(HIGH[:, 2], 1))
    assert (HIGH[:, 2] > 1).any()


def test_flags_of_other_results_are_not_clipped(tmp_path):
    flags = np.column_stack([FIRST[0, :, :2], np.arange(J) % 3])
    (track,) = read_keypoints(written(tmp_path, [result(0, flags)]), fps=25)
    np.testing.assert_array_equal(track.confidence[0], flags[:, 2])


def test_names_are_sorted_by_their_numbers():
    assert sorted(["f10", "f9", "f", "e11"], key=natural) == ["e11", "f", "f9", "f10"]


def test_results_of_several_videos_are_separated(tmp_path):
    content = [result(0, FIRST[i], image_id=f"walk_{i:03}.png") for i in range(3)]
    content += [result(0, SECOND[i], image_id=f"jump_{i:03}.png") for i in range(2)]
    jump, walk = read_keypoints(written(tmp_path, content), fps=25)
    assert (jump.name, walk.name) == ("tracks jump_", "tracks walk_")
    assert_track(jump, SECOND, [0, 1])
    assert_track(walk, FIRST, [0, 1, 2])


def test_alphapose_open_and_cmu_formats(tmp_path):
    for make in (openpose, lambda person: {"bodies": [{"joints": flat(person)}]}):
        content = {f"{i}.jpg": make(FIRST[i]) for i in range(4)}
        (track,) = read_keypoints(written(tmp_path, content), fps=25)
        assert_track(track, FIRST, [0, 1, 2, 3])


def openpose(*people, person_id=None):
    more = {} if person_id is None else {"person_id": person_id}
    return {"version": 1.3, "people": [{"pose_keypoints_2d": flat(p)} | more for p in people]}


def test_openpose_folder_list_and_single_frame(tmp_path):
    frames = [
        openpose(FIRST[0], person_id=[-1]),
        openpose(),
        {"people": [{"pose_keypoints_2d": [], "face_keypoints_2d": [1, 2, 1]}]},
        openpose(FIRST[1], person_id=[-1]),
    ]
    folder = tmp_path / "clip"
    folder.mkdir()
    for number, frame in enumerate(frames):
        written(folder, frame, f"clip_{8 + number}_keypoints.json")
    for path in (folder, written(tmp_path, frames)):
        (track,) = read_keypoints(path, fps=60)
        assert track.name == path.stem
        assert_track(track, FIRST, [0, 3], length=4)
    (single,) = read_keypoints(written(tmp_path, frames[0], "one.json"), fps=60)
    assert_track(single, FIRST, [0])


def test_openpose_files_must_be_evenly_numbered(tmp_path):
    for number in (0, 5, 10):
        written(tmp_path, openpose(FIRST[0]), f"cam01.{number:04}.json")
    (track,) = read_keypoints(tmp_path, fps=12)
    assert_track(track, FIRST[[0, 0, 0]], [0, 1, 2])
    written(tmp_path, openpose(FIRST[0]), "cam01.0020.json")
    with pytest.raises(MotionFileError, match="expected frames in steps of 5, got 10 and 20"):
        read_keypoints(tmp_path, fps=12)


def coco(**changes):
    """Annotations of two videos, with ids and file names out of order."""
    labelled = np.array(FIRST)
    labelled[..., 2] = 2
    labelled[0, 3] = (4, 5, 1)
    labelled[0, 4] = 0
    images = [
        {"id": 70, "file_name": "a/10.jpg", "video_id": 1},
        {"id": 90, "file_name": "a/9.jpg", "video_id": 1},
        {"id": 5, "file_name": "b/1.jpg", "video_id": 2},
    ]
    people = [
        {"image_id": image, "category_id": 1, "keypoints": flat(labelled[k]), "track_id": 4}
        for k, image in enumerate((90, 70, 5))
    ]
    return {"images": images, "annotations": people, "categories": []} | changes


def test_coco_annotations_and_visibilities(tmp_path):
    first, second = read_keypoints(written(tmp_path, coco()), fps=25)
    assert (first.name, second.name) == ("tracks 1 4", "tracks 2 4")
    assert (first.frames, second.frames) == (2, 1)
    assert first.confidence[0, [3, 4, 5]].tolist() == [0.5, 0, 1]
    np.testing.assert_array_equal(first.keypoints[[0, 1], [3, 0]], [[4, 5], FIRST[1, 0, :2]])
    np.testing.assert_array_equal(second.keypoints[0, 0], FIRST[2, 0, :2])
    images = [image | {"width": 640, "height": 480} for image in coco()["images"]]
    assert open_keypoints(written(tmp_path, coco(images=images))).image_size == (640, 480)
    images[0]["width"] = 480
    assert open_keypoints(written(tmp_path, coco(images=images))).image_size is None


def test_coco_categories_define_the_skeleton(tmp_path):
    animal = Skeleton.preset("apt36k17")
    # A ring of 16 keypoints and a single one: the spanning tree opens the ring opposite its root.
    names = [f"k{i}" for i in range(J)]
    ring = [[1 + i, 1 + (i + 1) % 16] for i in range(16)]
    parents = [-1, 0, 1, 2, 3, 4, 5, 6, 7, 10, 11, 12, 13, 14, 15, 0, -1]
    for entry, expected in (
        ({"keypoints": list(animal.joint_names)}, animal),
        ({"keypoints": names, "skeleton": ring}, Skeleton(names, parents)),
    ):
        content = coco(categories=[{"id": 1} | entry])
        assert read_keypoints(written(tmp_path, content), fps=25)[0].skeleton == expected


def test_skeleton_by_count_by_name_or_given(tmp_path):
    for count, name in ((18, "openpose18"), (26, "halpe26"), (16, "alphapose16"), (136, "halpe26")):
        content = [{"image_id": 0, "keypoints": [1.0] * 3 * count}]
        (track,) = read_keypoints(written(tmp_path, content), fps=1)
        assert track.skeleton == Skeleton.preset(name)
    path = written(tmp_path, [{"image_id": 0, "keypoints": [1.0] * 75}])
    with pytest.raises(
        MotionFileError, match=r"must be given for 25 keypoints \('body25' or 'body25b'"
    ):
        read_keypoints(path, fps=1)
    given = Skeleton([f"k{i}" for i in range(25)], [-1] * 25)
    assert read_keypoints(path, 1, given)[0].skeleton == given
    assert read_keypoints(path, 1, "body25")[0].skeleton == Skeleton.preset("body25")


STANDING = {  # x right and y down, of a person who faces the camera
    "nose": (0, 10), "neck": (0, 20), "head_top": (0, 0), "pelvis": (0, 55), "eye": (2, 8),
    "ear": (5, 9), "shoulder": (12, 21), "elbow": (16, 38), "wrist": (18, 53), "hip": (7, 55),
    "knee": (8, 75), "ankle": (8, 95), "big_toe": (10, 101), "small_toe": (13, 100),
    "heel": (8, 98),
}  # fmt: skip


def standing(layout, turn, noise):
    """Keypoints of a layout; ``turn`` -1 to 1 scales x, as a turn about the vertical does."""
    points = []
    for name in Skeleton.preset(layout).joint_names:
        side, _, part = name.partition("_")
        x, y = STANDING[part if side in ("left", "right") else name]
        points.append((x * turn * (-1 if side == "right" else 1), y, 1))
    return np.array(points) + noise * RNG.normal(size=(len(points), 3)) * [1, 1, 0]


@pytest.mark.parametrize("layout", ["body25", "body25b"])
@pytest.mark.parametrize("turn", [1, -1, 0.1])
def test_25_keypoints_are_recognised_by_their_bones(tmp_path, layout, turn):
    people = [standing(layout, turn, 1.5) for _ in range(5)]
    for person in people:
        person[RNG.choice(25, 5, replace=False)] = 0  # missing
    path = written(tmp_path, [openpose(person) for person in people])
    assert read_keypoints(path, 30)[0].skeleton == Skeleton.preset(layout)


def test_other_orders_of_25_keypoints_are_ambiguous(tmp_path):
    for _ in range(20):
        person = standing("body25", 1, 1.5)[RNG.permutation(25)]
        path = written(tmp_path, [openpose(person)])
        with pytest.raises(MotionFileError, match="skeleton must be given for 25 keypoints"):
            read_keypoints(path, 30)


def test_layout_of_real_keypoints(real_data, tmp_path):
    file = real_data / "originals/cam01.0050.json"
    assert read_keypoints(file, 60)[0].skeleton == Skeleton.preset("body25b")
    for path in sorted((real_data / "pose2sim_multiview").glob("*cam_0?.npz")):
        (track,) = read_keypoints(path)
        values = np.concatenate([track.keypoints, track.confidence[..., None]], axis=-1)
        frames = [openpose(np.nan_to_num(person)) for person in values]
        (again,) = read_keypoints(written(tmp_path, frames), 60)
        assert again.skeleton == Skeleton.preset("body25b")


ONE = result(0, FIRST[0])


def changed(key, value):
    content = coco()
    content["annotations"][0][key] = value
    return content


def category(**more):
    return coco(categories=[{"id": 1, "keypoints": ["a", "b"]} | more])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({}, r"expected keypoints of COCO .* got an empty object$"),
        ([ONE, ONE], "unique track ids .* got two people without track ids in frame 0"),
        ([openpose(FIRST[0], SECOND[0], person_id=[-1])], "two people without track ids"),
        ([ONE, result(0, FIRST[0], idx=1)], "track id for all .* or none, got 1 of 2 without"),
        ([result(0, FIRST[0], idx=[{}, 1])], "track_id must be int or str, got {}"),
        ([result(0, FIRST[0], idx=1)] * 2, "got person '1' twice in frame 0"),
        ([result(0, FIRST[0], idx={})], "track_id must be int or str, got {}"),
        ([ONE | {"image_id": "a.jpg"}], "a frame number of at most 18 digits, got 'a.jpg'"),
        ([ONE | {"image_id": 10**30}], "at most 18 digits"),
        ([ONE, ONE | {"image_id": 10**9}], "at most 500000 frames, got 0 to 1000000000"),
        ([ONE | {"keypoints": [1, 2]}], r"\[0\]: expected a list of x, y, conf.*, got \[1, 2\]"),
        ([ONE | {"keypoints": [[1, 2, 1]] * 17}], "a list of x, y, confidence per keypoint"),
        ([ONE | {"keypoints": [True, 2, 3]}], "expected numbers between -1e9 and 1e9, got True"),
        ([ONE | {"keypoints": [1e300, 2, 1]}], r"expected numbers between .*, got 1e\+300"),
        ([ONE | {"keypoints": [1, 2, -1]}], "expected confidence of at least 0, got -1"),
        ([ONE | {"keypoints": [1, 2, 95] * 17}], "confidence must be 0 to 2, got 95"),
        ([ONE | {"keypoints": [float("nan"), 2, 1]}], "where confidence is above 0, got NaN"),
        (
            [ONE | {"keypoints": [1, 2, 1] * 5}],
            r"for 5 keypoints, got None .--skeleton; see .*17 .coco17., 18 .openpose18., ",
        ),
        ([ONE, result(1, FIRST[0][:5])], r"the same number of keypoints, got \[5, 17\]"),
        ({"people": []}, "expected at least one person, got none"),
        (coco(images=None), "images must be a list of objects, got None"),
        (coco(images=[{"id": 1}, {"id": 1}]), "expected unique ids, got '1'"),
        (changed("image_id", 1), "image_id must be the id of an image, got '1'"),
        (changed("keypoints", [1, 2, 3]), "expected visibilities 0, 1 or 2"),
        (
            category(name="x", keypoints=["a", "a"]),
            r"category 'x': joint_names must be unique, got",
        ),
        (category(skeleton=[[1, 3]]), r"edges between keypoints 1 to 2, got \[1, 3\]"),
        (category(), "expected 2 keypoints as in skeleton, got 17"),
        ({"\u2028\0\ud800": []}, r"got the keys \\u2028\\x00\\ud800"),
    ],
)
def test_defects_are_reported(tmp_path, content, message):
    path = written(tmp_path, content)
    with pytest.raises(MotionFileError, match=message) as caught:
        read_keypoints(path, fps=25)
    assert str(path) in str(caught.value)
    assert str(caught.value).isprintable()


def test_invalid_arguments_and_files_are_refused(tmp_path):
    path = written(tmp_path, [ONE])
    (tmp_path / "empty").mkdir()
    for source, arguments, message in (
        (path, {}, "fps must be given for"),
        (path, {"fps": -1}, "fps must be a finite number above 0, got -1"),
        (path, {"fps": 1, "skeleton": "none"}, r"name must be one of .*coco17.*, got 'none'"),
        (
            path,
            {"fps": 1, "skeleton": "openpose18"},
            "expected 18 keypoints as in skeleton, got 17",
        ),
        (
            path,
            {"image_size": (4, 0)},
            r"image_size \(height\) must be a finite number above 0, got",
        ),
        (tmp_path / "empty", {"fps": 1}, r"expected \.json files of OpenPose or MMPose"),
        (tmp_path, {"fps": 1}, "expected a frame of OpenPose or MMPose, got"),
    ):
        with pytest.raises(ValueError, match=message):
            read_keypoints(source, **arguments)
    path.write_bytes(b"")
    with pytest.raises(MotionFileError, match=r"expected JSON \(the file is empty\)"):
        read_keypoints(path, fps=1)
    for content in (b"\xff\xfe\x00", b"{", b"[" * 100_000, b'{"people": [' + b"9" * 5000):
        path.write_bytes(content)
        with pytest.raises(MotionFileError, match="expected JSON"):
            read_keypoints(path, fps=1)
