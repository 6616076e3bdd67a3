"""Clips of two people: joint matching, dance frames, held-out clips, heights and seed pose."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from probmotion.data.pair_sets import (
    SALSA_HELD_OUT,
    check_close_people,
    choose_seed,
    dance_frames,
    describe_dance_frames,
    ground_truth,
    hold_out,
    person_height,
    scaled_to_height,
)
from probmotion.data.pairs import load_pairs, pair_motion, pair_of, read_salsa_bvh
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.geometry.rotations import vector_to_matrix
from probmotion.io.files import load, save
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton

PAIR = Skeleton.preset("pair17")
PERSON = Skeleton.preset("person17")


@pytest.fixture(scope="module")
def dances():
    return synthetic_dances(4, frames=45)


@pytest.fixture(scope="module")
def salsa(real_data):
    return load_pairs(real_data / "cmu_salsa_pairs")


def one_person(motion, person):
    """Return one person of a pair, named as in BVH files."""
    bvh_names = {"pelvis": "Hips", "left_hip": "LeftUpLeg", "left_knee": "LeftLeg"}
    skeleton = Skeleton([bvh_names.get(name, name) for name in PERSON.joint_names], PERSON.parents)
    positions = motion.positions[:, 17 * person :][:, :17]
    return Motion(positions, skeleton, motion.fps, name=f"p{person}")


# Recorded salsa.


def test_salsa_clips(real_data, salsa):
    assert [m.name for m in salsa][::9] == ["cmu_60_61_01", "cmu_60_61_11"]
    assert [m.frames for m in salsa] == [1106, 1036, 900, 921, 824, 871, 1021, 1273, 584, 1039]
    joint, parent = np.array(PAIR.bones).T
    for motion in salsa:
        assert (motion.skeleton, motion.fps) == (PAIR, 30)
        lengths = np.linalg.norm(motion.positions[:, joint] - motion.positions[:, parent], axis=-1)
        assert lengths.std(axis=0).max() < 1e-5
        heights = person_height(motion.positions, PAIR)
        assert np.ptp(heights, axis=0).max() < 1e-4
        np.testing.assert_allclose(heights[0], [1.715, 1.601], atol=2e-3)
    # The order of people is that of the file.
    archive = load(real_data / "cmu_salsa_pairs" / "cmu_60_61_05.npz")
    for person, subject in enumerate(("cmu60", "cmu61")):
        for name, word in (("pelvis", "hip"), ("left_shoulder", "lShldr"), ("right_knee", "rShin")):
            np.testing.assert_array_equal(
                salsa[4].positions[:, PAIR.index(f"person{person}:{name}")],
                archive.positions[:, archive.skeleton.index(f"{subject}:{word}")],
            )


def test_salsa_bvh_files_equal_the_archive(real_data, salsa, tmp_path):
    lead, follow = (real_data / "originals" / f"{s}_10_scaled.bvh" for s in (60, 61))
    read = read_salsa_bvh(lead, follow)
    assert (read.name, read.fps, read.frames) == (salsa[8].name, 30.0, 584)
    # The archive is float32.
    np.testing.assert_allclose(read.positions, salsa[8].positions, rtol=0, atol=2e-7)
    with pytest.raises(ValueError, match="lead must be named 60_TT_scaled"):
        read_salsa_bvh(follow, lead)
    with pytest.raises(ValueError, match="lead and follow must belong to one trial, got 10 and 11"):
        read_salsa_bvh(lead, tmp_path / "61_11_scaled.bvh")
    with pytest.raises(FileNotFoundError):
        read_salsa_bvh(lead, tmp_path / "61_10_scaled.bvh")


def test_dance_frames_of_salsa(salsa):
    masks = [dance_frames(motion) for motion in salsa]
    assert sum(mask.sum() for mask in masks) == 8257
    for motion, mask in zip(salsa, masks, strict=True):
        gap = np.linalg.norm(motion.positions[:, 0] - motion.positions[:, 17], axis=-1)
        assert not mask[:30].any()  # partners start more than a metre apart
        assert gap[mask].max() <= 1.2


def test_held_out_salsa_shares_no_frame_with_training_clips(salsa):
    training, held_out = hold_out(salsa)
    assert [m.name for m in held_out] == list(SALSA_HELD_OUT)
    training_poses, held_out_poses = ground_truth(training, 3000)[0], ground_truth(held_out)[0]
    assert training_poses.shape == (3000, 34, 3)
    assert len(held_out_poses) == 2658
    assert not {p.tobytes() for p in training_poses} & {p.tobytes() for p in held_out_poses}


# Data sets of pose pairs.


def test_excluded_frames_and_their_description(dances):
    positions = dances[0].positions.copy()
    positions[:6, 17:, 0] += 9.0  # the opening, with a glitch after it
    positions[20:23, :17, 2] -= 9.0  # apart, with glitches on both sides
    positions[30, 5, 1] += 0.5  # a glitch of one joint in one frame
    broken = Motion(positions, PAIR, 30.0, name="broken")
    excluded = set(range(7)) | set(range(19, 24)) | {29, 30, 31}
    assert set(np.flatnonzero(~dance_frames(broken))) == excluded
    assert describe_dance_frames(broken) == (
        "broken: 30 of 45 frames show the dance; excluded: 6 of the opening, 3 with partners over "
        "1.2 m apart, 6 next to a step faster than 7 m/s"
    )
    assert dance_frames(dances[0]).all()
    assert not dance_frames(dances[0], farthest=0.1).any()
    assert not dance_frames(dances[0], fastest=0.01).any()


def test_ground_truth_is_evenly_spaced(dances):
    _, clip, frame = ground_truth(dances, 36)
    np.testing.assert_array_equal(45 * clip + frame, np.arange(36) * 5 + 2)
    positions, clip, frame = ground_truth(dances)
    assert len(positions) == 180
    np.testing.assert_array_equal(positions[50], dances[clip[50]].positions[frame[50]])


def standing_pose():
    """Return a pose whose bones in the height chain add up to 1.5 m."""
    up = {"spine": 1.2, "chest": 1.3, "neck": 1.5, "head": 1.6, "pelvis": 1.0}
    down = {"hip": 0.9, "knee": 0.5, "ankle": 0.1, "shoulder": 1.4, "elbow": 1.1, "wrist": 0.9}
    pose = np.zeros((17, 3))
    for joint, name in enumerate(PERSON.joint_names):
        side, _, part = name.rpartition("_")
        pose[joint] = [{"left": 0.1, "right": -0.1}.get(side, 0), (up | down)[part], 0]
    return pose


def test_height_depends_on_the_scale_but_not_on_pose_or_rotation(dances):
    rotation = vector_to_matrix(np.array([0.7, -1.1, 2.0]))
    heights = person_height(dances[0].positions, PAIR)
    assert heights.shape == (45, 2)
    transformed = dances[0].positions @ rotation.T + 3.0
    np.testing.assert_allclose(person_height(transformed, PAIR), heights, rtol=1e-9)
    np.testing.assert_allclose(np.ptp(heights, axis=0), 0, atol=1e-9)
    np.testing.assert_allclose(person_height(standing_pose(), PERSON), [1.5 / (1 - 0.039 - 0.1)])
    # Both people are scaled by one factor.
    scaled = scaled_to_height(dances[1], 1.5)
    factor = scaled.positions[0, 0, 1] / dances[1].positions[0, 0, 1]
    np.testing.assert_allclose(scaled.positions, factor * dances[1].positions, rtol=1e-12)
    assert person_height(scaled.positions, PAIR).mean() == pytest.approx(1.5)


def test_seed_is_the_medoid_after_alignment(dances):
    rng = np.random.default_rng(0)
    poses = ground_truth(dances, 30)[0]
    transformed = np.stack(
        [p @ vector_to_matrix(rng.normal(size=3)).T + rng.normal(size=3) for p in poses]
    )
    centred = poses - poses.mean(axis=1, keepdims=True)
    total = [sum(Rotation.align_vectors(a, b)[1] for b in centred if b is not a) for a in centred]
    assert choose_seed(poses) == choose_seed(transformed) == int(np.argmin(total))
    assert choose_seed(poses[:1]) == 0
    # Reflections do not count as alignment.
    mirrored = poses[0] * [-1, 1, 1]
    poses = np.stack([mirrored, poses[0], transformed[0], mirrored + 1, poses[0]])
    assert choose_seed(poses) in (1, 2, 4)


# Conversion to pair17.


def test_motions_are_converted_to_pairs(dances):
    people = [one_person(dances[0], person) for person in range(2)]
    pair = pair_motion(*people)
    np.testing.assert_array_equal(pair.positions, dances[0].positions)
    assert (pair.skeleton, pair.name) == (PAIR, "p0 & p1")
    assert pair_motion(*people, "both").name == "both"
    assert pair_of(pair) is pair
    # Joints are matched by canonical names.
    order = np.random.default_rng(1).permutation(34)
    order = np.r_[order[order >= 17], order[order < 17]]  # the first root is person0
    names = [PAIR.joint_names[j].replace("person", "dancer").replace("knee", "shin") for j in order]
    parents = [-1 if PAIR.parents[j] < 0 else list(order).index(PAIR.parents[j]) for j in order]
    shuffled = Motion(dances[0].positions[:, order], Skeleton(names, parents), 30.0)
    converted = pair_of(shuffled)
    np.testing.assert_array_equal(converted.positions, dances[0].positions[:, np.r_[17:34, 0:17]])


def test_pairs_from_folders_files_and_patterns(dances, tmp_path):
    for dance in dances:
        save(dance, tmp_path / f"{dance.name}.npz")
    for given in (tmp_path, str(tmp_path / "*.npz"), [tmp_path / f"{d.name}.npz" for d in dances]):
        read = load_pairs(given)
        assert [m.name for m in read] == [d.name for d in dances]
        np.testing.assert_array_equal(read[3].positions, dances[3].positions)
    (tmp_path / "empty").mkdir()
    for path in (tmp_path / "empty", tmp_path / "*.bvh"):
        with pytest.raises(FileNotFoundError):
            load_pairs(path)


POSE = standing_pose()


def with_second(dances, second):
    return pair_motion(one_person(dances[0], 0), second)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda d: dance_frames(one_person(d[0], 0)), "motion must have at least 2 people"),
        (lambda d: ground_truth(d, 181), "n must be at most the 180 dance frames, got 181"),
        (lambda d: ground_truth([]), "motions must contain at least one"),
        (lambda d: ground_truth([d[0], one_person(d[1], 0)]), "motions must share one skeleton"),
        (lambda d: hold_out(d, ["dance-9"]), r"one motion each \(dance-0, .*'dance-9'.* of 0"),
        (lambda d: hold_out([d[0], *d], ["dance-0"]), "the name of 2"),
        (lambda d: hold_out(d, [m.name for m in d]), "got 4 names"),
        (lambda d: hold_out(d, []), "got 0 names"),
        (lambda d: hold_out(d, "dance-1"), "names must be a list of names, got 'dance-1'"),
        (lambda d: scaled_to_height(d[1], 0), "height must be a finite number above 0, got 0"),
        (lambda d: choose_seed(d[0].positions[:0]), "positions must contain at least one pose"),
        (lambda d: person_height(POSE[1:], PERSON.subset(range(1, 17))), "have hips, .* lacks"),
        (lambda d: check_close_people("pose", POSE * 10, PERSON), "0.5 to 3 m tall, got 17"),
        (lambda d: check_close_people("pose", np.r_[POSE, POSE + 9], PAIR), "5 m apart, got 15.6"),
        (
            lambda d: with_second(d, one_person(d[0], 1).resample(60)),
            r"got 30 and 60; use second\.res",
        ),
        (
            lambda d: with_second(d, one_person(d[0], 1).window(0, 40)),
            r"got 45 and 40; use first\.win",
        ),
        (lambda d: with_second(d, d[0]), "second must have one root, got 2"),
        (lambda d: pair_of(one_person(d[0], 0)), "motion must have 2 roots, one per person, got 1"),
    ],
)
def test_invalid_input(dances, call, message):
    with pytest.raises(ValueError, match=message):
        call(dances)
