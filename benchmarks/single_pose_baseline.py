"""Baseline of lifts: single poses by joint limits (Yin et al. 2018), for ``lift_figures.py``.

It is told what the lift has to infer: in every frame the distance of the person, so that keypoints
are in metres, and always the camera's pitch and the lengths of the limbs. It starts from a standing
pose in the direction, of eight, of the smallest energy after two minimisations, or in the true
direction of the hips. Time is not used.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from probmotion.data.videos import Video
from probmotion.geometry.rotations import vector_to_matrix
from probmotion.models.pose_pairs.joint_limits import JointLimits
from probmotion.models.pose_pairs.single_pose_lifting import lift_person
from probmotion.motion.skeleton import Skeleton

PERSON, LIMITED = Skeleton.preset("person14"), Skeleton.preset("person17")
LIMBS = [
    tuple(f"{side}_{part}" for part in parts)
    for side in ("left", "right")
    for parts in (("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle"))
]
FOCAL, CENTRE = 866.0, 500.0  # pixels, of the made videos
# Offsets from the parents on the left, metres.
STANDING = {
    "spine": (0, 0.1, 0), "chest": (0, 0.2, 0), "neck": (0, 0.15, 0), "head": (0, 0.18, 0.03),
    "left_shoulder": (0.18, 0.12, 0), "left_elbow": (0.06, -0.28, 0),
    "left_wrist": (0.02, -0.23, 0.08), "left_hip": (0.09, -0.06, 0), "left_knee": (0, -0.42, 0.02),
    "left_ankle": (0, -0.41, -0.03),
}  # fmt: skip
DIRECTIONS = np.arange(8) * np.pi / 4  # radians
EVALUATIONS = 60  # of the energy per minimisation
FEWEST = 4  # visible keypoints


def single_poses(video: Video, height: float, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the poses of F frames of a video from a camera of known height, (F, 14, 3), metres.

    The first array has directions of its own, the second the true ones. Axes are those of the
    truth, positions relative to an arbitrary point. Poses of frames with fewer than four keypoints
    are NaN.
    """
    limits = JointLimits.shipped(LIMITED)
    truth = video.motion.positions
    hips = [PERSON.index(f"{side}_hip") for side in ("left", "right")]
    distance = np.linalg.norm(truth[:, hips].mean(axis=(0, 1))[[0, 2]])
    pitch = np.arctan2(1.0 - height, distance)
    camera = vector_to_matrix(np.array([pitch, 0.0, 0.0]))  # columns: right, up, backwards
    pose = standing(truth)
    names = video.track.skeleton.joint_names
    seen = [j for j, name in enumerate(LIMITED.joint_names) if name in PERSON.joint_names]
    seen = [j for j in seen if LIMITED.joint_names[j] in names]
    source = [names.index(LIMITED.joint_names[j]) for j in seen]
    chosen = [LIMITED.joint_names.index(name) for name in PERSON.joint_names]
    result = np.full((2, len(frames), PERSON.n_joints, 3), np.nan)
    for row, frame in enumerate(frames):
        points, visible = np.zeros((LIMITED.n_joints, 2)), np.zeros(LIMITED.n_joints, dtype=bool)
        visible[seen] = video.track.confidence[frame, source] > 0
        depth = -(truth[frame, hips].mean(axis=0) @ camera)[2]
        pixels = video.track.keypoints[frame, source]
        points[seen] = (np.nan_to_num(pixels) - CENTRE) * [1, -1] * depth / FOCAL
        if visible.sum() < FEWEST:
            continue
        across = truth[frame, hips[0]] - truth[frame, hips[1]]
        starts = [
            pose @ vector_to_matrix(np.array([0.0, yaw, 0.0])).T @ camera
            for yaw in [np.arctan2(-across[2], across[0]), *DIRECTIONS]
        ]
        middle = points[visible].mean(axis=0)
        for start in starts:
            start[:, :2] += middle - start[visible, :2].mean(axis=0)
        energies = [
            lift_person(points, visible, start, limits, rounds=2, evaluations=EVALUATIONS)[1]
            for start in starts[1:]
        ]
        own = starts[1 + int(np.argmin(energies))]
        for poses, start in zip(result, (own, starts[0]), strict=True):
            lifted, _ = lift_person(points, visible, start, limits, evaluations=EVALUATIONS)
            poses[row] = (lifted @ camera.T)[chosen]
    return result[0], result[1]


def standing(truth: np.ndarray) -> np.ndarray:
    """Return a standing pose on ``person17`` with the mean limb lengths of the truth, (17, 3)."""
    offsets = np.array(
        [
            np.array(STANDING.get(name.replace("right", "left"), (0, 0, 0)), dtype=float)
            * (-1 if name.startswith("right") else 1, 1, 1)
            for name in LIMITED.joint_names
        ]
    )
    bones = [bone for limb in LIMBS for bone in pairwise(limb)]
    joints = [LIMITED.joint_names.index(name) for _, name in bones]
    ends = [[PERSON.joint_names.index(name) for name in bone] for bone in bones]
    true = np.array(
        [np.linalg.norm(truth[:, j] - truth[:, parent], axis=-1).mean() for parent, j in ends]
    )
    own = np.linalg.norm(offsets[joints], axis=-1)
    offsets *= true.mean() / own.mean()
    offsets[joints] *= (true / true.mean() / (own / own.mean()))[:, None]
    pose = np.zeros_like(offsets)
    for joint in LIMITED.topological_order[1:]:
        pose[joint] = pose[LIMITED.parents[joint]] + offsets[joint]
    return pose
