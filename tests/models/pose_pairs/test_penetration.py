"""Penetration depth: distances of segments and sums over pairs of bones."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import lsq_linear
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
    """Return a skeleton of n trees with one bone each."""
    names = [f"{end}{k}" for k in range(n) for end in ("foot", "head")]
    parents = [value for k in range(n) for value in (-1, 2 * k)]
    return Skeleton(names, parents, [radius] * (2 * n))


def crowd(people):
    return Skeleton(
        [f"p{p}:{name}" for p in range(people) for name in PERSON.joint_names],
        [-1 if q < 0 else q + 17 * p for p in range(people) for q in PERSON.parents],
        PERSON.radii * people,
    )


def random_poses(n, people=2):
    rng = np.random.default_rng(2)
    poses = np.zeros((n, 17 * people, 3))
    for person in range(people):
        for joint, parent in enumerate(PERSON.parents):
            above = poses[:, 17 * person + parent] if parent >= 0 else 0.0
            poses[:, 17 * person + joint] = above + 0.2 * rng.normal(size=(n, 3))
    return poses


def reference_distance(p, q, r, s):
    """Return the distance of two segments by bounded linear least squares."""
    solution = lsq_linear(np.stack([q - p, r - s], axis=1), r - p, (0, 1), method="bvls")
    return np.sqrt(2 * solution.cost)


def test_segment_distance_equals_bounded_least_squares():
    rng = np.random.default_rng(0)
    for _ in range(200):
        ends = rng.normal(size=(4, 3)) * rng.uniform(0.2, 2.0, size=(4, 1))
        assert segment_distance(*ends) == pytest.approx(reference_distance(*ends), abs=1e-9)


def test_segment_distance_by_hand():
    at = np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 2, 0], [0.5, 2, 1], [2, 0, 0], [3, 0, 0],
                   [0.5, -1, 0], [0.5, 1, 0], [0.2, 0.3, 0], [0.9, 0.3, 0]])  # fmt: skip
    a, b = at[0], at[1]
    assert segment_distance(a, b, at[2], at[3]) == pytest.approx(2.0)
    assert segment_distance(a, b, at[4], at[5]) == pytest.approx(1.0)  # collinear
    assert segment_distance(a, b, at[6], at[7]) == pytest.approx(0.0)  # crossing
    assert segment_distance(a, b, at[8], at[9]) == pytest.approx(0.3)  # parallel
    assert segment_distance(a, b, at[9], at[8]) == pytest.approx(0.3)
    assert segment_distance(a, b, b + at[2], b + at[2]) == pytest.approx(np.hypot(0.5, 2.0))
    assert segment_distance(at[2], at[2], a, b) == pytest.approx(2.0)  # point and segment
    assert segment_distance(a, a, at[3], at[3]) == pytest.approx(np.linalg.norm(at[3]))


@pytest.mark.parametrize("size", [1e-7, 1e-4, 1.0])
def test_segment_distance_of_nearly_parallel_and_tiny_segments(size):
    rng = np.random.default_rng(1)
    for _ in range(50):
        p, u, w = rng.normal(size=(3, 3))
        v = u + 1e-9 * rng.normal(size=3)
        r = p + 0.5 * np.cross(u, w) / np.linalg.norm(np.cross(u, w))
        distance = segment_distance(p, p + size * u, r, r + size * v)
        assert distance == pytest.approx(0.5, abs=1e-6)


def test_depth_by_hand():
    """Orthogonal capsules of radius 0.1 m at a distance of 0.15 m: depth 0.05 m."""
    pose = np.array([[-1.0, 0, 0], [1, 0, 0], [0, 0.15, -1], [0, 0.15, 1]])
    assert penetration_depth(pose, rods(2)) == pytest.approx(0.05)
    three = np.concatenate([pose, np.add(pose[:2], [0, 0.3, 0])])
    assert penetration_depth(three, rods(3)) == pytest.approx(0.10)
    assert penetration_depth(three, rods(3, radius=0.07)) == 0.0
    assert penetrating_bones(pose, rods(2)) == [("head0", "head1", pytest.approx(0.05))]
    assert penetrating_bones(pose, rods(2, radius=0.07)) == []
    assert penetration_depth(np.zeros((0, 4, 3)), rods(2)).shape == (0,)


def test_neighbouring_bones_of_a_tree_are_not_tested():
    """In a folded chain of four bones only the first and last are tested."""
    chain = Skeleton(["a", "b", "c", "d", "e"], [-1, 0, 1, 2, 3], [0.05] * 5)
    assert capsules_of(chain).pairs.tolist() == [[0, 3]]
    flat = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0.5, 1, 0], [0.5, 0.06, 0]])
    assert penetration_depth(flat, chain) == pytest.approx(0.04)
    names = [PERSON.joint_names[j] for j, _ in PERSON.bones]
    pairs = {frozenset(names[b] for b in pair) for pair in capsules_of(PERSON).pairs}
    assert {frozenset({"left_knee", "right_knee"}), frozenset({"left_wrist", "chest"})} <= pairs
    for beside in ({"left_knee", "left_hip"}, {"left_knee", "spine"}, {"left_elbow", "chest"}):
        assert frozenset(beside) not in pairs


def test_all_pairs_of_bones_of_two_people_are_tested():
    pairs = capsules_of(PAIR).pairs
    between = (pairs < 16).sum(axis=1) == 1
    assert between.sum() == 256
    assert (~between).sum() == 2 * len(capsules_of(PERSON).pairs)


def test_depth_is_the_sum_over_pairs_of_bones():
    pose = 0.4 * random_poses(1)[0]
    total = 0.0
    for first, second in capsules_of(PAIR).pairs:
        (a, b), (c, d) = PAIR.bones[first], PAIR.bones[second]
        total += max(0.0, PAIR.radii[a] + PAIR.radii[c] - reference_distance(*pose[[a, b, c, d]]))
    assert penetration_depth(pose, PAIR) == pytest.approx(total, abs=1e-9)
    assert total > 0.05
    found = penetrating_bones(pose, PAIR)
    depths = [depth for *_, depth in found]
    assert sum(depths) == pytest.approx(total)
    assert depths == sorted(depths, reverse=True)
    assert {name for first, second, _ in found for name in (first, second)} <= {*PAIR.joint_names}


def test_depth_is_invariant_to_rigid_motion_and_swapping_people():
    poses = random_poses(200)
    depth = penetration_depth(poses, PAIR)
    turn = Rotation.from_rotvec([0.3, 1.2, -0.5]).as_matrix()
    for other in (poses @ turn.T + [3.0, -1.0, 2.0], np.roll(poses, 17, axis=1)):
        np.testing.assert_allclose(penetration_depth(other, PAIR), depth, atol=1e-12)
    batch = penetration_depth(poses.reshape(50, 2, 2, 34, 3), PAIR)
    np.testing.assert_array_equal(batch, depth.reshape(50, 2, 2))


def test_depths_of_distant_people_add_up():
    people = 3
    poses = random_poses(50, people)
    apart = poses + 100.0 * np.repeat(np.arange(people), 17)[:, None]
    own = sum(penetration_depth(poses[:, 17 * p : 17 * p + 17], PERSON) for p in range(people))
    np.testing.assert_allclose(penetration_depth(apart, crowd(people)), own, atol=1e-9)
    assert (penetration_depth(poses, crowd(people)) >= own - 1e-12).all()


def test_skeletons_that_differ_in_radii_only_are_distinguished():
    poses = random_poses(20)
    thin = Skeleton(PAIR.joint_names, PAIR.parents, [0.001] * 34)
    assert thin == PAIR
    assert penetration_depth(poses, thin).sum() < 0.2 * penetration_depth(poses, PAIR).sum()


def penalty(poses):
    """Return w ρ² / (2 σ_p²) with w = 10 and σ_p = 0.05 (Yin et al. 2018, eq. 2)."""
    return 10.0 * penetration_depth(poses, PAIR) ** 2 / (2.0 * 0.05**2)


def test_real_pairs_have_small_penalties_and_collisions_large_ones(real_data):
    clips = sorted((real_data / "cmu_salsa_pairs").glob("*.npz"))
    poses = np.concatenate(
        [np.concatenate(clips_of_people(p), axis=1)[::5] for p in clips if p.stem not in HELD_OUT]
    )
    poses = poses[np.linalg.norm(poses[:, 0] - poses[:, 17], axis=1) < 1.2]
    nats = penalty(poses)
    assert np.median(nats) == 0.0
    assert np.quantile(nats, 0.9) < 0.1
    assert np.quantile(nats, 0.99) < 4.0
    for fraction, least in ((1.0, 0.99), (0.8, 0.95)):
        gap = (poses[:, :1] - poses[:, 17:18]) * np.array([fraction, 0.0, fraction])
        moved = np.concatenate([poses[:, :17], poses[:, 17:] + gap], axis=1)
        assert (penalty(moved) > 3.0).mean() > least


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: penetration_depth(np.zeros((17, 3)), Skeleton.preset("coco17")),
            "skeleton must have radii",
        ),
        (
            lambda: penetration_depth(np.zeros((17, 3)), PAIR),
            r"positions must have shape \(…, 34, 3\), got \(17, 3\)",
        ),
        (lambda: penetration_depth(np.full((34, 3), np.inf), PAIR), "positions must be finite"),
        (
            lambda: penetrating_bones(np.zeros((1, 34, 3)), PAIR),
            r"pose must have shape \(34, 3\), got \(1, 34, 3\)",
        ),
    ],
)
def test_invalid_arguments_are_rejected(call, message):
    with pytest.raises(ValueError, match=message):
        call()
