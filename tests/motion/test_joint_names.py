"""Canonical joint names in the schemes of data sets and programs."""

import re

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from probmotion.motion.joint_names import canonical_names, mirrored_name
from probmotion.motion.presets import PRESETS
from probmotion.motion.skeleton import Skeleton

LIMBS = [
    f"{side}_{joint}"
    for side in ("left", "right")
    for joint in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
]


SCHEMES = {
    "mixamo": (
        "mixamorig:Hips mixamorig:LeftShoulder mixamorig:LeftArm mixamorig:LeftForeArm "
        "mixamorig:LeftHand mixamorig:LeftUpLeg mixamorig:LeftLeg mixamorig:LeftFoot "
        "mixamorig:LeftToeBase mixamorig:LeftToe_End",
        "pelvis left_collar left_shoulder left_elbow left_wrist left_hip left_knee left_ankle "
        "left_foot left_toe",
    ),
    "mixamo trunk": (
        "Hips Spine Spine1 Spine2 Neck Head HeadTop_End",
        "pelvis lower_spine spine chest neck head head_top",
    ),
    "CMU in BVH": (
        "Hips LHipJoint LeftUpLeg LeftLeg LeftFoot LowerBack Spine Spine1 Neck Neck1 Head",
        "pelvis left_hip_joint left_hip left_knee left_ankle lower_spine spine chest neck "
        "upper_neck head",
    ),
    "CMU in ASF": (
        "root lhipjoint lfemur ltibia lfoot ltoes lclavicle lhumerus lradius lwrist thorax",
        "pelvis left_hip left_knee left_ankle left_foot left_toe left_shoulder left_elbow "
        "left_wrist left_palm chest",
    ),
    "DAZ": (
        "hip abdomen chest lCollar lShldr lForeArm lHand lButtock lThigh lShin lFoot lFoot_end",
        "pelvis spine chest left_collar left_shoulder left_elbow left_wrist left_hip_joint "
        "left_hip left_knee left_ankle left_foot",
    ),
    "SMPL": (
        "pelvis left_hip spine1 left_knee spine2 left_ankle spine3 left_foot",
        "pelvis left_hip lower_spine left_knee spine left_ankle chest left_foot",
    ),
    "Human3.6M": (
        "Hip RHip RKnee RFoot LHip LKnee LFoot Spine Thorax Neck/Nose Head",
        "pelvis right_hip right_knee right_ankle left_hip left_knee left_ankle spine neck nose "
        "head",
    ),
    "MPII": ("pelvis thorax upper_neck head_top", "pelvis neck upper_neck head_top"),
    "three joints of a foot": ("left_ankle left_foot left_toe", "left_ankle left_foot left_toe"),
    "dog": (
        "root spine0 spine1 left_forearm left_hand left_finger left_upper_leg left_leg left_foot "
        "left_toe tail0 tail1",
        "pelvis spine chest left_elbow left_wrist left_front_paw left_hip left_knee left_ankle "
        "left_back_paw tail tail1",
    ),
    "Unreal": (
        "pelvis clavicle_l upperarm_l lowerarm_l hand_l thigh_l calf_l foot_l ball_l",
        "pelvis left_collar left_shoulder left_elbow left_wrist left_hip left_knee left_ankle "
        "left_foot",
    ),
    "AP-10K": (
        "L_Eye Nose Neck Root_of_tail L_Shoulder L_Elbow L_F_Paw L_Hip L_Knee L_B_Paw",
        "left_eye nose neck tail left_shoulder left_elbow left_front_paw left_hip left_knee "
        "left_back_paw",
    ),
}


@pytest.mark.parametrize("scheme", SCHEMES)
def test_schemes_map_to_canonical_names(scheme):
    text, expected = (names.split() for names in SCHEMES[scheme])
    names = [name.replace("_of_", " of ") for name in text]
    assert canonical_names(names) == tuple(expected)
    # The result does not depend on the order of the joints.
    assert canonical_names(names[::-1]) == tuple(expected[::-1])


@pytest.mark.parametrize(
    ("canonical", "names"),
    [
        ("left_hip", "LeftUpLeg lhip LHip l_hip left_hip lThigh thigh.L LEFT-HIP"),
        ("left_knee", "LeftLeg"),
        ("left_ankle", "LeftFoot lFoot"),
        ("left_wrist", "LeftHand"),
        ("left_elbow", "LeftForeArm"),
        ("left_shoulder", "LeftArm LeftShoulder"),
    ],
)
def test_single_names_have_their_most_likely_meaning(canonical, names):
    assert {canonical_names([name]) for name in names.split()} == {(canonical,)}


def test_unknown_and_ambiguous_names():
    for name in ("ball", "lIndex1", "lumbar", "prop", "Ribs", ""):
        assert canonical_names([name]) == (name,)
    assert canonical_names(["hip", "pelvis"]) == ("hip", "pelvis")
    assert canonical_names(["LWrist", "LHand", "l_wrist"])[1] == "left_hand"


def test_several_people_keep_their_prefix():
    names = ["ann:hip", "ann:lShin", "ben:Hips", "ben:LeftLeg"]
    assert canonical_names(names) == ("ann:pelvis", "ann:left_knee", "ben:pelvis", "ben:left_knee")
    assert canonical_names(["rig:hip", "rig:lShin"]) == ("pelvis", "left_knee")


def test_mirrored_name_of_left_joints():
    lefts = "left_knee LeftUpLeg lShin LHip lfemur thigh_l L_Eye ann:lShin mixamorig:LeftHand"
    rights = "right_knee RightUpLeg rShin RHip rfemur thigh_r R_Eye ann:rShin mixamorig:RightHand"
    for left, right in zip(lefts.split(), rights.split(), strict=True):
        assert mirrored_name(left) == right
        assert mirrored_name(right) is None
    for name in ("lowerback", "lowerneck", "LowerBack", "root", "pelvis", "lumbar", "ball", "L"):
        assert mirrored_name(name) is None


@settings(max_examples=30)
@given(st.text(max_size=12))
def test_any_text_is_accepted(name):
    assert isinstance(canonical_names([name])[0], str)
    assert mirrored_name(name) != name


@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_canonical_names_of_presets_are_fixed_points(preset):
    names = Skeleton.preset(preset).canonical_names
    assert len(set(names)) == len(names)
    assert canonical_names(names) == names


def test_real_skeletons_have_canonical_limbs(real_data):
    skeletons = {}
    for path in sorted(real_data.glob("*/*.npz")):
        skeletons[tuple(np.load(path)["joint_names"].tolist())] = path
    for path in sorted(real_data.glob("originals/*.bvh")):
        skeletons[tuple(re.findall(r"(?:ROOT|JOINT) (\S+)", path.read_text()))] = path
    assert len(skeletons) >= 8
    for joint_names, path in skeletons.items():
        names = canonical_names(joint_names)
        assert len(set(names)) == len(names), path
        if "dog" not in path.name:
            assert set(LIMBS) <= set(names), path
            assert {"neck", "pelvis"} & set(names), path
        lefts = [name for name in names if name.startswith("left_")]
        assert {name.replace("left_", "right_") for name in lefts} <= set(names), path
        assert len(Skeleton(joint_names, [-1] * len(names)).mirrored_pairs) >= len(lefts), path
