"""npz archives: exact round trips, real clips, and every defect named by its key."""

from __future__ import annotations

import io
import os
import re
from pathlib import Path

import numpy as np
import pytest

from probmotion.io.errors import MotionFileError, MotionFileWarning
from probmotion.io.files import read_keypoints, read_motion, save_motion
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton

DATA = Path(__file__).parents[3] / "shared" / "data"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="no ../shared/data beside the checkout")


def arrays(**changes: object) -> dict[str, object]:
    """A valid archive's content with some keys changed; None takes a key away."""
    content: dict[str, object] = {
        "positions": np.arange(24.0).reshape(4, 2, 3),
        "fps": np.float32(30),
        "joint_names": np.array(["hip", "knee"]),
        "parents": np.array([-1, 0], dtype=np.int32),
    }
    content |= changes
    return {key: value for key, value in content.items() if value is not None}


def archive(folder: Path, **changes: object) -> Path:
    path = folder / "clip.npz"
    np.savez(path, **arrays(**changes))
    return path


def test_a_motion_reads_back_exactly(tmp_path: Path) -> None:
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
    save_motion(motion, tmp_path / "clip.npz")
    back = read_motion(tmp_path / "clip.npz")
    for name in ("positions", "rotations", "rest_offsets"):
        np.testing.assert_array_equal(getattr(back, name), getattr(motion, name))
    assert (back.skeleton, back.fps, back.name) == (skeleton, 59.94, "take 3")
    assert back.skeleton.radii == skeleton.radii


def test_an_unnamed_motion_is_called_after_its_file(tmp_path: Path) -> None:
    save_motion(read_motion(archive(tmp_path)), tmp_path / "walk.npz")
    save_motion(Motion(np.zeros((1, 1, 3)), Skeleton(["a"], [-1]), 1), tmp_path / "still.npz")
    assert read_motion(tmp_path / "walk.npz").name == "clip"
    assert read_motion(tmp_path / "still.npz").name == "still"


def test_people_become_one_skeleton_with_a_root_each(tmp_path: Path) -> None:
    positions = np.random.default_rng(0).normal(size=(4, 2, 2, 3))
    path = archive(tmp_path, positions=positions, persons=np.array(["lead", "follow"]))
    motion = read_motion(path)
    assert motion.skeleton == Skeleton(
        ["lead:hip", "lead:knee", "follow:hip", "follow:knee"], [-1, 0, -1, 2]
    )
    np.testing.assert_array_equal(motion.positions[:, 2], positions[:, 1, 0])
    assert read_motion(archive(tmp_path, positions=positions)).skeleton.joint_names == (
        "person0:hip",
        "person0:knee",
        "person1:hip",
        "person1:knee",
    )


def test_a_world_with_z_up_is_turned_not_mirrored(tmp_path: Path) -> None:
    axes = np.stack([np.eye(3), np.eye(3)], axis=1)  # x̂, ŷ, ẑ of a Z-up world in three frames
    x, y, z = read_motion(archive(tmp_path, positions=axes, up_axis="z")).positions[:, 0]
    np.testing.assert_array_equal(z, [0, 1, 0])
    np.testing.assert_array_equal(np.cross(x, y), z)


def test_joints_without_any_position_are_left_out_and_named(tmp_path: Path) -> None:
    positions = np.random.default_rng(0).normal(size=(4, 3, 3))
    positions[:, 1] = np.nan
    names, parents = np.array(["hip", "knee", "foot"]), np.array([-1, 0, 1])
    changes = {"positions": positions, "joint_names": names, "parents": parents}
    with pytest.warns(MotionFileWarning, match="the joints knee have no position in any frame"):
        motion = read_motion(archive(tmp_path, **changes))
    assert motion.skeleton == Skeleton(["hip", "foot"], [-1, 0])
    np.testing.assert_array_equal(motion.positions, positions[:, [0, 2]])


@needs_data
@pytest.mark.parametrize(
    ("folder", "clips", "joints", "roots"),
    [
        ("cmu_salsa_pairs", 10, {50}, 2),
        ("cmu_single", 26, {31, 38}, 1),
        ("deepmimic_human", 22, {15}, 1),
        ("deepmimic_dog", 4, {23}, 1),
    ],
)
def test_every_real_clip_reads(folder: str, clips: int, joints: set[int], roots: int) -> None:
    motions = [read_motion(path) for path in sorted((DATA / folder).glob("*.npz"))]
    assert len(motions) == clips
    assert {motion.skeleton.n_joints for motion in motions} == joints
    assert {len(motion.skeleton.roots) for motion in motions} == {roots}
    assert {motion.fps for motion in motions} == {30.0}
    for motion in motions:
        assert 0.2 < np.ptp(motion.positions[..., 1], axis=1).mean() < 2.5, motion


@needs_data
def test_real_views_read_as_tracks_and_their_3d_stands_upright() -> None:
    folder = DATA / "pose2sim_multiview"
    path = folder / "S00_P00_T01_BalancingTrial_multiview.npz"
    tracks = read_keypoints(path)
    assert [track.name.split()[1] for track in tracks] == [f"cam_0{i}" for i in (1, 2, 3, 4)]
    (alone,) = read_keypoints(folder / "S00_P00_T01_BalancingTrial_cam_02.npz")
    np.testing.assert_array_equal(alone.keypoints, tracks[1].keypoints)
    assert alone.fps == 60
    assert read_keypoints(path, fps=30)[0].fps == 30
    unseen = np.isnan(alone.keypoints).any(axis=-1)
    np.testing.assert_array_equal(unseen, alone.confidence == 0)
    with pytest.warns(MotionFileWarning, match="LEye, REye, LEar, REar have no position"):
        motion = read_motion(path)
    names = motion.skeleton.joint_names
    head, foot = names.index("Nose"), names.index("LAnkle")
    assert (motion.positions[:, head, 1] - motion.positions[:, foot, 1]).min() > 1


@needs_data
def test_a_2d_archive_is_no_motion() -> None:
    path = DATA / "pose2sim_multiview" / "S00_P00_T01_BalancingTrial_cam_02.npz"
    with pytest.raises(MotionFileError, match="use read_keypoints for 2D"):
        read_motion(path)


NAN = np.full((4, 2, 3), np.nan)
NAN[0] = 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"positions": None}, "key positions must be .*keys found are fps, got missing"),
        ({"fps": None}, "key fps is missing"),
        ({"parents": None}, "key parents is missing"),
        ({"joint_names": None}, "key joint_names is missing"),
        ({"positions": np.zeros((4, 2))}, r"positions must have shape \(L, J, 3\), got \(4, 2\)"),
        ({"positions": np.zeros((4, 2, 2))}, r"positions has shape \(4, 2, 2\)"),
        ({"positions": np.zeros((0, 2, 3))}, r"positions has shape \(0, 2, 3\)"),
        ({"positions": np.zeros((4, 0, 2, 3))}, r"positions has shape"),
        ({"positions": NAN}, "positions must be finite, got 18 values that are NaN"),
        ({"positions": np.full((4, 2, 3), np.nan)}, "24 values that are NaN"),
        ({"positions": np.full((4, 2, 3), np.inf)}, "positions holds inf"),
        ({"positions": np.full((4, 2, 3), 1e30)}, r"positions holds 1e\+30"),
        ({"positions": np.zeros((4, 2, 3), complex)}, "positions is of .*complex128"),
        ({"positions": np.array([["a"]])}, "positions is of .*U1"),
        ({"positions": np.array([None])}, "key positions cannot be read .*allow_pickle"),
        ({"fps": np.float64(0)}, "fps must be one number above 0, got 0.0"),
        ({"fps": np.array([30.0, 60.0])}, r"fps is \[30.0, 60.0\]"),
        ({"fps": np.float64("nan")}, "fps is nan"),
        ({"joint_names": np.array(["hip"])}, "joint_names .*expected 2 strings"),
        ({"joint_names": np.array([1, 2])}, "joint_names is of .*int64"),
        ({"joint_names": np.array(["hip", "hip"])}, r"joint_names repeats \['hip'\]"),
        ({"parents": np.array([1, 0])}, "parents form a cycle"),
        ({"parents": np.array([-1, 7])}, r"parents\[1\] \(knee\) is 7"),
        ({"parents": np.array([-1])}, r"parents must have shape 2 integers, got \(1,\)"),
        ({"parents": np.array([-1, 0.5])}, "expected 2 integers"),
        ({"up_axis": "x"}, "up_axis must be 'y' or 'z', got 'x'"),
        ({"up_axis": np.float64(1)}, "up_axis is of .*expected a string"),
        ({"radii": np.array([1.0])}, "radii has shape"),
        ({"rotations": np.zeros((4, 2, 3, 3))}, "key rest_offsets is missing"),
        (
            {"rotations": np.zeros((4, 2, 3)), "rest_offsets": np.zeros((2, 3))},
            r"rotations must have shape \(4, 2, 3, 3\), got \(4, 2, 3\)",
        ),
        (
            {"positions": np.zeros((4, 3, 2, 3)), "persons": np.array(["a", "b"])},
            "persons .*expected 3 strings",
        ),
        (
            {"positions": np.zeros((4, 2, 2, 3)), "persons": np.array(["a", "a"])},
            "joint_names repeats",
        ),
    ],
)
def test_a_defect_is_one_sentence_with_its_key(
    tmp_path: Path, changes: dict[str, object], message: str
) -> None:
    path = archive(tmp_path, **changes)
    with pytest.raises(MotionFileError) as caught:
        read_motion(path)
    said = str(caught.value)
    assert re.search(message, said), said
    assert str(path) in said
    assert "expected" in said
    assert "\n" not in said


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"keypoints": None}, "key keypoints is missing"),
        ({"keypoints": np.zeros((4, 2, 3))}, r"keypoints has shape \(4, 2, 3\)"),
        ({"confidence": np.ones((4, 3))}, r"confidence must have shape \(4, 2\), got \(4, 3\)"),
        ({"confidence": -np.ones((4, 2))}, "confidence is -1 at its least"),
        ({"confidence": np.full((4, 2), 95.0)}, "confidence is 95 at its most, expected 0 .* to 1"),
        ({"keypoints": np.full((4, 2, 2), np.nan)}, "not finite at frame 0, joint 0"),
    ],
)
def test_a_defect_of_a_track_names_its_key(
    tmp_path: Path, changes: dict[str, object], message: str
) -> None:
    track = {"keypoints": np.zeros((4, 2, 2)), "confidence": np.ones((4, 2)), "positions": None}
    with pytest.raises(MotionFileError, match=message):
        read_keypoints(archive(tmp_path, **(track | changes)))


def test_files_that_are_no_archive(tmp_path: Path) -> None:
    single = io.BytesIO()
    np.save(single, np.zeros(3))
    path = tmp_path / "clip.npz"
    for content in (b"", b"HIERARCHY\n", single.getvalue(), b"PK\x03\x04 rest"):
        path.write_bytes(content)
        with pytest.raises(MotionFileError, match="is no npz archive"):
            read_motion(path)
    with pytest.raises(FileNotFoundError):
        read_motion(tmp_path / "none.npz")
    with pytest.raises(FileNotFoundError):
        read_keypoints(tmp_path / "none.npz")


def test_a_failed_write_names_the_folder_and_keeps_the_old_file(tmp_path: Path) -> None:
    motion = read_motion(archive(tmp_path))
    with pytest.raises(OSError, match=r"cannot write .*expected a folder that is writable"):
        save_motion(motion, tmp_path / "none" / "clip.npz")
    with pytest.raises(ValueError, match=r"ends in '\.txt', expected \.bvh or \.npz"):
        save_motion(motion, tmp_path / "clip.txt")
    if os.geteuid() != 0:  # root writes everywhere
        tmp_path.chmod(0o500)
        with pytest.raises(OSError, match="cannot write"):
            save_motion(motion, tmp_path / "other.npz")
        tmp_path.chmod(0o700)
    assert [path.name for path in tmp_path.iterdir()] == ["clip.npz"]
