"""Joint-angle limits: what was seen is valid, what is corrected is valid, near and nothing else."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from probmotion import Motion, Skeleton
from probmotion.io.files import load_motion
from probmotion.models.pose_pairs.joint_limits import JointLimits, sphere_rings
from probmotion.models.pose_pairs.joint_limits_frames import cell_of
from probmotion.models.pose_pairs.joint_limits_kernels import PARTS
from probmotion.models.pose_pairs.joint_limits_learning import (
    HELD_OUT,
    clips_of_people,
    learn_limits,
    main,
    rejected_fractions,
)

PERSON = Skeleton.preset("person17")
PAIR = Skeleton.preset("pair17")
MIRROR = np.array([-1.0, 1.0, 1.0])

OFFSETS = {
    "spine": (0, 0.2, 0), "chest": (0, 0.15, 0), "neck": (0, 0.2, 0), "head": (0, 0.1, 0.05),
    "shoulder": (0.18, 0.12, 0), "elbow": (0.05, -0.28, 0), "wrist": (0, -0.24, 0.02),
    "hip": (0.1, -0.05, 0.02), "knee": (0, -0.4, 0), "ankle": (0, -0.42, 0),
}  # fmt: skip


def swings(n, seed=0):
    """People who swing arms and legs, bend knees backwards and elbows forwards, (n, 17, 3)."""
    rng = np.random.default_rng(seed)
    degrees = {name: rng.uniform(-8, 8, (n, 3)) for name in PERSON.joint_names}
    for side in ("left", "right"):
        turn = 1.0 if side == "left" else -1.0
        degrees[f"{side}_knee"] = rng.uniform((-40, -5, -10), (20, 5, 10), (n, 3))
        degrees[f"{side}_ankle"] = rng.uniform(0, 100, (n, 1)) * [1, 0, 0]
        degrees[f"{side}_elbow"] = rng.uniform((-70, -5, 5), (30, 5, 50), (n, 3)) * [1, turn, turn]
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


def scrambled(n, seed=1):
    """People whose bones point anywhere, with lengths of their own."""
    rng = np.random.default_rng(seed)
    poses = np.zeros((n, 17, 3))
    for joint, parent in PERSON.bones:
        poses[:, joint] = poses[:, parent] + 0.3 * rng.normal(size=(n, 3))
    return poses + rng.normal(size=(n, 1, 3))


def mirrored(poses):
    order = np.arange(17)
    for left, right in PERSON.mirrored_pairs:
        order[[left, right]] = right, left
    return (poses * MIRROR)[:, order]


def mirrored_bones(valid):
    order = np.arange(17)
    for left, right in PERSON.mirrored_pairs:
        order[[left, right]] = right, left
    return valid[:, order[1:] - 1]


def bones_of(poses, skeleton=PERSON):
    joints, parents = np.array(skeleton.bones).T
    return poses[..., joints, :] - poses[..., parents, :]


def turned_about_parent(poses, joint):
    """The bone to ``joint``, a hinge's lower bone, bent to the other side."""
    parent = PERSON.parents[joint]
    axis = poses[:, parent] - poses[:, PERSON.parents[parent]]
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    bone = poses[:, joint] - poses[:, parent]
    turned = poses.copy()
    turned[:, joint] = poses[:, parent] + 2 * (axis * bone).sum(1, keepdims=True) * axis - bone
    return turned


@pytest.fixture(scope="module")
def limits():
    return learn_limits([swings(4000)])


@pytest.fixture(scope="module")
def shipped():
    return JointLimits.shipped()


@pytest.mark.parametrize("dilation", [0.0, 0.2])
def test_what_was_seen_is_valid_and_left_as_it_is(dilation):
    poses = swings(300)
    limits = learn_limits([poses[:100], poses[100:]], dilation=dilation, bin_dilation=0.0)
    # The spine's tilt alone is not set by the one frame that tilts most.
    valid, nearest = limits.project(poses)
    assert valid[:, 1:].all()
    assert valid[:, 0].mean() > 0.995
    whole = valid.all(axis=1)
    np.testing.assert_array_equal(nearest[whole], poses[whole])
    assert limits.is_valid(mirrored(poses))[:, 1:].all()


def test_dilation_only_allows_more():
    poses = swings(500)
    tables = [learn_limits([poses], dilation=a).allowed for a in (0.0, 0.1, 0.3)]
    assert (tables[0] <= tables[1]).all()
    assert (tables[1] <= tables[2]).all()
    assert tables[0].sum() < tables[1].sum() < tables[2].sum()


def test_the_table_of_the_trunk_is_its_own_mirror_image():
    """Also in bins in which no parent was seen; and hips keep their sides at any dilation."""
    rough = learn_limits([swings(30)], dilation=1.4, bin_dilation=0.0)
    fine = learn_limits([swings(30)], dilation=0.1, bin_dilation=0.0)
    bins, cells = ((sphere_rings(n)[0], sphere_rings(n)[1] * MIRROR) for n in (6, 22))
    other_bin, other_cell = (
        np.array([cell_of(centre, rings) for centre in centres]) for rings, centres in (bins, cells)
    )
    for part in (PARTS.index("neck"), PARTS.index("head")):
        image = fine.allowed[part][other_bin][:, other_cell]
        np.testing.assert_array_equal(image, fine.allowed[part])
    assert not rough.allowed[PARTS.index("hip")][:, sphere_rings(22)[1][:, 0] <= 0].any()


def test_unseen_motion_of_the_same_kind_is_valid(limits):
    assert limits.is_valid(swings(2000, seed=5)).mean() > 0.99


@pytest.mark.parametrize("kind", ["made", "shipped"])
def test_the_nearest_valid_pose_is_valid_near_and_keeps_lengths_and_roots(kind, limits, shipped):
    table = limits if kind == "made" else shipped
    poses = np.concatenate([scrambled(3000), swings(500, seed=2)])
    valid, nearest = table.project(poses)
    assert 0.1 < valid.mean() < 0.9
    again, same = table.project(nearest)
    assert again.all()
    np.testing.assert_array_equal(same, nearest)
    np.testing.assert_array_equal(nearest[:, 0], poses[:, 0])
    np.testing.assert_allclose(
        np.linalg.norm(bones_of(nearest), axis=-1),
        np.linalg.norm(bones_of(poses), axis=-1),
        rtol=1e-12,
    )


def test_a_knee_bent_forwards_is_invalid_and_nothing_but_the_shin_moves(limits):
    poses = swings(400, seed=3)
    for joint in (PERSON.index("left_ankle"), PERSON.index("right_ankle")):
        flexion = angle(bones_of(poses)[:, joint - 1], bones_of(poses)[:, joint - 2])
        forwards = turned_about_parent(poses[flexion > np.deg2rad(40)], joint)
        valid, nearest = limits.project(forwards)
        assert not valid[:, joint - 1].any()
        others = valid[:, np.arange(16) != joint - 1].all(axis=1)
        assert others.mean() > 0.9
        moved = np.abs(nearest - forwards)[others].max(axis=(0, 2)) > 0
        assert np.flatnonzero(moved).tolist() == [joint]


def test_a_correction_goes_to_the_nearest_valid_direction(limits):
    """Against a search over directions, to within a cell's size."""
    around = sphere_rings(40)[1]
    poses = swings(60, seed=4)
    joint, parent = PERSON.index("left_wrist"), PERSON.index("left_elbow")
    wrong = turned_about_parent(poses, joint)
    length = np.linalg.norm(bones_of(wrong)[:, joint - 1], axis=1)
    for pose, reach, corrected in zip(wrong, length, limits.nearest_valid(wrong), strict=True):
        tried = np.repeat(pose[None], len(around), axis=0)
        tried[:, joint] = pose[parent] + reach * around
        fine = limits.is_valid(tried)[:, joint - 1]
        bone = pose[joint] - pose[parent]
        nearest = angle(around[fine], bone).min()
        went = angle(corrected[joint] - corrected[parent], bone)
        assert went <= nearest + np.pi / 22


def test_what_hangs_from_a_corrected_bone_turns_along(limits):
    poses = swings(400, seed=6)
    wrong = poses.copy()
    arm = [PERSON.index(f"left_{name}") for name in ("elbow", "wrist")]
    shoulder = poses[:, PERSON.index("left_shoulder")][:, None]
    wrong[:, arm] = 2 * shoulder - poses[:, arm]
    valid, nearest = limits.project(wrong)
    only = ~valid[:, arm[0] - 1] & np.delete(valid, arm[0] - 1, axis=1).all(axis=1)
    assert only.sum() > 10
    before, after = (bones_of(p[only])[:, [arm[0] - 1, arm[1] - 1]] for p in (wrong, nearest))
    np.testing.assert_allclose(
        angle(before[:, 0], before[:, 1]), angle(after[:, 0], after[:, 1]), atol=1e-7
    )
    still = np.delete(np.arange(17), arm)
    np.testing.assert_array_equal(nearest[only][:, still], wrong[only][:, still])


@pytest.mark.parametrize("kind", ["made", "shipped"])
def test_a_mirrored_pose_is_judged_as_the_mirror_image(kind, limits, shipped):
    table = limits if kind == "made" else shipped
    poses = np.concatenate([scrambled(2000, seed=7), swings(500, seed=8)])
    valid, nearest = table.project(poses)
    seen, corrected = table.project(mirrored(poses))
    np.testing.assert_array_equal(seen, mirrored_bones(valid))
    np.testing.assert_allclose(corrected, mirrored(nearest), atol=1e-9)


def test_turning_moving_and_scaling_a_person_change_nothing(limits):
    poses = scrambled(1000, seed=9)
    valid, nearest = limits.project(poses)
    turn = Rotation.from_rotvec([0.4, -1.1, 0.8]).as_matrix()
    seen, corrected = limits.project(1.3 * poses @ turn.T + [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(seen, valid)
    np.testing.assert_allclose(corrected, 1.3 * nearest @ turn.T + [1.0, 2.0, 3.0], atol=1e-9)


def test_limits_depend_on_where_the_parent_points():
    """Forearms seen ahead under hanging arms, and only straight under raised ones."""
    still = swings(1, seed=10)[0]
    shoulder, elbow, wrist = (PERSON.index(f"left_{n}") for n in ("shoulder", "elbow", "wrist"))
    across = np.cross(
        still[PERSON.index("left_hip")] - still[PERSON.index("right_hip")], still[1] - still[0]
    )
    ahead = across / np.linalg.norm(across)
    up = still[PERSON.index("neck")] - still[PERSON.index("chest")]
    up /= np.linalg.norm(up)

    def posed(arm, forearm):
        pose = still.copy()
        pose[elbow] = pose[shoulder] + 0.3 * arm
        pose[wrist] = pose[elbow] + 0.25 * forearm
        return pose

    seen = np.stack([posed(-up, ahead), posed(ahead, ahead)])
    limits = learn_limits([seen])
    assert limits.is_valid(seen).all()
    assert not limits.is_valid(posed(-up, -up))[wrist - 1]
    assert not limits.is_valid(posed(ahead, -up))[wrist - 1]
    assert limits.is_valid(posed(ahead, -up))[elbow - 1]


@pytest.mark.parametrize("people", [1, 2, 3])
def test_every_tree_is_judged_alone_whatever_the_order_of_joints(people, limits):
    rng = np.random.default_rng(people)
    each = [scrambled(50, seed=20 + p) for p in range(people)]
    order = rng.permutation(17 * people)
    place = np.argsort(order)
    names = [f"p{p}:{name}" for p in range(people) for name in PERSON.joint_names]
    parents = [-1 if q < 0 else q + 17 * p for p in range(people) for q in PERSON.parents]
    crowd = Skeleton(
        [names[j] for j in order], [-1 if parents[j] < 0 else place[parents[j]] for j in order]
    )
    valid, nearest = limits.on(crowd).project(np.concatenate(each, axis=1)[:, order])
    assert valid.shape == (50, 16 * people)
    for p, poses in enumerate(each):
        alone, corrected = limits.project(poses)
        np.testing.assert_array_equal(nearest[:, place[17 * p : 17 * p + 17]], corrected)
        bone = {joint: i for i, (joint, _) in enumerate(crowd.bones)}
        mine = [bone[place[17 * p + joint]] for joint, _ in PERSON.bones]
        np.testing.assert_array_equal(valid[:, mine], alone)


def test_any_batch_shape(limits):
    poses = scrambled(12, seed=11).reshape(3, 2, 2, 17, 3)
    valid, nearest = limits.project(poses)
    assert valid.shape == (3, 2, 2, 16)
    np.testing.assert_array_equal(limits.nearest_valid(poses[1, 0, 1]), nearest[1, 0, 1])
    np.testing.assert_array_equal(limits.is_valid(poses[1, 0, 1]), valid[1, 0, 1])
    assert limits.project(poses[:0])[0].shape == (0, 2, 2, 16)


def test_degenerate_poses_are_corrected_too(limits):
    """All joints at one place, hips on one line, a spine along the hips, bones turned about."""
    poses = np.repeat(swings(1), 5, axis=0)
    poses[0] = 0.0
    hips = [PERSON.index("left_hip"), PERSON.index("right_hip")]
    poses[1, hips[1]] = poses[1, hips[0]]
    poses[2, 1] = poses[2, 0] + (poses[2, hips[0]] - poses[2, hips[1]])
    poses[3, hips] = poses[3, hips[::-1]]
    poses[4] = 2 * poses[4, :1] - poses[4]
    nearest = limits.nearest_valid(poses)
    assert np.isfinite(nearest).all()
    assert limits.is_valid(nearest).all()
    np.testing.assert_array_equal(nearest[0], poses[0])


def test_cells_cut_the_sphere_evenly_and_alike_on_both_sides():
    rings, centres = sphere_rings(22)
    assert rings[:, 0].sum() == len(centres) == 624
    assert [cell_of(centre, rings) for centre in centres] == list(range(len(centres)))
    rng = np.random.default_rng(12)
    points = rng.normal(size=(60_000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    cells = np.array([cell_of(point, rings) for point in points])
    counts = np.bincount(cells, minlength=len(centres))
    assert counts.min() > 0.5 * counts.mean()
    assert angle(points, centres[cells]).max() < np.deg2rad(8)
    image = np.array([cell_of(centre * MIRROR, rings) for centre in centres])
    np.testing.assert_array_equal(image[cells], [cell_of(p * MIRROR, rings) for p in points])


def test_learning_and_saving_give_the_same_bytes(tmp_path, limits):
    paths = [tmp_path / "a.npz", tmp_path / "b.npz"]
    limits.save(paths[0])
    poses = swings(4000)
    motions = [Motion(poses[:1500], PERSON, 30.0), poses[1500:]]
    learn_limits(motions).save(paths[1])
    assert paths[0].read_bytes() == paths[1].read_bytes()
    read = JointLimits.load(paths[0])
    np.testing.assert_array_equal(read.allowed, limits.allowed)
    poses = scrambled(100)
    np.testing.assert_array_equal(read.nearest_valid(poses), limits.nearest_valid(poses))


def test_shares_tell_real_random_and_backwards_apart(limits):
    shares = rejected_fractions(limits, swings(1000, seed=13))
    assert all(row["real"] < 0.02 for row in shares.values())
    assert all(row["random"] > 0.3 for row in shares.values())
    assert shares["ankle"]["backwards"] > 0.95
    rng = np.random.default_rng(14)
    poses = swings(2000, seed=15)
    joint, parent = PERSON.index("left_ankle"), PERSON.index("left_knee")
    aim = rng.normal(size=(2000, 3))
    aim /= np.linalg.norm(aim, axis=1, keepdims=True)
    poses[:, joint] = poses[:, parent] + 0.4 * aim
    rejected = 1 - limits.is_valid(poses)[:, joint - 1].mean()
    assert rejected == pytest.approx(shares["ankle"]["random"], abs=0.03)


def test_the_shipped_limits_are_small_and_say_where_they_are_from(shipped):
    from importlib.resources import files

    table = files("probmotion.models") / "weights" / "joint_limits.npz"
    assert len(table.read_bytes()) <= 1_000_000
    learnt = shipped.provenance["clips"]
    assert len(learnt) > 20
    assert not set(learnt) & set(HELD_OUT)
    assert JointLimits.shipped(PAIR).is_valid(np.zeros((34, 3))).shape == (32,)


def test_unseen_real_clips_are_accepted(shipped, real_data):
    """The issue's target: fewer than 2 % of bones, here of each bone alone too."""
    for folder, stated in shipped.provenance["rejected_of_held_out"].items():
        paths = {"singles": "cmu_single", "salsa": "cmu_salsa_pairs"}
        clips = [p for p in sorted((real_data / paths[folder]).glob("*.npz")) if p.stem in HELD_OUT]
        poses = np.concatenate([person for path in clips for person in clips_of_people(path)])
        valid = shipped.is_valid(poses)
        assert 1 - valid.mean() == pytest.approx(stated, abs=1e-4)
        assert stated < 0.01
        assert (1 - valid.mean(axis=0)).max() < 0.02
        for joint in ("left_ankle", "right_ankle", "left_wrist", "right_wrist"):
            bone = PERSON.index(joint)
            bones = bones_of(poses)
            flexed = angle(bones[:, bone - 1], bones[:, bone - 2]) > np.deg2rad(40)
            wrong = turned_about_parent(poses[flexed], bone)
            assert (~shipped.is_valid(wrong)[:, bone - 1]).mean() > 0.98


def test_the_command_makes_the_shipped_limits(shipped, real_data, tmp_path, capsys):
    main(real_data, tmp_path / "again.npz")
    again = JointLimits.load(tmp_path / "again.npz")
    np.testing.assert_array_equal(again.allowed, shipped.allowed)
    np.testing.assert_array_equal(again.rest, shipped.rest)
    assert (again.tilt, again.provenance) == (shipped.tilt, shipped.provenance)
    assert "5910 unseen poses, 0.40% of their bones rejected" in capsys.readouterr().out


def test_people_of_a_clip_come_without_suspect_frames(real_data):
    path = real_data / "cmu_salsa_pairs" / "cmu_60_61_03.npz"
    motion = load_motion(path)
    with np.load(path) as archive:
        kept = ~archive["suspect"]
    people = clips_of_people(path)
    assert kept.sum() < len(kept)
    for person, positions in zip(("cmu60", "cmu61"), people, strict=True):
        knee = motion.skeleton.index(f"{person}:left_knee")
        wanted = motion.positions[kept, knee]
        np.testing.assert_array_equal(positions[:, PERSON.index("left_knee")], wanted)


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda limits: learn_limits([]), "motions has no frame, expected at least one"),
        (
            lambda limits: learn_limits([np.zeros((2, 16, 3))]),
            r"motions\[0\] has shape \(2, 16, 3\), expected \(L, 17, 3\)",
        ),
        (
            lambda limits: learn_limits([swings(2)], dilation=2.0),
            "dilation must be an angle from 0 to below π/2 radians, got 2.0",
        ),
        (
            lambda limits: learn_limits([swings(2)], bin_rings=1),
            "bin_rings must be an integer of at least 2, got 1",
        ),
        (lambda limits: limits.is_valid(np.zeros((34, 3))), r"expected \(…, 17, 3\)"),
        (lambda limits: limits.is_valid(np.full((17, 3), np.nan)), "poses has 51 values"),
        (
            lambda limits: limits.on(Skeleton.preset("gymnast-ball")),
            "expected the joints of 'person17'",
        ),
        (lambda limits: main_without_clips(), "has no cmu_01_07, cmu_02_05"),
    ],
)
def test_wrong_input_is_one_sentence(make, sentence, limits):
    with pytest.raises(ValueError, match=sentence):
        make(limits)


def main_without_clips():
    from pathlib import Path

    main(Path("nowhere"), Path("out.npz"))


def angle(a, b):
    across = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.arctan2(across, (a * b).sum(axis=-1))
