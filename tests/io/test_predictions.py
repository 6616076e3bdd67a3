"""Predictions of other lifters: they read as motions of our joints, and every defect is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from probmotion.io.errors import MotionFileError
from probmotion.io.predictions import read_predictions
from probmotion.motion.skeleton import Skeleton

LEG = Skeleton(["pelvis", "left_knee", "right_knee"], [-1, 0, 0])
# Another program's order and names, and a joint that nobody asked for.
NAMES = np.array(["RightKnee", "nose", "LeftKnee", "Hips"])
RNG = np.random.default_rng(0)
CLIPS = RNG.normal(size=(2, 7, 4, 3))


def archive(folder: Path, **changes: object) -> Path:
    """A valid file with some keys changed; None takes a key away."""
    content: dict[str, object] = {"positions": CLIPS, "joint_names": NAMES, "fps": 30.0} | changes
    path = folder / "lifted.npz"
    np.savez(path, **{key: value for key, value in content.items() if value is not None})
    return path


def test_joints_are_found_by_name_and_the_root_is_the_origin(tmp_path: Path) -> None:
    found = read_predictions(archive(tmp_path), LEG)
    wanted = CLIPS[:, :, [3, 2, 0]] - CLIPS[:, :, [3]]
    np.testing.assert_allclose(found, wanted, atol=1e-12)


def test_one_motion_is_a_batch_of_one(tmp_path: Path) -> None:
    several = read_predictions(archive(tmp_path), LEG)
    one = read_predictions(archive(tmp_path, positions=CLIPS[1]), LEG)
    np.testing.assert_array_equal(one, several[1:])


def test_a_world_with_z_up_is_turned(tmp_path: Path) -> None:
    """Up becomes Y, and left stays left: the turn is no reflection."""
    z_up = np.stack([CLIPS[..., 0], -CLIPS[..., 2], CLIPS[..., 1]], axis=-1)
    found = read_predictions(archive(tmp_path, positions=z_up, up_axis="z"), LEG)
    np.testing.assert_allclose(found, read_predictions(archive(tmp_path), LEG), atol=1e-12)


def test_windows_follow_each_other(tmp_path: Path) -> None:
    whole = read_predictions(archive(tmp_path), LEG)
    found = read_predictions(archive(tmp_path), LEG, frames=3)
    assert found.shape == (4, 3, 3, 3)
    np.testing.assert_array_equal(found[2:].reshape(6, 3, 3), whole[1, :6])


def test_resampling_keeps_the_time(tmp_path: Path) -> None:
    """A motion of constant speed is the same line at every rate."""
    time = np.arange(7)[:, None, None] / 30
    clip = CLIPS[0, :1] + time * RNG.normal(size=(4, 3))
    found = read_predictions(archive(tmp_path, positions=clip), LEG, fps=15.0)
    assert found.shape == (1, 4, 3, 3)
    whole = read_predictions(archive(tmp_path, positions=clip), LEG)
    np.testing.assert_allclose(found, whole[:, ::2], atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"positions": None}, "key positions must be positions, joint_names and fps, got missing"),
        ({"joint_names": None}, "key joint_names is missing"),
        ({"fps": None}, "key fps is missing"),
        ({"positions": CLIPS[..., :2]}, r"positions has shape \(2, 7, 4, 2\)"),
        ({"positions": CLIPS[0, 0]}, r"positions has shape \(4, 3\)"),
        ({"positions": CLIPS[:, :0]}, r"positions has shape \(2, 0, 4, 3\)"),
        ({"positions": np.where(CLIPS > 2, np.nan, CLIPS)}, "values that are NaN, the first at"),
        ({"positions": np.array(["a"])}, "positions is of dtype"),
        ({"joint_names": NAMES[:3]}, r"joint_names is of .* expected 4 strings"),
        ({"joint_names": np.array(["a", "a", "b", "c"])}, "joint_names"),
        ({"joint_names": np.array(["a", "b", "LeftKnee", "Hips"])}, "the joint 'right_knee'"),
        ({"fps": 0.0}, "fps is 0"),
        ({"up_axis": "x"}, "up_axis must be 'y' or 'z', got 'x'"),
    ],
)
def test_every_defect_is_one_sentence(
    tmp_path: Path, changes: dict[str, object], message: str
) -> None:
    path = archive(tmp_path, **changes)
    with pytest.raises(MotionFileError, match=message) as raised:
        read_predictions(path, LEG)
    assert str(path) in str(raised.value)
    assert "\n" not in str(raised.value)


def test_pickles_are_refused(tmp_path: Path) -> None:
    with pytest.raises(MotionFileError, match="key joint_names cannot be read"):
        read_predictions(archive(tmp_path, joint_names=np.array(NAMES.tolist(), object)), LEG)


def test_a_file_that_is_no_archive_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "lifted.npz"
    path.write_bytes(b"PK but not really")
    with pytest.raises(MotionFileError, match="is no npz archive"):
        read_predictions(path, LEG)
    with pytest.raises(FileNotFoundError):
        read_predictions(tmp_path / "missing.npz", LEG)


def test_short_motions_and_bad_numbers_are_refused(tmp_path: Path) -> None:
    path = archive(tmp_path)
    with pytest.raises(MotionFileError, match="positions has 7 frames, expected at least 8"):
        read_predictions(path, LEG, frames=8)
    with pytest.raises(MotionFileError, match="4 frames at 15 frames per second"):
        read_predictions(path, LEG, frames=5, fps=15.0)
    with pytest.raises(ValueError, match="frames is 0"):
        read_predictions(path, LEG, frames=0)
    with pytest.raises(ValueError, match="fps is -1"):
        read_predictions(path, LEG, fps=-1)
