"""Bone lengths from noisy joints: against known lengths, and where a bone is not seen."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion import Joints3D, Motion, Skeleton, seeds
from probmotion.data.synthetic.gaits import make_gait
from probmotion.posteriors.bone_lengths import bone_lengths

PERSON = Skeleton.preset("person14")


def body(frames: int = 60) -> tuple[Motion, np.ndarray]:
    motion = make_gait("run", 3, frames=frames).retarget(PERSON)
    lengths = np.zeros(14)
    for joint, parent in PERSON.bones:
        lengths[joint] = np.linalg.norm(
            motion.positions[0, joint] - motion.positions[0, parent], axis=-1
        )
    return motion, lengths


def estimates(
    noise: float, degrees_of_freedom: float | None = None, confidence: np.ndarray | None = None,
    repeats: int = 200, frames: int = 60,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Estimates (repeats, 14) from noise drawn anew, and the true lengths (14,)."""
    motion, lengths = body(frames)
    shown = np.ones((frames, 14)) if confidence is None else confidence
    blank = Joints3D(motion.positions, noise, shown, degrees_of_freedom, PERSON, 30.0)
    found = []
    for number in range(repeats):
        seen = blank.simulate(seeds.generator(number, "bones"), motion.positions)
        found.append(bone_lengths(seen.joints, shown, PERSON, noise, degrees_of_freedom))
    return np.array(found), lengths


def test_without_noise_lengths_are_exact() -> None:
    motion, lengths = body()
    found = bone_lengths(motion.positions, None, PERSON, 1e-9)
    np.testing.assert_allclose(found, lengths, atol=1e-12)
    # Bone lengths of a body that moves elsewhere are its own.
    turned = motion.turned(1.0).positions + np.array([3.0, 0.0, -5.0])
    np.testing.assert_allclose(bone_lengths(turned, None, PERSON, 1e-9), lengths, atol=1e-12)
    robust = bone_lengths(motion.positions, None, PERSON, 1e-6, 4.0)
    np.testing.assert_allclose(robust, lengths, atol=2e-5)


def test_squared_lengths_have_no_bias_under_gaussian_noise() -> None:
    confidence = seeds.generator(0, "confidence").uniform(0.2, 3.0, (60, 14))
    for shown in (None, confidence):
        found, lengths = estimates(0.03, confidence=shown, repeats=400)
        bones = lengths > 0
        squares = found[:, bones] ** 2
        error = squares.std(axis=0) / np.sqrt(400)
        # Twelve bones: 4 standard errors are passed in one of a thousand runs.
        assert (abs(squares.mean(axis=0) - lengths[bones] ** 2) < 4 * error).all()
    # What the correction is for: without it a hip's bone is a third longer.
    seen = Joints3D.observe(body()[0], 0.03, 0).joints
    plain = np.linalg.norm(seen[:, 8] - seen[:, 0], axis=-1).mean()
    assert plain > 1.1 * lengths[8]


def test_confident_frames_count_for_more() -> None:
    confidence = np.ones((60, 14))
    confidence[30:] = 0.01
    found, lengths = estimates(0.01, confidence=confidence)
    alone, _ = estimates(0.01, frames=30)
    bones = lengths > 0
    # Frames with ten times the noise neither spoil the others nor add much to them.
    ratio = found.std(axis=0)[bones] / alone.std(axis=0)[bones]
    assert 0.8 < np.median(ratio) < 1.05
    assert ratio.max() < 1.3


@pytest.mark.parametrize("degrees_of_freedom", [2.0, 4.0])
def test_heavy_tails_leave_a_bias_of_millimetres(degrees_of_freedom: float) -> None:
    found, lengths = estimates(0.03, degrees_of_freedom, repeats=25)
    bones = lengths > 0
    error = np.median(found, axis=0)[bones] - lengths[bones]
    assert abs(error).max() < 0.012
    assert np.sqrt((error**2).mean()) < 0.005
    # The same noise taken for Gaussian: bones look longer by centimetres.
    motion, _ = body()
    taken = []
    for seed in range(25):
        seen = Joints3D.observe(motion, 0.03, seed, degrees_of_freedom=degrees_of_freedom).joints
        taken.append(bone_lengths(seen, None, PERSON, 0.03)[bones] - lengths[bones])
    assert np.median(taken) > 2 * np.sqrt((error**2).mean())


def test_one_wild_frame_does_not_matter_to_the_median() -> None:
    motion, lengths = body(61)
    seen = Joints3D.observe(motion, 0.005, 1, degrees_of_freedom=4.0).joints
    wild = seen.copy()
    wild[7] += seeds.generator(2, "wild").normal(0, 100.0, (14, 3))
    calm = bone_lengths(seen, None, PERSON, 0.005, 4.0)
    np.testing.assert_allclose(bone_lengths(wild, None, PERSON, 0.005, 4.0), calm, atol=0.003)
    np.testing.assert_allclose(calm, lengths, atol=0.006)


def test_very_many_degrees_of_freedom_are_gaussian() -> None:
    seen = Joints3D.observe(body(400)[0], 0.01, 0).joints
    gaussian = bone_lengths(seen, None, PERSON, 0.01)
    median = bone_lengths(seen, None, PERSON, 0.01, 1e6)
    np.testing.assert_allclose(median, gaussian, atol=0.004)


def test_a_bone_that_is_not_seen_is_its_mirror_images() -> None:
    motion, lengths = body()
    confidence = np.ones((60, 14))
    confidence[:, PERSON.index("left_wrist")] = 0
    # Each end of the right shin is seen, but never both at once.
    confidence[:30, PERSON.index("right_knee")] = 0
    confidence[30:, PERSON.index("right_ankle")] = 0
    joints = np.where(confidence[..., None] > 0, motion.positions, np.nan)
    found = bone_lengths(joints, confidence, PERSON, 1e-9)
    np.testing.assert_allclose(found, lengths, atol=1e-12)
    assert found[PERSON.index("left_wrist")] == found[PERSON.index("right_wrist")]


def test_a_bone_that_nothing_shows_is_an_error_or_typical() -> None:
    motion, lengths = body()
    confidence = np.ones((60, 14))
    confidence[:, [PERSON.index("left_wrist"), PERSON.index("right_wrist")]] = 0
    with pytest.raises(ValueError, match="bone from left_elbow to left_wrist, nor of its mirror"):
        bone_lengths(motion.positions, confidence, PERSON, 0.001)
    typical = np.full(14, 0.21)
    found = bone_lengths(motion.positions, confidence, PERSON, 1e-9, typical=typical)
    hands = confidence[0] == 0
    np.testing.assert_array_equal(found[hands], 0.21)
    np.testing.assert_allclose(found[~hands], lengths[~hands], atol=1e-12)
    # The neck has no mirror image of its own.
    confidence = np.ones((60, 14))
    confidence[:, PERSON.index("neck")] = 0
    with pytest.raises(ValueError, match="bone from pelvis to neck"):
        bone_lengths(motion.positions, confidence, PERSON, 0.001)


@pytest.mark.parametrize("degrees_of_freedom", [None, 3.0])
def test_bones_that_noise_drowns_have_no_length(degrees_of_freedom: float | None) -> None:
    point = Motion(np.zeros((40, 14, 3)), PERSON, 30.0)
    seen = Joints3D.observe(point, 0.02, 0, degrees_of_freedom=degrees_of_freedom).joints
    typical = np.full(14, 7.0)
    found = bone_lengths(seen, None, PERSON, 0.04, degrees_of_freedom, typical)
    np.testing.assert_array_equal(found, [0.0] + [7.0] * 13)


def test_bad_input_is_one_sentence() -> None:
    joints = np.zeros((5, 14, 3))
    with pytest.raises(ValueError, match="joints has shape"):
        bone_lengths(joints[:, :3], None, PERSON, 0.01)
    with pytest.raises(ValueError, match="confidence has shape"):
        bone_lengths(joints, np.ones((5, 3)), PERSON, 0.01)
    with pytest.raises(ValueError, match="noise is 0"):
        bone_lengths(joints, None, PERSON, 0.0)
    with pytest.raises(ValueError, match="degrees_of_freedom is -1"):
        bone_lengths(joints, None, PERSON, 0.01, -1.0)
    with pytest.raises(ValueError, match="joints must be finite, got 42 values that are NaN"):
        bone_lengths(np.where(np.arange(5)[:, None, None] == 2, np.nan, joints), None, PERSON, 0.01)
    with pytest.raises(ValueError, match="typical has shape"):
        bone_lengths(joints, None, PERSON, 0.01, typical=np.ones(3))
