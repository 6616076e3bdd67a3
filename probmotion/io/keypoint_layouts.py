"""Keypoints of 2D pose detectors, in the order in which they are listed.

Sources: the OpenPose output documentation (COCO, BODY_25) and the Halpe full-body data set.
"""

from __future__ import annotations

from collections.abc import Mapping

from probmotion.motion.presets import PRESETS
from probmotion.motion.skeleton import Skeleton

__all__ = ["LAYOUTS", "keypoint_skeleton"]

_ARMS = (
    "right_shoulder:neck right_elbow:right_shoulder right_wrist:right_elbow "
    "left_shoulder:neck left_elbow:left_shoulder left_wrist:left_elbow"
)
_LEGS = (
    "right_hip:{hips} right_knee:right_hip right_ankle:right_knee "
    "left_hip:{hips} left_knee:left_hip left_ankle:left_knee"
)
_FACE = "right_eye:nose left_eye:nose right_ear:right_eye left_ear:left_eye"

LAYOUTS: Mapping[str, str] = {
    "openpose18": f"nose:neck neck {_ARMS} {_LEGS} {_FACE}".format(hips="neck"),
    "body25": (
        f"nose:neck neck:pelvis {_ARMS} pelvis {_LEGS} {_FACE} "
        "left_big_toe:left_ankle left_small_toe:left_ankle left_heel:left_ankle "
        "right_big_toe:right_ankle right_small_toe:right_ankle right_heel:right_ankle"
    ).format(hips="pelvis"),
    "halpe26": (
        "nose:neck left_eye:nose right_eye:nose left_ear:left_eye right_ear:right_eye "
        "left_shoulder:neck right_shoulder:neck left_elbow:left_shoulder "
        "right_elbow:right_shoulder left_wrist:left_elbow right_wrist:right_elbow "
        "left_hip:pelvis right_hip:pelvis left_knee:left_hip right_knee:right_hip "
        "left_ankle:left_knee right_ankle:right_knee head_top:neck neck:pelvis pelvis "
        "left_big_toe:left_ankle right_big_toe:right_ankle left_small_toe:left_ankle "
        "right_small_toe:right_ankle left_heel:left_ankle right_heel:right_ankle"
    ),
}
"""Keypoints ``name:parent`` of each layout that is no preset of its own."""


def keypoint_skeleton(name: str) -> Skeleton:
    """Return the skeleton of a detector's layout or a preset, by name.

    Raises
    ------
    ValueError
        If the name is unknown; the message lists the known ones.
    """
    if name in PRESETS:
        return Skeleton.preset(name)
    if name not in LAYOUTS:
        known = ", ".join(sorted([*LAYOUTS, *PRESETS]))
        raise ValueError(f"skeleton must be a Skeleton or one of {known}, got {name!r}")
    joints = [entry.partition(":") for entry in LAYOUTS[name].split()]
    names = [joint for joint, _, _ in joints]
    return Skeleton(names, [names.index(parent) if parent else -1 for _, _, parent in joints])
