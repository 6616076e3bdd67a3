"""Retargeting and resampling with occluded joints, against motions without occlusion."""

import numpy as np
import pytest

from probmotion import Motion, Skeleton, seeds
from probmotion.data.synthetic.gaits import make_gait
from probmotion.motion.occlusion import joints_at_rate, joints_on_skeleton

PERSON = Skeleton.preset("person14")


def walk(frames, fps):
    return make_gait("walk", frames=frames, fps=fps)


@pytest.mark.parametrize("preset", ["h36m17", "smpl22", "person17", "cmu31"])
def test_joints_agree_with_motion_retarget(preset):
    source = Skeleton.preset(preset)
    rng = seeds.generator(0, preset)
    places = rng.normal(size=(3, source.n_joints, 3))
    joints, confidence = joints_on_skeleton(places, np.ones(places.shape[:2]), source, PERSON)
    wanted = Motion(places, source, 30.0).retarget(PERSON)
    np.testing.assert_array_equal(joints, wanted.positions)
    np.testing.assert_array_equal(confidence, 1.0)


def test_same_skeleton_only_masks_occluded_joints():
    confidence = np.full((20, 14), 0.5)
    confidence[3, 4] = 0.0
    joints, weights = joints_on_skeleton(np.ones((20, 14, 3)), confidence, PERSON, PERSON)
    np.testing.assert_array_equal(weights, confidence)
    np.testing.assert_array_equal(np.isnan(joints).all(axis=-1), confidence == 0)
    assert np.isnan(joints).sum() == 3


def test_missing_pelvis_and_neck_are_midpoints():
    names = ["LHip", "RHip", "LShoulder", "RShoulder", "Nose", *(
        f"{side}{part}" for side in "LR" for part in ("Elbow", "Wrist", "Knee", "Ankle")
    )]  # fmt: skip
    source = Skeleton(names, [-1] * len(names))
    rng = seeds.generator(0, "midway")
    places, confidence = rng.normal(size=(50, 13, 3)), rng.uniform(0.1, 2.0, (50, 13))
    confidence[7, 0] = 0.0
    joints, weights = joints_on_skeleton(places, confidence, source, PERSON)
    expected = places[:, :2].mean(axis=1)
    expected[7] = np.nan
    np.testing.assert_allclose(joints[:, 0], expected)
    np.testing.assert_allclose(joints[:, 1], places[:, 2:4].mean(axis=1))
    assert weights[7, 0] == 0
    # The variance of the mean is a quarter of the sum of the variances 1/w.
    variance = (1 / confidence[:, 2] + 1 / confidence[:, 3]) / 4
    np.testing.assert_allclose(weights[:, 1], 1 / variance)


def test_missing_and_ambiguous_joints_are_named():
    source = Skeleton(["LHip", "LShoulder", "Nose"], [-1, 0, 1])
    with pytest.raises(ValueError, match="joints pelvis, neck, left_elbow, left_wrist, right_sh"):
        joints_on_skeleton(np.zeros((2, 3, 3)), np.ones((2, 3)), source, PERSON)
    twice = Skeleton(["lfemur", "lhipjoint", "left_hip"], [1, -1, 1])
    with pytest.raises(ValueError, match="one counterpart of 'lHip', got several"):
        joints_on_skeleton(np.zeros((2, 3, 3)), np.ones((2, 3)), twice, Skeleton(["lHip"], [-1]))


@pytest.mark.parametrize(("fps", "new_fps"), [(60, 30), (25, 30), (30, 25), (50, 30)])
def test_rates_agree_with_motion_resample(fps, new_fps):
    motion = walk(31, fps)
    joints, weights = joints_at_rate(motion.positions, np.ones((31, 17)), fps, new_fps)
    np.testing.assert_allclose(joints, motion.resample(new_fps).positions, atol=1e-12)
    assert weights.shape == joints.shape[:2]
    assert weights.min() >= 1 - 1e-12


def test_joints_are_occluded_next_to_occluded_frames():
    motion = walk(21, 20.0)
    confidence = np.ones((21, 17))
    confidence[6, 3] = 0.0
    places = np.where(confidence[..., None] > 0, motion.positions, np.nan)
    joints, weights = joints_at_rate(places, confidence, 20.0, 30.0)
    # At 30 fps, frame t is at 2 t / 3 of the old frames: 8 is at 5⅓, 9 at 6, 10 at 6⅔.
    assert np.flatnonzero(weights[:, 3] == 0).tolist() == [8, 9, 10]
    expected = np.where(weights[..., None] > 0, motion.resample(30.0).positions, np.nan)
    np.testing.assert_allclose(joints, expected, atol=1e-12)


def test_coinciding_frames_ignore_their_neighbours():
    confidence = np.ones((9, 1))
    confidence[1::2] = 0.0  # half the rate selects only the other frames
    places = np.where(confidence[..., None] > 0, np.arange(9.0)[:, None, None], np.nan)
    joints, weights = joints_at_rate(np.broadcast_to(places, (9, 1, 3)), confidence, 60.0, 30.0)
    np.testing.assert_array_equal(weights, 1.0)
    np.testing.assert_allclose(joints[:, 0, 0], [0, 2, 4, 6, 8])


def test_confidence_is_the_precision_after_interpolation():
    rng = seeds.generator(0, "precision")
    confidence = np.array([[4.0], [0.25], [1.0]])
    noise = rng.normal(size=(4000, 3, 1, 3)) / np.sqrt(confidence)[..., None]
    joints = [joints_at_rate(each, confidence, 20.0, 30.0)[0] for each in noise]
    _, weights = joints_at_rate(noise[0], confidence, 20.0, 30.0)
    np.testing.assert_allclose(np.var(joints, axis=(0, 3)), 1 / weights, rtol=0.06)
