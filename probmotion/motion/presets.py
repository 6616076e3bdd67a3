"""Skeletons by name: the joint sets that data sets and detectors use."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

__all__ = ["PRESETS", "Preset"]


class Preset(NamedTuple):
    """Joint names, parents and bone radii of a :class:`~probmotion.motion.skeleton.Skeleton`."""

    joint_names: list[str]
    parents: list[int]
    radii: list[float] | None = None


def _tree(*bones: str) -> Preset:
    """Return the preset of lines ``"joint parent"``; a line of one word is a root."""
    names = [bone.split()[0] for bone in bones]
    parents = [names.index(b.split()[1]) if " " in b else -1 for b in bones]
    return Preset(names, parents)


def _alphapose16() -> Preset:
    """AlphaPose's model with 16 joints: those of MPII."""
    return _tree(
        "right_ankle right_knee", "right_knee right_hip", "right_hip pelvis", "left_hip pelvis",
        "left_knee left_hip", "left_ankle left_knee", "pelvis", "thorax pelvis",
        "upper_neck thorax", "head_top upper_neck", "right_wrist right_elbow",
        "right_elbow right_shoulder", "right_shoulder thorax", "left_shoulder thorax",
        "left_elbow left_shoulder", "left_wrist left_elbow",
    )  # fmt: skip


def _apt36k17() -> Preset:
    """The quadrupeds of AP-10K and APT-36K."""
    return _tree(
        "left_eye nose", "right_eye nose", "nose neck", "neck tail", "tail",
        "left_shoulder neck", "left_elbow left_shoulder", "left_front_paw left_elbow",
        "right_shoulder neck", "right_elbow right_shoulder", "right_front_paw right_elbow",
        "left_hip tail", "left_knee left_hip", "left_back_paw left_knee",
        "right_hip tail", "right_knee right_hip", "right_back_paw right_knee",
    )  # fmt: skip


def _body25b() -> Preset:
    """OpenPose's BODY_25B, which has no pelvis: the hips hang from the neck."""
    return _tree(
        "nose neck", "left_eye nose", "right_eye nose", "left_ear left_eye", "right_ear right_eye",
        "left_shoulder neck", "right_shoulder neck", "left_elbow left_shoulder",
        "right_elbow right_shoulder", "left_wrist left_elbow", "right_wrist right_elbow",
        "left_hip neck", "right_hip neck", "left_knee left_hip", "right_knee right_hip",
        "left_ankle left_knee", "right_ankle right_knee", "neck", "head_top neck",
        "left_big_toe left_ankle", "left_small_toe left_ankle", "left_heel left_ankle",
        "right_big_toe right_ankle", "right_small_toe right_ankle", "right_heel right_ankle",
    )  # fmt: skip


def _cmu31() -> Preset:
    """CMU's ASF skeleton: a joint is where the bone of its name ends."""
    return _tree(
        "root", "lhipjoint root", "rhipjoint root", "lowerback root", "lfemur lhipjoint",
        "ltibia lfemur", "lfoot ltibia", "ltoes lfoot", "rfemur rhipjoint", "rtibia rfemur",
        "rfoot rtibia", "rtoes rfoot", "upperback lowerback", "thorax upperback",
        "lowerneck thorax", "lclavicle thorax", "rclavicle thorax", "upperneck lowerneck",
        "head upperneck", "lhumerus lclavicle", "lradius lhumerus", "lwrist lradius",
        "lhand lwrist", "lthumb lwrist", "lfingers lhand", "rhumerus rclavicle",
        "rradius rhumerus", "rwrist rradius", "rhand rwrist", "rthumb rwrist", "rfingers rhand",
    )  # fmt: skip


def _coco17() -> Preset:
    """COCO's keypoints, which have neither pelvis nor neck: the shoulders hang from the nose."""
    return _tree(
        "nose", "left_eye nose", "right_eye nose", "left_ear left_eye", "right_ear right_eye",
        "left_shoulder nose", "right_shoulder nose", "left_elbow left_shoulder",
        "right_elbow right_shoulder", "left_wrist left_elbow", "right_wrist right_elbow",
        "left_hip left_shoulder", "right_hip right_shoulder", "left_knee left_hip",
        "right_knee right_hip", "left_ankle left_knee", "right_ankle right_knee",
    )  # fmt: skip


def _h36m17() -> Preset:
    """Human3.6M's 17 joints; ``neck`` is between the shoulders, ``head`` the top of the head."""
    return _tree(
        "pelvis", "right_hip pelvis", "right_knee right_hip", "right_ankle right_knee",
        "left_hip pelvis", "left_knee left_hip", "left_ankle left_knee", "spine pelvis",
        "neck spine", "nose neck", "head nose", "left_shoulder neck", "left_elbow left_shoulder",
        "left_wrist left_elbow", "right_shoulder neck", "right_elbow right_shoulder",
        "right_wrist right_elbow",
    )  # fmt: skip


def _quadruped21() -> Preset:
    """A four-legged animal as motion capture has it, hocks and all.

    ``tail`` is where the tail begins, ``head`` where the skull joins the neck, ``wrist`` the carpus
    and ``ankle`` the hock. It has what ``apt36k17`` has but the nose and the eyes.
    """
    return _tree(
        "pelvis", "tail pelvis", "chest pelvis", "neck chest", "head neck",
        "left_shoulder chest", "left_elbow left_shoulder", "left_wrist left_elbow",
        "left_front_paw left_wrist",
        "right_shoulder chest", "right_elbow right_shoulder", "right_wrist right_elbow",
        "right_front_paw right_wrist",
        "left_hip pelvis", "left_knee left_hip", "left_ankle left_knee", "left_back_paw left_ankle",
        "right_hip pelvis", "right_knee right_hip", "right_ankle right_knee",
        "right_back_paw right_ankle",
    )  # fmt: skip


def _smpl22() -> Preset:
    """The body of SMPL without its hands."""
    return _tree(
        "pelvis", "left_hip pelvis", "right_hip pelvis", "spine1 pelvis", "left_knee left_hip",
        "right_knee right_hip", "spine2 spine1", "left_ankle left_knee", "right_ankle right_knee",
        "spine3 spine2", "left_foot left_ankle", "right_foot right_ankle", "neck spine3",
        "left_collar spine3", "right_collar spine3", "head neck", "left_shoulder left_collar",
        "right_shoulder right_collar", "left_elbow left_shoulder", "right_elbow right_shoulder",
        "left_wrist left_elbow", "right_wrist right_elbow",
    )  # fmt: skip


# Metres. Thinner than flesh on purpose: with radii of real limbs (forearm 3.5 cm, trunk 10 cm)
# real salsa pairs have a penetration of .17 m at the median, most of it of arms beside their own
# trunk. Begun at half of those and moved bone by bone until real pairs that dance within 1.2 m have
# almost none (median and 90 % of frames under 3 mm), while of two people, one moved into the other,
# each pair has decimetres. The root's number is there for completeness: it has no bone.
_PERSON_RADII = {
    "pelvis": 0.05, "spine": 0.045, "chest": 0.035, "neck": 0.02, "head": 0.06,
    "shoulder": 0.025, "elbow": 0.02, "wrist": 0.01, "hip": 0.05, "knee": 0.045, "ankle": 0.03,
}  # fmt: skip


def _person17() -> Preset:
    """One person as motion capture has it: the trunk's joints, limbs, no face (Yin et al. 2018)."""
    tree = _tree(
        "pelvis", "spine pelvis", "chest spine", "neck chest", "head neck",
        "left_shoulder chest", "left_elbow left_shoulder", "left_wrist left_elbow",
        "right_shoulder chest", "right_elbow right_shoulder", "right_wrist right_elbow",
        "left_hip pelvis", "left_knee left_hip", "left_ankle left_knee",
        "right_hip pelvis", "right_knee right_hip", "right_ankle right_knee",
    )  # fmt: skip
    radii = [_PERSON_RADII[name.rpartition("_")[2]] for name in tree.joint_names]
    return tree._replace(radii=radii)


def _person14() -> Preset:
    """What motion capture and 2D detectors have in common: trunk ends and limbs."""
    return _tree(
        "pelvis", "neck pelvis", "left_shoulder neck", "left_elbow left_shoulder",
        "left_wrist left_elbow", "right_shoulder neck", "right_elbow right_shoulder",
        "right_wrist right_elbow", "left_hip pelvis", "left_knee left_hip", "left_ankle left_knee",
        "right_hip pelvis", "right_knee right_hip", "right_ankle right_knee",
    )  # fmt: skip


def _pair17() -> Preset:
    """Two people of ``person17``'s joints."""
    one = _person17()
    names = [f"person{p}:{name}" for p in range(2) for name in one.joint_names]
    parents = [*one.parents, *(q if q < 0 else q + 17 for q in one.parents)]
    return Preset(names, parents, (one.radii or []) * 2)


def _gymnast_ball() -> Preset:
    """A person of COCO's keypoints and a ball (MAS, section 5)."""
    one = _coco17()
    return Preset([*one.joint_names, "ball"], [*one.parents, -1])


PRESETS: Mapping[str, Callable[[], Preset]] = {
    "alphapose16": _alphapose16,
    "apt36k17": _apt36k17,
    "body25b": _body25b,
    "cmu31": _cmu31,
    "coco17": _coco17,
    "gymnast-ball": _gymnast_ball,
    "h36m17": _h36m17,
    "pair17": _pair17,
    "person14": _person14,
    "person17": _person17,
    "quadruped21": _quadruped21,
    "smpl22": _smpl22,
}
"""Functions that return each preset, by name."""
