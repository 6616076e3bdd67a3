"""Resampling of motions to other frame rates."""

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.spatial.transform import Rotation, Slerp

from probmotion import Motion, Skeleton

POINT = Skeleton(["hip"], [-1])


def clip(frames, fps):
    """Point with constant velocity and position equal to time."""
    time = np.arange(frames) / fps
    return Motion(time[:, None, None] * np.array([1.0, 2.0, -3.0]), POINT, fps)


@given(st.integers(1, 200), st.floats(1, 240), st.floats(1, 240))
def test_linear_motion_is_resampled_exactly(frames, fps, other):
    motion = clip(frames, fps)
    resampled = motion.resample(other)
    time = np.arange(resampled.frames) / other
    wanted = np.minimum(time, motion.duration)
    np.testing.assert_allclose(resampled.positions[:, 0, 0], wanted, atol=1e-10)
    assert motion.duration - 1 / other < resampled.duration < motion.duration + 1.1e-3 / other
    assert resampled.fps == other


@pytest.mark.parametrize(("fps", "other"), [(30, 120), (120, 30), (24, 72), (1 / 0.0083333, 30)])
def test_integer_ratios_preserve_duration_and_shared_frames(fps, other):
    motion = Motion(np.random.default_rng(1).standard_normal((241, 1, 3)), POINT, fps)
    resampled = motion.resample(other)
    assert resampled.duration == pytest.approx(motion.duration, abs=2e-5)
    ratio = round(other / fps) or 1
    step = round(fps / other) or 1
    np.testing.assert_allclose(resampled.positions[::ratio], motion.positions[::step], atol=0.01)


def test_edge_cases_of_rate_and_length():
    motion = clip(7, 30)
    assert motion.resample(30) is motion
    assert clip(1, 30).resample(50).frames == 1
    for fps in (0, np.nan):
        with pytest.raises(ValueError, match="fps must be a finite number above 0, got"):
            motion.resample(fps)
    with pytest.raises(ValueError, match="fps must be at most 10000 frames per second"):
        motion.resample(10_001)


def test_rotations_agree_with_scipy_slerp():
    two = Skeleton(["hip", "knee"], [-1, 0])
    turns = Rotation.random(22, rng=3).as_matrix().reshape(11, 2, 3, 3)
    rest = np.ones((2, 3))
    motion = Motion(np.zeros((11, 2, 3)), two, 10, rotations=turns, rest_offsets=rest)
    resampled = motion.resample(30)
    assert resampled.rotations is not None
    for joint in range(2):
        oracle = Slerp(np.arange(11) / 10, Rotation.from_matrix(turns[:, joint]))
        wanted = oracle(np.minimum(np.arange(31) / 30, 1.0)).as_matrix()
        np.testing.assert_allclose(resampled.rotations[:, joint], wanted, atol=1e-10)
    np.testing.assert_array_equal(resampled.rest_offsets, rest)
