"""Matching of joints between skeletons."""

import numpy as np
import pytest

from probmotion import Motion, Skeleton
from probmotion.motion.retargeting import common_skeleton

SMPL = Skeleton.preset("smpl22")


def motion_of(skeleton, frames=4, seed=0):
    positions = np.random.default_rng(seed).standard_normal((frames, skeleton.n_joints, 3))
    return Motion(positions, skeleton, 30, name="clip")


BVH = Skeleton(
    ["Hips", "LeftUpLeg", "LeftLeg", "LeftFoot", "RightUpLeg", "RightLeg", "RightFoot", "prop"],
    [-1, 0, 1, 2, 0, 4, 5, -1],
)


@pytest.mark.parametrize(
    ("source", "target", "matches"),
    [
        (
            BVH,
            Skeleton(["RAnkle", "RKnee", "RHip", "LHip", "prop"], [1, 2, -1, 2, -1]),
            [6, 5, 4, 1, 7],
        ),
        # A name of the source takes precedence over an equal canonical name.
        (
            SMPL,
            Skeleton(["pelvis", "spine1", "left_foot"], [-1, 0, 0]),
            ["pelvis", "spine1", "left_foot"],
        ),
        # Human3.6M calls the ankle a foot.
        (SMPL, Skeleton(["left_foot", "LKnee"], [1, -1]), ["left_ankle", "left_knee"]),
        (
            Skeleton.preset("pair17"),
            Skeleton(["person1:RHip", "person0:RHip"], [-1, -1]),
            ["person1:right_hip", "person0:right_hip"],
        ),
    ],
    ids=["canonical names", "equal names", "foot", "two people"],
)
def test_joints_are_matched_by_name(source, target, matches):
    motion = motion_of(source)
    moved = motion.retarget(target)
    joints = [source.index(joint) if isinstance(joint, str) else joint for joint in matches]
    np.testing.assert_array_equal(moved.positions, motion.positions[:, joints])
    assert moved.skeleton == target
    assert (moved.fps, moved.name) == (30.0, "clip")


def test_missing_and_ambiguous_joints_are_named():
    with pytest.raises(ValueError, match="got 'spine', which has no counterpart"):
        motion_of(BVH).retarget(Skeleton.preset("h36m17").subset([0, 1, 7]))
    feet = Skeleton(["left_ankle", "LeftToeBase", "left_foot"], [-1, 0, 0])
    assert feet.canonical_names == ("left_ankle", "left_foot", "left_foot")
    with pytest.raises(ValueError, match="one counterpart of 'lfoot', got several"):
        motion_of(feet).retarget(Skeleton(["lfoot", "ltibia"], [-1, 0]))


def test_equal_skeletons_change_nothing():
    equal = Skeleton(BVH.joint_names, BVH.parents)
    motion = motion_of(BVH)
    assert motion.retarget(equal) is motion
    assert common_skeleton([BVH, equal]) == BVH


def test_rotations_are_dropped():
    skeleton = Skeleton(["hip", "neck"], [-1, 0])
    turns = np.tile(np.eye(3), (2, 2, 1, 1))
    motion = Motion(np.zeros((2, 2, 3)), skeleton, 30, rotations=turns, rest_offsets=np.eye(3)[:2])
    moved = motion.retarget(Skeleton(["neck", "hip"], [-1, 0]))
    assert moved.rotations is moved.rest_offsets is None


def test_common_skeleton_has_the_joints_of_all():
    motions = [motion_of(Skeleton.preset(name)) for name in ("h36m17", "smpl22", "cmu31")]
    shared = common_skeleton([motion.skeleton for motion in motions])
    limbs = ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")
    paired = {f"{side}_{limb}" for side in ("left", "right") for limb in limbs}
    assert set(shared.joint_names) == {"pelvis", "spine", "neck", "head"} | paired
    assert shared.parents[shared.index("left_knee")] == shared.index("left_hip")
    assert shared.parents[shared.index("head")] == shared.index("neck")  # bridging the nose
    assert len(shared.roots) == 1
    for motion in motions:
        knee = motion.positions[:, motion.skeleton.index("left_knee")]
        moved = motion.retarget(shared).positions[:, shared.index("left_knee")]
        np.testing.assert_array_equal(moved, knee)


def test_skeletons_without_common_joints_are_refused():
    with pytest.raises(ValueError, match="skeletons must contain at least one skeleton, got none"):
        common_skeleton([])
    one, other = Skeleton(["a"], [-1]), Skeleton(["b"], [-1])
    with pytest.raises(ValueError, match="skeletons must have a joint in common, got a, … and b"):
        common_skeleton([one, other])
