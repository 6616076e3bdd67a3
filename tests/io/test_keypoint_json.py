"""Keypoint JSON: the same tracks from every flavour, and every defect in one sentence."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from probmotion.io.errors import MotionFileError
from probmotion.io.files import read_keypoints
from probmotion.io.keypoint_layouts import LAYOUTS, keypoint_skeleton
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton

DATA = Path(__file__).parents[3] / "shared" / "data"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="no ../shared/data beside the checkout")

J = 17
RNG = np.random.default_rng(3)
FIRST = RNG.uniform(1, 100, size=(4, J, 3))  # four frames of one person
SECOND = RNG.uniform(1, 100, size=(4, J, 3))
for values in (FIRST, SECOND):
    values[..., 2] /= 100
    values[1, 5] = 0  # a joint that was not seen


def flat(person: np.ndarray) -> list[float]:
    return person.ravel().tolist()


def written(folder: Path, content: Any, name: str = "tracks.json") -> Path:
    path = folder / name
    path.write_text(json.dumps(content))
    return path


def result(frame: int, person: np.ndarray, **more: Any) -> dict[str, Any]:
    entry = {"image_id": f"{frame}.jpg", "category_id": 1, "keypoints": flat(person), "score": 3.1}
    return entry | more


def assert_holds(track: KeypointTrack, person: np.ndarray, frames: list[int]) -> None:
    """The track holds ``person`` in ``frames``, and nothing elsewhere."""
    expected = np.zeros((track.frames, J, 3))
    expected[frames] = person[: len(frames)]
    unseen = expected[..., 2] == 0
    np.testing.assert_array_equal(track.confidence, expected[..., 2])
    assert np.isnan(track.keypoints[unseen]).all()
    np.testing.assert_array_equal(track.keypoints[~unseen], expected[..., :2][~unseen])


# --- flavours ----------------------------------------------------------------------------------


def test_results_without_track_ids_are_one_track(tmp_path: Path) -> None:
    content = [result(frame, FIRST[i]) for i, frame in enumerate((9, 10, 12))]
    (track,) = read_keypoints(written(tmp_path, content[::-1]), fps=25)
    assert (track.frames, track.fps, track.name) == (4, 25, "tracks")
    assert_holds(track, FIRST, [0, 1, 3])
    assert track.skeleton == Skeleton.preset("coco17")


def test_results_with_track_ids_are_a_track_each_over_the_same_frames(tmp_path: Path) -> None:
    for identity in ("idx", "track_id"):
        content = [result(i, FIRST[i], **{identity: 10}) for i in range(4)]
        content += [result(i, SECOND[i - 2], **{identity: [[9.0]]}) for i in (2, 3)]
        nine, ten = read_keypoints(written(tmp_path, content), fps=25)
        assert (nine.name, ten.name) == ("tracks 9", "tracks 10")
        assert_holds(nine, SECOND, [2, 3])
        assert_holds(ten, FIRST, [0, 1, 2, 3])


def test_results_of_several_videos_are_kept_apart(tmp_path: Path) -> None:
    content = [result(0, FIRST[i], image_id=f"walk_{i:03}.png") for i in range(3)]
    content += [result(0, SECOND[i], image_id=f"jump_{i:03}.png") for i in range(2)]
    jump, walk = read_keypoints(written(tmp_path, content), fps=25)
    assert (jump.name, walk.name) == ("tracks jump_", "tracks walk_")
    assert_holds(jump, SECOND, [0, 1])
    assert_holds(walk, FIRST, [0, 1, 2])


def test_alphapose_open_and_cmu_forms(tmp_path: Path) -> None:
    open_form = {
        f"{i}.jpg": {"version": "x", "people": [{"pose_keypoints_2d": flat(FIRST[i])}]}
        for i in range(4)
    }
    cmu_form = {f"{i}.jpg": {"bodies": [{"joints": flat(FIRST[i])}]} for i in range(4)}
    for content in (open_form, cmu_form):
        (track,) = read_keypoints(written(tmp_path, content), fps=25)
        assert_holds(track, FIRST, [0, 1, 2, 3])


def openpose(*people: np.ndarray, person_id: list[int] | None = None) -> dict[str, Any]:
    more = {} if person_id is None else {"person_id": person_id}
    return {"version": 1.3, "people": [{"pose_keypoints_2d": flat(p)} | more for p in people]}


def test_openpose_folder_list_and_single_frame(tmp_path: Path) -> None:
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
    listed = written(tmp_path, frames)
    for path in (folder, listed):
        (track,) = read_keypoints(path, fps=60)
        assert (track.frames, track.name) == (4, path.stem)
        assert_holds(track, FIRST, [0, 3])
    (single,) = read_keypoints(written(tmp_path, frames[0], "one.json"), fps=60)
    assert_holds(single, FIRST, [0])


def test_openpose_people_without_an_identity_are_not_told_apart(tmp_path: Path) -> None:
    strangers = [openpose(FIRST[0], SECOND[0], person_id=[-1])]
    with pytest.raises(MotionFileError, match="two people without a track id"):
        read_keypoints(written(tmp_path, strangers), fps=60)


def test_openpose_frames_are_numbered_evenly(tmp_path: Path) -> None:
    for number in (0, 5, 10):
        written(tmp_path, openpose(FIRST[0]), f"cam01.{number:04}.json")
    (track,) = read_keypoints(tmp_path, fps=12)
    assert_holds(track, FIRST[[0, 0, 0]], [0, 1, 2])
    written(tmp_path, openpose(FIRST[0]), "cam01.0020.json")
    with pytest.raises(MotionFileError, match=r"frame 20 follows frame 10, expected .* steps of 5"):
        read_keypoints(tmp_path, fps=12)


def coco(**changes: Any) -> dict[str, Any]:
    """Annotations of two videos of two images each; ids and file names are out of order."""
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
        {"image_id": 90, "category_id": 1, "keypoints": flat(labelled[0]), "track_id": 4},
        {"image_id": 70, "category_id": 1, "keypoints": flat(labelled[1]), "track_id": 4},
        {"image_id": 5, "category_id": 1, "keypoints": flat(labelled[2]), "track_id": 4},
    ]
    return {"images": images, "annotations": people, "categories": []} | changes


def test_coco_annotations_follow_the_images_and_halve_the_visibility(tmp_path: Path) -> None:
    first, second = read_keypoints(written(tmp_path, coco()), fps=25)
    assert (first.name, second.name) == ("tracks 1 4", "tracks 2 4")
    assert (first.frames, second.frames) == (2, 1)
    assert first.confidence[0, [3, 4, 5]].tolist() == [0.5, 0, 1]
    np.testing.assert_array_equal(first.keypoints[0, 3], [4, 5])
    np.testing.assert_array_equal(first.keypoints[1, 0], FIRST[1, 0, :2])
    np.testing.assert_array_equal(second.keypoints[0, 0], FIRST[2, 0, :2])


def test_coco_categories_name_the_keypoints(tmp_path: Path) -> None:
    animal = Skeleton.preset("apt36k17")
    known = [{"id": 1, "name": "dog", "keypoints": list(animal.joint_names)}]
    (first, _) = read_keypoints(written(tmp_path, coco(categories=known)), fps=25)
    assert first.skeleton == animal
    # A ring of 16 keypoints and one apart: the tree found first cuts the ring opposite its root.
    names = [f"k{i}" for i in range(J)]
    ring = [[1 + i, 1 + (i + 1) % 16] for i in range(16)]
    other = [{"id": 1, "name": "ring", "keypoints": names, "skeleton": ring}]
    (first, _) = read_keypoints(written(tmp_path, coco(categories=other)), fps=25)
    parents = [-1, 0, 1, 2, 3, 4, 5, 6, 7, 10, 11, 12, 13, 14, 15, 0, -1]
    assert first.skeleton == Skeleton(names, parents)


def test_layouts_are_skeletons_of_the_detectors_sizes() -> None:
    sizes = {name: keypoint_skeleton(name).n_joints for name in LAYOUTS}
    assert sizes == {"openpose18": 18, "body25": 25, "halpe26": 26}
    for name in LAYOUTS:
        skeleton = keypoint_skeleton(name)
        assert len(skeleton.roots) == 1
        assert skeleton.canonical_names == skeleton.joint_names
        for left, right in skeleton.mirrored_pairs:
            above = (skeleton.parents[left], skeleton.parents[right])
            assert above[0] == above[1] or above in skeleton.mirrored_pairs


def test_the_skeleton_by_count_by_name_or_given(tmp_path: Path) -> None:
    for count, name in ((18, "openpose18"), (26, "halpe26"), (16, "alphapose16")):
        content = [{"image_id": 0, "keypoints": [1.0] * 3 * count}]
        (track,) = read_keypoints(written(tmp_path, content), fps=1)
        assert track.skeleton == keypoint_skeleton(name)
    path = written(tmp_path, [{"image_id": 0, "keypoints": [1.0] * 75}])
    with pytest.raises(MotionFileError, match=r"25 keypoints .*'body25' and 'body25b'"):
        read_keypoints(path, fps=1)
    assert read_keypoints(path, 1, "body25")[0].skeleton.joint_names[8] == "pelvis"
    assert read_keypoints(path, 1, "body25b")[0].skeleton.joint_names[8] == "right_elbow"
    given = Skeleton([f"k{i}" for i in range(25)], [-1] * 25)
    assert read_keypoints(path, 1, given)[0].skeleton == given


@needs_data
def test_a_real_openpose_frame_is_the_frame_of_the_converted_track() -> None:
    path = DATA / "originals" / "cam01.0050.json"
    (frame,) = read_keypoints(path, fps=60, skeleton="body25b")
    folder = DATA / "pose2sim_multiview"
    (track,) = read_keypoints(folder / "S00_P00_T01_BalancingTrial_cam_01.npz")
    errors = [
        np.nanmax(np.abs(frame.keypoints[0] - points), initial=0)
        for points in track.keypoints
        if (np.isnan(points) == np.isnan(frame.keypoints[0])).all()
    ]
    assert min(errors) < 1e-3, "the 50th frame is among the hundred, to float32"
    assert frame.skeleton.canonical_names == track.skeleton.canonical_names


# --- defects -----------------------------------------------------------------------------------

ONE = result(0, FIRST[0])


def changed(key: str, value: Any) -> dict[str, Any]:
    content = coco()
    content["annotations"][0][key] = value
    return content


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({}, "holds the keys , expected keypoints of COCO"),
        ({"positions": [1]}, "holds the keys positions, expected keypoints"),
        ([], r"holds a list with \[\], expected keypoints"),
        ([1, 2], "holds a list with"),
        ("text", "holds a str with 'text'"),
        ([ONE, ONE], "frame 0 holds two people without a track id, expected track ids"),
        ([ONE, result(0, FIRST[0], idx=1)], "1 of 2 detections have no track id"),
        ([result(0, FIRST[0], idx=1)] * 2, "frame 0 holds person '1' twice"),
        ([result(0, FIRST[0], idx={})], "track_id must be a number, got {}"),
        ([ONE | {"image_id": "a.jpg"}], "called 'a.jpg', expected a name with the frame's number"),
        ([ONE | {"image_id": None}], "called None"),
        ([ONE | {"image_id": 10**30}], "at most 18 digits"),
        ([ONE, ONE | {"image_id": 10**9}], "frames run from 0 to 1000000000"),
        ([ONE | {"keypoints": [1, 2]}], r"\[0\] holds \[1, 2\], expected a list of x, y, conf"),
        ([ONE | {"keypoints": []}], r"\[0\] holds \[\]"),
        ([ONE | {"keypoints": "12"}], "holds '12'"),
        ([ONE | {"keypoints": ["1", 2, 3]}], "holds '1', expected numbers"),
        ([ONE | {"keypoints": [True, 2, 3]}], "holds True, expected numbers"),
        ([ONE | {"keypoints": [1, 2, -1]}], "holds the confidence -1, expected 0 or more"),
        ([ONE | {"keypoints": [1, 2, 95] * 17}], "confidence is 95 at its most, expected 0"),
        ([ONE | {"keypoints": [float("nan"), 2, 1]}], "holds NaN where confidence is above 0"),
        ([ONE | {"keypoints": [1e300, 2, 1]}], r"holds 1e\+300"),
        ([ONE | {"keypoints": [1, 2, 1] * 5}], "5 keypoints of unknown names"),
        ([ONE, result(1, FIRST[0][:5])], r"people have \[5, 17\] keypoints, expected one number"),
        ({"people": []}, "no person in any frame"),
        ({"people": 3}, "people must be a list of objects, got 3"),
        ({"people": [{}]}, r"people\[0\] holds None"),
        (coco(images=None), "images must be a list of objects, got None"),
        (coco(images=[{"file_name": "1.jpg"}]), "id None came, expected an id for each image"),
        (coco(images=[{"id": 1}, {"id": 1}]), "id '1' came, expected .* all different"),
        (coco(annotations=[]), "no person in any frame"),
        (changed("image_id", 1), "image_id '1', expected the id of an image"),
        (changed("keypoints", [1, 2, 3]), "visibility that is not 0, 1 or 2"),
        (
            coco(categories=[{"id": 1, "name": "x", "keypoints": ["a", "a"]}]),
            r"category 'x': joint_names repeats \['a'\]",
        ),
        (
            coco(categories=[{"id": 1, "keypoints": ["a", "b"], "skeleton": [[1, 3]]}]),
            r"the edge \[1, 3\], expected keypoint numbers from 1 to 2",
        ),
        (
            coco(categories=[{"id": 1, "keypoints": ["a", "b"]}]),
            "people have 17 keypoints, expected 2, the joints of the skeleton",
        ),
    ],
)
def test_a_defect_is_one_sentence(tmp_path: Path, content: Any, message: str) -> None:
    path = written(tmp_path, content)
    with pytest.raises(MotionFileError, match=message) as caught:
        read_keypoints(path, fps=25)
    assert str(path) in str(caught.value)
    assert "expected" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_cannot_be_printed_is_escaped(tmp_path: Path) -> None:
    with pytest.raises(MotionFileError, match=r"holds the keys \\u2028\\x00\\ud800, expected"):
        read_keypoints(written(tmp_path, {"\u2028\0\ud800": []}), fps=25)


def test_arguments_and_files_that_do_not_fit(tmp_path: Path) -> None:
    path = written(tmp_path, [ONE])
    with pytest.raises(ValueError, match="fps must be frames per second, got missing"):
        read_keypoints(path)
    with pytest.raises(ValueError, match="fps is -1"):
        read_keypoints(path, fps=-1)
    with pytest.raises(ValueError, match="skeleton must be a Skeleton or one of, got 'none'"):
        read_keypoints(path, fps=1, skeleton="none")
    with pytest.raises(MotionFileError, match="17 keypoints, expected 18"):
        read_keypoints(path, fps=1, skeleton="openpose18")
    with pytest.raises(FileNotFoundError):
        read_keypoints(tmp_path / "none.json", fps=1)
    (tmp_path / "empty").mkdir()
    with pytest.raises(MotionFileError, match=r"no \.json file"):
        read_keypoints(tmp_path / "empty", fps=1)
    with pytest.raises(MotionFileError, match="expected one OpenPose frame"):
        read_keypoints(tmp_path, fps=1)
    for content in (b"", b"\xff\xfe\x00", b"{", b"[" * 100_000, b'{"people": [' + b"9" * 5000):
        path.write_bytes(content)
        with pytest.raises(MotionFileError, match="is no JSON"):
            read_keypoints(path, fps=1)
