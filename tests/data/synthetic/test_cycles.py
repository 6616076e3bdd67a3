"""Repeated cycles: motion and rotation of the root, seams and rigid groups."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from probmotion import Motion, Skeleton
from probmotion.data.synthetic.cycles import repeated_cycle


def sway(frames, degrees=50.0, miss=0.1):
    """Return a cycle of a trunk that walks a 1 m arc; its end misses its start by ``miss``."""
    skeleton = Skeleton(
        ["pelvis", "tail", "left_hip", "right_hip", "chest", "neck"], [-1, 0, 0, 0, 0, 4]
    )
    time = np.linspace(0, 1, frames)
    arc = np.radians(degrees)
    heading = Rotation.from_rotvec(arc * time[:, None] * [0.0, 1.0, 0.0])
    wave = np.sin(2 * np.pi * time) + miss * time
    roll = heading * Rotation.from_rotvec(0.2 * wave[:, None] * [0.0, 0.0, 1.0])
    pitch = heading * Rotation.from_rotvec(0.3 * wave[:, None] * [1.0, 0.0, 0.0])
    nod = heading * Rotation.from_rotvec(-0.5 * wave[:, None] * [1.0, 0.0, 0.0])
    across = time * np.sinc(arc * time / (2 * np.pi)) * np.sin(arc * time / 2)
    ahead = time * np.sinc(arc * time / np.pi)
    root = np.stack([across, 0.6 + 0.02 * wave, ahead], axis=-1)
    chest = root + pitch.apply([0.0, 0.0, 0.4])
    parts = [
        root, root + roll.apply([0, 0, -0.1]), root + roll.apply([0.1, -0.1, 0]),
        root + roll.apply([-0.1, -0.1, 0]), chest, chest + nod.apply([0, 0.1, 0.2]),
    ]  # fmt: skip
    return Motion(np.stack(parts, axis=1), skeleton, 30.0, name="sway")


def test_mismatch_is_distributed_evenly():
    # With fixed rotation axes, the correction removes exactly the added drift.
    positions = repeated_cycle(sway(21, degrees=0, miss=0.3), 41).positions
    closed = sway(21, degrees=0, miss=0).positions
    np.testing.assert_allclose(positions[:21], closed, atol=1e-12)
    np.testing.assert_allclose(positions[20:], np.add(closed, [0, 0, 1]), atol=1e-12)


def test_cycles_are_rigid_motions_of_the_first():
    period = 20
    cycle = sway(period + 1)
    clip = repeated_cycle(cycle, 3 * period + 5)
    first = clip.positions[: period + 1]
    yaw = Rotation.from_rotvec([0.0, np.radians(50), 0.0])
    for number in (1, 2):
        later = clip.positions[number * period : (number + 1) * period + 1]
        expected = (yaw**number).apply((first - first[0, 0]).reshape(-1, 3)).reshape(first.shape)
        np.testing.assert_allclose(later - later[0, 0], expected, atol=2e-2)
    # Every cycle turns by the same angle.
    heading = clip.positions[:, 2] - clip.positions[:, 3]
    angle = np.unwrap(np.arctan2(-heading[:, 2], heading[:, 0]))
    step = np.diff(angle[[0, period, 2 * period, 3 * period]])
    np.testing.assert_allclose(step, step[0], atol=1e-12)
    assert np.degrees(step[0]) == pytest.approx(50, abs=1)
    travel = (cycle.positions[-1, 0] - cycle.positions[0, 0]) * [1.0, 0.0, 1.0]
    np.testing.assert_allclose(clip.positions[period, 0] - first[0, 0], travel, atol=1e-12)
    np.testing.assert_allclose(clip.positions[::period, 0, 1], 0.6, atol=1e-12)


def test_groups_stay_rigid_and_seams_are_smooth():
    period = 20
    cycle = sway(period + 1)
    clip = repeated_cycle(cycle, 4 * period)
    joints, others = np.array([*cycle.skeleton.bones, (1, 2), (2, 3)]).T
    lengths = np.linalg.norm(clip.positions[:, joints] - clip.positions[:, others], axis=-1)
    expected = np.linalg.norm(cycle.positions[0, joints] - cycle.positions[0, others], axis=-1)
    np.testing.assert_allclose(lengths, np.tile(expected, (clip.frames, 1)), atol=1e-12)
    bends = np.linalg.norm(np.diff(clip.positions, n=2, axis=0), axis=-1).max(axis=-1)
    within = np.linalg.norm(np.diff(cycle.positions, n=2, axis=0), axis=-1).max()
    seams = [number * period - 1 for number in (1, 2, 3)]
    assert bends[seams].max() < 1.2 * within


def test_invalid_cycles():
    cycle = sway(3)
    pair = Motion(np.zeros((4, 2, 3)), Skeleton(["one", "other"], [-1, -1]), 30.0)
    for clip, frames, message in (
        (cycle.window(0, 2), 9, "cycle must have at least 3 frames, got 2"),
        (cycle, 0, "frames must be an integer of at least 1, got 0"),
        (pair, 9, "cycle must have one root, got 2"),
    ):
        with pytest.raises(ValueError, match=message):
            repeated_cycle(clip, frames)
