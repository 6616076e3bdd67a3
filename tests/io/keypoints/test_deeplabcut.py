"""DeepLabCut tables: tracks of one and several animals, and defects."""

import pickle

import h5py
import numpy as np
import pytest

from probmotion.io.errors import MotionFileError
from probmotion.io.keypoints.files import read_keypoints
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


COLUMNS = [
    ("net", animal, part, coordinate)
    for animal in ("mouse2", "mouse1")
    for part in ("snout", "tail_base")
    for coordinate in ("x", "y", "likelihood")
]
CELLS = np.random.default_rng(8).uniform(0.1, 1, size=(3, 12))
CELLS[1, 3:5] = np.nan


def appendable(folder, columns=COLUMNS, cells=CELLS, kind=None):
    """Write pandas' format "table", that of analysed videos."""
    with h5py.File(folder / "table.h5", "w") as file:
        group = file.create_group("df_with_missing")
        group.attrs["pandas_type"] = np.bytes_("frame_table")
        dtype = [("index", "<i8"), ("values_block_0", "<f8", cells.shape[1:])]
        rows = np.zeros(len(cells), dtype)
        rows["index"], rows["values_block_0"] = np.arange(len(cells)), cells
        table = group.create_dataset("table", data=rows, maxshape=(None,))
        kind = pickle.dumps(columns, protocol=0) if kind is None else kind
        table.attrs["values_block_0_kind"] = np.bytes_(kind)
    return folder / "table.h5"


def fixed(folder, columns=COLUMNS, cells=CELLS, index=None, **changes):
    """Write pandas' format "fixed", that of labelled images."""
    with h5py.File(folder / "table.h5", "w") as file:
        group = file.create_group("df_with_missing")
        group.attrs.update({"pandas_type": np.bytes_("frame"), "nblocks": 1})
        group["block0_values"] = cells
        levels = (
            {"block0_items": columns}
            if index is None
            else {"block0_items": columns} | {"axis1": index}
        )
        for name, entries in levels.items():
            group.attrs[f"{name}_nlevels"] = len(entries[0])
            for k, level in enumerate(zip(*entries, strict=True)):
                texts, codes = np.unique(np.array(level, dtype="S"), return_inverse=True)
                group[f"{name}_level{k}"], group[f"{name}_label{k}"] = texts, codes.astype("i1")
        if index is None:
            group["axis1"] = np.arange(len(cells))
        for key, value in changes.items():
            del group[key]
            group[key] = value
    return folder / "table.h5"


@pytest.mark.parametrize("write", [appendable, fixed])
def test_hdf5_tables_of_several_animals_and_of_one(tmp_path, write):
    two, one = read_keypoints(write(tmp_path), fps=50)
    assert (two.name, one.name, two.fps) == ("table mouse2", "table mouse1", 50)
    assert two.skeleton == Skeleton(["snout", "tail_base"], [-1, -1])
    np.testing.assert_array_equal(two.keypoints[:, 0], CELLS[:, :2])
    np.testing.assert_array_equal(two.keypoints[:, 1], CELLS[:, 3:5])
    np.testing.assert_array_equal(two.confidence[:, 1], [CELLS[0, 5], 0, CELLS[2, 5]])
    np.testing.assert_array_equal(one.keypoints[:, 1], CELLS[:, 9:11])
    columns = [(scorer, *rest) for scorer, _, *rest in COLUMNS[:6]]
    (single,) = read_keypoints(write(tmp_path, columns, CELLS[:, :6]), fps=50)
    assert single.name == "table"
    np.testing.assert_array_equal(single.keypoints, two.keypoints)
    (chosen,) = read_keypoints(tmp_path / "table.h5", 50, Skeleton(["tail_base"], [-1]))
    np.testing.assert_array_equal(chosen.keypoints[:, 0], two.keypoints[:, 1])


def test_hdf5_tables_of_labelled_images(tmp_path):
    index = [("labeled-data", "run", f"img{k:03}.png") for k in (3, 5, 6)]
    columns = [("me", part, axis) for part in ("snout", "tail") for axis in "xy"]
    (track,) = read_keypoints(fixed(tmp_path, columns, CELLS[:, 6:10], index), fps=50)
    np.testing.assert_array_equal(track.keypoints[[0, 2, 3], 0], CELLS[:, 6:8])
    np.testing.assert_array_equal(track.confidence[:, 0], [1, 0, 1, 1])


class Trap:
    """An object whose unpickling creates a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (type(self.path).touch, (self.path,))


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (b"", "expected columns of strings, got b''; save it as .csv"),
        (pickle.dumps(COLUMNS, protocol=0)[:-1], "expected columns of strings"),
        (pickle.dumps(COLUMNS, protocol=4), "expected columns of strings"),
        (pickle.dumps([*COLUMNS[1:], (1, 2, 3)], protocol=0), "expected columns of strings"),
        (
            pickle.dumps(COLUMNS[1:], protocol=0),
            r"expected 3 rows of 11 cells, got shape \(3, 12\)",
        ),
        (pickle.dumps([("a", "b")] * 12, protocol=0), "expected columns of scorer, indiv.* got"),
        (pickle.dumps([("a", "b", "y")] * 12, protocol=0), "x, y and likelihood once for each"),
    ],
)
def test_damaged_columns_of_hdf5_tables(tmp_path, kind, message):
    with pytest.raises(MotionFileError, match=message):
        read_keypoints(appendable(tmp_path, kind=kind), 50)


def test_pickles_in_hdf5_tables_are_not_loaded(tmp_path):
    marker = tmp_path / "marker"
    kind = pickle.dumps([*COLUMNS[:-1], Trap(marker)], protocol=0)
    with pytest.raises(MotionFileError, match="expected columns of strings"):
        read_keypoints(appendable(tmp_path, kind=kind), 50)
    assert not marker.exists()
    pickle.loads(kind)
    assert marker.exists()  # the trap works


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cells": CELLS[:0]}, "expected a row per frame, got none"),
        ({"cells": CELLS * 1e12}, "expected numbers between -1e9 and 1e9 in all cells|be between"),
        ({"cells": -CELLS}, "row 0, column 3: expected a likelihood of at least 0, got -0."),
        ({"block0_items_label1": np.full(12, 9)}, "expected codes of 2 names in block0_items"),
        ({"block0_items_label1": np.zeros(3)}, "expected levels of equal length in block0_items"),
        ({"axis1": np.arange(9)}, "expected 9 rows of 12 cells, got shape"),
        ({"axis1": -np.arange(3)}, "row 1: expected a frame number or an image path, got '-1'"),
        ({"block0_values": np.array([b"a"])}, "block0_values must contain numbers with 2 axes"),
    ],
)
def test_damaged_hdf5_tables(tmp_path, changes, message):
    with pytest.raises(MotionFileError, match=message):
        read_keypoints(fixed(tmp_path, **changes), 50)


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
        ("", "a.h5", {}, "expected a readable HDF5 file"),
    ],
)
def test_invalid_arguments_are_refused(tmp_path, content, name, changes, message):
    with pytest.raises(ValueError, match=message):
        read_keypoints(written(tmp_path, content, name), **({"fps": 25} | changes))
