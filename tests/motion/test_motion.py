"""Motions and keypoint tracks: operations and validation."""

import numpy as np
import pytest

from probmotion import KeypointTrack, Motion, Skeleton
from probmotion.io.files import load_all, save

CHAIN = Skeleton(["hip", "knee", "ankle"], [-1, 0, 1])


def chain_motion(frames=5, fps=30.0):
    rng = np.random.default_rng(1)
    return Motion(rng.standard_normal((frames, 3, 3)), CHAIN, fps, name="clip")


def test_window_selects_frames():
    motion = chain_motion(frames=10)
    assert motion.duration == pytest.approx(0.3)
    part = motion.window(3, 4)
    np.testing.assert_array_equal(part.positions, motion.positions[3:7])
    assert part.fps == motion.fps
    for start, frames in ((-1, 4), (7, 4), (0, 11)):
        with pytest.raises(ValueError, match=rf"start must be 0 to .*, got {start}"):
            motion.window(start, frames)
    with pytest.raises(ValueError, match="frames must be an integer of at least 1, got 0"):
        motion.window(0, 0)


def test_centred_translates_the_mean_root_to_the_origin():
    motion = chain_motion()
    centred = motion.centred()
    np.testing.assert_allclose(centred.positions[:, 0].mean(axis=0), 0, atol=1e-15)
    shift = motion.positions - centred.positions
    np.testing.assert_allclose(shift, np.broadcast_to(shift[0, 0], shift.shape), atol=1e-15)


def test_turned_rotates_about_the_vertical_from_z_to_x():
    motion = Motion(np.array([[[0, 0, 1.0], [1.0, 0, 0], [0, 2.0, 0]]]), CHAIN, 30)
    expected = [[1.0, 0, 0], [0, 0, -1.0], [0, 2.0, 0]]
    np.testing.assert_allclose(motion.turned(np.pi / 2).positions[0], expected, atol=1e-15)


POSITIONS, TURNS, REST = np.zeros((4, 3, 3)), np.tile(np.eye(3), (4, 3, 1, 1)), np.zeros((3, 3))
POINTS, SEEN = np.zeros((4, 3, 2)), np.ones((4, 3))


def with_nan(array, *index):
    broken = array.copy()
    broken[index] = np.nan
    return broken


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((POSITIONS[:, :2], CHAIN, 30), r"positions must have shape \(L, 3, 3\), got \(4, 2, 3\)"),
        ((POSITIONS[:0], CHAIN, 30), "positions must contain at least one frame, got none"),
        ((with_nan(POSITIONS, 2, 1, 0), CHAIN, 30), r"positions must be finite, got 1 .* \(2, 1,"),
        ((POSITIONS, CHAIN, 0), "fps must be a finite number above 0, got 0"),
        ((POSITIONS, CHAIN, np.inf), "fps must be a finite number above 0, got inf"),
        ((POSITIONS, CHAIN, 30, TURNS), "rotations and rest_offsets must be given together"),
        ((POSITIONS, CHAIN, 30, TURNS[:1], REST), r"rotations must have shape \(4, 3, 3, 3\), got"),
        ((POSITIONS, CHAIN, 30, TURNS, REST[:2]), r"rest_offsets must have shape \(3, 3\), got"),
        ((POSITIONS, CHAIN, 30, with_nan(TURNS, 1, 2), REST), "rotations must be finite, got 9"),
        ((POSITIONS, CHAIN, 30, 0 * TURNS, REST), "rotations must be orthonormal to 0.001, got a"),
    ],
)
def test_invalid_motions_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Motion(*arguments)


@pytest.mark.parametrize(
    ("points", "confidence", "message"),
    [
        (POSITIONS, SEEN, r"keypoints must have shape \(L, 3, 2\), got \(4, 3, 3\)"),
        (POINTS, SEEN[:, :2], r"confidence must have shape \(4, 3\), got \(4, 2\)"),
        (POINTS[:0], SEEN[:0], "keypoints must contain at least one frame, got none"),
        (POINTS, -SEEN, "confidence must be 0 to 2, got -1"),
        (POINTS, 95 * SEEN, "confidence must be 0 to 2, got 95"),
        (POINTS, np.nan * SEEN, "confidence must be finite, got 12 values"),
        (with_nan(POINTS, 2, 1), SEEN, "keypoints must be finite .* at frame 2, joint 1 with"),
    ],
)
def test_invalid_tracks_are_refused(points, confidence, message):
    with pytest.raises(ValueError, match=message):
        KeypointTrack(points, confidence, CHAIN, 30)


def test_tracks_are_flipped_within_the_image():
    track = KeypointTrack(with_nan(POINTS, 2, 1), np.where(SEEN > 2, SEEN, 0.0), CHAIN, 30)
    x, y = np.moveaxis(track.keypoints, -1, 0)
    expected = {"x": (640 - x, y), "y": (x, 480 - y), "xy": (640 - x, 480 - y)}
    for axes, parts in expected.items():
        flipped = track.flipped(axes, (640, 480))
        np.testing.assert_array_equal(flipped.keypoints, np.stack(parts, axis=-1))
    with pytest.raises(ValueError, match="axes must be 'x', 'y' or 'xy', got 'z'"):
        track.flipped("z", (640, 480))


def test_load_all_sorts_and_resamples(tmp_path):
    for name, fps in (("b", 60.0), ("a", 30.0)):
        motion = chain_motion(frames=int(fps) + 1, fps=fps)
        save(Motion(motion.positions, CHAIN, fps, name=name), tmp_path / f"{name}.npz")
    motions = load_all(tmp_path / "*.npz", fps=20)
    assert [motion.name for motion in motions] == ["a", "b"]
    assert [(motion.fps, motion.frames) for motion in motions] == [(20.0, 21)] * 2
    assert [motion.fps for motion in load_all([str(tmp_path / "b.npz")])] == [60.0]
    with pytest.raises(FileNotFoundError, match=r"paths must match a file, got '.*\*\.bvh'"):
        load_all(tmp_path / "*.bvh")
