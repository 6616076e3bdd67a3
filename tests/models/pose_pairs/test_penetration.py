"""Penetration depth: distances between segments and sums over pairs of bones."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import lsq_linear
from scipy.spatial.transform import Rotation

from probmotion import Skeleton
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


def random_poses(n):
    rng = np.random.default_rng(2)
    poses = np.zeros((n, 34, 3))
    for joint, parent in enumerate(PAIR.parents):
        above = poses[:, parent] if parent >= 0 else 0.0
        poses[:, joint] = above + 0.2 * rng.normal(size=(n, 3))
    return poses


def reference_distance(p, q, r, s):
    """Return the distance between two segments by bounded linear least squares."""
    solution = lsq_linear(np.stack([q - p, r - s], axis=1), r - p, (0, 1), method="bvls")
    return np.sqrt(2 * solution.cost)


def test_segment_distance_equals_bounded_least_squares():
    rng = np.random.default_rng(0)
    for _ in range(200):
        ends = rng.normal(size=(4, 3)) * rng.uniform(0.2, 2.0, size=(4, 1))
        assert segment_distance(*ends) == pytest.approx(reference_distance(*ends), abs=1e-9)


def test_segment_distance_by_hand():
    """The cases are skew, collinear, crossing and parallel segments, and points."""
    for segment, distance in (
        (([0.5, 2, 0], [0.5, 2, 1]), 2.0),
        (([2, 0, 0], [3, 0, 0]), 1.0),
        (([0.5, -1, 0], [0.5, 1, 0]), 0.0),
        (([0.2, 0.3, 0], [0.9, 0.3, 0]), 0.3),
        (([0.9, 0.3, 0], [0.2, 0.3, 0]), 0.3),
        (([1.5, 2, 0], [1.5, 2, 0]), np.hypot(0.5, 2.0)),
    ):
        unit, other = np.eye(2, 3)[::-1] * [1, 0, 0], np.array(segment, dtype=float)
        assert segment_distance(*unit, *other) == pytest.approx(distance)
        assert segment_distance(*other, *unit) == pytest.approx(distance)
    points = np.array([[0.0, 0, 0], [0.5, 2, 1]])
    assert segment_distance(*points[[0, 0, 1, 1]]) == pytest.approx(np.sqrt(5.25))


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
    """Orthogonal capsules of radius 0.1 m at 0.15 m from each other have depth 0.05 m."""
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
    for adjacent in ({"left_knee", "left_hip"}, {"left_knee", "spine"}, {"left_elbow", "chest"}):
        assert frozenset(adjacent) not in pairs


def test_depth_is_the_sum_over_pairs_of_bones():
    pose, pairs = 0.4 * random_poses(1)[0], capsules_of(PAIR).pairs
    between = (pairs < 16).sum(axis=1) == 1
    assert between.sum() == 16 * 16
    assert (~between).sum() == 2 * len(capsules_of(PERSON).pairs)
    total = 0.0
    for first, second in pairs:
        (a, b), (c, d) = PAIR.bones[first], PAIR.bones[second]
        total += max(0.0, PAIR.radii[a] + PAIR.radii[c] - reference_distance(*pose[[a, b, c, d]]))
    assert penetration_depth(pose, PAIR) == pytest.approx(total, abs=1e-9)
    assert total > 0.05
    depths = [depth for *_, depth in penetrating_bones(pose, PAIR)]
    assert sum(depths) == pytest.approx(total)
    assert depths == sorted(depths, reverse=True)


def test_depth_is_invariant_to_rigid_motion_and_swapping_people():
    poses = random_poses(200)
    depth = penetration_depth(poses, PAIR)
    rotation = Rotation.from_rotvec([0.3, 1.2, -0.5]).as_matrix()
    for other in (poses @ rotation.T + [3.0, -1.0, 2.0], np.roll(poses, 17, axis=1)):
        np.testing.assert_allclose(penetration_depth(other, PAIR), depth, atol=1e-12)
    batch = penetration_depth(poses.reshape(50, 2, 2, 34, 3), PAIR)
    np.testing.assert_array_equal(batch, depth.reshape(50, 2, 2))


def test_skeletons_that_differ_in_radii_only_are_distinguished():
    poses = random_poses(20)
    thin = Skeleton(PAIR.joint_names, PAIR.parents, [0.001] * 34)
    assert thin == PAIR
    assert penetration_depth(poses, thin).sum() < 0.2 * penetration_depth(poses, PAIR).sum()


INFINITE = np.full((34, 3), np.inf)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: penetration_depth(INFINITE, Skeleton.preset("coco17")), "must have radii"),
        (lambda: penetration_depth(INFINITE[:17], PAIR), r"positions must have shape \(…, 34, 3\)"),
        (lambda: penetration_depth(INFINITE, PAIR), "positions must be finite"),
        (lambda: penetrating_bones(INFINITE[None], PAIR), r"pose must have shape \(34, 3\)"),
    ],
)
def test_invalid_arguments_are_rejected(call, message):
    with pytest.raises(ValueError, match=message):
        call()
