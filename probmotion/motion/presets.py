"""Preset skeletons: the joint sets of common data sets and 2D pose detectors.

Sources: the data sets' papers, the OpenPose output documentation, the Halpe data set and
MediaPipe's pose landmark model.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

__all__ = ["PRESETS"]


class Preset(NamedTuple):
    """Joint names, parents and bone radii of a :class:`~probmotion.motion.skeleton.Skeleton`."""

    joint_names: list[str]
    parents: list[int]
    radii: list[float] | None = None


# Joints ``name:parent`` in the order of the data set or detector; roots have no parent.
_TREES = {
    # AlphaPose's 16-joint model, with the joints of MPII.
    "alphapose16": """
        right_ankle:right_knee right_knee:right_hip right_hip:pelvis left_hip:pelvis
        left_knee:left_hip left_ankle:left_knee pelvis thorax:pelvis upper_neck:thorax
        head_top:upper_neck right_wrist:right_elbow right_elbow:right_shoulder
        right_shoulder:thorax left_shoulder:thorax left_elbow:left_shoulder
        left_wrist:left_elbow""",
    # Quadruped joints of AP-10K and APT-36K.
    "apt36k17": """
        left_eye:nose right_eye:nose nose:neck neck:tail tail left_shoulder:neck
        left_elbow:left_shoulder left_front_paw:left_elbow right_shoulder:neck
        right_elbow:right_shoulder right_front_paw:right_elbow left_hip:tail left_knee:left_hip
        left_back_paw:left_knee right_hip:tail right_knee:right_hip right_back_paw:right_knee""",
    # OpenPose's BODY_25 model.
    "body25": """
        nose:neck neck:pelvis right_shoulder:neck right_elbow:right_shoulder
        right_wrist:right_elbow left_shoulder:neck left_elbow:left_shoulder left_wrist:left_elbow
        pelvis right_hip:pelvis right_knee:right_hip right_ankle:right_knee left_hip:pelvis
        left_knee:left_hip left_ankle:left_knee right_eye:nose left_eye:nose right_ear:right_eye
        left_ear:left_eye left_big_toe:left_ankle left_small_toe:left_ankle left_heel:left_ankle
        right_big_toe:right_ankle right_small_toe:right_ankle right_heel:right_ankle""",
    # OpenPose's BODY_25B model. It has no pelvis, so the hips are children of the neck.
    "body25b": """
        nose:neck left_eye:nose right_eye:nose left_ear:left_eye right_ear:right_eye
        left_shoulder:neck right_shoulder:neck left_elbow:left_shoulder
        right_elbow:right_shoulder left_wrist:left_elbow right_wrist:right_elbow left_hip:neck
        right_hip:neck left_knee:left_hip right_knee:right_hip left_ankle:left_knee
        right_ankle:right_knee neck head_top:neck left_big_toe:left_ankle
        left_small_toe:left_ankle left_heel:left_ankle right_big_toe:right_ankle
        right_small_toe:right_ankle right_heel:right_ankle""",
    # CMU's ASF skeleton: each joint is the end of the bone with the same name.
    "cmu31": """
        root lhipjoint:root rhipjoint:root lowerback:root lfemur:lhipjoint ltibia:lfemur
        lfoot:ltibia ltoes:lfoot rfemur:rhipjoint rtibia:rfemur rfoot:rtibia rtoes:rfoot
        upperback:lowerback thorax:upperback lowerneck:thorax lclavicle:thorax rclavicle:thorax
        upperneck:lowerneck head:upperneck lhumerus:lclavicle lradius:lhumerus lwrist:lradius
        lhand:lwrist lthumb:lwrist lfingers:lhand rhumerus:rclavicle rradius:rhumerus
        rwrist:rradius rhand:rwrist rthumb:rwrist rfingers:rhand""",
    # COCO's keypoints. There is no pelvis and no neck, so the shoulders are children of the nose.
    "coco17": """
        nose left_eye:nose right_eye:nose left_ear:left_eye right_ear:right_eye
        left_shoulder:nose right_shoulder:nose left_elbow:left_shoulder
        right_elbow:right_shoulder left_wrist:left_elbow right_wrist:right_elbow
        left_hip:left_shoulder right_hip:right_shoulder left_knee:left_hip right_knee:right_hip
        left_ankle:left_knee right_ankle:right_knee""",
    # Human3.6M's 17 joints; neck is the midpoint of the shoulders, head the top of the head.
    "h36m17": """
        pelvis right_hip:pelvis right_knee:right_hip right_ankle:right_knee left_hip:pelvis
        left_knee:left_hip left_ankle:left_knee spine:pelvis neck:spine nose:neck head:nose
        left_shoulder:neck left_elbow:left_shoulder left_wrist:left_elbow right_shoulder:neck
        right_elbow:right_shoulder right_wrist:right_elbow""",
    # Halpe's 26 body keypoints.
    "halpe26": """
        nose:neck left_eye:nose right_eye:nose left_ear:left_eye right_ear:right_eye
        left_shoulder:neck right_shoulder:neck left_elbow:left_shoulder
        right_elbow:right_shoulder left_wrist:left_elbow right_wrist:right_elbow left_hip:pelvis
        right_hip:pelvis left_knee:left_hip right_knee:right_hip left_ankle:left_knee
        right_ankle:right_knee head_top:neck neck:pelvis pelvis left_big_toe:left_ankle
        right_big_toe:right_ankle left_small_toe:left_ankle right_small_toe:right_ankle
        left_heel:left_ankle right_heel:right_ankle""",
    # MediaPipe's pose landmarks. As for coco17, the shoulders are children of the nose.
    "mediapipe33": """
        nose left_eye_inner:nose left_eye:left_eye_inner left_eye_outer:left_eye
        right_eye_inner:nose right_eye:right_eye_inner right_eye_outer:right_eye
        left_ear:left_eye_outer right_ear:right_eye_outer mouth_left:nose mouth_right:nose
        left_shoulder:nose right_shoulder:nose left_elbow:left_shoulder
        right_elbow:right_shoulder left_wrist:left_elbow right_wrist:right_elbow
        left_pinky:left_wrist right_pinky:right_wrist left_index:left_wrist
        right_index:right_wrist left_thumb:left_wrist right_thumb:right_wrist
        left_hip:left_shoulder right_hip:right_shoulder left_knee:left_hip right_knee:right_hip
        left_ankle:left_knee right_ankle:right_knee left_heel:left_ankle right_heel:right_ankle
        left_foot_index:left_ankle right_foot_index:right_ankle""",
    # OpenPose's COCO model with 18 keypoints.
    "openpose18": """
        nose:neck neck right_shoulder:neck right_elbow:right_shoulder right_wrist:right_elbow
        left_shoulder:neck left_elbow:left_shoulder left_wrist:left_elbow right_hip:neck
        right_knee:right_hip right_ankle:right_knee left_hip:neck left_knee:left_hip
        left_ankle:left_knee right_eye:nose left_eye:nose right_ear:right_eye left_ear:left_eye""",
    # Joints common to motion capture and 2D detectors: pelvis, neck and limbs.
    "person14": """
        pelvis neck:pelvis left_shoulder:neck left_elbow:left_shoulder left_wrist:left_elbow
        right_shoulder:neck right_elbow:right_shoulder right_wrist:right_elbow left_hip:pelvis
        left_knee:left_hip left_ankle:left_knee right_hip:pelvis right_knee:right_hip
        right_ankle:right_knee""",
    # Motion-capture joints of a person: trunk and limbs, no face (Yin et al. 2018).
    "person17": """
        pelvis spine:pelvis chest:spine neck:chest head:neck left_shoulder:chest
        left_elbow:left_shoulder left_wrist:left_elbow right_shoulder:chest
        right_elbow:right_shoulder right_wrist:right_elbow left_hip:pelvis left_knee:left_hip
        left_ankle:left_knee right_hip:pelvis right_knee:right_hip right_ankle:right_knee""",
    # Motion-capture joints of a quadruped: those of apt36k17 except nose and eyes, and others. tail
    # is the base of the tail, head the joint of skull and neck, wrist the carpus, ankle the hock.
    "quadruped21": """
        pelvis tail:pelvis chest:pelvis neck:chest head:neck left_shoulder:chest
        left_elbow:left_shoulder left_wrist:left_elbow left_front_paw:left_wrist
        right_shoulder:chest right_elbow:right_shoulder right_wrist:right_elbow
        right_front_paw:right_wrist left_hip:pelvis left_knee:left_hip left_ankle:left_knee
        left_back_paw:left_ankle right_hip:pelvis right_knee:right_hip right_ankle:right_knee
        right_back_paw:right_ankle""",
    # SMPL's body joints without hands.
    "smpl22": """
        pelvis left_hip:pelvis right_hip:pelvis spine1:pelvis left_knee:left_hip
        right_knee:right_hip spine2:spine1 left_ankle:left_knee right_ankle:right_knee
        spine3:spine2 left_foot:left_ankle right_foot:right_ankle neck:spine3 left_collar:spine3
        right_collar:spine3 head:neck left_shoulder:left_collar right_shoulder:right_collar
        left_elbow:left_shoulder right_elbow:right_shoulder left_wrist:left_elbow
        right_wrist:right_elbow""",
}

# Bone radii, metres. Anatomical radii (forearm 3.5 cm, trunk 10 cm) result in a median penetration
# of 0.17 m for real salsa pairs, mostly between arms and trunk of a person. With these smaller
# tuned radii, it is under 3 mm in 90 % of the frames of real pairs within 1.2 m, but several
# decimetres for overlapping people. The radius of the root is unused.
_PERSON_RADII = {
    "pelvis": 0.05, "spine": 0.045, "chest": 0.035, "neck": 0.02, "head": 0.06,
    "shoulder": 0.025, "elbow": 0.02, "wrist": 0.01, "hip": 0.05, "knee": 0.045, "ankle": 0.03,
}  # fmt: skip


def _tree(text: str) -> Preset:
    joints = [joint.partition(":") for joint in text.split()]
    names = [name for name, _, _ in joints]
    return Preset(names, [names.index(parent) if parent else -1 for _, _, parent in joints])


def _presets() -> dict[str, Preset]:
    presets = {name: _tree(text) for name, text in _TREES.items()}
    person, coco = presets["person17"], presets["coco17"]
    radii = [_PERSON_RADII[name.rpartition("_")[2]] for name in person.joint_names]
    presets["person17"] = person._replace(radii=radii)
    presets["pair17"] = Preset(
        [f"person{p}:{name}" for p in range(2) for name in person.joint_names],
        [*person.parents, *(parent if parent < 0 else parent + 17 for parent in person.parents)],
        radii * 2,
    )
    # A gymnast with COCO's keypoints, and a ball (MAS, section 5).
    presets["gymnast-ball"] = Preset([*coco.joint_names, "ball"], [*coco.parents, -1])
    return dict(sorted(presets.items()))


PRESETS: Mapping[str, Preset] = _presets()
"""Presets by name; see :meth:`probmotion.motion.skeleton.Skeleton.preset`."""
