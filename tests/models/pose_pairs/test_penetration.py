"""Penetration of capsules: distances of segments, and sums over the bones that count."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from probmotion import Skeleton
from probmotion.models.pose_pairs.joint_limits_learning import HELD_OUT, clips_of_people
from probmotion.models.pose_pairs.penetration import (
    capsules_of,
    penetrating_bones,
    penetration_depth,
)
from probmotion.models.pose_pairs.penetration_kernels import segment_distance

PERSON = Skeleton.preset("person17")
PAIR = Skeleton.preset("pair17")


def rods(n, radius=0.1):
    """n trees of one bone each."""
    names = [f"{end}{k}" for k in range(n) for end in ("foot", "head")]
    parents = [value for k in range(n) for value in (-1, 2 * k)]
    return Skeleton(names, parents, [radius] * (2 * n))


def searched_distance(p, q, r, s):
    """The least distance by a bounded minimisation over both segments."""

    def square(at):
        gap = p + at[0] * (q - p) - r - at[1] * (s - r)
        return gap @ gap

    starts = [(a, b) for a in (0.1, 0.9) for b in (0.1, 0.9)]
    found = [
        minimize(square, start, bounds=[(0, 1)] * 2, method="L-BFGS-B", tol=1e-14).fun
        for start in starts
    ]
    return np.sqrt(min(found))


def test_distance_is_the_least_over_both_segments():
    rng = np.random.default_rng(0)
    for _ in range(200):
        ends = rng.normal(size=(4, 3)) * rng.uniform(0.2, 2.0, size=(4, 1))
        assert segment_distance(*ends) == pytest.approx(searched_distance(*ends), abs=1e-6)


def test_distance_of_segments_placed_by_hand():
    at = np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 2, 0], [0.5, 2, 1], [2, 0, 0], [3, 0, 0],
                   [0.5, -1, 0], [0.5, 1, 0], [0.2, 0.3, 0], [0.9, 0.3, 0]])  # fmt: skip
    a, b = at[0], at[1]
    assert segment_distance(a, b, at[2], at[3]) == pytest.approx(2.0)
    assert segment_distance(a, b, at[4], at[5]) == pytest.approx(1.0)  # On one line.
    assert segment_distance(a, b, at[6], at[7]) == pytest.approx(0.0)  # Crossing.
    assert segment_distance(a, b, at[8], at[9]) == pytest.approx(0.3)  # Parallel, beside.
    assert segment_distance(a, b, at[9], at[8]) == pytest.approx(0.3)
    assert segment_distance(a, b, b + at[2], b + at[2]) == pytest.approx(np.hypot(0.5, 2.0))
    assert segment_distance(at[2], at[2], a, b) == pytest.approx(2.0)  # A point and a segment.
    assert segment_distance(a, a, at[3], at[3]) == pytest.approx(np.linalg.norm(at[3]))


def test_nearly_parallel_and_tiny_segments_keep_their_distance():
    rng = np.random.default_rng(1)
    for size in (1e-7, 1e-4, 1.0):
        for _ in range(50):
            p, u, w = rng.normal(size=(3, 3))
            v = u + 1e-9 * rng.normal(size=3)
            away = np.cross(u, w) / np.linalg.norm(np.cross(u, w))
            found = segment_distance(p, p + size * u, p + 0.5 * away, p + 0.5 * away + size * v)
            assert found == pytest.approx(0.5, abs=1e-6)


def test_capsules_of_known_depth():
    """Crossing at right angles, 0.15 m apart with radii of 0.1 m: 0.05 m deep."""
    pose = np.array([[-1.0, 0, 0], [1, 0, 0], [0, 0.15, -1], [0, 0.15, 1]])
    assert penetration_depth(pose, rods(2)) == pytest.approx(0.05)
    three = np.concatenate([pose, np.add(pose[:2], [0, 0.3, 0])])
    assert penetration_depth(three, rods(3)) == pytest.approx(0.10)
    assert penetration_depth(three, rods(3, radius=0.07)) == 0.0
    assert penetration_depth(np.add(pose, [0, 5, 0]), rods(2)) == pytest.approx(0.05)
    assert penetrating_bones(pose, rods(2)) == [("head0", "head1", pytest.approx(0.05))]
    assert penetrating_bones(pose, rods(2, radius=0.07)) == []
    assert penetration_depth(np.zeros((0, 4, 3)), rods(2)).shape == (0,)


def test_bones_of_one_tree_count_unless_they_are_neighbours():
    """A chain folded back: of its four bones only the first and the last may not touch."""
    chain = Skeleton(["a", "b", "c", "d", "e"], [-1, 0, 1, 2, 3], [0.05] * 5)
    assert capsules_of(chain).pairs.tolist() == [[0, 3]]
    flat = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0.5, 1, 0], [0.5, 0.06, 0]])
    assert penetration_depth(flat, chain) == pytest.approx(0.04)
    names = [(PERSON.joint_names[j]) for j, _ in PERSON.bones]
    pairs = {frozenset(names[b] for b in pair) for pair in capsules_of(PERSON).pairs}
    assert frozenset({"left_knee", "right_knee"}) in pairs
    assert frozenset({"left_wrist", "chest"}) in pairs
    for beside in ({"left_knee", "left_hip"}, {"left_knee", "spine"}, {"left_elbow", "chest"}):
        assert frozenset(beside) not in pairs


def test_all_pairs_of_two_people_count():
    pairs = capsules_of(PAIR).pairs
    crossing = (pairs < 16).sum(axis=1) == 1
    assert crossing.sum() == 256
    assert (~crossing).sum() == 2 * len(capsules_of(PERSON).pairs)


def tangle(n, people=2, seed=2):
    rng = np.random.default_rng(seed)
    poses = np.zeros((n, 17 * people, 3))
    for person in range(people):
        for joint, parent in enumerate(PERSON.parents):
            above = poses[:, 17 * person + parent] if parent >= 0 else 0.0
            poses[:, 17 * person + joint] = above + 0.2 * rng.normal(size=(n, 3))
    return poses


def test_the_sum_is_over_all_pairs_of_bones():
    """Against plain loops and the searched distance."""
    poses = 0.4 * tangle(1)
    bones = PAIR.bones
    for pose, depth in zip(poses, penetration_depth(poses, PAIR), strict=True):
        total = 0.0
        for first, second in capsules_of(PAIR).pairs:
            (a, b), (c, d) = bones[first], bones[second]
            apart = searched_distance(*pose[[a, b, c, d]])
            total += max(0.0, PAIR.radii[a] + PAIR.radii[c] - apart)
        assert depth == pytest.approx(total, abs=1e-5)
        assert total > 0.05


def test_rigid_motion_and_swapping_the_people_change_nothing():
    poses = tangle(200)
    depth = penetration_depth(poses, PAIR)
    turn = Rotation.from_rotvec([0.3, 1.2, -0.5]).as_matrix()
    moved = penetration_depth(poses @ turn.T + [3.0, -1.0, 2.0], PAIR)
    np.testing.assert_allclose(moved, depth, atol=1e-12)
    swapped = penetration_depth(np.concatenate([poses[:, 17:], poses[:, :17]], axis=1), PAIR)
    np.testing.assert_allclose(swapped, depth, atol=1e-12)


@pytest.mark.parametrize("people", [1, 2, 3])
def test_people_far_apart_have_each_their_own(people):
    crowd = Skeleton(
        [f"p{p}:{name}" for p in range(people) for name in PERSON.joint_names],
        [-1 if q < 0 else q + 17 * p for p in range(people) for q in PERSON.parents],
        (PERSON.radii or ()) * people,
    )
    poses = tangle(50, people)
    apart = poses + 100.0 * np.repeat(np.arange(people), 17)[:, None]
    own = sum(penetration_depth(poses[:, 17 * p : 17 * p + 17], PERSON) for p in range(people))
    np.testing.assert_allclose(penetration_depth(apart, crowd), own, atol=1e-9)
    assert (penetration_depth(poses, crowd) >= own - 1e-12).all()


def test_batches_and_names_of_what_penetrates():
    poses = tangle(6).reshape(3, 2, 34, 3)
    depths = penetration_depth(poses, PAIR)
    assert depths.shape == (3, 2)
    found = penetrating_bones(poses[1, 1], PAIR)
    assert sum(depth for _, _, depth in found) == pytest.approx(depths[1, 1])
    assert [depth for *_, depth in found] == sorted((d for *_, d in found), reverse=True)
    assert all(
        first in PAIR.joint_names and second in PAIR.joint_names for first, second, _ in found
    )
    assert penetration_depth(poses[0, 0], PAIR).shape == ()


def test_skeletons_that_differ_in_radii_alone_are_told_apart():
    poses = tangle(20)
    thin = Skeleton(PAIR.joint_names, PAIR.parents, [0.001] * 34)
    assert thin == PAIR
    assert penetration_depth(poses, thin).sum() < 0.2 * penetration_depth(poses, PAIR).sum()


def penalty(depth):
    """Nats of w ρ² / (2 σ_p²) with w = 10 and σ_p = .05 (Yin et al. 2018, eq. 2)."""
    return 10.0 * depth**2 / (2.0 * 0.05**2)


def test_real_pairs_carry_almost_no_penalty_and_made_collisions_do(real_data):
    pairs = []
    for path in sorted((real_data / "cmu_salsa_pairs").glob("*.npz")):
        if path.stem not in HELD_OUT:
            pairs.append(np.concatenate(clips_of_people(path), axis=1)[::5])
    poses = np.concatenate(pairs)
    poses = poses[np.linalg.norm(poses[:, 0] - poses[:, 17], axis=1) < 1.2]
    nats = penalty(penetration_depth(poses, PAIR))
    assert np.median(nats) == 0.0
    assert np.quantile(nats, 0.9) < 0.1
    assert np.quantile(nats, 0.99) < 4.0
    for share, collide in ((1.0, 0.99), (0.8, 0.95)):
        gap = (poses[:, :1] - poses[:, 17:18]) * np.array([share, 0.0, share])
        moved = np.concatenate([poses[:, :17], poses[:, 17:] + gap], axis=1)
        assert (penalty(penetration_depth(moved, PAIR)) > 3.0).mean() > collide


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (
            lambda: penetration_depth(np.zeros((17, 3)), Skeleton.preset("coco17")),
            "skeleton of 17 joints has no radii, expected one per joint",
        ),
        (
            lambda: penetration_depth(np.zeros((17, 3)), PAIR),
            r"positions must have shape \(…, 34, 3\), got \(17, 3\)",
        ),
        (lambda: penetration_depth(np.full((34, 3), np.inf), PAIR), "positions has 102 values"),
        (
            lambda: penetrating_bones(np.zeros((1, 34, 3)), PAIR),
            r"pose must have shape \(34, 3\), got \(1, 34, 3\)",
        ),
    ],
)
def test_wrong_input_is_one_sentence(make, sentence):
    with pytest.raises(ValueError, match=sentence):
        make()
