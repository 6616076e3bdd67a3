"""Motions on other skeletons."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from probmotion import Motion, Skeleton
from probmotion.motion.retargeting import common_skeleton


def motion_of(skeleton: Skeleton, frames: int = 4, seed: int = 0) -> Motion:
    positions = np.random.default_rng(seed).standard_normal((frames, skeleton.n_joints, 3))
    return Motion(positions, skeleton, 30, name="clip")


BVH = Skeleton(
    ["Hips", "LeftUpLeg", "LeftLeg", "LeftFoot", "RightUpLeg", "RightLeg", "RightFoot", "prop"],
    [-1, 0, 1, 2, 0, 4, 5, -1],
)


def test_joints_are_matched_by_their_common_names() -> None:
    motion = motion_of(BVH)
    legs = Skeleton(["RAnkle", "RKnee", "RHip", "LHip", "prop"], [1, 2, -1, 2, -1])
    moved = motion.retarget(legs)
    np.testing.assert_array_equal(moved.positions, motion.positions[:, [6, 5, 4, 1, 7]])
    assert moved.skeleton == legs
    assert (moved.fps, moved.name) == (30.0, "clip")


def test_a_skeletons_own_names_come_first() -> None:
    """A part of a skeleton keeps its joints, though alone their names would mean others."""
    smpl = Skeleton.preset("smpl22")
    motion = motion_of(smpl)
    part = Skeleton(["pelvis", "spine1", "left_foot"], [-1, 0, 0])
    assert part.canonical_names == ("pelvis", "spine", "left_ankle")
    moved = motion.retarget(part)
    wanted = [smpl.joint_names.index(name) for name in part.joint_names]
    np.testing.assert_array_equal(moved.positions, motion.positions[:, wanted])


def test_a_foot_is_not_taken_for_an_ankle() -> None:
    feet = Skeleton(["left_foot", "LKnee"], [1, -1])  # an ankle, in the scheme of Human3.6M
    moved = motion_of(Skeleton.preset("smpl22")).retarget(feet)
    smpl = Skeleton.preset("smpl22")
    ankle = motion_of(smpl).positions[:, smpl.index("left_ankle")]
    np.testing.assert_array_equal(moved.positions[:, 0], ankle)


def test_the_error_names_the_joint_without_counterpart() -> None:
    with pytest.raises(
        ValueError, match=r"skeleton has the joint 'spine', which has no counterpar"
    ):
        motion_of(BVH).retarget(Skeleton.preset("h36m17").subset([0, 1, 7]))


def test_the_error_names_the_joint_with_several_counterparts() -> None:
    """A ball of the foot beside an ankle, and a word that could only have been either of them."""
    feet = Skeleton(["left_ankle", "LeftToeBase", "left_foot"], [-1, 0, 0])
    assert feet.canonical_names == ("left_ankle", "left_foot", "left_foot")
    with pytest.raises(
        ValueError, match=r"skeleton has the joint 'lfoot', which is several joints"
    ):
        motion_of(feet).retarget(Skeleton(["lfoot", "ltibia"], [-1, 0]))


def test_the_same_skeleton_gives_the_same_motion() -> None:
    motion = motion_of(BVH)
    assert motion.retarget(Skeleton(BVH.joint_names, BVH.parents)) is motion


def test_rotations_do_not_survive_other_parents() -> None:
    skeleton = Skeleton(["hip", "neck"], [-1, 0])
    motion = Motion(
        np.zeros((2, 2, 3)),
        skeleton,
        30,
        rotations=np.tile(np.eye(3), (2, 2, 1, 1)),
        rest_offsets=np.zeros((2, 3)),
    )
    moved = motion.retarget(Skeleton(["neck", "hip"], [-1, 0]))
    assert moved.rotations is None
    assert moved.rest_offsets is None


def test_people_are_matched_by_name() -> None:
    pair = Skeleton.preset("pair17")
    motion = motion_of(pair)
    second = Skeleton(["person1:RHip", "person0:RHip"], [-1, -1])
    moved = motion.retarget(second)
    wanted = [pair.index("person1:right_hip"), pair.index("person0:right_hip")]
    np.testing.assert_array_equal(moved.positions, motion.positions[:, wanted])


def test_one_skeleton_is_its_own_common_skeleton() -> None:
    assert common_skeleton([BVH, Skeleton(BVH.joint_names, BVH.parents)]) == BVH


def test_mixed_skeletons_share_the_joints_that_all_have() -> None:
    motions = [motion_of(Skeleton.preset(name)) for name in ("h36m17", "smpl22", "cmu31")]
    shared = common_skeleton([motion.skeleton for motion in motions])
    limbs = ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")
    wanted = {"pelvis", "spine", "neck", "head"} | {
        f"{s}_{l}" for s in ("left", "right") for l in limbs
    }
    assert set(shared.joint_names) == wanted
    assert shared.parents[shared.index("left_knee")] == shared.index("left_hip")
    assert shared.parents[shared.index("head")] == shared.index("neck")  # the nose is bridged
    assert len(shared.roots) == 1
    for motion in motions:
        moved = motion.retarget(shared)
        knee = motion.positions[:, motion.skeleton.index("left_knee")]
        np.testing.assert_array_equal(moved.positions[:, shared.index("left_knee")], knee)


def test_nothing_in_common_is_refused() -> None:
    with pytest.raises(ValueError, match="skeletons must contain at least one, got none"):
        common_skeleton([])
    one, other = Skeleton(["a"], [-1]), Skeleton(["b"], [-1])
    with pytest.raises(ValueError, match="skeletons have no joint in common: a, … and b, …"):
        common_skeleton([one, other])


def test_real_skeletons_of_every_folder_have_a_body_in_common(real_data: Path) -> None:
    motions = []
    for file in (
        "cmu_single/cmu_01_01",
        "cmu_single/cmu_131_01",
        "deepmimic_human/humanoid3d_walk",
    ):
        archive = np.load(real_data / f"{file}.npz")
        skeleton = Skeleton(archive["joint_names"].tolist(), archive["parents"].tolist())
        motions.append(Motion(archive["positions"], skeleton, 30))
    shared = common_skeleton([motion.skeleton for motion in motions])
    assert shared.n_joints == 15
    assert len(shared.roots) == 1
    for motion in motions:
        heights = motion.retarget(shared).positions[0, :, 1]
        assert heights[shared.index("left_hip")] > heights[shared.index("left_knee")]
        assert heights[shared.index("left_knee")] > heights[shared.index("left_ankle")]
