"""DeepLabCut's tables: tracks of one animal and of several, and every defect in one sentence."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from probmotion.io.deeplabcut import read_deeplabcut
from probmotion.io.errors import MotionFileError
from probmotion.io.files import read_keypoints
from probmotion.motion.skeleton import Skeleton

SINGLE = """scorer,net,net,net,net,net,net
bodyparts,snout,snout,snout,tail_base,tail_base,tail_base
coords,x,y,likelihood,x,y,likelihood
0,1.5,2.5,0.9,10,20,1.0
1,3.5,4.5,0.8,,,
2,5.5,6.5,0.0,30,40,0.25
"""
SEVERAL = """scorer,net,net,net,net,net,net,net,net
individuals,mouse2,mouse2,mouse2,mouse1,mouse1,mouse1,single,single
bodyparts,snout,snout,snout,snout,snout,snout,corner,corner
coords,x,y,likelihood,x,y,likelihood,x,y
7,1,2,0.5,3,4,0.6,0,9
8,,,,nan,4,0.6,0,9
9,5,6,0.7,7,8,NaN,0,9
"""
LABELLED = """scorer,,,me,me
bodyparts,,,snout,snout
coords,,,x,y
labeled-data,run,img003.png,1,2
labeled-data,run,img005.png,5,6
labeled-data,walk2,img001.png,7,8
"""


def written(folder: Path, text: str, name: str = "table.csv") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_one_animal(tmp_path: Path) -> None:
    (track,) = read_keypoints(written(tmp_path, SINGLE), fps=50)
    assert (track.name, track.fps, track.frames) == ("table", 50, 3)
    assert track.skeleton == Skeleton(["snout", "tail_base"], [-1, -1])
    nan = [np.nan, np.nan]
    np.testing.assert_array_equal(
        track.keypoints, [[[1.5, 2.5], [10, 20]], [[3.5, 4.5], nan], [nan, [30, 40]]]
    )
    np.testing.assert_array_equal(track.confidence, [[0.9, 1], [0.8, 0], [0, 0.25]])


def test_several_animals_are_a_track_each_over_the_same_frames(tmp_path: Path) -> None:
    two, one, corners = read_keypoints(written(tmp_path, SEVERAL), fps=50)
    assert (two.name, one.name) == ("table mouse2", "table mouse1")
    nan = [np.nan, np.nan]
    np.testing.assert_array_equal(two.keypoints[:, 0], [[1, 2], nan, [5, 6]])
    np.testing.assert_array_equal(two.confidence[:, 0], [0.5, 0, 0.7])
    np.testing.assert_array_equal(one.keypoints[:, 0], [[3, 4], nan, nan])
    np.testing.assert_array_equal(one.confidence[:, 0], [0.6, 0, 0])
    assert corners.name == "table single"
    assert corners.skeleton.joint_names == ("corner",)
    np.testing.assert_array_equal(corners.confidence, np.ones((3, 1)))


def test_body_parts_of_no_animal_are_left_out_where_a_skeleton_is_asked_for(
    tmp_path: Path,
) -> None:
    tracks = read_keypoints(written(tmp_path, SEVERAL), 50, Skeleton(["snout"], [-1]))
    assert [track.name for track in tracks] == ["table mouse2", "table mouse1"]


def test_labelled_images_span_their_frames_and_are_sure(tmp_path: Path) -> None:
    run, walk = read_keypoints(written(tmp_path, LABELLED), fps=50)
    assert (run.name, walk.name) == ("table labeled-data/run/img", "table labeled-data/walk2/img")
    np.testing.assert_array_equal(run.confidence[:, 0], [1, 0, 1])
    np.testing.assert_array_equal(run.keypoints[[0, 2], 0], [[1, 2], [5, 6]])
    one_column = LABELLED.replace("scorer,,,", "scorer,").replace("bodyparts,,,", "bodyparts,")
    one_column = one_column.replace("coords,,,", "coords,").replace("labeled-data,", "labeled-data")
    one_column = one_column.replace(",img", "/img").replace("labeled-data", "labeled-data\\")
    again, _ = read_keypoints(written(tmp_path, one_column), fps=50)
    assert again.name == run.name
    np.testing.assert_array_equal(again.keypoints, run.keypoints)


def quadruped_table(skeleton: Skeleton, names: list[str]) -> tuple[str, np.ndarray]:
    """A table of the skeleton's joints under ``names`` in reverse, and a part it does not have."""
    values = np.random.default_rng(0).uniform(1, 9, size=(4, skeleton.n_joints, 2)).round(3)
    order = list(range(skeleton.n_joints))[::-1]
    rows = [["scorer"], ["bodyparts"], ["coords"], *([str(frame)] for frame in range(4))]
    for joint in [*order, None]:
        name = "antler" if joint is None else names[joint]
        for axis, coordinate in enumerate(("x", "y", "likelihood")):
            rows[0].append("net")
            rows[1].append(name)
            rows[2].append(coordinate)
            for frame in range(4):
                cell = 0.5 if axis == 2 or joint is None else values[frame, joint, axis]
                rows[3 + frame].append(str(cell))
    return "\n".join(",".join(row) for row in rows), values


@pytest.mark.parametrize("side", ["left_", "L_"])
def test_a_skeleton_gives_order_and_links_by_own_or_canonical_names(
    tmp_path: Path, side: str
) -> None:
    skeleton = Skeleton.preset("apt36k17")
    names = [name.replace("left_", side) for name in skeleton.joint_names]
    text, values = quadruped_table(skeleton, names)
    path = written(tmp_path, text)
    for given in (skeleton, "apt36k17"):
        (track,) = read_keypoints(path, 30, given)
        assert track.skeleton == skeleton
        np.testing.assert_array_equal(track.keypoints, values)
    (own,) = read_keypoints(path, 30)
    assert own.skeleton.joint_names == (*names[::-1], "antler")
    np.testing.assert_array_equal(own.keypoints[:, :17], values[:, ::-1])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("scorer,", "speed,", r"begins with the rows \['speed', .*expected DeepLabCut's scorer"),
        ("coords,x", "cords,x", "expected DeepLabCut's scorer, individuals"),
        ("3.5,4.5,0.8,,,", "3.5,4.5,0.8,,", "line 5 has 6 cells, expected 7"),
        ("30,40", "30,4o", "line 6, column 6 holds '4o', expected a number"),
        ("30,40", "30,1e12", "line 6, column 6 holds '1e12', expected a number"),
        ("30,40", "30,inf", "line 6, column 6 holds 'inf', expected a number"),
        ("40,0.25", "40,-0.25", "line 6, column 7 holds the likelihood -0.25, expected 0 or more"),
        ("\n1,3.5", "\n1.5,3.5", r"line 5, column 1 holds '1.5', expected a frame's number"),
        ("\n1,3.5", "\n,3.5", "line 5, column 1 holds '', expected a frame's number"),
        ("\n1,3.5", "\nimage.png,3.5", "line 5, column 1 is called 'image.png', expected a name"),
        ("\n1,3.5", "\n2,3.5", "frame 2 holds two people without a track id"),
        ("x,y,likelihood,x", "x,x,likelihood,x", "column 3 is 'x' of the body part 'snout'"),
        ("x,y,likelihood,x", "x,z,likelihood,x", "column 3 is 'z' of the body part 'snout'"),
        (
            "snout,snout,snout",
            "snout,snot,snout",
            "body part 'snout' has the columns x, likelihood",
        ),
    ],
)
def test_a_defect_is_one_sentence(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in SINGLE
    path = written(tmp_path, SINGLE.replace(old, new, 1))
    with pytest.raises(MotionFileError, match=message) as caught:
        read_keypoints(path, fps=25)
    assert str(path) in str(caught.value)
    assert "expected" in str(caught.value)


def test_files_and_arguments_that_do_not_fit(tmp_path: Path) -> None:
    path = written(tmp_path, SINGLE)
    with pytest.raises(ValueError, match=r"fps must be .* is a table, got missing"):
        read_keypoints(path)
    with pytest.raises(ValueError, match="fps is 0, expected"):
        read_keypoints(path, fps=0)
    with pytest.raises(ValueError, match=r"people was given with .*: tables say who is who"):
        read_keypoints(path, fps=25, people=1)
    with pytest.raises(MotionFileError, match="the table lacks the joint 'nose' of skeleton, exp"):
        read_keypoints(path, 25, "coco17")
    several = written(tmp_path, SEVERAL, "several.csv")
    with pytest.raises(MotionFileError, match="the individual 'mouse2' lacks the joint 'corner'"):
        read_keypoints(several, 25, Skeleton(["corner"], [-1]))
    with pytest.raises(MotionFileError, match="is HDF5, expected the same table exported as CSV"):
        read_keypoints(written(tmp_path, "", "table.h5"), fps=25)
    with pytest.raises(MotionFileError, match="begins with the rows"):
        read_keypoints(written(tmp_path, "", "empty.csv"), fps=25)
    head = "\n".join(SINGLE.splitlines()[:3])
    with pytest.raises(MotionFileError, match="holds no row below its header"):
        read_keypoints(written(tmp_path, head, "head.csv"), fps=25)
    with pytest.raises(MotionFileError, match="holds no body part"):
        read_keypoints(written(tmp_path, "scorer\nbodyparts\ncoords\n0\n", "no.csv"), fps=25)
    for content in (b"\xff\xfe\x00", b'scorer,"net'):
        path.write_bytes(content)
        with pytest.raises(MotionFileError, match="is no CSV"):
            read_keypoints(path, fps=25)
    with pytest.raises(FileNotFoundError):
        read_deeplabcut(tmp_path / "none.csv", fps=25)


def test_damaged_tables_are_read_or_refused(tmp_path: Path) -> None:
    """Bytes changed, cut and doubled: a track or MotionFileError, nothing else."""
    rng = np.random.default_rng(5)
    path = tmp_path / "table.csv"
    alphabet = np.frombuffer(b'09.,-\n\r"xyn\x00\xff einf/', dtype=np.uint8)
    refused = 0
    for text in (SINGLE, SEVERAL, LABELLED) * 100:
        content = np.frombuffer(text.encode(), dtype=np.uint8).copy()
        content[rng.integers(len(content), size=rng.integers(1, 4))] = rng.choice(alphabet)
        if rng.random() < 0.3:
            content = content[: rng.integers(len(content))]
        path.write_bytes(content.tobytes())
        try:
            assert read_keypoints(path, fps=25)
        except MotionFileError as error:
            refused += 1
            assert "\n" not in str(error)  # noqa: PT017 - of every message, not of one
    assert 30 < refused < 300


def test_a_table_quotes_its_cells_as_any_csv(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    with path.open("w", newline="", encoding="utf-8-sig") as file:
        csv.writer(file, quoting=csv.QUOTE_ALL).writerows(
            line.split(",") for line in SINGLE.splitlines()
        )
    (quoted,) = read_keypoints(path, 25)
    (plain,) = read_keypoints(written(tmp_path, SINGLE), 25)
    np.testing.assert_array_equal(quoted.keypoints, plain.keypoints)
