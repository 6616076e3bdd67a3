"""BVH writing: positions come back, and pybvh reads the same ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from probmotion.geometry.rotations import vector_to_matrix
from probmotion.io.bvh import read_bvh
from probmotion.io.errors import MotionFileWarning
from probmotion.io.files import read_motion, save_motion
from probmotion.motion.kinematics import forward_kinematics
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton

DATA = Path(__file__).parents[3] / "shared" / "data"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="no ../shared/data beside the checkout")

# Parents after their children, a joint with two children, and a second tree.
SKELETON = Skeleton(
    ["hand", "arm", "hip", "thigh", "shin", "ball", "string"], [1, 2, -1, 2, 3, -1, 5]
)


def rigid_motion(frames: int = 20, fps: float = 30) -> Motion:
    """A motion with constant offsets, rotations of every size among them."""
    rng = np.random.default_rng(5)
    rotations = vector_to_matrix(
        rng.normal(size=(frames, 7, 3)) * rng.exponential(2, (frames, 1, 1))
    )
    offsets = rng.normal(size=(7, 3)) * 0.4
    offsets[[2, 5]] = 0
    roots = rng.normal(size=(frames, 2, 3)) * 3
    positions, _ = forward_kinematics(SKELETON, rotations, roots, offsets)
    return Motion(positions, SKELETON, fps, rotations=rotations, rest_offsets=offsets)


def loose_motion() -> Motion:
    """A motion whose bones change their length, as a sampler's draws do."""
    positions = np.random.default_rng(6).normal(size=(20, 7, 3))
    positions[3, 0] = positions[3, 1]  # a bone of no length
    return Motion(positions, SKELETON, 30)


def ordered(motion: Motion, names: tuple[str, ...]) -> np.ndarray:
    return motion.positions[:, [motion.skeleton.index(name) for name in names]]


def assert_comes_back(motion: Motion, path: Path) -> Motion:
    save_motion(motion, path)
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


def test_a_rigid_motion_keeps_its_rotations(tmp_path: Path) -> None:
    motion = rigid_motion()
    back = assert_comes_back(motion, tmp_path / "clip.bvh")
    order = [motion.skeleton.index(name) for name in back.skeleton.joint_names]
    np.testing.assert_allclose(back.rotations, motion.rotations[:, order], atol=1e-8)
    np.testing.assert_allclose(back.rest_offsets, motion.rest_offsets[order], atol=1e-8)


def test_rigid_positions_without_rotations_need_no_position_channel(tmp_path: Path) -> None:
    motion = replace(rigid_motion(), rotations=None, rest_offsets=None)
    back = assert_comes_back(motion, tmp_path / "clip.bvh")
    assert back.rotations is not None
    assert (tmp_path / "clip.bvh").read_text().count("Xposition") == 2, "the roots' alone"


def test_bones_that_change_come_back_through_position_channels(tmp_path: Path) -> None:
    back = assert_comes_back(loose_motion(), tmp_path / "clip.bvh")
    assert back.rotations is None
    assert (tmp_path / "clip.bvh").read_text().count("Xposition") == 7


def test_rotations_that_contradict_the_positions_do_not_move_them(tmp_path: Path) -> None:
    motion = rigid_motion()
    assert_comes_back(replace(motion, positions=motion.positions * 1.1), tmp_path / "clip.bvh")


def test_one_joint_one_frame_and_a_long_chain(tmp_path: Path) -> None:
    assert_comes_back(Motion(np.ones((1, 1, 3)), Skeleton(["a"], [-1]), 1), tmp_path / "a.bvh")
    names = [f"j{i}" for i in range(1200)]
    positions = np.cumsum(np.full((1, 1200, 3), 1e-3), axis=1)
    chain = Motion(positions, Skeleton(names, range(-1, 1199)), 60)
    assert_comes_back(chain, tmp_path / "chain.bvh")


@pytest.mark.parametrize("fps", [1, 23.976, 24, 29.97, 59.998, 60, 119.99, 10_000])
def test_the_frame_rate_comes_back(tmp_path: Path, fps: float) -> None:
    assert_comes_back(rigid_motion(frames=2, fps=fps), tmp_path / "clip.bvh")


def test_pybvh_reads_the_same_positions(tmp_path: Path) -> None:
    import pybvh

    motion = rigid_motion()
    tree = [2, 1, 0, 3, 4]  # pybvh reads one root
    one = Motion(motion.positions[:, tree], motion.skeleton.subset(tree), 30)
    save_motion(one, tmp_path / "clip.bvh")
    read = pybvh.read_bvh_file(tmp_path / "clip.bvh", world_up="+y")
    joints = [node for node in read.nodes if not node.is_end_site()]
    assert [node.name for node in joints] == ["hip", "arm", "hand", "thigh", "shin"]
    kept = [index for index, node in enumerate(read.nodes) if not node.is_end_site()]
    np.testing.assert_allclose(read.node_positions()[:, kept], one.positions, atol=1e-6)


def test_a_motion_in_metres_is_read_in_metres(tmp_path: Path) -> None:
    motion = rigid_motion()
    save_motion(motion, tmp_path / "clip.bvh")
    names = motion.skeleton.joint_names
    back = read_motion(tmp_path / "clip.bvh")
    np.testing.assert_allclose(ordered(back, names), motion.positions, atol=1e-6)


@needs_data
@pytest.mark.parametrize(
    ("clip", "rigid"),
    [
        ("cmu_single/cmu_131_01.npz", True),
        ("deepmimic_human/humanoid3d_backflip.npz", True),
        ("deepmimic_dog/dog3d_canter.npz", True),
        ("cmu_salsa_pairs/cmu_60_61_10.npz", True),
        ("cmu_single/cmu_02_01.npz", False),  # ASF: sibling bones turn against each other
    ],
)
def test_real_clips_come_back(tmp_path: Path, clip: str, rigid: bool) -> None:
    motion = read_motion(DATA / clip)
    back = assert_comes_back(motion.window(0, min(motion.frames, 100)), tmp_path / "clip.bvh")
    assert (back.rotations is not None) == rigid


@needs_data
def test_a_real_bvh_file_comes_back_with_its_rotations(tmp_path: Path) -> None:
    with pytest.warns(MotionFileWarning):
        motion = read_motion(DATA / "originals" / "131_01.bvh")
    back = assert_comes_back(motion, tmp_path / "clip.bvh")
    np.testing.assert_allclose(back.rotations, motion.rotations, atol=1e-8)


@pytest.mark.parametrize("name", ["left knee", "a\tb", "a{", "}", "", " "])
def test_names_that_bvh_cannot_hold_are_refused(tmp_path: Path, name: str) -> None:
    motion = Motion(np.zeros((1, 1, 3)), Skeleton([name], [-1]), 30)
    with pytest.raises(ValueError, match="joint_names holds"):
        save_motion(motion, tmp_path / "clip.bvh")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("fps", [0.5, 20_000])
def test_rates_that_bvh_readers_refuse_are_refused(tmp_path: Path, fps: float) -> None:
    with pytest.raises(ValueError, match=r"fps must be 1 to 10000, got .*"):
        save_motion(rigid_motion(frames=2, fps=fps), tmp_path / "clip.bvh")


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(OSError, match=r"cannot write .*none.clip\.bvh"):
        save_motion(rigid_motion(), tmp_path / "none" / "clip.bvh")
