"""BVH writing: round trips and agreement with pybvh."""

from dataclasses import replace

import numpy as np
import pytest

from probmotion.geometry.rotations import vector_to_matrix
from probmotion.io.bvh import read_bvh
from probmotion.io.files import load, save
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
    rotations = vector_to_matrix(
        rng.normal(size=(frames, 7, 3)) * rng.exponential(2, (frames, 1, 1))
    )
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


def ordered(motion, names):
    return motion.positions[:, [motion.skeleton.index(name) for name in names]]


def assert_round_trip(motion, path):
    save(motion, path)
    back = read_bvh(path, scale=1.0)
    names = motion.skeleton.joint_names
    assert sorted(back.skeleton.joint_names) == sorted(names)
    for joint, parent in back.skeleton.bones:
        original = motion.skeleton.index(back.skeleton.joint_names[joint])
        above = motion.skeleton.parents[original]
        assert back.skeleton.joint_names[parent] == names[above]
    np.testing.assert_allclose(ordered(back, names), motion.positions, atol=1e-6)
    assert back.fps == pytest.approx(motion.fps, rel=1e-14)
    return back


def test_rigid_motion_keeps_its_rotations(tmp_path):
    motion = rigid_motion()
    back = assert_round_trip(motion, tmp_path / "clip.bvh")
    order = [motion.skeleton.index(name) for name in back.skeleton.joint_names]
    np.testing.assert_allclose(back.rotations, motion.rotations[:, order], atol=1e-8)
    np.testing.assert_allclose(back.rest_offsets, motion.rest_offsets[order], atol=1e-8)


def test_rigid_positions_are_written_as_rotations(tmp_path):
    motion = replace(rigid_motion(), rotations=None, rest_offsets=None)
    back = assert_round_trip(motion, tmp_path / "clip.bvh")
    assert back.rotations is not None
    assert (tmp_path / "clip.bvh").read_text().count("Xposition") == 2, "roots only"


def test_varying_bones_are_written_as_position_channels(tmp_path):
    back = assert_round_trip(loose_motion(), tmp_path / "clip.bvh")
    assert back.rotations is None
    assert (tmp_path / "clip.bvh").read_text().count("Xposition") == 7


def test_positions_take_precedence_over_inconsistent_rotations(tmp_path):
    motion = rigid_motion()
    assert_round_trip(replace(motion, positions=motion.positions * 1.1), tmp_path / "clip.bvh")


def test_single_joint_and_long_chain(tmp_path):
    assert_round_trip(Motion(np.ones((1, 1, 3)), Skeleton(["a"], [-1]), 1), tmp_path / "a.bvh")
    positions = np.cumsum(np.full((1, 400, 3), 1e-3), axis=1)
    skeleton = Skeleton([f"j{i}" for i in range(400)], range(-1, 399))
    assert_round_trip(Motion(positions, skeleton, 60), tmp_path / "chain.bvh")


@pytest.mark.parametrize("fps", [1, 23.976, 59.998, 60, 10_000])
def test_frame_rates_round_trip(tmp_path, fps):
    assert_round_trip(rigid_motion(frames=2, fps=fps), tmp_path / "clip.bvh")


def test_positions_agree_with_pybvh(tmp_path):
    import pybvh

    motion = rigid_motion()
    tree = [2, 1, 0, 3, 4]  # pybvh supports one root
    one = Motion(motion.positions[:, tree], motion.skeleton.subset(tree), 30)
    save(one, tmp_path / "clip.bvh")
    read = pybvh.read_bvh_file(tmp_path / "clip.bvh", world_up="+y")
    joints = [node for node in read.nodes if not node.is_end_site()]
    assert [node.name for node in joints] == ["hip", "arm", "hand", "thigh", "shin"]
    kept = [index for index, node in enumerate(read.nodes) if not node.is_end_site()]
    np.testing.assert_allclose(read.node_positions()[:, kept], one.positions, atol=1e-6)


@pytest.mark.parametrize(
    ("clip", "rigid"),
    [
        ("cmu_single/cmu_131_01.npz", True),
        ("deepmimic_dog/dog3d_canter.npz", True),
        ("cmu_salsa_pairs/cmu_60_61_10.npz", True),
        ("cmu_single/cmu_02_01.npz", False),  # ASF: sibling bones rotate independently
    ],
)
def test_real_clips_round_trip(tmp_path, real_data, clip, rigid):
    motion = load(real_data / clip)
    back = assert_round_trip(motion.window(0, min(motion.frames, 100)), tmp_path / "clip.bvh")
    assert (back.rotations is not None) == rigid


@pytest.mark.parametrize("name", ["left knee", "a\tb", "a{", "}", "", " "])
def test_invalid_names_are_refused(tmp_path, name):
    motion = Motion(np.zeros((1, 1, 3)), Skeleton([name], [-1]), 30)
    with pytest.raises(ValueError, match="joint_names must not contain blanks or braces in BVH"):
        save(motion, tmp_path / "clip.bvh")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("fps", [0.5, 20_000])
def test_invalid_rates_are_refused(tmp_path, fps):
    with pytest.raises(ValueError, match=r"fps must be 1 to 10000 in BVH files, got"):
        save(rigid_motion(frames=2, fps=fps), tmp_path / "clip.bvh")
