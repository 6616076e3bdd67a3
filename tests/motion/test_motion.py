"""Motions and keypoint tracks: what they hold and what they refuse."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from probmotion import KeypointTrack, Motion, Skeleton
from probmotion.io.files import load_motions, save_motion

CHAIN = Skeleton(["hip", "knee", "ankle"], [-1, 0, 1])


def chain_motion(frames: int = 5, fps: float = 30.0) -> Motion:
    rng = np.random.default_rng(1)
    return Motion(rng.standard_normal((frames, 3, 3)), CHAIN, fps, name="clip")


def test_a_clip_knows_its_length() -> None:
    motion = chain_motion(frames=31)
    assert motion.frames == 31
    assert motion.duration == pytest.approx(1.0)
    assert chain_motion(frames=1).duration == 0
    assert repr(motion) == "Motion(clip: 31 frames at 30 fps, 3 joints)"


def test_bad_positions_are_refused_in_one_sentence() -> None:
    good = np.zeros((4, 3, 3))
    with pytest.raises(ValueError, match=r"positions must have shape \(L, 3, 3\), got \(4, 2, 3\)"):
        Motion(good[:, :2], CHAIN, 30)
    with pytest.raises(ValueError, match=r"positions must have shape \(L, 3, 3\), got \(3, 3\)"):
        Motion(good[0], CHAIN, 30)
    with pytest.raises(ValueError, match="positions has no frame, expected at least one"):
        Motion(good[:0], CHAIN, 30)
    for bad in (np.nan, np.inf, -np.inf):
        broken = good.copy()
        broken[2, 1, 0] = bad
        wanted = r"positions must be finite, got 1 values that are NaN or infinite, the first at index \(2, 1, 0\)"
        with pytest.raises(ValueError, match=wanted):
            Motion(broken, CHAIN, 30)


@pytest.mark.parametrize("fps", [0, -30, np.nan, np.inf])
def test_a_wrong_frame_rate_is_refused(fps: float) -> None:
    with pytest.raises(ValueError, match=r"fps is .*expected a finite number above 0"):
        Motion(np.zeros((2, 3, 3)), CHAIN, fps)


def test_rotations_come_with_their_rest_pose() -> None:
    positions, turns = np.zeros((2, 3, 3)), np.tile(np.eye(3), (2, 3, 1, 1))
    with pytest.raises(
        ValueError, match="rotations and rest_offsets are given one without the oth"
    ):
        Motion(positions, CHAIN, 30, rotations=turns)
    with pytest.raises(
        ValueError, match=r"rotations must have shape \(2, 3, 3, got \(1, 3, 3, 3\)"
    ):
        Motion(positions, CHAIN, 30, rotations=turns[:1], rest_offsets=np.zeros((3, 3)))
    with pytest.raises(ValueError, match=r"rest_offsets must have shape \(3, 3\), got \(2, 3\)"):
        Motion(positions, CHAIN, 30, rotations=turns, rest_offsets=np.zeros((2, 3)))
    broken = turns.copy()
    broken[1, 2] = np.nan
    with pytest.raises(
        ValueError, match="rotations must be finite, got 9 values that are NaN or infinite"
    ):
        Motion(positions, CHAIN, 30, rotations=broken, rest_offsets=np.zeros((3, 3)))


def test_a_window_is_a_part_of_the_clip() -> None:
    motion = chain_motion(frames=10)
    part = motion.window(3, 4)
    np.testing.assert_array_equal(part.positions, motion.positions[3:7])
    assert part.fps == motion.fps
    for start, frames in ((-1, 4), (7, 4), (0, 11)):
        with pytest.raises(ValueError, match="expected a window inside the 10 frames of clip"):
            motion.window(start, frames)
    with pytest.raises(ValueError, match="frames must be an integer of at least 1, got 0"):
        motion.window(0, 0)


def test_centring_moves_the_first_root_alone_to_the_origin() -> None:
    motion = chain_motion()
    centred = motion.centred()
    np.testing.assert_allclose(centred.positions[:, 0].mean(axis=0), 0, atol=1e-15)
    shift = motion.positions - centred.positions
    np.testing.assert_allclose(shift, np.broadcast_to(shift[0, 0], shift.shape), atol=1e-15)


def test_turning_is_about_the_vertical_axis_from_z_to_x() -> None:
    motion = Motion(np.array([[[0, 0, 1.0], [1.0, 0, 0], [0, 2.0, 0]]]), CHAIN, 30)
    turned = motion.turned(np.pi / 2)
    np.testing.assert_allclose(
        turned.positions[0], [[1.0, 0, 0], [0, 0, -1.0], [0, 2.0, 0]], atol=1e-15
    )


def test_bad_tracks_are_refused_in_one_sentence() -> None:
    points, shown = np.zeros((4, 3, 2)), np.ones((4, 3))
    with pytest.raises(ValueError, match=r"keypoints must have shape \(L, 3, 2\), got \(4, 3, 3\)"):
        KeypointTrack(np.zeros((4, 3, 3)), shown, CHAIN, 30)
    with pytest.raises(ValueError, match=r"confidence must have shape \(4, 3\), got \(4, 2\)"):
        KeypointTrack(points, shown[:, :2], CHAIN, 30)
    with pytest.raises(ValueError, match="keypoints has no frame"):
        KeypointTrack(points[:0], shown[:0], CHAIN, 30)
    with pytest.raises(ValueError, match="confidence is -1 at its least, expected 0 or more"):
        KeypointTrack(points, -shown, CHAIN, 30)
    with pytest.raises(
        ValueError, match="confidence must be finite, got 12 values that are NaN or infinite"
    ):
        KeypointTrack(points, np.nan * shown, CHAIN, 30)
    points[2, 1, 0] = np.nan
    with pytest.raises(ValueError, match="keypoints is not finite at frame 2, joint 1, where conf"):
        KeypointTrack(points, shown, CHAIN, 30)
    shown[2, 1] = 0
    assert np.isnan(KeypointTrack(points, shown, CHAIN, 30).keypoints[2, 1, 0])


def test_a_pattern_without_files_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"paths has '.*\*\.bvh', which matches no file"):
        load_motions(tmp_path / "*.bvh")


def test_clips_of_a_folder_come_sorted_and_at_one_rate(tmp_path: Path) -> None:
    for name, fps in (("b", 60.0), ("a", 30.0)):
        motion = chain_motion(frames=int(fps) + 1, fps=fps)
        save_motion(Motion(motion.positions, CHAIN, fps, name=name), tmp_path / f"{name}.npz")
    motions = load_motions(tmp_path / "*.npz", fps=20)
    assert [motion.name for motion in motions] == ["a", "b"]
    assert [(motion.fps, motion.frames) for motion in motions] == [(20.0, 21)] * 2
    one = load_motions([str(tmp_path / "b.npz")])
    assert [motion.fps for motion in one] == [60.0]


def test_rotations_that_are_none_are_refused() -> None:
    skeleton = Skeleton(["root", "tip"], [-1, 0])
    rest = np.array([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    with pytest.raises(ValueError, match="rotations is off orthonormal matrices by 1, expected"):
        Motion(np.zeros((3, 2, 3)), skeleton, 30.0, np.zeros((3, 2, 3, 3)), rest)
