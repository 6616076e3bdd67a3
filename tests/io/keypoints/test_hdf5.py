"""SLEAP analysis files and netCDF files of movement: layouts and defects."""

import json

import h5py
import numpy as np
import pytest
import xarray as xr

from probmotion.io.errors import MotionFileError
from probmotion.io.keypoints.files import open_keypoints, read_keypoints
from probmotion.motion.skeleton import Skeleton

RNG = np.random.default_rng(7)
POINTS = RNG.uniform(1, 99, size=(2, 5, 4, 2))  # animals, frames, keypoints
POINTS[1, 2, 3] = np.nan
SCORES = RNG.uniform(0.1, 1, size=(2, 5, 4))
SCORES[0, 0, 0] = np.nan  # labelled by hand
NODES = ["nose", "neck", "left_paw", "right_paw"]
EDGES = [[1, 0], [1, 2], [1, 3]]
AXES = ("track", "frame", "node", "xy")


def sleap(folder, order=("track", "xy", "node", "frame"), name="clip.h5", **changes):
    axes = [AXES.index(axis) for axis in order]
    short = [axis for axis in order if axis != "xy"]
    content = {
        "tracks": POINTS.transpose(axes),
        "point_scores": SCORES.transpose([AXES.index(axis) for axis in short]),
        "node_names": np.array(NODES, dtype="S"),
        "track_names": np.array(["b", "a"], dtype="S"),
        "edge_inds": np.array(EDGES),
        "track_occupancy": np.ones((5, 2), dtype=np.uint8),
    }
    with h5py.File(folder / name, "w") as file:
        for key, value in (content | changes).items():
            if value is not None:
                file.create_dataset(
                    key, data=value, compression="gzip" if key == "tracks" else None
                )
        if order[0] == "node":
            file["tracks"].attrs["dims"] = json.dumps(order)
    return folder / name


def movement(folder, order=("time", "space", "keypoints", "individuals"), name="clip.nc", **attrs):
    axes = [("individuals", "time", "keypoints", "space").index(axis) for axis in order]
    plain = {axis: axis for axis in order}
    if attrs.pop("singular", False):  # names of the dimensions in later versions
        plain |= {"keypoints": "keypoint", "individuals": "individual"}
    dims = [plain[axis] for axis in order]
    xr.Dataset(
        {
            "position": (dims, POINTS.transpose(axes)),
            "confidence": (
                [plain[axis] for axis in ("time", "keypoints", "individuals")],
                SCORES.transpose(1, 2, 0),
            ),
        },
        coords={
            "time": np.arange(5) / 25,
            "space": ["x", "y"],
            plain["keypoints"]: NODES,
            plain["individuals"]: ["b", "a"],
        },
        attrs={"ds_type": "poses", "time_unit": "seconds", **attrs},
    ).to_netcdf(folder / name, engine="h5netcdf")
    return folder / name


def assert_tracks(tracks):
    assert [track.name for track in tracks] == ["clip b", "clip a"]
    for track, points, scores in zip(tracks, POINTS, SCORES, strict=True):
        np.testing.assert_array_equal(track.keypoints, points)
        expected = np.where(np.isnan(scores), 1, scores)
        expected[np.isnan(points[..., 0])] = 0
        np.testing.assert_array_equal(track.confidence, expected)


@pytest.mark.parametrize(
    "order",
    [
        ("track", "xy", "node", "frame"),
        ("frame", "node", "xy", "track"),
        ("node", "xy", "frame", "track"),  # declared by an attribute
    ],
)
def test_sleap(tmp_path, order):
    file = open_keypoints(sleap(tmp_path, order))
    assert (file.format, file.fps) == ("SLEAP analysis", None)
    assert_tracks(file.tracks)
    assert file.tracks[0].skeleton == Skeleton(NODES, [-1, 0, 1, 1])


def test_optional_parts_of_sleap(tmp_path):
    for names in (None, np.empty(0)):  # SLEAP stores an empty list of names as numbers
        path = sleap(tmp_path, edge_inds=np.array(EDGES).T, track_names=names, point_scores=None)
        first, second = read_keypoints(path, 30)
        assert (first.name, second.name) == ("clip 0", "clip 1")
        assert first.skeleton.parents == (-1, 0, 1, 1)
        assert (first.confidence == 1).all()
    path = sleap(
        tmp_path, edge_inds=None, tracks=POINTS[:1].transpose(0, 3, 2, 1), point_scores=None
    )
    (single,) = read_keypoints(path, 30)
    assert (single.name, single.skeleton.roots) == ("clip", (0, 1, 2, 3))
    (chosen,) = read_keypoints(path, 30, Skeleton(["right_paw", "nose"], [-1, 0]))
    np.testing.assert_array_equal(chosen.keypoints, POINTS[0, :, [3, 0]].transpose(1, 0, 2))


@pytest.mark.parametrize("singular", [False, True])
@pytest.mark.parametrize(
    "order",
    [
        ("time", "space", "keypoints", "individuals"),
        ("time", "individuals", "keypoints", "space"),
    ],
)
def test_movement(tmp_path, order, singular):
    file = open_keypoints(movement(tmp_path, order, singular=singular, fps=25.0))
    assert (file.format, file.fps) == ("movement", 25)
    assert_tracks(file.tracks)
    assert file.tracks[0].skeleton == Skeleton(NODES, [-1] * 4)
    assert read_keypoints(tmp_path / "clip.nc", 50)[0].fps == 50
    assert open_keypoints(movement(tmp_path)).fps is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"tracks": POINTS[:, :, :3].transpose(0, 3, 2, 1), "point_scores": None},
            r"tracks must have shape \(tracks, 2, 4 nodes, frames\), got \(2, 2, 3, 5\)",
        ),
        ({"tracks": POINTS[0]}, "tracks must contain numbers with 4 axes"),
        ({"tracks": np.full((2, 2, 4, 5), np.inf)}, "tracks must be between -1e9 and 1e9"),
        (
            {"tracks": np.empty((2, 2, 4, 0)), "point_scores": None},
            r"least one person, frame and keypoint, got \(2, 0, 4",
        ),
        ({"tracks": np.array([b"a"])}, "tracks must contain numbers with 4 axes, got dtype"),
        ({"point_scores": SCORES}, r"expected point_scores of \(2, 5, 4\) .*, got \(2, 4, 5\)"),
        ({"point_scores": -SCORES.transpose(0, 2, 1)}, "confidence must be 0 to 2, got -0"),
        ({"node_names": np.arange(4)}, "node_names must be a list of strings, got dtype"),
        ({"track_names": np.arange(2)}, "track_names must be a list of strings, got dtype"),
        ({"node_names": np.empty(0)}, r"tracks must have shape \(tracks, 2, 0 nodes, frames\)"),
        ({"node_names": np.array([b"a"] * 4)}, "joint_names must be unique"),
        ({"node_names": None}, r"expected a table of DeepLabCut, .* got 'edge_inds \(3, 2\)"),
        ({"edge_inds": np.array([[0, 9]])}, r"edges between keypoints 1 to 4, got \[1.0, 10.0\]"),
        ({"edge_inds": np.ones((3, 3))}, r"edge_inds must be pairs of nodes, got \(3, 3\)"),
    ],
)
def test_defects_of_sleap(tmp_path, changes, message):
    with pytest.raises(MotionFileError, match=message):
        read_keypoints(sleap(tmp_path, **changes), 30)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda file: file.attrs.update(fps=-1.0), "fps must be a number above 0, got -1"),
        (lambda file: file.pop("individuals"), "must have the dimensions .* got time, space"),
        (lambda file: file.pop("position"), "expected a table of DeepLabCut, .* got 'confidence"),
        (
            lambda file: file.move("time", "frames"),
            "must have the dimensions individual, time, key",
        ),
    ],
)
def test_defects_of_movement(tmp_path, change, message):
    path = movement(tmp_path)
    with h5py.File(path, "a") as file:
        change(file)
    with pytest.raises(MotionFileError, match=message):
        read_keypoints(path)


def test_unreadable_files_and_positions_in_3d(tmp_path):
    path = sleap(tmp_path)
    content = path.read_bytes()
    for damaged in (b"", content[:100], content[: len(content) // 2]):
        path.write_bytes(damaged)
        with pytest.raises(MotionFileError, match="expected a readable HDF5 file"):
            read_keypoints(path, 30)
    with xr.open_dataset(movement(tmp_path), engine="h5netcdf") as flat:
        deep = flat[["position"]].pad(space=(0, 1)).assign_coords(space=["x", "y", "z"])
        deep.to_netcdf(tmp_path / "deep.nc", engine="h5netcdf")
    with pytest.raises(MotionFileError, match="expected positions x and y, got 3 axes"):
        read_keypoints(tmp_path / "deep.nc", 30)
