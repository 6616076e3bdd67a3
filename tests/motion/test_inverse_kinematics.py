"""Inverse kinematics: rigid bones, twist, standing feet."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from probmotion import Motion, Skeleton
from probmotion.geometry.rotations import geodesic_angle
from probmotion.io.npz import read_npz
from probmotion.motion._bone_fits import Distances, nearest_rigid, twisted
from probmotion.motion.inverse_kinematics import rigid_motion
from probmotion.motion.kinematics import forward_kinematics

PERSON = Skeleton.preset("person14")
# Offsets of person14 in a T-pose, metres.
T_POSE = {
    "neck": (0, 0.5, 0), "left_shoulder": (0.17, -0.05, 0), "left_elbow": (0.28, 0, 0),
    "left_wrist": (0.25, 0, 0), "left_hip": (0.1, -0.08, 0), "left_knee": (0, -0.42, 0),
    "left_ankle": (0, -0.4, 0),
}  # fmt: skip
OFFSETS = np.array(
    [
        np.array(T_POSE.get(name.replace("right", "left"), (0, 0, 0)), dtype=float)
        * (-1 if name.startswith("right") else 1, 1, 1)
        for name in PERSON.joint_names
    ]
)


def smooth(shape, seed, frames_of_change=8):
    """Return smooth standard normal noise over the first axis."""
    noise = np.random.default_rng(seed).normal(size=shape)
    noise = gaussian_filter1d(noise, frames_of_change, axis=0)
    return noise / noise.std()


def moving_person(frames=120, bend=1.2):
    """Return a person with random rotations, elbows and knees bent as hinges, and its rotations."""
    vectors = 0.4 * smooth((frames, 14, 3), seed=1)
    for side, sign in (("left", 1), ("right", -1)):
        angles = bend * (1 + 0.2 * smooth((frames, 2), seed=2 + sign))
        for joint, axis, angle in (
            (f"{side}_elbow", [0, -sign, 0], angles[:, 0]),
            (f"{side}_knee", [1, 0, 0], angles[:, 1]),
        ):
            vectors[:, PERSON.index(joint)] = angle[:, None] * np.array(axis)
        for end in ("wrist", "ankle"):
            vectors[:, PERSON.index(f"{side}_{end}")] = 0
    rotations = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(frames, 14, 3, 3)
    roots = 0.3 * smooth((frames, 1, 3), seed=9) + [0, 1, 0]
    positions, world = forward_kinematics(PERSON, rotations, roots, OFFSETS)
    return Motion(positions, PERSON, 30.0), world


def noisy(motion, deviation, seed=0):
    noise = deviation * smooth(motion.positions.shape, seed, frames_of_change=3)
    return Motion(motion.positions + noise, motion.skeleton, motion.fps)


def world_rotations(motion):
    roots = motion.positions[:, list(motion.skeleton.roots)]
    return forward_kinematics(motion.skeleton, motion.rotations, roots, motion.rest_offsets)


def largest_turns(motion):
    """Return the largest rotation of each joint between frames, degrees."""
    _, world = world_rotations(motion)
    return np.rad2deg(geodesic_angle(world[:-1], world[1:])).max(axis=0)


def bone_lengths(motion):
    joints, parents = map(list, zip(*motion.skeleton.bones, strict=True))
    return np.linalg.norm(motion.positions[:, joints] - motion.positions[:, parents], axis=-1)


def test_rotations_with_twist_are_recovered():
    """Hinges determine the twist of thighs and upper arms, hips and shoulders that of the trunk."""
    motion, world = moving_person()
    rigid = rigid_motion(motion)
    assert rigid.skeleton == PERSON
    np.testing.assert_allclose(rigid.positions, motion.positions, atol=1e-9)
    np.testing.assert_allclose(rigid.rest_offsets, OFFSETS, atol=0.02)
    # The rest pose, here of constant rotation relative to the T-pose, is the mean of the clip.
    found = world_rotations(rigid)[1]
    differences = np.swapaxes(world, -1, -2) @ found
    constant = np.stack(
        [Rotation.from_matrix(one).mean().as_matrix() for one in differences.swapaxes(0, 1)]
    )
    errors = np.rad2deg(geodesic_angle(differences, constant))
    assert np.rad2deg(geodesic_angle(constant, np.eye(3))).max() < 25
    assert np.quantile(errors, 0.95) < 4
    assert errors.max() < 12


def test_rest_pose_of_a_noisy_person_is_a_t_pose():
    rest = rigid_motion(noisy(moving_person()[0], 0.005)).rest_offsets
    for name, offset in zip(PERSON.joint_names, rest, strict=False):
        side = 1.0 if name.startswith("left") else -1.0
        if name.endswith(("elbow", "wrist")):
            np.testing.assert_allclose(offset / np.linalg.norm(offset), [side, 0, 0], atol=1e-9)
        elif name.endswith(("knee", "ankle")):
            np.testing.assert_allclose(offset / np.linalg.norm(offset), [0, -1, 0], atol=1e-9)
        elif name != "pelvis":
            np.testing.assert_allclose(offset, OFFSETS[PERSON.index(name)], atol=0.02)


def test_straight_limbs_do_not_flip():
    """Elbows and knees that are straight up to noise have planes in all directions."""
    motion = noisy(moving_person(bend=0.0)[0], 0.002)
    assert (largest_turns(rigid_motion(motion)) < 25).all()


@pytest.mark.parametrize(
    ("first", "last", "bound"),
    # A bone that passes its opposite at 3° per frame, and one that circles around it at 10°.
    [((1, 0, 1e-3), (0, 1, 0), 3.2), ((0, 0.17, 0), (0, 0, 0.17), 0.8)],
)
def test_bones_close_to_a_half_turn_do_not_flip(first, last, bound):
    axis = np.array([1.0, 0, 0])
    angle = np.linspace(0, 2 * np.pi, 121)[:, None]
    path = np.cos(angle) * first + np.sin(angle) * last - (bound < 1) * axis
    path /= np.linalg.norm(path, axis=-1, keepdims=True)
    rotations = twisted(axis, path, path, np.zeros(121), np.array([0, 1.0, 0]), 30.0)
    np.testing.assert_allclose(rotations @ axis, path, atol=1e-12)
    assert np.rad2deg(geodesic_angle(rotations[:-1], rotations[1:])).max() < bound


def test_nearest_rigid_positions_are_optimal():
    rng = np.random.default_rng(3)
    positions = rng.normal(size=(2, 4, 3))
    pairs = np.array([0, 1, 1]), np.array([1, 2, 3])
    lengths = np.linalg.norm(positions[0, pairs[0]] - positions[0, pairs[1]], axis=-1)
    distances = Distances(*pairs, lengths * [1.1, 0.95, 1.05])
    weights = rng.uniform(0.5, 2, size=(2, 4))
    found = nearest_rigid(positions[:1], distances, weights[:1])[0]
    np.testing.assert_allclose(distances.deviations(found[None]), 0, atol=1e-7)

    def loss(q):
        return (weights[0][:, None] * (q.reshape(4, 3) - positions[0]) ** 2).sum()

    best = minimize(
        loss,
        positions[0].ravel(),
        constraints={
            "type": "eq",
            "fun": lambda q: distances.deviations(q.reshape(1, 4, 3))[0],
        },
        options={"ftol": 1e-14, "maxiter": 500},
    )
    assert loss(found) == pytest.approx(best.fun, rel=1e-6)
    np.testing.assert_allclose(found.ravel(), best.x, atol=1e-4)


def test_consistent_rotations_are_kept():
    motion = rigid_motion(moving_person(frames=5)[0])
    assert rigid_motion(motion) is motion
    shifted = replace(motion, positions=motion.positions + 0.01)
    assert rigid_motion(shifted) is shifted  # roots are given
    bent = motion.positions.copy()
    bent[:, 4] += 0.01
    assert rigid_motion(replace(motion, positions=bent)) is not motion


def test_children_that_move_against_siblings_get_their_own_joint():
    motion, _ = moving_person()
    positions = motion.positions.copy()
    upper = [j for j in range(14) if j == 1 or 1 in PERSON.ancestors(j)]
    bends = Rotation.from_rotvec(0.4 * smooth((motion.frames, 3), seed=20)).as_matrix()
    pelvis = positions[:, :1]
    positions[:, upper] = pelvis + (positions[:, upper] - pelvis) @ np.swapaxes(bends, 1, 2)
    rigid = rigid_motion(replace(motion, positions=positions))
    assert rigid.skeleton.joint_names == (*PERSON.joint_names, "pelvis_to_neck")
    assert rigid.skeleton.parents[1] == 14
    assert rigid.skeleton.parents[14] == 0
    np.testing.assert_allclose(rigid.positions[:, :14], positions, atol=1e-9)


def test_a_joint_follows_the_child_with_more_joints_below():
    hand = Skeleton(["wrist", "thumb", "finger", "tip"], [-1, 0, 0, 2])
    bones = smooth((60, 4, 3), seed=5)
    bones /= np.linalg.norm(bones, axis=-1, keepdims=True)
    positions = bones.copy()
    positions[:, 1:3] += positions[:, :1]
    positions[:, 3] += positions[:, 2]
    rigid = rigid_motion(Motion(positions, hand, 30.0))
    assert rigid.skeleton.joint_names[4:] == ("wrist_to_thumb",)
    np.testing.assert_allclose(rigid.positions[:, :4], positions, atol=1e-9)


def steps_on_the_spot(frames=300):
    """Return a person who steps with bent knees, and the mask of standing ankles (L, 2)."""
    time = np.arange(frames) / 30
    lifts = np.maximum(0.25 * np.sin(2 * np.pi * time[:, None] / 2 + [0, np.pi]), 0)
    positions = np.zeros((frames, 14, 3))
    positions[:, 0] = np.stack([0.03 * np.sin(np.pi * time), 0.8 + 0 * time, 0 * time], axis=-1)
    for joint in PERSON.topological_order[1:]:
        positions[:, joint] = positions[:, PERSON.parents[joint]] + OFFSETS[joint]
    for foot, side in enumerate(("left", "right")):
        hip, knee, ankle = (PERSON.index(f"{side}_{part}") for part in ("hip", "knee", "ankle"))
        positions[:, ankle] = (
            OFFSETS[hip] * [1, 0, 0] + [0, 0.08, 0] + lifts[:, foot, None] * [0, 1, 0]
        )
        leg = positions[:, ankle] - positions[:, hip]
        size = np.linalg.norm(leg, axis=-1, keepdims=True)
        along = (0.42**2 - 0.4**2 + size**2) / (2 * size)
        forward = np.cross(leg, [-1.0, 0, 0])
        forward /= np.linalg.norm(forward, axis=-1, keepdims=True)
        bend = np.sqrt(0.42**2 - along**2) * forward
        positions[:, knee] = positions[:, hip] + along * leg / size + bend
    return Motion(positions, PERSON, 30.0), lifts == 0


def test_standing_feet_are_held_to_the_floor():
    """The joints have slow noise of 1 cm; the true feet stand at one height."""
    true, standing = steps_on_the_spot()
    assert np.ptp(bone_lengths(true), axis=0).max() < 1e-12
    noise = 0.01 * smooth(true.positions.shape, seed=0)
    motion = replace(true, positions=true.positions + noise)
    rigid = rigid_motion(motion)
    feet = [PERSON.index("left_ankle"), PERSON.index("right_ankle")]
    heights = rigid.positions[:, feet, 1][standing]
    assert np.abs(heights - 0.08).max() < 0.015
    assert np.abs(motion.positions[:, feet, 1][standing] - 0.08).max() > 0.02
    assert rigid.positions[:, feet, 1].max() > 0.3
    errors = np.linalg.norm(rigid.positions[:, :14] - motion.positions, axis=-1)
    assert np.median(errors) < 0.01
    assert np.ptp(bone_lengths(rigid), axis=0).max() < 1e-6


def test_feet_stand_below_straight_legs_whose_length_varies():
    """Hips give way, since the feet are given with more weight."""
    still = np.tile(np.eye(3), (300, 14, 1, 1))
    pose, _ = forward_kinematics(PERSON, still, np.tile([0, 0.98, 0], (300, 1, 1)), OFFSETS)
    motion = Motion(pose + 0.015 * smooth(pose.shape, seed=0), PERSON, 30.0)
    feet = [PERSON.index("left_ankle"), PERSON.index("right_ankle")]
    assert np.abs(rigid_motion(motion).positions[:, feet, 1] - 0.08).max() < 0.0145


def test_bones_that_vary_are_reported():
    motion = moving_person()[0]
    stretch = 1 + 0.2 * smooth((motion.frames, 1, 1), seed=4)
    with pytest.warns(UserWarning, match=r"rigid bones are [\d.]+ cm .* and \d+ cm at the 95 %"):
        rigid = rigid_motion(replace(motion, positions=motion.positions * stretch))
    assert np.ptp(bone_lengths(rigid), axis=0).max() < 1e-6


@pytest.mark.parametrize("skeleton", [None, "person14"])
@pytest.mark.parametrize(
    "clip", ["cmu_actions/walking_2", "cmu_actions/soccer_2", "deepmimic_human/humanoid3d_dance_a"]
)
def test_real_clips_become_rigid(real_data, clip, skeleton):
    motion = read_npz(real_data / f"{clip}.npz")
    if skeleton is not None:
        motion = motion.retarget(Skeleton.preset(skeleton))
    rigid = rigid_motion(motion)
    errors = np.linalg.norm(
        rigid.positions[:, : motion.skeleton.n_joints] - motion.positions, axis=-1
    )
    assert np.median(errors) < 0.01
    assert np.quantile(errors, 0.95) < 0.02
    assert np.ptp(bone_lengths(rigid), axis=0).max() < 1e-6
