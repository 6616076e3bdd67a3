"""Joint-angle limits: learning, validity and correction of poses."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from probmotion import Motion, Skeleton
from probmotion.models.pose_pairs.joint_limits import JointLimits, sphere_rings
from probmotion.models.pose_pairs.joint_limits_frames import cell_of
from probmotion.models.pose_pairs.joint_limits_kernels import PARTS
from probmotion.models.pose_pairs.joint_limits_learning import (
    HELD_OUT,
    learn_limits,
    main,
)

PERSON = Skeleton.preset("person17")
JOINT = {name: index for index, name in enumerate(PERSON.joint_names)}
MIRROR = np.array([-1.0, 1.0, 1.0])
SWAPPED = np.arange(17)
for left, right in PERSON.mirrored_pairs:
    SWAPPED[[left, right]] = right, left

OFFSETS = {
    "spine": (0, 0.2, 0), "chest": (0, 0.15, 0), "neck": (0, 0.2, 0), "head": (0, 0.1, 0.05),
    "shoulder": (0.18, 0.12, 0), "elbow": (0.05, -0.28, 0), "wrist": (0, -0.24, 0.02),
    "hip": (0.1, -0.05, 0.02), "knee": (0, -0.4, 0), "ankle": (0, -0.42, 0),
}  # fmt: skip


def angle(a, b):
    across = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.arctan2(across, (a * b).sum(axis=-1))


def swings(n, seed=0):
    """Simulate people swinging arms and legs with flexed knees and elbows, (n, 17, 3)."""
    rng = np.random.default_rng(seed)
    degrees = {name: rng.uniform(-8, 8, (n, 3)) for name in PERSON.joint_names}
    for side, sign in (("left", 1.0), ("right", -1.0)):
        degrees[f"{side}_knee"] = rng.uniform((-40, -5, -10), (20, 5, 10), (n, 3))
        degrees[f"{side}_ankle"] = rng.uniform(0, 100, (n, 1)) * [1, 0, 0]
        degrees[f"{side}_elbow"] = rng.uniform((-70, -5, 5), (30, 5, 50), (n, 3)) * [1, sign, sign]
        degrees[f"{side}_wrist"] = rng.uniform(-120, 0, (n, 1)) * [1, 0, 0]
    poses = np.zeros((n, 17, 3))
    frames = {0: Rotation.random(n, rng=rng)}
    poses[:, 0] = rng.normal(size=(n, 3))
    for joint, parent in PERSON.bones:
        name = PERSON.joint_names[joint]
        offset = np.array(OFFSETS[name.rpartition("_")[2]], dtype=float)
        if name.startswith("right"):
            offset *= MIRROR
        frames[joint] = frames[parent] * Rotation.from_euler("xyz", degrees[name], degrees=True)
        poses[:, joint] = poses[:, parent] + frames[joint].apply(offset)
    return poses


def random_poses(n, seed=1):
    """Simulate bones of random direction and length."""
    rng = np.random.default_rng(seed)
    poses = np.zeros((n, 17, 3))
    for joint, parent in PERSON.bones:
        poses[:, joint] = poses[:, parent] + 0.3 * rng.normal(size=(n, 3))
    return poses + rng.normal(size=(n, 1, 3))


def mirrored(poses):
    return (poses * MIRROR)[:, SWAPPED]


def bones_of(poses):
    joints, parents = np.array(PERSON.bones).T
    return poses[..., joints, :] - poses[..., parents, :]


def bent_backwards(poses, joint):
    """Rotate the bone to ``joint`` by half a turn about its parent."""
    parent = PERSON.parents[joint]
    axis = poses[:, parent] - poses[:, PERSON.parents[parent]]
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    bone = poses[:, joint] - poses[:, parent]
    rotated = poses.copy()
    rotated[:, joint] = poses[:, parent] + 2 * (axis * bone).sum(1, keepdims=True) * axis - bone
    return rotated


def flexion(poses, joint):
    bones = bones_of(poses)
    return angle(bones[:, joint - 1], bones[:, joint - 2])


def flexed(poses, joint):
    return poses[flexion(poses, joint) > np.deg2rad(40)]


@pytest.fixture(scope="module")
def limits():
    return learn_limits([swings(4000)])


@pytest.fixture(scope="module")
def shipped():
    return JointLimits.shipped()


@pytest.fixture(params=["learnt", "shipped"])
def table(request, limits, shipped):
    return limits if request.param == "learnt" else shipped


def test_training_poses_are_valid_and_dilation_enlarges_the_table():
    poses, tables = swings(300), []
    for dilation in (0.0, 0.1, 0.3):
        limits = learn_limits([poses[:100], poses[100:]], dilation=dilation, bin_dilation=0.0)
        valid, nearest = limits.project(poses)
        assert valid[:, 1:].all()
        assert valid[:, 0].mean() > 0.995  # the tilt of the spine is a quantile
        unchanged = valid.all(axis=1)
        np.testing.assert_array_equal(nearest[unchanged], poses[unchanged])
        assert limits.is_valid(mirrored(poses))[:, 1:].all()
        tables.append(limits.allowed)
    for small, large in pairwise(tables):
        assert (small <= large).all()
        assert small.sum() < large.sum()


def test_hips_stay_on_their_side():
    wide = learn_limits([swings(30)], dilation=1.4, bin_dilation=0.0)
    assert not wide.allowed[PARTS.index("hip")][:, sphere_rings(22)[1][:, 0] <= 0].any()


def test_nearest_valid_pose_is_valid_and_preserves_lengths_and_roots(table, limits):
    poses = np.concatenate([random_poses(3000), swings(500, seed=2)])
    valid, nearest = table.project(poses)
    assert 0.1 < valid.mean() < 0.9
    assert limits.is_valid(swings(2000, seed=5)).mean() > 0.99
    valid_again, unchanged = table.project(nearest)
    assert valid_again.all()
    np.testing.assert_array_equal(unchanged, nearest)
    np.testing.assert_array_equal(nearest[:, 0], poses[:, 0])
    lengths = (np.linalg.norm(bones_of(p), axis=-1) for p in (nearest, poses))
    np.testing.assert_allclose(*lengths, rtol=1e-12)


@pytest.mark.parametrize("ankle", ["left_ankle", "right_ankle"])
def test_knee_bent_forwards_is_invalid_and_only_the_shin_moves(limits, ankle):
    joint = JOINT[ankle]
    forwards = bent_backwards(flexed(swings(400, seed=3), joint), joint)
    valid, nearest = limits.project(forwards)
    assert not valid[:, joint - 1].any()
    others = np.delete(valid, joint - 1, axis=1).all(axis=1)
    assert others.mean() > 0.9
    changed = np.abs(nearest - forwards)[others].max(axis=(0, 2)) > 0
    assert np.flatnonzero(changed).tolist() == [joint]


def test_correction_is_the_nearest_valid_direction(limits):
    """The reference is a search over directions; the tolerance is the size of a cell."""
    directions = sphere_rings(40)[1]
    joint, parent = JOINT["left_wrist"], JOINT["left_elbow"]
    wrong = bent_backwards(swings(30, seed=4), joint)
    length = np.linalg.norm(bones_of(wrong)[:, joint - 1], axis=1)
    for pose, reach, corrected in zip(wrong, length, limits.nearest_valid(wrong), strict=True):
        candidates = np.repeat(pose[None], len(directions), axis=0)
        candidates[:, joint] = pose[parent] + reach * directions
        valid = limits.is_valid(candidates)[:, joint - 1]
        bone = pose[joint] - pose[parent]
        nearest = angle(directions[valid], bone).min()
        assert angle(corrected[joint] - corrected[parent], bone) <= nearest + np.pi / 22


def test_descendants_rotate_with_a_corrected_bone(limits):
    poses = swings(400, seed=6)
    arm = [JOINT["left_elbow"], JOINT["left_wrist"]]
    wrong = poses.copy()
    wrong[:, arm] = 2 * poses[:, JOINT["left_shoulder"]][:, None] - poses[:, arm]
    valid, nearest = limits.project(wrong)
    selected = ~valid[:, arm[0] - 1] & np.delete(valid, arm[0] - 1, axis=1).all(axis=1)
    assert selected.sum() > 10
    before, after = (flexion(p[selected], arm[1]) for p in (wrong, nearest))
    np.testing.assert_allclose(before, after, atol=1e-7)
    fixed = np.delete(np.arange(17), arm)
    np.testing.assert_array_equal(nearest[selected][:, fixed], wrong[selected][:, fixed])


def test_limits_are_equivariant_to_reflection_and_similarity(table):
    poses = np.concatenate([random_poses(2000, seed=7), swings(500, seed=8)])
    valid, nearest = table.project(poses)
    valid_image, nearest_image = table.project(mirrored(poses))
    np.testing.assert_array_equal(valid_image, valid[:, SWAPPED[1:] - 1])
    np.testing.assert_allclose(nearest_image, mirrored(nearest), atol=1e-9)
    turn = Rotation.from_rotvec([0.4, -1.1, 0.8]).as_matrix()
    valid_moved, nearest_moved = table.project(1.3 * poses @ turn.T + [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(valid_moved, valid)
    np.testing.assert_allclose(nearest_moved, 1.3 * nearest @ turn.T + [1.0, 2.0, 3.0], atol=1e-9)


def test_limits_depend_on_the_parents_direction():
    """In the training poses, forearms point ahead from hanging arms and from arms ahead."""
    base = swings(1, seed=10)[0]
    shoulder, elbow, wrist = (JOINT[f"left_{n}"] for n in ("shoulder", "elbow", "wrist"))
    ahead = np.cross(base[JOINT["left_hip"]] - base[JOINT["right_hip"]], base[1] - base[0])
    ahead /= np.linalg.norm(ahead)
    up = base[JOINT["neck"]] - base[JOINT["chest"]]
    up /= np.linalg.norm(up)

    def posed(arm, forearm):
        pose = base.copy()
        pose[elbow] = pose[shoulder] + 0.3 * arm
        pose[wrist] = pose[elbow] + 0.25 * forearm
        return pose

    training = np.stack([posed(-up, ahead), posed(ahead, ahead)])
    limits = learn_limits([training])
    assert limits.is_valid(training).all()
    assert not limits.is_valid(posed(-up, -up))[wrist - 1]
    assert not limits.is_valid(posed(ahead, -up))[wrist - 1]
    assert limits.is_valid(posed(ahead, -up))[elbow - 1]


def test_people_are_independent_for_any_order_of_joints(limits):
    people = 3
    each = [random_poses(50, seed=20 + p) for p in range(people)]
    order = np.random.default_rng(people).permutation(17 * people)
    position = np.argsort(order)
    names = [f"p{p}:{name}" for p in range(people) for name in PERSON.joint_names]
    parents = [-1 if q < 0 else position[q + 17 * p] for p in range(people) for q in PERSON.parents]
    crowd = Skeleton([names[j] for j in order], [parents[j] for j in order])
    poses = np.concatenate(each, axis=1)[:, order]
    valid, nearest = limits.on(crowd).project(poses)
    batch = limits.on(crowd).nearest_valid(poses.reshape(5, 10, -1, 3))
    np.testing.assert_array_equal(batch.reshape(poses.shape), nearest)
    bone = {joint: i for i, (joint, _) in enumerate(crowd.bones)}
    for p, poses in enumerate(each):
        expected, corrected = limits.project(poses)
        np.testing.assert_array_equal(nearest[:, position[17 * p : 17 * p + 17]], corrected)
        bones = [bone[position[17 * p + joint]] for joint, _ in PERSON.bones]
        np.testing.assert_array_equal(valid[:, bones], expected)


def test_a_pose_is_corrected_alike_after_similar_ones(table):
    """Bones that equal those of the previous pose are not checked again."""
    rng = np.random.default_rng(0)
    # On a grid, joints that move together keep their bones exactly.
    start = np.round(1024 * swings(1)[0]) / 1024
    poses = []
    for joint in rng.integers(1, 17, size=600):
        moved = [j for j in range(17) if joint in (j, *PERSON.ancestors(j))]
        pose = start.copy()
        # Every fourth bone has no length.
        bone = pose[joint] - pose[PERSON.parents[joint]]
        far = rng.random() < 0.75
        pose[moved] += rng.integers(-200, 200, size=3) / 1024 if far else -bone
        poses.append(pose)
    valid, nearest = table.project(np.array(poses))
    assert 0.1 < valid.mean() < 0.99
    for index, pose in enumerate(poses):
        expected, corrected = table.project(pose)
        np.testing.assert_array_equal(valid[index], expected)
        np.testing.assert_array_equal(nearest[index], corrected)


def test_degenerate_poses_are_corrected(limits):
    """The poses have coincident joints or hips, a spine along the hips, or are mirrored."""
    poses = np.repeat(swings(1), 5, axis=0)
    poses[0] = 0.0
    hips = [JOINT["left_hip"], JOINT["right_hip"]]
    poses[1, hips[1]] = poses[1, hips[0]]
    poses[2, 1] = poses[2, 0] + (poses[2, hips[0]] - poses[2, hips[1]])
    poses[3, hips] = poses[3, hips[::-1]]
    poses[4] = 2 * poses[4, :1] - poses[4]
    nearest = limits.nearest_valid(poses)
    assert np.isfinite(nearest).all()
    assert limits.is_valid(nearest).all()
    np.testing.assert_array_equal(nearest[0], poses[0])


def test_cells_partition_the_sphere_evenly_and_symmetrically():
    rings, centres = sphere_rings(22)
    assert rings[:, 0].sum() == len(centres) == 624
    assert [cell_of(centre, rings) for centre in centres] == list(range(len(centres)))
    points = np.random.default_rng(12).normal(size=(60_000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    cells = np.array([cell_of(point, rings) for point in points])
    counts = np.bincount(cells, minlength=len(centres))
    assert counts.min() > 0.5 * counts.mean()
    assert angle(points, centres[cells]).max() < np.deg2rad(8)
    image = np.array([cell_of(centre * MIRROR, rings) for centre in centres])
    np.testing.assert_array_equal(image[cells], [cell_of(p * MIRROR, rings) for p in points])


def test_learning_and_saving_are_byte_reproducible(tmp_path, limits):
    paths = [tmp_path / "a.npz", tmp_path / "b.npz"]
    limits.save(paths[0])
    poses = swings(4000)
    learn_limits([Motion(poses[:1500], PERSON, 30.0), poses[1500:]]).save(paths[1])
    assert paths[0].read_bytes() == paths[1].read_bytes()
    read = JointLimits.load(paths[0])
    np.testing.assert_array_equal(read.allowed, limits.allowed)
    poses = random_poses(100)
    np.testing.assert_array_equal(read.nearest_valid(poses), limits.nearest_valid(poses))
    paths[0].write_bytes(paths[0].read_bytes()[:100])
    with pytest.raises(ValueError, match=r"path must be a file written by JointLimits.save"):
        JointLimits.load(paths[0])


def test_command_reproduces_the_shipped_limits(shipped, real_data, tmp_path, capsys):
    main(real_data, tmp_path / "again.npz")
    again = JointLimits.load(tmp_path / "again.npz")
    np.testing.assert_array_equal(again.allowed, shipped.allowed)
    np.testing.assert_array_equal(again.rest, shipped.rest)
    assert again.tilt == shipped.tilt
    # The shipped file records the command under its former module path.
    assert {**again.provenance, "command": shipped.provenance["command"]} == shipped.provenance
    assert not set(shipped.provenance["clips"]) & set(HELD_OUT)
    assert max(shipped.provenance["rejected_of_held_out"].values()) < 0.01
    assert "5910 held-out poses, 0.40% of bones rejected" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda _: learn_limits([]), "motions must contain at least one frame, got none"),
        (lambda _: learn_limits([np.zeros((2, 16, 3))]), r"motions\[0\] must have shape \(L, 17"),
        (lambda _: learn_limits([swings(2)], dilation=2.0), "dilation must be at least 0"),
        (lambda _: learn_limits([swings(2)], bin_rings=1), "bin_rings must be an integer"),
        (lambda x: x.is_valid(np.zeros((34, 3))), r"poses must have shape \(…, 17, 3\)"),
        (lambda x: x.is_valid(np.full((17, 3), np.nan)), "poses must be finite, got 51 values"),
        (lambda x: x.on(Skeleton.preset("gymnast-ball")), "joints and parents of 'person17'"),
        (lambda _: main(Path("nowhere"), Path("out.npz")), "data must contain cmu_01_07"),
    ],
)
def test_invalid_arguments_are_rejected(call, message, limits):
    with pytest.raises(ValueError, match=message):
        call(limits)
