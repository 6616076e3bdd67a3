"""Bone lengths from noisy joints, against known lengths and for occluded bones."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion import Joints3D, Motion, Skeleton, seeds
from probmotion.data.synthetic.gaits import make_gait
from probmotion.posteriors.bone_lengths import bone_lengths

PERSON = Skeleton.preset("person14")


def body(frames=60):
    motion = make_gait("run", 3, frames=frames).retarget(PERSON)
    lengths = np.zeros(14)
    for joint, parent in PERSON.bones:
        lengths[joint] = np.linalg.norm(motion.positions[0, joint] - motion.positions[0, parent])
    return motion, lengths


def estimates(noise, degrees_of_freedom=None, confidence=None, repeats=200, frames=60):
    """Estimates from independent noise (repeats, bones), and the true lengths (bones,)."""
    motion, lengths = body(frames)
    shown = np.ones((frames, 14)) if confidence is None else confidence
    blank = Joints3D(motion.positions, noise, shown, degrees_of_freedom, PERSON, 30.0)
    found = []
    for number in range(repeats):
        seen = blank.simulate(seeds.generator(number, "bones"), motion.positions)
        found.append(bone_lengths(seen.joints, shown, PERSON, noise, degrees_of_freedom))
    bones = lengths > 0
    return np.array(found)[:, bones], lengths[bones]


def test_lengths_are_exact_without_noise_for_any_placement():
    motion, lengths = body()
    found = bone_lengths(motion.positions, None, PERSON, 1e-9)
    np.testing.assert_allclose(found, lengths, atol=1e-12)
    turned = motion.turned(1.0).positions + np.array([3.0, 0.0, -5.0])
    np.testing.assert_allclose(bone_lengths(turned, None, PERSON, 1e-9), lengths, atol=1e-12)
    robust = bone_lengths(motion.positions, None, PERSON, 1e-6, 4.0)
    np.testing.assert_allclose(robust, lengths, atol=2e-5)


def test_squared_lengths_are_unbiased_under_gaussian_noise():
    confidence = seeds.generator(0, "confidence").uniform(0.2, 3.0, (60, 14))
    for shown in (None, confidence):
        found, lengths = estimates(0.03, confidence=shown, repeats=400)
        squares = found**2
        error = squares.std(axis=0) / np.sqrt(400)
        # 12 bones: 4 standard errors are exceeded once in a thousand runs.
        assert (abs(squares.mean(axis=0) - lengths**2) < 4 * error).all()
    # The average length itself is biased by more than 10 %.
    motion, lengths = body()
    seen = Joints3D.observe(motion, 0.03, 0).joints
    assert np.linalg.norm(seen[:, 8] - seen[:, 0], axis=-1).mean() > 1.1 * lengths[8]


def test_frames_are_weighted_by_confidence():
    confidence = np.ones((60, 14))
    confidence[30:] = 0.01
    found, _ = estimates(0.01, confidence=confidence)
    alone, _ = estimates(0.01, frames=30)
    # Frames with ten times the noise hardly change the standard deviation.
    ratio = found.std(axis=0) / alone.std(axis=0)
    assert 0.8 < np.median(ratio) < 1.05
    assert ratio.max() < 1.3


@pytest.mark.parametrize("degrees_of_freedom", [2.0, 4.0])
def test_bias_under_student_t_noise_is_millimetres(degrees_of_freedom):
    repeats = 16
    found, lengths = estimates(0.03, degrees_of_freedom, repeats=repeats)
    error = np.median(found, axis=0) - lengths
    assert abs(error).max() < 0.012
    assert np.sqrt((error**2).mean()) < 0.005
    # The Gaussian estimate is biased by centimetres.
    motion, _ = body()
    gaussian = []
    for seed in range(repeats):
        seen = Joints3D.observe(motion, 0.03, seed, degrees_of_freedom=degrees_of_freedom).joints
        found = bone_lengths(seen, None, PERSON, 0.03)
        gaussian.append(found[found > 0] - lengths)
    assert np.median(gaussian) > 2 * np.sqrt((error**2).mean())


def test_the_median_is_robust_to_one_outlying_frame():
    motion, lengths = body(61)
    seen = Joints3D.observe(motion, 0.005, 1, degrees_of_freedom=4.0).joints
    wild = seen.copy()
    wild[7] += seeds.generator(2, "wild").normal(0, 100.0, (14, 3))
    calm = bone_lengths(seen, None, PERSON, 0.005, 4.0)
    np.testing.assert_allclose(bone_lengths(wild, None, PERSON, 0.005, 4.0), calm, atol=0.003)
    np.testing.assert_allclose(calm, lengths, atol=0.006)


def test_occluded_bones_take_the_length_of_their_mirror_image():
    motion, lengths = body()
    confidence = np.ones((60, 14))
    confidence[:, PERSON.index("left_wrist")] = 0
    # The ends of the right shin are never visible together.
    confidence[:30, PERSON.index("right_knee")] = 0
    confidence[30:, PERSON.index("right_ankle")] = 0
    joints = np.where(confidence[..., None] > 0, motion.positions, np.nan)
    found = bone_lengths(joints, confidence, PERSON, 1e-9)
    np.testing.assert_allclose(found, lengths, atol=1e-12)
    assert found[PERSON.index("left_wrist")] == found[PERSON.index("right_wrist")]


def test_bones_without_estimate_need_typical_lengths():
    motion, lengths = body()
    confidence = np.ones((60, 14))
    confidence[:, [PERSON.index("left_wrist"), PERSON.index("right_wrist")]] = 0
    with pytest.raises(ValueError, match="from left_elbow to left_wrist, or its mirror image"):
        bone_lengths(motion.positions, confidence, PERSON, 0.001)
    found = bone_lengths(motion.positions, confidence, PERSON, 1e-9, typical=np.full(14, 0.21))
    hands = confidence[0] == 0
    np.testing.assert_array_equal(found[hands], 0.21)
    np.testing.assert_allclose(found[~hands], lengths[~hands], atol=1e-12)
    # The neck is its own mirror image.
    confidence = np.ones((60, 14))
    confidence[:, PERSON.index("neck")] = 0
    with pytest.raises(ValueError, match="bone from pelvis to neck"):
        bone_lengths(motion.positions, confidence, PERSON, 0.001)


@pytest.mark.parametrize("degrees_of_freedom", [None, 3.0])
def test_bones_shorter_than_the_noise_have_no_estimate(degrees_of_freedom):
    point = Motion(np.zeros((40, 14, 3)), PERSON, 30.0)
    seen = Joints3D.observe(point, 0.02, 0, degrees_of_freedom=degrees_of_freedom).joints
    found = bone_lengths(seen, None, PERSON, 0.04, degrees_of_freedom, np.full(14, 7.0))
    np.testing.assert_array_equal(found, [0.0] + [7.0] * 13)


JOINTS = np.zeros((5, 14, 3))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"joints": JOINTS[:, :3]}, "joints must have shape"),
        ({"confidence": np.ones((5, 3))}, "confidence must have shape"),
        ({"noise": 0.0}, "noise must be a finite number above 0"),
        ({"degrees_of_freedom": -1.0}, "degrees_of_freedom must be a finite number above 0"),
        ({"joints": JOINTS * np.nan}, "joints must be finite, got 210 values"),
        ({"typical": np.ones(3)}, "typical must have shape"),
    ],
)
def test_invalid_arguments(changes, message):
    given = {"joints": JOINTS, "confidence": None, "skeleton": PERSON, "noise": 0.01} | changes
    with pytest.raises(ValueError, match=message):
        bone_lengths(**given)
