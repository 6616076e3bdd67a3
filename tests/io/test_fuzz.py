"""Damaged and foreign files are read or raise MotionFileError. Warnings are errors."""

import io
import json
import pickle
import tempfile
import warnings
import zipfile
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from probmotion.io.bvh import read_bvh
from probmotion.io.errors import MotionFileError, MotionFileWarning
from probmotion.io.files import load, read_joints
from probmotion.io.keypoints.files import read_keypoints
from probmotion.motion.motion import JointTrack, KeypointTrack, Motion
from probmotion.motion.presets import PRESETS

BVH = b"""HIERARCHY
ROOT Hips {
    OFFSET 0 0 0
    CHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation
    JOINT Knee {
        OFFSET 0 -1 0
        CHANNELS 4 Zrotation Yposition Yrotation Xrotation
        End Site { OFFSET 0 -0.5 0 }
    }
}
ROOT Ball {
    OFFSET 0 0 1
    CHANNELS 0
}
MOTION
Frames: 2
Frame Time: 0.0333333
0 1 0 90 0 0 0 0 0 90
1.5e0 1 0 -90 .25 0 -.5 0 0 90
"""
ASF = (
    b":units\nlength 1\nangle deg\n:root\norder TX RY\n:bonedata\nbegin\nname leg\nlength 1\n"
    b"direction 0 -1 0\naxis 0 90 0 XYZ\ndof rz\nend\n:hierarchy\nbegin\nroot leg\nend\n"
)
AMC = b":FULLY-SPECIFIED\n:DEGREES\n1\nroot 1 90\nleg 45\n2\nroot 0 0\nleg 1.5e0\n"


MOTION = {
    "positions": np.arange(24.0).reshape(4, 2, 3),
    "joint_names": np.array(["hip", "knee"]),
    "parents": np.array([-1, 0], dtype=np.int32),
    "fps": 30,
    "up_axis": "y",
}
PERSON = [0.5 if i % 3 == 2 else float(i) for i in range(51)]
COCO = {
    "images": [{"id": 1, "file_name": "1.jpg"}, {"id": 2, "file_name": "2.jpg"}],
    "annotations": [
        {"image_id": i, "category_id": 1, "keypoints": [1, 2, 2] * 17, "track_id": 1}
        for i in (1, 2)
    ],
    "categories": [{"id": 1, "keypoints": [f"k{i}" for i in range(17)], "skeleton": [[1, 2]]}],
}
RESULTS = [{"image_id": f"{i}.jpg", "keypoints": PERSON, "idx": 1} for i in range(3)]
OPENPOSE = {"people": [{"person_id": [-1], "pose_keypoints_2d": PERSON}]}
ALPHAPOSE = {"1.jpg": OPENPOSE, "3.jpg": OPENPOSE}
CMU = {"1.jpg": {"bodies": [{"joints": PERSON}]}}
POINTS = [[float(i), 2.0] for i in range(17)]
INSTANCE = {"keypoints": POINTS, "keypoint_scores": [0.5] * 17, "bbox": [[0, 0, 9, 9]]}
MMPOSE = {
    "meta_info": {"keypoint_id2name": {str(i): f"k{i}" for i in range(17)}},
    "instance_info": [{"frame_id": i, "instances": [INSTANCE]} for i in (1, 2)],
}
RTMPOSE = {"fps": 30, "frames": [{"keypoints": [POINTS], "scores": [[0.5] * 17]}] * 2}
LANDMARKS = [{"x": 100.0 + i, "y": 200, "visibility": 0.9} for i in range(33)]
MEDIAPIPE = [{"timestamp_ms": 33 * i, "pose_landmarks": LANDMARKS} for i in range(2)]
JSONS = [
    json.dumps(content, indent=1).encode()
    for content in (
        *(COCO, RESULTS, OPENPOSE, ALPHAPOSE, CMU, [OPENPOSE, OPENPOSE]),
        *(MMPOSE, [INSTANCE], RTMPOSE, MEDIAPIPE),
    )
]
TABLE = b"""scorer,net,net,net,net,net
individuals,mouse,mouse,mouse,single,single
bodyparts,snout,snout,snout,corner,corner
coords,x,y,likelihood,x,y
7,1,2,0.5,0,9
8,nan,,,0,9
"""
LANDMARK_TABLE = "\n".join(
    ",".join(map(str, row))
    for row in (
        [
            "frame",
            *(f"{name}_{axis}" for name in PRESETS["mediapipe33"].joint_names for axis in "xyv"),
        ],
        [0, *range(99)],
        [1, *range(99)],
    )
).encode()
JOINTS = PRESETS["person14"].joint_names
TRC = "\n".join(
    "\t".join(map(str, row))
    for row in (
        ["PathFileType", 4, "(X/Y/Z)", "walk.trc"],
        ["DataRate", "NumFrames", "NumMarkers", "Units"],
        [30, 2, 14, "m"],
        ["Frame#", "Time", *(cell for name in JOINTS for cell in (name, "", ""))],
        ["", "", *(f"{axis}{n}" for n in range(1, 15) for axis in "XYZ")],
        [1, 0, *np.linspace(0.1, 0.9, 42)],
        [2, 0.033, *np.linspace(0.1, 0.9, 39), "", "", ""],
    )
).encode()
ARCHIVES = []
for more in ({}, {"keypoints": np.zeros((4, 2, 2)), "confidence": np.ones((4, 2))}):
    file = io.BytesIO()
    np.savez(file, **MOTION, **more)
    ARCHIVES.append(file.getvalue())
HDF5 = []


def hdf5_of(group, datasets, **attributes):
    file = io.BytesIO()
    with h5py.File(file, "w") as archive:
        home = archive.require_group(group)
        home.attrs.update(attributes)
        for key, value in datasets.items():
            home[key] = value
        if "table" in home:
            columns = [("net", "snout", axis) for axis in ("x", "y", "likelihood")]
            home["table"].attrs["values_block_0_kind"] = np.bytes_(pickle.dumps(columns, 0))
        if "position" in home:
            for axis, name in enumerate(("time", "space", "keypoint", "individual")):
                home[name].make_scale(name)
                home["position"].dims[axis].attach_scale(home[name])
    HDF5.append(file.getvalue())


hdf5_of(
    "/",
    {
        "tracks": np.ones((1, 2, 3, 4)),
        "point_scores": np.ones((1, 3, 4)),
        "node_names": np.array([b"a", b"b", b"c"]),
        "edge_inds": np.array([[0, 1]]),
    },
)
hdf5_of(
    "/",
    {
        "position": np.ones((4, 2, 3, 1)),
        "time": np.arange(4.0),
        "space": np.array([b"x", b"y"]),
        "keypoint": np.array([b"a", b"b", b"c"]),
        "individual": np.array([b"a"]),
    },
    fps=25.0,
)
ROWS = np.ones(4, dtype=[("index", "<i8"), ("values_block_0", "<f8", (3,))])
ROWS["index"] = range(4)
hdf5_of("tracks", {"table": ROWS}, pandas_type=np.bytes_("frame_table"))
SNIPPETS = [
    *(b"\r", b"\n", b"\r\n", b"\t", b"\x00", b"\xff", b"\xef\xbb\xbf", b"{", b"}", b"[", b"]"),
    *(b'"', b",", b":", b"nan", b"NaN", b"-Infinity", b"null", b"true", b"-1", b"0", b"1e308"),
    *(b"1e999", b"-1e-400", b"9" * 30, b"9" * 5000, b"_", b"MOTION", b"ROOT a", b"JOINT Knee"),
    *(b"End Site", b"CHANNELS 0", b"Frames: 999999999", b"Frame Time: 1e-9", b"[" * 5000),
    *(b"\xd9\xa1", b"(99999999999,)", b"<f8", b"|O", b"PK\x01\x02", b"\xe2\x80\xa8"),
]


@st.composite
def damaged(draw, originals):
    """One of ``originals`` after one to four mutations."""
    content = draw(st.sampled_from(originals))
    for _ in range(draw(st.integers(1, 4))):
        kind = draw(st.sampled_from(("cut", "insert", "overwrite", "lines", "ends")))
        at = draw(st.integers(0, max(len(content) - 1, 0)))
        before, after = content[:at], content[at:]
        if kind == "cut":
            content = before
        elif kind == "insert":
            content = before + draw(st.sampled_from(SNIPPETS)) + after
        elif kind == "overwrite":
            snippet = draw(st.one_of(st.sampled_from(SNIPPETS), st.binary(max_size=20)))
            content = before + snippet + after[len(snippet) :]
        elif kind == "lines":
            lines = content.split(b"\n")
            first, second = (draw(st.integers(0, len(lines) - 1)) for _ in range(2))
            moved = lines.pop(first)
            lines[second:second] = [moved] * draw(st.integers(0, 2))
            content = b"\n".join(lines)
        else:
            content = before + after.replace(b"\n", draw(st.sampled_from((b"\r\n", b"\r", b" \n"))))
    return content


def check(content, ending, read, skeleton=ASF):
    """Read ``content`` from a file; other exceptions than MotionFileError propagate."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", MotionFileWarning)
        path = Path(folder) / f"clip{ending}"
        path.write_bytes(content)
        path.with_suffix(".asf").write_bytes(skeleton)
        try:
            result = read(path)
        except MotionFileError as error:
            message = str(error)
            assert "expected" in message or "must" in message, message
            assert message.isprintable()
            assert len(message.replace(str(path), "")) < 600, message
            return
    if isinstance(result, Motion):
        assert np.isfinite(result.positions).all()
    elif isinstance(result, JointTrack):
        assert not np.isinf(result.joints).any()
        assert result.seen.any()
    else:
        assert result
        assert all(isinstance(track, KeypointTrack) for track in result)


read_tracks = partial(read_keypoints, fps=30)
FORMATS = [
    ([BVH], ".bvh", partial(read_bvh, end_sites=True)),
    ([AMC], ".amc", load),
    (ARCHIVES, ".npz", load),
    (ARCHIVES[1:], ".npz", read_tracks),
    (JSONS, ".json", read_tracks),
    ([TABLE, LANDMARK_TABLE], ".csv", read_tracks),
    (HDF5, ".h5", read_tracks),
    ([TRC], ".trc", read_joints),
    (ARCHIVES, ".npz", partial(read_joints, unit="m")),
]


@pytest.mark.filterwarnings("ignore::probmotion.io.errors.MotionFileWarning")
def test_undamaged_files_are_read(tmp_path):
    (tmp_path / "clip.asf").write_bytes(ASF)
    for originals, ending, read in FORMATS:
        for content in originals:
            path = tmp_path / f"clip{ending}"
            path.write_bytes(content)
            assert read(path)


@pytest.mark.parametrize(("originals", "ending", "read"), FORMATS)
@settings(derandomize=True, max_examples=120)
@given(data=st.data())
def test_damaged_files(originals, ending, read, data):
    check(data.draw(damaged(originals)), ending, read)


@settings(derandomize=True, max_examples=120)
@given(damaged([ASF]))
def test_damaged_skeletons(skeleton):
    check(AMC, ".amc", load, skeleton)


@settings(derandomize=True, max_examples=150)
@given(st.binary(max_size=200), st.binary(max_size=300))
def test_damaged_arrays_in_valid_archives(head, body):
    """The zip's checksums are valid, so that the array's own header is damaged."""
    file = io.BytesIO()
    valid = zipfile.ZipFile(io.BytesIO(ARCHIVES[0]))
    with zipfile.ZipFile(file, "w") as archive:
        for name in valid.namelist():
            member = valid.read(name)
            if name == "positions.npy":
                member = member[: 10 + len(head) % 90] + head + body
            archive.writestr(name, member)
    check(file.getvalue(), ".npz", load)


NUMBERS = st.one_of(st.integers(), st.floats(), st.just(10**400), st.just(1e308))
SCALARS = st.one_of(st.none(), st.booleans(), NUMBERS, st.text(max_size=5), st.just("7.jpg"))
LISTS = st.lists(st.floats(0, 9), min_size=51, max_size=51)
KEYS = st.sampled_from(
    [
        *("images", "annotations", "categories", "people", "bodies", "joints", "keypoints", "name"),
        *("image_id", "id", "idx", "track_id", "person_id", "file_name", "frame_id", "video_id"),
        *("category_id", "skeleton", "pose_keypoints_2d", "3.jpg", "instance_info", "instances"),
        *("keypoint_scores", "scores", "frames", "pose_landmarks", "fps", "timestamp_ms"),
        *("landmark", "x", "y", "meta_info", "keypoint_id2name", "skeleton_links"),
    ]
)


def nested(inner):
    return st.one_of(st.lists(inner, max_size=4), st.dictionaries(KEYS, inner, max_size=5))


@settings(derandomize=True, max_examples=80)
@given(st.recursive(st.one_of(SCALARS, LISTS), nested, max_leaves=20))
def test_any_json(content):
    check(json.dumps(content).encode(), ".json", read_tracks)


def test_files_of_other_formats():
    for content in [BVH, *ARCHIVES, *JSONS, *HDF5, b"", BVH.decode().encode("utf-16")]:
        for _, ending, read in FORMATS:
            check(content, ending, read)
