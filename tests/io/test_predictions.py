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
    wanted = CLIPS[:, :, [3, 2, 0]] - CLIPS[:, :, [3]]
    z_up = np.stack([CLIPS[..., 0], -CLIPS[..., 2], CLIPS[..., 1]], axis=-1)
    for changes, expected in (
        ({}, wanted),
        ({"positions": CLIPS[1]}, wanted[1:]),  # a single motion
        ({"positions": z_up, "up_axis": "z"}, wanted),
    ):
        positions = read_predictions(archive(tmp_path, **changes), LEG)
        np.testing.assert_allclose(positions, expected, atol=1e-12)
    windows = read_predictions(archive(tmp_path), LEG, frames=3)
    np.testing.assert_allclose(windows, wanted[:, :6].reshape(4, 3, 3, 3), atol=1e-12)


def test_resampling_of_linear_motion_is_exact(tmp_path):
    time = np.arange(7)[:, None, None] / 30
    clip = CLIPS[0, :1] + time * RNG.normal(size=(4, 3))
    positions = read_predictions(archive(tmp_path, positions=clip), LEG, fps=15.0)
    wanted = (clip[:, [3, 2, 0]] - clip[:, [3]])[None, ::2]
    np.testing.assert_allclose(positions, wanted, atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"positions": None}, "expected the key positions, got joint_names, fps"),
        (
            {"positions": CLIPS[..., :2]},
            r"positions must have nonempty shape .* got \(2, 7, 4, 2\)",
        ),
        ({"positions": np.where(CLIPS > 2, np.nan, CLIPS)}, "positions must be finite, got"),
        ({"joint_names": np.array(["a", "a", "b", "c"])}, "joint_names must be unique"),
        (
            {"joint_names": np.array(["a", "b", "LeftKnee", "Hips"])},
            "got 'right_knee', which has no counterpart",
        ),
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
