"""BVH writing: round trips of rigid, varying and real bones."""

from dataclasses import replace

import numpy as np
import pytest

from probmotion.geometry.rotations import vector_to_matrix
from probmotion.io.bvh import read_bvh
from probmotion.io.files import load, save
from probmotion.motion import inverse_kinematics
from probmotion.motion.kinematics import forward_kinematics
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton

# Parents after their children, a joint with two children, and a second tree.
SKELETON = Skeleton(
    ["hand", "arm", "hip", "thigh", "shin", "ball", "string"], [1, 2, -1, 2, 3, -1, 5]
)


def rigid_motion(frames=20, fps=30):
    """Motion with constant offsets and rotations of all magnitudes."""
    rng = np.random.default_rng(5)
    vectors = rng.normal(size=(frames, 7, 3)) * rng.exponential(2, (frames, 1, 1))
    rotations = vector_to_matrix(vectors)
    offsets = rng.normal(size=(7, 3)) * 0.4
    offsets[[2, 5]] = 0
    roots = rng.normal(size=(frames, 2, 3)) * 3
    positions, _ = forward_kinematics(SKELETON, rotations, roots, offsets)
    return Motion(positions, SKELETON, fps, rotations=rotations, rest_offsets=offsets)


def loose_motion():
    """Motion with varying bone lengths, as in sampled draws."""
    positions = np.random.default_rng(6).normal(size=(20, 7, 3))
    positions[3, 0] = positions[3, 1]  # a bone of length 0
    return Motion(positions, SKELETON, 30)


def assert_round_trip(motion, path):
    """Check joints, positions and rate; return the motion read and the order of its joints."""
    save(motion, path)
    back = read_bvh(path, scale=1.0)
    order = [motion.skeleton.index(name) for name in back.skeleton.joint_names]
    assert sorted(order) == list(range(motion.skeleton.n_joints))
    for joint, parent in back.skeleton.bones:
        assert order[parent] == motion.skeleton.parents[order[joint]]
    np.testing.assert_allclose(back.positions, motion.positions[:, order], atol=1e-6)
    assert back.fps == pytest.approx(motion.fps, rel=1e-14)
    return back, order


def test_rotations_round_trip(tmp_path):
    motion = rigid_motion()
    back, order = assert_round_trip(motion, tmp_path / "clip.bvh")
    np.testing.assert_allclose(back.rotations, motion.rotations[:, order], atol=1e-8)
    np.testing.assert_allclose(back.rest_offsets, motion.rest_offsets[order], atol=1e-8)


@pytest.mark.parametrize(
    "motion",
    [
        replace(rigid_motion(), rotations=None, rest_offsets=None),
        Motion(np.ones((1, 1, 3)), Skeleton(["a"], [-1]), 1),
        *(rigid_motion(frames=2, fps=fps) for fps in (23.976, 59.998, 10_000)),
    ],
)
def test_only_roots_have_position_channels(tmp_path, motion):
    back, _ = assert_round_trip(motion, tmp_path / "clip.bvh")
    assert back.rotations is not None
    count = (tmp_path / "clip.bvh").read_text().count("Xposition")
    assert count == len(motion.skeleton.roots)


@pytest.mark.parametrize(
    "motion",
    # Positions take precedence over inconsistent rotations.
    [loose_motion(), replace(rigid_motion(), positions=loose_motion().positions)],
)
def test_varying_bones_are_written_rigid_with_a_warning(tmp_path, motion):
    with pytest.warns(UserWarning, match=r"rigid bones are .* cm from the joints in the median"):
        rigid = inverse_kinematics.rigid_motion(motion)
    with pytest.warns(UserWarning, match=r"rigid bones are .* cm from the joints in the median"):
        save(motion, tmp_path / "clip.bvh")
    back = read_bvh(tmp_path / "clip.bvh", scale=1.0)
    # Joints that were added for a hub's loose children are left out again.
    assert rigid.skeleton.n_joints > motion.skeleton.n_joints
    save(rigid_motion(), tmp_path / "rigid.bvh")
    assert back.skeleton == read_bvh(tmp_path / "rigid.bvh", scale=1.0).skeleton
    order = [rigid.skeleton.index(name) for name in back.skeleton.joint_names]
    np.testing.assert_allclose(back.positions, rigid.positions[:, order], atol=1e-6)


@pytest.mark.parametrize(
    ("clip", "tolerance"),
    [
        ("deepmimic_dog/dog3d_canter.npz", 1e-6),
        ("cmu_salsa_pairs/cmu_60_61_10.npz", 1e-6),
        ("cmu_single/cmu_02_01.npz", 0.025),  # ASF: sibling bones rotate independently
    ],
)
def test_real_clips_round_trip(tmp_path, real_data, clip, tolerance):
    motion = load(real_data / clip)
    motion = motion.window(0, min(motion.frames, 100))
    save(motion, tmp_path / "clip.bvh")
    back = read_bvh(tmp_path / "clip.bvh", scale=1.0)
    assert back.rotations is not None
    order = [motion.skeleton.index(name) for name in back.skeleton.joint_names]
    np.testing.assert_allclose(back.positions, motion.positions[:, order], atol=tolerance)


@pytest.mark.parametrize(
    ("name", "fps", "message"),
    [
        *((name, 30, "must not contain blanks or braces") for name in ("a\tb", "a{", "}", "", " ")),
        *(("a", fps, r"fps must be 1 to 10000 in BVH files, got") for fps in (0.5, 20_000)),
    ],
)
def test_invalid_names_and_rates_are_refused(tmp_path, name, fps, message):
    with pytest.raises(ValueError, match=message):
        save(Motion(np.zeros((1, 1, 3)), Skeleton([name], [-1]), fps), tmp_path / "clip.bvh")
    assert not list(tmp_path.iterdir())
