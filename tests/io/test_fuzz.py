"""Damaged and foreign files are read or raise MotionFileError. Warnings are errors."""

import io
import json
import tempfile
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from probmotion.io.bvh import read_bvh
from probmotion.io.errors import MotionFileError, MotionFileWarning
from probmotion.io.files import load, read_keypoints
from probmotion.motion.motion import KeypointTrack, Motion

BVH = b"""HIERARCHY
ROOT Hips
{
    OFFSET 0 0 0
    CHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation
    JOINT Knee
    {
        OFFSET 0 -1 0
        CHANNELS 4 Zrotation Yposition Yrotation Xrotation
        End Site
        {
            OFFSET 0 -0.5 0
        }
    }
}
ROOT Ball
{
    OFFSET 0 0 1
    CHANNELS 0
}
MOTION
Frames: 3
Frame Time: 0.0333333
0 1 0 0 0 0 0 0 0 0
0 1 0 90 0 0 0 0 0 90
1.5e0 1 0 -90 .25 0 -.5 0 0 90
"""


def npz(**more):
    file = io.BytesIO()
    np.savez(
        file,
        positions=np.arange(24, dtype=np.float32).reshape(4, 2, 3),
        fps=np.float32(30),
        joint_names=np.array(["hip", "knee"]),
        parents=np.array([-1, 0], dtype=np.int32),
        up_axis="y",
        **more,
    )
    return file.getvalue()


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
ALPHAPOSE = {"1.jpg": OPENPOSE, "3.jpg": {"bodies": [{"joints": PERSON}]}}
JSONS = [
    json.dumps(content, indent=indent).encode()
    for content in (COCO, RESULTS, OPENPOSE, ALPHAPOSE, [OPENPOSE, OPENPOSE])
    for indent in (None, 1)
]
TABLE = b"""scorer,net,net,net,net,net
individuals,mouse,mouse,mouse,single,single
bodyparts,snout,snout,snout,corner,corner
coords,x,y,likelihood,x,y
7,1,2,0.5,0,9
8,nan,,,0,9
"""
ARCHIVES = [npz(), npz(keypoints=np.zeros((4, 2, 2)), confidence=np.ones((4, 2)))]
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
        kind = draw(st.sampled_from(("cut", "flip", "insert", "overwrite", "lines", "ends")))
        at = draw(st.integers(0, max(len(content) - 1, 0)))
        if kind == "cut":
            content = content[:at]
        elif kind == "flip":
            bit = draw(st.integers(0, 7))
            content = (
                content[:at] + bytes(b ^ 1 << bit for b in content[at : at + 1]) + content[at + 1 :]
            )
        elif kind == "insert":
            content = content[:at] + draw(st.sampled_from(SNIPPETS)) + content[at:]
        elif kind == "overwrite":
            snippet = draw(st.one_of(st.sampled_from(SNIPPETS), st.binary(max_size=20)))
            content = content[:at] + snippet + content[at + len(snippet) :]
        elif kind == "lines":
            lines = content.split(b"\n")
            first, second = (draw(st.integers(0, len(lines) - 1)) for _ in range(2))
            change = draw(st.sampled_from(("delete", "duplicate", "swap")))
            if change == "delete":
                del lines[first]
            elif change == "duplicate":
                lines.insert(second, lines[first])
            else:
                lines[first], lines[second] = lines[second], lines[first]
            content = b"\n".join(lines)
        else:
            end = draw(st.sampled_from((b"\r\n", b"\r", b"\n\n", b" \n")))
            content = content[:at] + content[at:].replace(b"\n", end)
    return content


def read_damaged(content, ending, read):
    """Read ``content`` from a file; other exceptions than MotionFileError propagate."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", MotionFileWarning)
        path = Path(folder) / f"clip{ending}"
        path.write_bytes(content)
        try:
            result = read(path)
        except MotionFileError as error:
            said = str(error)
            assert "expected" in said or "must" in said, said
            assert said.isprintable()
            assert len(said.replace(str(path), "")) < 600, said
            return
    if isinstance(result, Motion):
        assert np.isfinite(result.positions).all()
    else:
        assert result
        assert all(isinstance(track, KeypointTrack) for track in result)


def read_tracks(path):
    return read_keypoints(path, fps=30)


def read_with_end_sites(path):
    return read_bvh(path, end_sites=True)


@pytest.mark.parametrize(
    ("content", "ending", "read"),
    [
        (BVH, ".bvh", load),
        *((archive, ".npz", load) for archive in ARCHIVES),
        (ARCHIVES[1], ".npz", read_tracks),
        *((content, ".json", read_tracks) for content in JSONS if b"bodies" not in content),
    ],
)
def test_undamaged_files_are_read(content, ending, read, tmp_path):
    path = tmp_path / f"clip{ending}"
    path.write_bytes(content)
    assert read(path)


@settings(derandomize=True, max_examples=250)
@given(damaged([BVH]))
def test_damaged_bvh(content):
    read_damaged(content, ".bvh", read_with_end_sites)


@settings(derandomize=True, max_examples=150)
@given(damaged(ARCHIVES))
def test_damaged_npz(content):
    read_damaged(content, ".npz", load)
    read_damaged(content, ".npz", read_tracks)


@settings(derandomize=True, max_examples=150)
@given(damaged(JSONS))
def test_damaged_json(content):
    read_damaged(content, ".json", read_tracks)


@settings(derandomize=True, max_examples=150)
@given(damaged([TABLE]))
def test_damaged_tables(content):
    read_damaged(content, ".csv", read_tracks)


@settings(derandomize=True, max_examples=200)
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
    read_damaged(file.getvalue(), ".npz", load)


NUMBERS = st.one_of(st.integers(), st.floats(), st.just(10**400), st.just(1e308))
SCALARS = st.one_of(st.none(), st.booleans(), NUMBERS, st.text(max_size=5), st.just("7.jpg"))
KEYS = st.sampled_from(
    [
        *("images", "annotations", "categories", "people", "bodies", "joints", "keypoints"),
        *("image_id", "id", "idx", "track_id", "person_id", "file_name", "frame_id", "video_id"),
        *("category_id", "skeleton", "name", "pose_keypoints_2d", "3.jpg"),
    ]
)


@settings(derandomize=True, max_examples=80)
@given(
    st.recursive(
        st.one_of(SCALARS, st.lists(st.floats(0, 9), min_size=51, max_size=51)),
        lambda inner: st.one_of(
            st.lists(inner, max_size=4), st.dictionaries(KEYS, inner, max_size=5)
        ),
        max_leaves=20,
    )
)
def test_any_json(content):
    read_damaged(json.dumps(content).encode(), ".json", read_tracks)


def test_files_of_other_formats():
    foreign = [BVH, *ARCHIVES, *JSONS, b"", BVH.decode().encode("utf-16")]
    for content in foreign:
        for ending in (".bvh", ".npz"):
            read_damaged(content, ending, load)
        for ending in (".json", ".npz"):
            read_damaged(content, ending, read_tracks)
