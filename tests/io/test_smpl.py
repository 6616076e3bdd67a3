"""SMPL's 22 joints from the 14 of ``person14``: rotations, positions and the T-pose."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from probmotion import Motion, Skeleton
from probmotion.data.synthetic.gaits import make_gait
from probmotion.geometry.rotations import geodesic_angle
from probmotion.io.files import load, save
from probmotion.io.smpl import smpl_motion
from probmotion.motion.kinematics import forward_kinematics

SMPL, PERSON = Skeleton.preset("smpl22"), Skeleton.preset("person14")
# Positions of the left joints in the T-pose by the rule, metres; pelvis at 0, neck at .52.
T_POSE = {
    "spine1": (0, 0.13, 0), "spine2": (0, 0.26, 0), "spine3": (0, 0.325, 0), "neck": (0, 0.52, 0),
    "head": (0, 0.624, 0), "left_collar": (0.09, 0.495, 0), "left_shoulder": (0.18, 0.47, 0),
    "left_elbow": (0.46, 0.47, 0), "left_wrist": (0.71, 0.47, 0), "left_hip": (0.1, -0.09, 0),
    "left_knee": (0.1, -0.51, 0), "left_ankle": (0.1, -0.9, 0),
}  # fmt: skip
HINGES = {"elbow": (0, -1, 0), "knee": (1, 0, 0)}  # axes on the left


def rest_pose():
    """Return the T-pose, (22, 3), metres."""
    foot = 0.13 * np.array([0, -0.4, 0.9]) / np.hypot(0.4, 0.9)
    places = T_POSE | {"left_foot": T_POSE["left_ankle"] + foot}
    rows = [
        np.array(places.get(name.replace("right", "left"), (0, 0, 0)), dtype=float)
        * (-1 if name.startswith("right") else 1, 1, 1)
        for name in SMPL.joint_names
    ]
    return np.stack(rows)


def moving_person(frames=90):
    """Return a person on smpl22 who leans, swings and bends, with the rotations of the rule."""
    angles = np.linspace(0, 2 * np.pi, frames)
    vectors = np.zeros((frames, 22, 3))
    swing = {"pelvis": 0.3, "spine1": 0.3, "shoulder": 0.5, "hip": 0.5}
    for joint, name in enumerate(SMPL.joint_names):
        side, _, part = name.rpartition("_")
        for axis in range(3):
            vectors[:, joint, axis] = swing.get(part, 0.0) * np.sin(angles + joint + 2 * axis)
        if part in HINGES:
            sign = -1 if part == "elbow" and side == "right" else 1
            bend = 1.2 + 0.3 * np.sin(angles + joint)
            vectors[:, joint] = sign * bend[:, None] * np.array(HINGES[part])
    rotations = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(frames, 22, 3, 3)
    rest = rest_pose()
    offsets = rest - rest[list(SMPL.parents)]
    offsets[0] = 0
    root = np.stack([0.2 * np.sin(angles), 1 + 0 * angles, angles / 3], axis=-1)[:, None]
    positions, world = forward_kinematics(SMPL, rotations, root, offsets)
    return Motion(positions, SMPL, 30.0, rotations, offsets), world


def world_of(motion):
    """Return positions and world rotations by forward kinematics."""
    root = motion.positions[:, :1]
    return forward_kinematics(motion.skeleton, motion.rotations, root, motion.rest_offsets)


def test_rotations_of_the_joints_of_smpl_are_recovered():
    truth, world = moving_person()
    found = smpl_motion(truth.retarget(PERSON))
    assert found.skeleton == SMPL
    np.testing.assert_allclose(found.rest_offsets, truth.rest_offsets, atol=0.02)
    wrong = np.degrees(geodesic_angle(world_of(found)[1], world))
    # The neck moves about spine1, not about the pelvis, as the bones of person14 have it.
    assert np.median(wrong, axis=0).max() < 5
    assert np.linalg.norm(found.positions - truth.positions, axis=-1).mean() < 0.015


@pytest.mark.parametrize("kind", ["walk", "run"])
def test_written_rotations_reproduce_written_positions(kind, tmp_path):
    gait = make_gait(kind, 1, frames=40)
    save(smpl_motion(gait), tmp_path / "x.npz")
    read = load(tmp_path / "x.npz")
    assert read.skeleton == SMPL
    np.testing.assert_allclose(world_of(read)[0], read.positions, atol=1e-6)
    moved = read.retarget(PERSON).positions - gait.retarget(PERSON).positions
    assert np.quantile(np.linalg.norm(moved, axis=-1), 0.95) < 0.025


def test_the_rest_pose_is_a_t_pose_of_smpl():
    offsets = smpl_motion(make_gait("walk", 1, frames=40)).rest_offsets
    places, _ = forward_kinematics(
        SMPL, np.tile(np.eye(3), (1, 22, 1, 1)), np.zeros((1, 1, 3)), offsets
    )
    place = dict(zip(SMPL.joint_names, places[0], strict=True))
    assert place["left_wrist"][0] > place["left_elbow"][0] > place["left_shoulder"][0] > 0
    assert place["left_wrist"][1] == pytest.approx(place["left_shoulder"][1])
    assert place["head"][1] > place["neck"][1] > place["spine1"][1] > 0 > place["left_knee"][1]
    assert place["left_foot"][2] > place["left_ankle"][2] + 0.05
    mirrored = places[0][list(SMPL.mirrored_order)] * [-1, 1, 1]
    np.testing.assert_allclose(places[0], mirrored, atol=0.02)


def test_motions_with_all_joints_are_unchanged_and_with_too_few_refused():
    truth, _ = moving_person(frames=5)
    assert smpl_motion(truth) is truth
    legs = PERSON.subset([0, 8, 9, 10, 11, 12, 13])
    with pytest.raises(ValueError, match="no counterpart"):
        smpl_motion(truth.retarget(legs))
