"""DeepLabCut tables: tracks of one and several animals, and defects."""

import numpy as np
import pytest

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


def written(folder, text, name="table.csv"):
    path = folder / name
    path.write_text(text)
    return path


def test_single_animal(tmp_path):
    (track,) = read_keypoints(written(tmp_path, SINGLE), fps=50)
    assert (track.name, track.fps) == ("table", 50)
    assert track.skeleton == Skeleton(["snout", "tail_base"], [-1, -1])
    nan = [np.nan, np.nan]
    np.testing.assert_array_equal(
        track.keypoints, [[[1.5, 2.5], [10, 20]], [[3.5, 4.5], nan], [nan, [30, 40]]]
    )
    np.testing.assert_array_equal(track.confidence, [[0.9, 1], [0.8, 0], [0, 0.25]])


def test_several_animals_have_one_track_each(tmp_path):
    two, one, corners = read_keypoints(written(tmp_path, SEVERAL), fps=50)
    assert (two.name, one.name) == ("table mouse2", "table mouse1")
    nan = [np.nan, np.nan]
    np.testing.assert_array_equal(two.keypoints[:, 0], [[1, 2], nan, [5, 6]])
    np.testing.assert_array_equal(two.confidence[:, 0], [0.5, 0, 0.7])
    np.testing.assert_array_equal(one.keypoints[:, 0], [[3, 4], nan, nan])
    np.testing.assert_array_equal(one.confidence[:, 0], [0.6, 0, 0])
    assert (corners.name, corners.skeleton.joint_names) == ("table single", ("corner",))
    np.testing.assert_array_equal(corners.confidence, np.ones((3, 1)))
    # Body parts of no animal are dropped for a skeleton without them.
    tracks = read_keypoints(written(tmp_path, SEVERAL), 50, Skeleton(["snout"], [-1]))
    assert [track.name for track in tracks] == ["table mouse2", "table mouse1"]


def test_labelled_images_have_confidence_one(tmp_path):
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


def test_skeleton_selects_joints_by_own_or_canonical_names(tmp_path):
    text = SINGLE.replace("snout", "L_ankle").replace("tail_base", "right_ankle")
    path = written(tmp_path, text)
    (own,) = read_keypoints(path, 30)
    for names, order in ((["right_ankle", "left_ankle"], [1, 0]), (["left_ankle"], [0])):
        skeleton = Skeleton(names, range(-1, len(names) - 1))
        (track,) = read_keypoints(path, 30, skeleton)
        assert track.skeleton == skeleton
        np.testing.assert_array_equal(track.keypoints, own.keypoints[:, order])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("scorer,", "speed,", r"expected the rows scorer, .*, got \['speed', "),
        (SINGLE, "", "expected the rows scorer"),
        (SINGLE[SINGLE.index("\n0,") :], "", "expected a row per frame, got none"),
        (SINGLE, "scorer\nbodyparts\ncoords\n0\n", "expected at least one body part, got none"),
        (SINGLE, 'scorer,"net', "expected a CSV table"),
        ("3.5,4.5,0.8,,,", "3.5,4.5,0.8,,", "line 5: expected 7 cells as in the first row, got 6"),
        ("30,40", "30,4o", "line 6, column 6: expected a number between .*, got '4o'"),
        ("30,40", "30,1e12", "line 6, column 6: expected a number between .*, got '1e12'"),
        ("40,0.25", "40,-0.25", "line 6, column 7: expected a likelihood of at least 0, got -0.2"),
        ("\n1,3.5", "\n1.5,3.5", "line 5, column 1: expected a frame number .*, got '1.5'"),
        ("\n1,3.5", "\nimage.png,3.5", "a frame number of at most 18 digits, got 'image.png'"),
        ("\n1,3.5", "\n2,3.5", "two people without track ids in frame 2"),
        ("x,y,likelihood,x", "x,x,likelihood,x", "column 3: expected x, .* got 'x' of 'snout'"),
        ("x,y,likelihood,x", "x,z,likelihood,x", "column 3: expected x, .* got 'z' of 'snout'"),
        ("snout,snout,snout", "snout,snot,snout", "x and y of the body part 'snout', got x, likel"),
    ],
)
def test_defects_are_reported(tmp_path, old, new, message):
    assert old in SINGLE
    path = written(tmp_path, SINGLE.replace(old, new, 1))
    with pytest.raises(MotionFileError, match=message) as caught:
        read_keypoints(path, fps=25)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("content", "name", "changes", "message"),
    [
        (
            SINGLE,
            "a.csv",
            {"fps": None},
            "fps must be given for .*, which contains no frame rate",
        ),
        (SINGLE, "a.csv", {"fps": 0}, "fps must be a finite number above 0, got 0"),
        (SINGLE, "a.csv", {"people": 1}, "people must be None for .csv files, got 1"),
        (SINGLE, "a.csv", {"skeleton": "coco17"}, "the joint 'nose' .* body parts of the table"),
        (SEVERAL, "a.csv", {"skeleton": Skeleton(["corner"], [-1])}, "of individual 'mouse2'"),
        ("", "a.h5", {}, "expected a CSV table, got HDF5"),
    ],
)
def test_invalid_arguments_are_refused(tmp_path, content, name, changes, message):
    with pytest.raises(ValueError, match=message):
        read_keypoints(written(tmp_path, content, name), **({"fps": 25} | changes))
