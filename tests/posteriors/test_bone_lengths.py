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
    bones = motion.positions[0] - motion.positions[0, [max(p, 0) for p in PERSON.parents]]
    return motion, np.linalg.norm(bones, axis=-1)


def estimates(noise, degrees_of_freedom=None, confidence=None, repeats=200, frames=60):
    """Estimates from independent noise (repeats, bones), and the true lengths (bones,)."""
    motion, lengths = body(frames)
    shown = np.ones((frames, 14)) if confidence is None else confidence
    blank = Joints3D(motion.positions, noise, shown, degrees_of_freedom, PERSON, 30.0)
    estimated = []
    for number in range(repeats):
        seen = blank.simulate(seeds.generator(number, "bones"), motion.positions)
        estimated.append(bone_lengths(seen.joints, shown, PERSON, noise, degrees_of_freedom))
    return np.array(estimated)[:, 1:], lengths[1:]


def test_lengths_are_exact_without_noise_for_any_placement():
    motion, lengths = body()
    turned = motion.turned(1.0).positions + np.array([3.0, 0.0, -5.0])
    for joints in (motion.positions, turned):
        np.testing.assert_allclose(bone_lengths(joints, None, PERSON, 1e-9), lengths, atol=1e-12)
        robust = bone_lengths(joints, None, PERSON, 1e-6, 4.0)
        np.testing.assert_allclose(robust, lengths, atol=2e-5)


def test_squared_lengths_are_unbiased_under_gaussian_noise():
    confidence = seeds.generator(0, "confidence").uniform(0.2, 3.0, (60, 14))
    for shown in (None, confidence):
        estimated, lengths = estimates(0.03, confidence=shown)
        error = (estimated**2).std(axis=0) / np.sqrt(len(estimated))
        # 13 bones: 4 standard errors are exceeded once in a thousand runs.
        assert (abs((estimated**2).mean(axis=0) - lengths**2) < 4 * error).all()


def test_frames_are_weighted_by_confidence():
    confidence = np.ones((60, 14))
    confidence[30:] = 0.01
    estimated, _ = estimates(0.01, confidence=confidence)
    alone, _ = estimates(0.01, frames=30)
    # Frames with ten times the noise hardly change the standard deviation.
    ratio = estimated.std(axis=0) / alone.std(axis=0)
    assert 0.8 < np.median(ratio) < 1.05
    assert ratio.max() < 1.3


def test_bias_under_student_t_noise_is_millimetres():
    estimated, lengths = estimates(0.03, 2.0, repeats=10)
    error = np.median(estimated, axis=0) - lengths
    assert abs(error).max() < 0.012
    assert np.sqrt((error**2).mean()) < 0.005


def test_the_median_is_robust_to_one_outlying_frame():
    motion, lengths = body(61)
    joints = Joints3D.observe(motion, 0.005, 1, degrees_of_freedom=4.0).joints.copy()
    joints[7] += seeds.generator(2, "wild").normal(0, 100.0, (14, 3))
    np.testing.assert_allclose(bone_lengths(joints, None, PERSON, 0.005, 4.0), lengths, atol=0.007)


def test_occluded_bones_take_the_length_of_their_mirror_image():
    motion, lengths = body()
    confidence = np.ones((60, 14))
    confidence[:, PERSON.index("left_wrist")] = 0
    # The ends of the right shin are never visible together.
    confidence[:30, PERSON.index("right_knee")] = 0
    confidence[30:, PERSON.index("right_ankle")] = 0
    joints = np.where(confidence[..., None] > 0, motion.positions, np.nan)
    estimated = bone_lengths(joints, confidence, PERSON, 1e-9)
    np.testing.assert_allclose(estimated, lengths, atol=1e-12)


@pytest.mark.parametrize("joints", [["left_wrist", "right_wrist"], ["neck"]])
def test_bones_without_estimate_need_typical_lengths(joints):
    motion, lengths = body()
    confidence = np.ones((60, 14))
    confidence[:, [PERSON.index(name) for name in joints]] = 0
    with pytest.raises(ValueError, match=f"to {joints[0]} or its mirror image"):
        bone_lengths(motion.positions, confidence, PERSON, 0.001)
    typical = np.full(14, 0.21)
    estimated = bone_lengths(motion.positions, confidence, PERSON, 1e-9, typical=typical)
    seen = [joint for joint, parent in PERSON.bones if confidence[0, [joint, parent]].all()]
    np.testing.assert_allclose(estimated[seen], lengths[seen], atol=1e-12)
    np.testing.assert_array_equal(np.delete(estimated, [0, *seen]), 0.21)


@pytest.mark.parametrize("degrees_of_freedom", [None, 3.0])
def test_bones_shorter_than_the_noise_have_no_estimate(degrees_of_freedom):
    point = Motion(np.zeros((40, 14, 3)), PERSON, 30.0)
    seen = Joints3D.observe(point, 0.02, 0, degrees_of_freedom=degrees_of_freedom).joints
    estimated = bone_lengths(seen, None, PERSON, 0.04, degrees_of_freedom, np.full(14, 7.0))
    np.testing.assert_array_equal(estimated, [0.0] + [7.0] * 13)


JOINTS = np.zeros((5, 14, 3))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"joints": JOINTS[:, :3]}, "joints must have shape"),
        ({"confidence": np.ones((5, 3))}, "confidence must have shape"),
        ({"joints": JOINTS * np.nan}, "joints must be finite, got 210 values"),
        ({"typical": np.ones(3)}, "typical must have shape"),
    ],
)
def test_invalid_arguments(changes, message):
    given = {"joints": JOINTS, "confidence": None, "skeleton": PERSON, "noise": 0.01} | changes
    with pytest.raises(ValueError, match=message):
        bone_lengths(**given)
