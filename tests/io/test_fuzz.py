"""Files of other formats and arbitrary JSON are read or raise MotionFileError.

Mutated files are in ``tests/fuzz``.
"""

import json
import tempfile
import warnings
from functools import partial
from pathlib import Path

import numpy as np
from hypothesis import given, settings, strategies as st
from motion_files import ARCHIVES, ASF, BVH, HDF5, JSONS

from probmotion.io.bvh import read_bvh
from probmotion.io.errors import MotionFileError, MotionFileWarning
from probmotion.io.files import load, read_joints
from probmotion.io.keypoints.files import read_keypoints
from probmotion.motion.motion import JointTrack, KeypointTrack, Motion


def check(content, ending, read):
    """Read ``content`` from a file; other exceptions than MotionFileError propagate."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", MotionFileWarning)
        path = Path(folder) / f"clip{ending}"
        path.write_bytes(content)
        path.with_suffix(".asf").write_bytes(ASF)
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
READERS = [
    (".bvh", partial(read_bvh, end_sites=True)),
    *((ending, load) for ending in (".amc", ".npz")),
    *((ending, read_tracks) for ending in (".npz", ".json", ".csv", ".h5")),
    (".trc", read_joints),
    (".npz", partial(read_joints, unit="m")),
]

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
        for ending, read in READERS:
            check(content, ending, read)
