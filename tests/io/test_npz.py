"""npz archives: exact round trips, real clips and defects by key."""

import io
from dataclasses import replace

import numpy as np
import pytest

from probmotion.io.errors import MotionFileError, MotionFileWarning
from probmotion.io.files import load, save
from probmotion.io.keypoints.files import read_keypoints
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton


def archive(folder, **changes):
    """Write a valid archive with changed keys; None removes a key."""
    content: dict[str, object] = {
        "positions": np.arange(24.0).reshape(4, 2, 3),
        "fps": np.float32(30),
        "joint_names": np.array(["hip", "knee"]),
        "parents": np.array([-1, 0], dtype=np.int32),
    } | changes
    path = folder / "clip.npz"
    np.savez(path, **{key: value for key, value in content.items() if value is not None})
    return path


def test_motions_round_trip_exactly(tmp_path):
    rng = np.random.default_rng(0)
    skeleton = Skeleton(["knee", "hip é", "ball"], [1, -1, -1], radii=[0.1, 0.2, 1 / 3])
    motion = Motion(
        rng.normal(size=(5, 3, 3)) * 1e3,
        skeleton,
        59.94,
        rotations=np.linalg.qr(rng.normal(size=(5, 3, 3, 3)))[0],
        rest_offsets=rng.normal(size=(3, 3)),
        name="take 3",
    )
    save(motion, tmp_path / "clip.npz")
    back = load(tmp_path / "clip.npz")
    for name in ("positions", "rotations", "rest_offsets"):
        np.testing.assert_array_equal(getattr(back, name), getattr(motion, name))
    assert (back.skeleton, back.fps, back.name) == (skeleton, 59.94, "take 3")
    assert back.skeleton.radii == skeleton.radii
    save(replace(motion, name=""), tmp_path / "unnamed.npz")
    assert load(tmp_path / "unnamed.npz").name == "unnamed"


def test_several_people_form_one_skeleton(tmp_path):
    positions = np.random.default_rng(0).normal(size=(4, 2, 2, 3))
    motion = load(archive(tmp_path, positions=positions, persons=np.array(["lead", "follow"])))
    assert motion.skeleton == Skeleton(
        ["lead:hip", "lead:knee", "follow:hip", "follow:knee"], [-1, 0, -1, 2]
    )
    np.testing.assert_array_equal(motion.positions[:, 2], positions[:, 1, 0])
    unnamed = load(archive(tmp_path, positions=positions)).skeleton
    assert unnamed.joint_names[1:3] == ("person0:knee", "person1:hip")


def test_z_up_is_rotated_not_mirrored(tmp_path):
    axes = np.stack([np.eye(3), np.eye(3)], axis=1)  # x̂, ŷ, ẑ in three frames
    rotated = load(archive(tmp_path, positions=axes, up_axis="z")).positions[:, 0]
    np.testing.assert_array_equal(rotated, [[1, 0, 0], [0, 0, -1], [0, 1, 0]])


def test_joints_without_positions_are_dropped_with_a_warning(tmp_path):
    positions = np.random.default_rng(0).normal(size=(4, 3, 3))
    positions[:, 1] = np.nan
    names, parents = np.array(["hip", "knee", "foot"]), np.array([-1, 0, 1])
    path = archive(tmp_path, positions=positions, joint_names=names, parents=parents)
    with pytest.warns(MotionFileWarning, match="dropping the joints knee, which have no position"):
        motion = load(path)
    assert motion.skeleton == Skeleton(["hip", "foot"], [-1, 0])
    np.testing.assert_array_equal(motion.positions, positions[:, [0, 2]])


@pytest.mark.parametrize(
    ("folder", "clips", "joints", "roots"),
    [("cmu_salsa_pairs", 10, {50}, 2), ("cmu_single", 26, {31, 38}, 1)],
)
def test_real_clips_are_read(real_data, folder, clips, joints, roots):
    motions = [load(path) for path in sorted((real_data / folder).glob("*.npz"))]
    assert len(motions) == clips
    assert {motion.skeleton.n_joints for motion in motions} == joints
    assert {(len(motion.skeleton.roots), motion.fps) for motion in motions} == {(roots, 30.0)}
    for motion in motions:
        assert 0.2 < np.ptp(motion.positions[..., 1], axis=1).mean() < 2.5, motion


def test_real_views_are_read_as_tracks_and_upright_3d(real_data):
    folder = real_data / "pose2sim_multiview"
    path = folder / "S00_P00_T01_BalancingTrial_multiview.npz"
    single = folder / "S00_P00_T01_BalancingTrial_cam_02.npz"
    tracks, (alone,) = read_keypoints(path), read_keypoints(single)
    assert [track.name.split()[1] for track in tracks] == [f"cam_0{i}" for i in (1, 2, 3, 4)]
    np.testing.assert_array_equal(alone.keypoints, tracks[1].keypoints)
    assert (alone.fps, read_keypoints(path, fps=30)[0].fps) == (60, 30)
    with pytest.warns(MotionFileWarning, match="LEye, REye, LEar, REar, which have no position"):
        motion = load(path)
    head, foot = (motion.skeleton.index(name) for name in ("Nose", "LAnkle"))
    assert (motion.positions[:, head, 1] - motion.positions[:, foot, 1]).min() > 1
    with pytest.raises(MotionFileError, match="use read_keypoints for 2D"):
        load(single)


NAN = np.full((4, 2, 3), np.nan)
NAN[0] = 0
TWO = {"positions": np.zeros((4, 2, 2, 3))}
TRACK = {"keypoints": np.zeros((4, 2, 2)), "confidence": np.ones((4, 2)), "positions": None}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"positions": None}, "expected the key positions, got fps, joint_names, parents"),
        ({"fps": None}, "expected the key fps"),
        ({"joint_names": None}, "expected the key joint_names"),
        (
            {"positions": np.zeros((4, 2))},
            r"positions must have nonempty shape \(L, J, 3\) or .*\(4, 2\)",
        ),
        (
            {"positions": np.zeros((4, 2, 2))},
            r"positions must have nonempty shape .* got \(4, 2, 2\)",
        ),
        (
            {"positions": np.zeros((0, 2, 3))},
            r"positions must have nonempty shape .* got \(0, 2, 3\)",
        ),
        ({"positions": NAN}, "positions must be finite, got 18 values that are NaN"),
        ({"positions": NAN * np.nan}, "24 values that are NaN"),
        ({"positions": np.full((4, 2, 3), np.inf)}, "must be between -1e9 and 1e9, got inf"),
        ({"positions": np.zeros((4, 2, 3), complex)}, "must contain real numbers, got .*complex"),
        ({"positions": np.array([None])}, "numbers or strings in positions .*allow_pickle"),
        ({"fps": np.array([30.0, 60.0])}, r"fps must be one number above 0, got \[30.0, 60.0\]"),
        ({"fps": np.float64("nan")}, "fps must be one number above 0, got nan"),
        ({"joint_names": np.array(["hip"])}, "joint_names must be 2 strings, got"),
        ({"joint_names": np.array([1, 2])}, "joint_names must be 2 strings, got int64"),
        ({"joint_names": np.array(["hip", "hip"])}, r"joint_names must be unique, got \['hip'\]"),
        ({"parents": np.array([-1])}, r"parents must be 2 integers, got shape \(1,\)"),
        ({"parents": np.array([-1, 0.5])}, "parents must be 2 integers"),
        ({"up_axis": "x"}, "up_axis must be 'y' or 'z', got 'x'"),
        ({"up_axis": np.float64(1)}, "up_axis must be a string, got float64"),
        ({"radii": np.array([1.0])}, "radii must have one entry per joint, 2, got 1"),
        ({"rotations": np.zeros((4, 2, 3, 3))}, "expected the key rest_offsets"),
        (
            {"rotations": np.zeros((4, 2, 3)), "rest_offsets": np.zeros((2, 3))},
            r"rotations must have shape \(4, 2, 3, 3\), got \(4, 2, 3\)",
        ),
        (TWO | {"persons": np.array(["a"])}, "persons must be 2 strings, got"),
        (TRACK | {"keypoints": NAN}, r"keypoints must have nonempty shape .* got \(4, 2, 3\)"),
        (
            TRACK | {"confidence": np.ones((4, 3))},
            r"confidence must have shape \(4, 2\), got \(4, 3",
        ),
        (TRACK | {"confidence": -np.ones((4, 2))}, "confidence must be 0 to 2, got -1"),
    ],
)
def test_defects_are_reported(tmp_path, changes, message):
    path = archive(tmp_path, **changes)
    read = read_keypoints if "confidence" in changes else load
    with pytest.raises(MotionFileError, match=message) as caught:
        read(path)
    assert str(path) in str(caught.value)


def test_invalid_archives_are_refused(tmp_path):
    single = io.BytesIO()
    np.save(single, np.zeros(3))
    path = tmp_path / "clip.npz"
    for content in (b"", b"HIERARCHY\n", single.getvalue(), b"PK\x03\x04 rest"):
        path.write_bytes(content)
        with pytest.raises(MotionFileError, match="expected an npz archive"):
            load(path)
    with pytest.raises(FileNotFoundError):
        read_keypoints(tmp_path / "none.npz")
    with pytest.raises(ValueError, match=r"people must be None for \.npz files, got 1"):
        read_keypoints(path, people=1)


def test_failed_writes_leave_no_file(tmp_path):
    motion = load(archive(tmp_path))
    with pytest.raises(OSError, match=r"cannot write .*choose a writable folder"):
        save(motion, tmp_path / "none" / "clip.npz")
    with pytest.raises(ValueError, match=r"path must end in \.bvh, .*\.trc or \.csv, got '\.txt'"):
        save(motion, tmp_path / "clip.txt")
    assert [path.name for path in tmp_path.iterdir()] == ["clip.npz"]
