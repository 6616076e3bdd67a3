"""Clips of two people: names matched, frames chosen, clips held out whole, one factor a pair."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from probmotion.data.pairs import (
    SALSA_HELD_OUT,
    choose_seed,
    dance_frames,
    describe_dance_frames,
    ground_truth,
    hold_out,
    load_pairs,
    pair_motion,
    pair_of,
    person_height,
    read_salsa_bvh,
    scaled_to_height,
)
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.geometry.rotations import vector_to_matrix
from probmotion.io.files import load_motion, save_motion
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton

PAIR = Skeleton.preset("pair17")
ONE = Skeleton.preset("person17")


@pytest.fixture(scope="module")
def dances():
    return synthetic_dances(4, frames=45)


@pytest.fixture(scope="module")
def salsa(real_data):
    return load_pairs(real_data / "cmu_salsa_pairs")


def alone(motion, person):
    """One person of a pair, named in the manner of BVH files."""
    words = {"pelvis": "Hips", "left_hip": "LeftUpLeg", "left_knee": "LeftLeg"}
    names = [words.get(name, name) for name in ONE.joint_names]
    skeleton = Skeleton(names, ONE.parents)
    return Motion(
        motion.positions[:, 17 * person :][:, :17], skeleton, motion.fps, name=f"p{person}"
    )


def one_sentence(error):
    text = str(error.value)
    assert "\n" not in text
    assert not text.endswith(".")
    return text


def test_ten_clips_of_two_people(salsa):
    assert [m.name for m in salsa][::9] == ["cmu_60_61_01", "cmu_60_61_11"]
    assert [m.frames for m in salsa] == [1106, 1036, 900, 921, 824, 871, 1021, 1273, 584, 1039]
    joint, parent = np.array(PAIR.bones).T
    for motion in salsa:
        assert motion.skeleton == PAIR
        assert motion.fps == 30
        lengths = np.linalg.norm(motion.positions[:, joint] - motion.positions[:, parent], axis=-1)
        assert lengths.std(axis=0).max() < 1e-5
        # The leader, subject 60, is the taller one in all clips.
        assert np.ptp(person_height(motion.positions, PAIR), axis=0).max() < 1e-4
        np.testing.assert_allclose(
            person_height(motion.positions[0], PAIR), [1.715, 1.601], atol=2e-3
        )


def test_persons_keep_the_order_of_the_file(real_data, salsa):
    whole = load_motion(real_data / "cmu_salsa_pairs" / "cmu_60_61_05.npz")
    for person, subject in enumerate(("cmu60", "cmu61")):
        for name, own in (("pelvis", "hip"), ("left_shoulder", "lShldr"), ("right_knee", "rShin")):
            np.testing.assert_array_equal(
                salsa[4].positions[:, PAIR.index(f"person{person}:{name}")],
                whole.positions[:, whole.skeleton.index(f"{subject}:{own}")],
            )


def test_two_bvh_files_are_the_archive(real_data, salsa):
    files = [real_data / "originals" / f"{subject}_10_scaled.bvh" for subject in (60, 61)]
    read = read_salsa_bvh(*files)
    archive = salsa[8]
    assert (read.name, read.fps, read.frames) == (archive.name, 30.0, 584)
    # The archive has float32.
    np.testing.assert_allclose(read.positions, archive.positions, rtol=0, atol=2e-7)


def test_salsa_files_must_be_one_trial(real_data, tmp_path):
    lead, follow = (real_data / "originals" / f"{s}_10_scaled.bvh" for s in (60, 61))
    with pytest.raises(ValueError, match=r"lead must be '60_TT_sc, got '61_10_scaled\.bvh'"):
        read_salsa_bvh(follow, lead)
    with pytest.raises(ValueError, match="follow is of trial 11 and lead of 10, expected one"):
        read_salsa_bvh(lead, tmp_path / "61_11_scaled.bvh")
    with pytest.raises(FileNotFoundError):
        read_salsa_bvh(lead, tmp_path / "61_10_scaled.bvh")


def test_frames_that_are_not_the_dance_are_found_on_real_clips(salsa):
    kept = [dance_frames(motion) for motion in salsa]
    assert sum(k.sum() for k in kept) == 8257
    for motion, keep in zip(salsa, kept, strict=True):
        gap = np.linalg.norm(motion.positions[:, 0] - motion.positions[:, 17], axis=-1)
        step = np.linalg.norm(np.diff(motion.positions, axis=0), axis=-1).max(axis=-1) * 30
        assert not keep[:30].any()  # they open more than a metre apart
        assert gap[keep].max() <= 1.2
        assert step[keep[1:] & keep[:-1]].max() <= 7
    assert describe_dance_frames(salsa[8]) == (
        "cmu_60_61_10: 410 of 584 frames are the dance; left out are 132 of the opening, 33 with "
        "the partners over 1.2 m apart and 9 beside a step faster than 7 m/s"
    )


def test_held_out_clips_share_no_frame_with_those_held_in(salsa):
    held_in, held_out = hold_out(salsa)
    assert [m.name for m in held_out] == list(SALSA_HELD_OUT)
    inside, clip, frame = ground_truth(held_in, 3000)
    outside = ground_truth(held_out)[0]
    assert inside.shape == (3000, 34, 3)
    assert len(outside) == 2658
    for index in (0, 1234, 2999):
        np.testing.assert_array_equal(inside[index], held_in[clip[index]].positions[frame[index]])
    assert not {pose.tobytes() for pose in inside} & {pose.tobytes() for pose in outside}


def test_made_frames_that_are_not_the_dance(dances):
    positions = dances[0].positions.copy()
    positions[:6, 17:, 0] += 9.0  # the opening, with an impossible step after it
    positions[20:23, :17, 2] -= 9.0  # apart, with impossible steps on both sides
    positions[30, 5, 1] += 0.5  # one joint jumps in one frame
    broken = Motion(positions, PAIR, 30.0, name="made")
    gone = set(range(7)) | set(range(19, 24)) | {29, 30, 31}
    assert set(np.flatnonzero(~dance_frames(broken))) == gone
    assert describe_dance_frames(broken) == (
        "made: 30 of 45 frames are the dance; left out are 6 of the opening, 3 with the partners "
        "over 1.2 m apart and 6 beside a step faster than 7 m/s"
    )
    assert dance_frames(dances[0]).all()
    assert not dance_frames(dances[0], farthest=0.1).any()
    assert not dance_frames(dances[0], fastest=0.01).any()
    with pytest.raises(ValueError, match="of 1 person, expected 2 or more"):
        dance_frames(alone(dances[0], 0))


def test_ground_truth_is_evenly_apart(dances):
    _, clip, frame = ground_truth(dances, 36)
    at = 45 * clip + frame
    np.testing.assert_array_equal(at, np.arange(36) * 5 + 2)
    positions, clip, frame = ground_truth(dances)
    assert len(positions) == 180
    np.testing.assert_array_equal(positions[50], dances[clip[50]].positions[frame[50]])
    with pytest.raises(ValueError, match="n must be at most the 180 frames of the dance, got 181"):
        ground_truth(dances, 181)
    with pytest.raises(ValueError, match="motions is empty"):
        ground_truth([])
    with pytest.raises(ValueError, match="of another skeleton than"):
        ground_truth([dances[0], alone(dances[1], 0)])


def test_hold_out_is_by_whole_clips(dances):
    held_in, held_out = hold_out(dances, ["dance-2", "dance-0"])
    assert [m.name for m in held_in] == ["dance-1", "dance-3"]
    assert [m.name for m in held_out] == ["dance-0", "dance-2"]
    with pytest.raises(
        ValueError, match=r"names has 'dance-9', .* 0 motions, expected one of"
    ) as e:
        hold_out(dances, ["dance-9"])
    assert "dance-0, dance-1" in one_sentence(e)
    with pytest.raises(ValueError, match="the name of 2 motions"):
        hold_out([dances[0], *dances], ["dance-0"])
    with pytest.raises(ValueError, match="names has 4 of the 4 motions"):
        hold_out(dances, [m.name for m in dances])
    with pytest.raises(ValueError, match="names has 0 of the 4 motions"):
        hold_out(dances, [])
    with pytest.raises(ValueError, match="names must be a list of names, got 'dance-1'"):
        hold_out(dances, "dance-1")


def test_height_is_of_the_body_not_of_the_pose(dances):
    turn = vector_to_matrix(np.array([0.7, -1.1, 2.0]))
    heights = person_height(dances[0].positions, PAIR)
    assert heights.shape == (45, 2)
    np.testing.assert_allclose(
        person_height(dances[0].positions @ turn.T + 3.0, PAIR), heights, rtol=1e-9
    )
    np.testing.assert_allclose(np.ptp(heights, axis=0), 0, atol=1e-9)
    # A figure that stands straight, by hand: 0.4 + 0.4 + 0.1 + 0.2 + 0.1 + 0.2 + 0.1 in chain.
    up = {"spine": 1.2, "chest": 1.3, "neck": 1.5, "head": 1.6, "pelvis": 1.0}
    down = {"hip": 0.9, "knee": 0.5, "ankle": 0.1, "shoulder": 1.4, "elbow": 1.1, "wrist": 0.9}
    pose = np.zeros((17, 3))
    for joint, name in enumerate(ONE.joint_names):
        side, _, part = name.rpartition("_")
        pose[joint] = [{"left": 0.1, "right": -0.1}.get(side, 0), (up | down)[part], 0]
    np.testing.assert_allclose(person_height(pose, ONE), [1.5 / (1 - 0.039 - 0.1)])
    with pytest.raises(ValueError, match="skeleton lacks left_knee below 'pelvis'"):
        person_height(
            np.delete(pose, ONE.index("left_knee"), axis=0),
            ONE.subset([j for j in range(17) if j != ONE.index("left_knee")]),
        )


def test_one_factor_for_both_people(dances):
    scaled = scaled_to_height(dances[1], 1.5)
    factor = scaled.positions[0, 0, 1] / dances[1].positions[0, 0, 1]
    np.testing.assert_allclose(scaled.positions, factor * dances[1].positions, rtol=1e-12)
    assert person_height(scaled.positions, PAIR).mean() == pytest.approx(1.5)
    taller, smaller = person_height(scaled.positions[0], PAIR)
    assert taller > smaller
    assert scaled_to_height(dances[1]).positions.shape == (45, 34, 3)
    with pytest.raises(ValueError, match="height must be a finite number above 0, got 0"):
        scaled_to_height(dances[1], 0)


def test_the_seed_is_the_medoid_after_alignment(dances):
    rng = np.random.default_rng(0)
    poses = ground_truth(dances, 30)[0]
    moved = np.stack(
        [p @ vector_to_matrix(rng.normal(size=3)).T + rng.normal(size=3) for p in poses]
    )
    # Brute force, by SciPy's alignment.
    from scipy.spatial.transform import Rotation

    centred = poses - poses.mean(axis=1, keepdims=True)
    total = [
        sum(Rotation.align_vectors(a, b)[1] / np.sqrt(34) for b in centred if b is not a)
        for a in centred
    ]
    assert choose_seed(poses) == int(np.argmin(total))
    assert choose_seed(moved) == choose_seed(poses)
    assert choose_seed(poses[:1]) == 0
    # Mirrored pairs are other pairs: no reflection may bring them onto each other.
    mirrored = poses[0] * [-1, 1, 1]
    assert choose_seed(np.stack([mirrored, poses[0], moved[0], mirrored + 1, poses[0]])) in (
        1,
        2,
        4,
    )
    with pytest.raises(ValueError, match="positions has no pose-pair"):
        choose_seed(poses[:0])


def test_a_seed_of_many_is_one_of_them(salsa):
    positions = ground_truth(hold_out(salsa)[0])[0]
    seed = choose_seed(positions)
    assert seed == choose_seed(positions.copy())
    assert 0 <= seed < len(positions)


def test_two_motions_become_a_pair(dances):
    pair = pair_motion(alone(dances[0], 0), alone(dances[0], 1))
    np.testing.assert_array_equal(pair.positions, dances[0].positions)
    assert pair.skeleton == PAIR
    assert pair.name == "p0 & p1"
    assert pair_motion(alone(dances[0], 0), alone(dances[0], 1), "both").name == "both"
    assert pair_of(pair) is pair


def test_people_are_matched_by_canonical_names(dances):
    order = np.random.default_rng(1).permutation(34)
    order = np.r_[order[order >= 17], order[order < 17]]  # whose root comes first is person0
    names = [PAIR.joint_names[j].replace("person", "dancer").replace("knee", "shin") for j in order]
    parents = [-1 if PAIR.parents[j] < 0 else list(order).index(PAIR.parents[j]) for j in order]
    shuffled = Motion(dances[0].positions[:, order], Skeleton(names, parents), 30.0)
    back = pair_of(shuffled)
    np.testing.assert_array_equal(back.positions, dances[0].positions[:, np.r_[17:34, 0:17]])


def test_clips_that_do_not_fit_are_refused_in_one_sentence(dances):
    first, second = alone(dances[0], 0), alone(dances[0], 1)
    with pytest.raises(ValueError, match=r"second has 60 frames per second and first 30") as e:
        pair_motion(first, second.resample(60))
    assert "second.resample(30) has it" in one_sentence(e)
    with pytest.raises(ValueError, match=r"second has 40 frames and first 45") as e:
        pair_motion(first, second.window(0, 40))
    assert "first.window(start, 40) cuts" in one_sentence(e)
    with pytest.raises(ValueError, match=r"first is Motion.* with 2 roots, expected one person"):
        pair_motion(dances[0], second)
    with pytest.raises(
        ValueError, match=r"motion is Motion.* with 1 root, expected 2: one for each"
    ):
        pair_of(first)
    kept = [j for j in range(17) if ONE.joint_names[j] not in ("chest", "left_wrist")]
    partial = Motion(second.positions[:, kept], second.skeleton.subset(kept), 30.0)
    with pytest.raises(
        ValueError, match=r"person 1 \(root 'Hips'\) lacks chest, left_wrist, expected the 17"
    ) as e:
        pair_motion(first, partial)
    one_sentence(e)


def test_folders_files_and_patterns(dances, tmp_path):
    for dance in dances:
        save_motion(dance, tmp_path / f"{dance.name}.npz")
    for given in (tmp_path, str(tmp_path / "*.npz"), [tmp_path / f"{d.name}.npz" for d in dances]):
        read = load_pairs(given)
        assert [m.name for m in read] == [d.name for d in dances]
        np.testing.assert_array_equal(read[3].positions, dances[3].positions)
    save_motion(alone(dances[0], 0), tmp_path / "one.npz")
    with pytest.raises(ValueError, match=r"Motion\(p0: 45 frames.*1 root, expected 2"):
        load_pairs(tmp_path)
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileNotFoundError, match=r"the folder .*empty, which holds no \.npz file"):
        load_pairs(tmp_path / "empty")
    with pytest.raises(FileNotFoundError, match="which matches no file"):
        load_pairs(tmp_path / "*.bvh")


def test_two_bvh_files_written_by_us(dances, tmp_path):
    for person in range(2):
        save_motion(alone(dances[0], person), tmp_path / f"{person}.bvh")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        pair = pair_motion(*[load_motion(tmp_path / f"{person}.bvh") for person in range(2)])
    assert np.abs(pair.positions - dances[0].positions).max() < 5e-3
