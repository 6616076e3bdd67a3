"""Names of joints in the schemes of data sets and programs."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st

from probmotion.motion.joint_names import canonical_name, canonical_names, mirrored_name
from probmotion.motion.presets import PRESETS
from probmotion.motion.skeleton import Skeleton

LIMBS = [
    f"{side}_{joint}"
    for side in ("left", "right")
    for joint in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
]

# From, to, shortest and longest, metres.
BONES = [
    ("hip", "knee", 0.3, 0.55),
    ("knee", "ankle", 0.3, 0.55),
    ("shoulder", "elbow", 0.2, 0.4),
    ("elbow", "wrist", 0.15, 0.35),
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
    "MPII": (
        "pelvis thorax upper_neck head_top",
        "pelvis neck upper_neck head_top",
    ),
    "three joints of a foot": (
        "left_ankle left_foot left_toe",
        "left_ankle left_foot left_toe",
    ),
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
        "L_Eye Nose Neck Root of tail,L_Shoulder L_Elbow L_F_Paw L_Hip L_Knee L_B_Paw",
        "left_eye nose neck tail left_shoulder left_elbow left_front_paw left_hip left_knee "
        "left_back_paw",
    ),
}


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_scheme_speaks_the_common_vocabulary(scheme: str) -> None:
    given_names, wanted = SCHEMES[scheme]
    if "," in given_names:
        before, after = given_names.split("Root of tail,")
        names = [*before.split(), "Root of tail", *after.split()]
    else:
        names = given_names.split()
    assert canonical_names(names) == tuple(wanted.split())
    # The order of a skeleton's joints says nothing about what they are.
    assert canonical_names(names[::-1]) == tuple(wanted.split())[::-1]


@pytest.mark.parametrize(
    "name", ["LeftUpLeg", "lhip", "LHip", "l_hip", "left_hip", "lThigh", "thigh.L", "LEFT-HIP"]
)
def test_one_joint_alone_has_its_likeliest_meaning(name: str) -> None:
    assert canonical_name(name) == "left_hip"


def test_words_of_two_meanings_alone() -> None:
    assert canonical_name("LeftLeg") == "left_knee"
    assert canonical_name("LeftFoot") == canonical_name("lFoot") == "left_ankle"
    assert canonical_name("LeftHand") == "left_wrist"
    assert canonical_name("LeftForeArm") == "left_elbow"
    assert canonical_name("LeftArm") == canonical_name("LeftShoulder") == "left_shoulder"


def test_unknown_names_stay() -> None:
    for name in ("ball", "lIndex1", "lumbar", "prop", "Ribs", ""):
        assert canonical_name(name) == name


def test_two_joints_of_one_meaning_do_not_share_it() -> None:
    assert canonical_names(["hip", "pelvis"]) == ("hip", "pelvis")
    assert canonical_names(["LWrist", "LHand", "l_wrist"])[1] == "left_hand"


def test_people_keep_their_joints_apart() -> None:
    names = ["ann:hip", "ann:lShin", "ben:Hips", "ben:LeftLeg"]
    assert canonical_names(names) == ("ann:pelvis", "ann:left_knee", "ben:pelvis", "ben:left_knee")
    assert canonical_names(["rig:hip", "rig:lShin"]) == ("pelvis", "left_knee")


@pytest.mark.parametrize(
    ("left", "right"),
    [
        ("left_knee", "right_knee"),
        ("LeftUpLeg", "RightUpLeg"),
        ("lShin", "rShin"),
        ("LHip", "RHip"),
        ("lfemur", "rfemur"),
        ("thigh_l", "thigh_r"),
        ("L_Eye", "R_Eye"),
        ("lIndex1", "rIndex1"),
        ("ann:lShin", "ann:rShin"),
        ("mixamorig:LeftHandIndex1", "mixamorig:RightHandIndex1"),
    ],
)
def test_left_joints_have_a_right_counterpart(left: str, right: str) -> None:
    assert mirrored_name(left) == right
    assert mirrored_name(right) is None


def test_the_middle_has_no_counterpart() -> None:
    for name in ("lowerback", "lowerneck", "LowerBack", "root", "pelvis", "lumbar", "ball", "L"):
        assert mirrored_name(name) is None


@given(st.text(max_size=12))
def test_any_text_is_a_name(name: str) -> None:
    assert isinstance(canonical_name(name), str)
    assert mirrored_name(name) != name


@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_canonical_names_are_their_own(preset: str) -> None:
    names = Skeleton.preset(preset).canonical_names
    assert len(set(names)) == len(names)
    assert canonical_names(names) == names


def test_real_skeletons_are_understood(real_data: Path) -> None:
    skeletons = {}
    for path in sorted(real_data.glob("*/*.npz")):
        skeletons[tuple(np.load(path)["joint_names"].tolist())] = path
    for path in sorted(real_data.glob("originals/*.bvh")):
        skeletons[tuple(re.findall(r"(?:ROOT|JOINT) (\S+)", path.read_text()))] = path
    assert len(skeletons) >= 8
    for names, path in skeletons.items():
        found = canonical_names(names)
        assert len(set(found)) == len(found), path
        if "dog" not in path.name:
            assert set(LIMBS) <= set(found), path
            assert {"neck", "pelvis"} & set(found), path
        # Every left joint has its right one, whatever the scheme.
        lefts = [name for name in found if name.startswith("left_")]
        assert {name.replace("left_", "right_") for name in lefts} <= set(found), path
        assert len(Skeleton(names, [-1] * len(names)).mirrored_pairs) >= len(lefts), path


def test_real_joints_are_where_their_names_say(real_data: Path) -> None:
    """Between joints of these names lie bones of a grown person's lengths, in every frame."""
    for file in ("cmu_single/cmu_02_01", "cmu_single/cmu_131_01", "deepmimic_human/humanoid3d_walk",
                 "cmu_salsa_pairs/cmu_60_61_01"):  # fmt: skip
        archive = np.load(real_data / f"{file}.npz")
        positions = archive["positions"].astype(float).reshape(len(archive["positions"]), -1, 3)
        names = canonical_names(archive["joint_names"].tolist())
        at = {name: positions[:, joint] for joint, name in enumerate(names)}
        for start, end, least, most in BONES:
            for side in ("left", "right"):
                length = np.linalg.norm(at[f"{side}_{end}"] - at[f"{side}_{start}"], axis=-1)
                assert least < length.min() <= length.max() < most, (file, side, start)
