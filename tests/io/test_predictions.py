"""Predictions of other lifters: reading and defects."""

import numpy as np
import pytest

from probmotion.io.errors import MotionFileError
from probmotion.io.predictions import read_predictions
from probmotion.motion.skeleton import Skeleton

LEG = Skeleton(["pelvis", "left_knee", "right_knee"], [-1, 0, 0])
# Names and order of another program, with an extra joint.
NAMES = np.array(["RightKnee", "nose", "LeftKnee", "Hips"])
RNG = np.random.default_rng(0)
CLIPS = RNG.normal(size=(2, 7, 4, 3))


def archive(folder, **changes):
    """Write a valid file with changed keys; None removes a key."""
    content: dict[str, object] = {"positions": CLIPS, "joint_names": NAMES, "fps": 30.0} | changes
    path = folder / "lifted.npz"
    np.savez(path, **{key: value for key, value in content.items() if value is not None})
    return path


def test_joints_are_matched_and_root_centred(tmp_path):
    found = read_predictions(archive(tmp_path), LEG)
    wanted = CLIPS[:, :, [3, 2, 0]] - CLIPS[:, :, [3]]
    np.testing.assert_allclose(found, wanted, atol=1e-12)


def test_single_motion_is_a_batch_of_one(tmp_path):
    several = read_predictions(archive(tmp_path), LEG)
    one = read_predictions(archive(tmp_path, positions=CLIPS[1]), LEG)
    np.testing.assert_array_equal(one, several[1:])


def test_z_up_is_rotated_to_y_up(tmp_path):
    z_up = np.stack([CLIPS[..., 0], -CLIPS[..., 2], CLIPS[..., 1]], axis=-1)
    found = read_predictions(archive(tmp_path, positions=z_up, up_axis="z"), LEG)
    np.testing.assert_allclose(found, read_predictions(archive(tmp_path), LEG), atol=1e-12)


def test_windows_are_consecutive(tmp_path):
    whole = read_predictions(archive(tmp_path), LEG)
    found = read_predictions(archive(tmp_path), LEG, frames=3)
    assert found.shape == (4, 3, 3, 3)
    np.testing.assert_array_equal(found[2:].reshape(6, 3, 3), whole[1, :6])


def test_resampling_of_linear_motion_is_exact(tmp_path):
    time = np.arange(7)[:, None, None] / 30
    clip = CLIPS[0, :1] + time * RNG.normal(size=(4, 3))
    found = read_predictions(archive(tmp_path, positions=clip), LEG, fps=15.0)
    assert found.shape == (1, 4, 3, 3)
    whole = read_predictions(archive(tmp_path, positions=clip), LEG)
    np.testing.assert_allclose(found, whole[:, ::2], atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"positions": None}, "expected the key positions, got joint_names, fps"),
        ({"joint_names": None}, "expected the key joint_names"),
        ({"fps": None}, "expected the key fps"),
        ({"positions": CLIPS[..., :2]}, r"positions must have shape .*, got \(2, 7, 4, 2\)"),
        ({"positions": CLIPS[0, 0]}, r"positions must have shape .*, got \(4, 3\)"),
        ({"positions": CLIPS[:, :0]}, r"positions must have shape .*, got \(2, 0, 4, 3\)"),
        ({"positions": np.where(CLIPS > 2, np.nan, CLIPS)}, "positions must be finite, got"),
        ({"joint_names": NAMES[:3]}, "joint_names must be 4 strings, got"),
        ({"joint_names": np.array(["a", "a", "b", "c"])}, "joint_names must be unique"),
        ({"joint_names": np.array(["a", "b", "LeftKnee", "Hips"])}, "the joint 'right_knee'"),
        ({"joint_names": np.array(NAMES.tolist(), object)}, "numbers or strings in joint_names"),
        ({"fps": 0.0}, "fps must be one number above 0, got 0.0"),
        ({"up_axis": "x"}, "up_axis must be 'y' or 'z', got 'x'"),
    ],
)
def test_defects_are_reported(tmp_path, changes, message):
    path = archive(tmp_path, **changes)
    with pytest.raises(MotionFileError, match=message) as raised:
        read_predictions(path, LEG)
    assert str(path) in str(raised.value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"frames": 8}, "positions must have at least 8 frames, got 7"),
        ({"frames": 5, "fps": 15.0}, "at least 5 frames, got 4 at 15 frames per second"),
        ({"frames": 0}, "frames must be an integer of at least 1, got 0"),
        ({"fps": -1}, "fps must be a finite number above 0, got -1"),
    ],
)
def test_invalid_windows_and_rates_are_refused(tmp_path, arguments, message):
    with pytest.raises(ValueError, match=message):
        read_predictions(archive(tmp_path), LEG, **arguments)
