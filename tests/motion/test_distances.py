"""Distances of motions against a search over yaws, and mirror images."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from probmotion.data.synthetic.gaits import make_gait
from probmotion.motion import distances as motion_distances
from probmotion.motion.distances import (
    mirrored_fraction,
    nearest_distances,
    windows,
    yaw_aligned_distances,
)

IN_DEPTH = np.array([1.0, 1.0, -1.0])


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def turned(motions, yaw):
    """Motions (N, L, J, 3) rotated about the vertical by one yaw each or all."""
    rotation = Rotation.from_rotvec(np.multiply.outer(np.atleast_1d(yaw), [0, 1, 0])).as_matrix()
    return motions @ rotation.transpose(0, 2, 1)[:, None]


def gaits(style, numbers, frames=20):
    return np.stack([make_gait(style, n, frames=frames).positions for n in numbers])


def distance_at(a, b, yaw):
    """Root mean square joint distance of two motions, (L, J, 3), after one rotation."""
    a, b = (motion - motion[:, :1] for motion in (a, b))
    difference = turned(a[None], np.atleast_1d(yaw)) - b
    return np.sqrt((difference**2).sum(axis=-1).mean(axis=(1, 2)))


def test_distance_is_symmetric_and_invariant_to_heading_and_path(rng):
    motions = rng.normal(size=(12, 3, 4, 3))
    moved = turned(motions, rng.uniform(0, 7, 12)) + rng.normal(size=(12, 3, 1, 3))
    distances = yaw_aligned_distances(motions, moved)
    assert np.diag(distances).max() < 1e-7
    assert distances[~np.eye(12, dtype=bool)].min() > 0.5
    np.testing.assert_allclose(distances, distances.T, atol=1e-7)


def test_distance_is_the_minimum_over_yaw(rng):
    a, b = rng.normal(size=(3, 5, 4, 3)), rng.normal(size=(4, 5, 4, 3))
    yaws = np.linspace(0, 2 * np.pi, 3601)
    expected = [[distance_at(one, other, yaws).min() for other in b] for one in a]
    np.testing.assert_allclose(yaw_aligned_distances(a, b), expected, atol=1e-6)


def test_distance_of_a_raised_joint_by_hand(rng):
    motion = rng.normal(size=(1, 6, 4, 3))

    def distance(joint, root):
        raised = motion.copy()
        raised[:, :, joint, 1] += 0.3
        return yaw_aligned_distances(motion, raised, root=root)

    # One of four joints is 0.3 m away in every frame; with the root raised, the three others are.
    assert distance(2, root=0) == pytest.approx(0.3 / 2)
    assert distance(0, root=0) == pytest.approx(0.3 * np.sqrt(3 / 4))
    assert distance(0, root=1) == pytest.approx(0.3 / 2)


def test_depth_mirrored_motions_differ_unless_mirrored_back(rng):
    motions = gaits("walk", range(3))
    images = turned(motions * IN_DEPTH, rng.uniform(0, 7, 3))
    assert np.diag(yaw_aligned_distances(motions, images)).min() > 0.05
    assert np.diag(yaw_aligned_distances(motions, images, mirrored=True)).max() < 1e-7


def test_distances_are_independent_of_the_other_motions(rng, monkeypatch):
    a, b = rng.normal(size=(300, 3, 4, 3)), rng.normal(size=(270, 3, 4, 3))
    distances = yaw_aligned_distances(a, b)
    part = yaw_aligned_distances(a[250:260], b[3:4])
    np.testing.assert_array_equal(distances[250:260, 3:4], part)
    nearest = nearest_distances(a, b)
    assert nearest.of_draws == distances.min(axis=1).mean()
    assert nearest.of_real == distances.min(axis=0).mean()
    monkeypatch.setattr(motion_distances, "_BLOCK", 7)
    np.testing.assert_allclose(distances, yaw_aligned_distances(a, b), rtol=1e-12)


def test_mirrored_fraction_counts_depth_mirrored_draws(rng):
    real = gaits("walk", range(40))
    draws = turned(gaits("walk", range(40, 60)), rng.uniform(0, 7, 20))
    assert mirrored_fraction(draws, real) < 0.1
    draws[:5] = turned(draws[:5] * IN_DEPTH, rng.uniform(0, 7, 5))
    expected = mirrored_fraction(draws[5:], real) * 0.75 + 0.25
    assert mirrored_fraction(draws, real) == pytest.approx(expected)
    flat, other = rng.normal(size=(2, 6, 4, 5, 3)) * [1, 1, 0]
    assert mirrored_fraction(flat, other) == 0


def test_windows_of_a_clip():
    clip = np.arange(5.0)[:, None, None] * np.ones((5, 2, 3))
    assert windows(clip, 3)[:, :, 0, 0].tolist() == [[0, 1, 2], [1, 2, 3], [2, 3, 4]]
    assert windows(clip, 2, stride=3)[:, :, 1, 2].tolist() == [[0, 1], [3, 4]]
    with pytest.raises(ValueError, match="positions must have at least frames=6 frames, got 5"):
        windows(clip, 6)


@pytest.mark.parametrize(
    ("function", "first", "second", "message"),
    [
        (yaw_aligned_distances, (2, 3, 4, 3), (2, 2, 4, 3), r"b must have .* like a, got \(2, 4"),
        (nearest_distances, (2, 3, 4, 3), (2, 3, 5, 3), r"real must have .* like draws, got \(3"),
        (yaw_aligned_distances, (3, 4, 3), (2, 3, 4, 3), r"a must have shape \(N, L, J, 3\), got"),
        (nearest_distances, (2, 3, 4, 3), (0, 3, 4, 3), "real must contain at least one motion"),
    ],
)
def test_invalid_motions_are_refused(function, first, second, message):
    with pytest.raises(ValueError, match=message):
        function(np.zeros(first), np.zeros(second))
    with pytest.raises(ValueError, match="draws must be finite, got 36 values"):
        mirrored_fraction(np.full((1, 3, 4, 3), np.nan), np.zeros((1, 3, 4, 3)))
