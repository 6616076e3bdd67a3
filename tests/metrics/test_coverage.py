"""Coverage and pose distances against plain formulas, SciPy and known cases."""

import itertools

import numpy as np
import pytest
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation

from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.interaction.geometry.coordinates import align_rigidly
from probmotion.interaction.geometry.pose_distances import MEASURES, pose_distances
from probmotion.interaction.geometry.rigid_kernels import align, residual
from probmotion.interaction.geometry.shape_context import shape_context_distance, shape_contexts
from probmotion.metrics.coverage import coverage, nearest_draw_distances

PAIRS = np.concatenate([dance.positions[::9] for dance in synthetic_dances(6)])
TRUTHS, DRAWS = PAIRS[:8], PAIRS[20:40]
BROKEN = DRAWS.copy()
BROKEN[4, 2, 1] = np.nan


def displaced(poses, seed=0, upright=False):
    """Return the poses, each rotated and translated at random."""
    rng = np.random.default_rng(seed)
    rotations = Rotation.random(len(poses), rng=rng)
    if upright:
        rotations = Rotation.from_rotvec(rng.uniform(0, 6, (len(poses), 1)) * [0.0, 1.0, 0.0])
    return poses @ np.swapaxes(rotations.as_matrix(), 1, 2) + rng.normal(size=(len(poses), 1, 3))


def plain_interaction(first, second):
    """Return the distance of eq. 8 in 3D, with the triangulation and rotation of SciPy."""
    first, second = first - first.mean(axis=0), second - second.mean(axis=0)
    second = Rotation.align_vectors(first, second)[0].apply(second)
    total = 0.0
    for pose in (first, second):
        pairs = (itertools.permutations(simplex, 2) for simplex in Delaunay(pose).simplices)
        i, j = np.unique(np.sort([edge for edges in pairs for edge in edges]), axis=0).T
        differences = np.linalg.norm(first[i] - first[j] - second[i] + second[j], axis=1)
        lengths = np.linalg.norm(pose[i] - pose[j], axis=1)
        total += np.average(differences, weights=1 / np.maximum(0.05, lengths))
    return total


def plain_cartesian(first, second):
    first, second = first - first.mean(axis=0), second - second.mean(axis=0)
    return Rotation.align_vectors(first, second)[1] / np.sqrt(len(first))


def plain_shape_context(first, second):
    aligned = align_rigidly(second, first)
    return float(shape_context_distance(shape_contexts(first), shape_contexts(aligned)))


@pytest.mark.parametrize(
    ("measure", "plain"),
    [
        ("interaction", plain_interaction),
        ("cartesian", plain_cartesian),
        ("shape-context", plain_shape_context),
    ],
)
def test_distances_agree_with_the_plain_formula(measure, plain):
    first, second = displaced(TRUTHS[:3], 1), displaced(DRAWS[:4], 2)
    expected = [[plain(a, b) for b in second] for a in first]
    np.testing.assert_allclose(pose_distances(first, second, measure), expected, atol=1e-7)


@pytest.mark.parametrize("measure", MEASURES)
def test_distances_are_invariant_to_rigid_motion_but_not_reflection(measure):
    table = pose_distances(TRUTHS, DRAWS, measure)
    np.testing.assert_allclose(pose_distances(TRUTHS, displaced(DRAWS), measure), table, atol=1e-10)
    # Shape contexts use the first pose's vertical.
    rotated = displaced(TRUTHS, 3, upright=measure == "shape-context")
    np.testing.assert_allclose(pose_distances(rotated, DRAWS, measure), table, atol=1e-10)
    assert table.min() > 0.01
    if measure != "shape-context":
        transposed = pose_distances(DRAWS, TRUTHS, measure).T
        np.testing.assert_allclose(transposed, table, atol=1e-12)
    mirrored = TRUTHS * np.array([-1.0, 1.0, 1.0])
    assert pose_distances(TRUTHS, mirrored, measure).min() > 0.05


def test_distances_of_a_scaled_pose_by_hand():
    pose = np.zeros((4, 3))
    pose[:3] = np.eye(3)
    centred = pose - pose.mean(axis=0)
    expected = 0.1 * np.sqrt((centred**2).sum() / 4)
    result = {m: pose_distances(pose[None], 1.1 * pose[None], m)[0, 0] for m in MEASURES}
    assert result["cartesian"] == pytest.approx(expected)
    lengths = np.array([1.0, 1.0, 1.0, np.sqrt(2), np.sqrt(2), np.sqrt(2)])
    mean = np.average(0.1 * lengths, weights=1 / lengths)
    assert result["interaction"] == pytest.approx(2 * mean)


def test_alignment_finds_the_best_proper_rotation():
    rng = np.random.default_rng(4)
    rotation, horn = np.empty((3, 3)), np.empty((4, 4))
    for trial in range(100):
        n_joints = int(rng.integers(1, 20))
        first, second = rng.normal(size=(2, n_joints, 3))
        if trial % 5 == 1:
            second = Rotation.random(rng=rng).apply(first)
        if trial % 5 == 2:
            second = -first
        if trial % 5 == 3:
            first[:, 1:] = second[:, 1:] = 0
        if trial % 5 == 4:
            first[:, 2] = second[:, 2] = 0
        first -= first.mean(axis=0)
        second -= second.mean(axis=0)
        left, sizes, right = np.linalg.svd(second.T @ first)
        sizes[2] *= np.sign(np.linalg.det(left @ right))
        minimum = (first**2).sum() + (second**2).sum() - 2 * sizes.sum()
        differences = np.empty_like(first)
        assert abs(align(first, second, rotation, horn) - minimum) < 1e-10
        assert abs(residual(first, second, rotation, differences) - minimum) < 1e-10
        np.testing.assert_allclose(differences, first - second @ rotation.T, atol=1e-14)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-13)
        assert np.linalg.det(rotation) > 0


@pytest.mark.parametrize("measure", MEASURES)
def test_coverage_is_the_mean_distance_to_the_nearest_draw(measure):
    table = pose_distances(TRUTHS, DRAWS, measure)
    assert coverage(TRUTHS, DRAWS, measure) == pytest.approx(table.min(axis=1).mean(), abs=1e-12)
    counts = [20, 1, 10, 3]
    result = nearest_draw_distances(TRUTHS, DRAWS, measure, counts)
    expected = [table[:, :count].min(axis=1) for count in counts]
    np.testing.assert_allclose(result, expected, atol=1e-12)
    np.testing.assert_array_equal(coverage(TRUTHS, DRAWS, measure, counts), result.mean(axis=1))
    assert coverage(TRUTHS, np.concatenate([DRAWS, displaced(TRUTHS, 5)]), measure) < 1e-7


def test_blocks_and_repeated_draws():
    rng = np.random.default_rng(6)
    repeated = DRAWS[rng.integers(0, len(DRAWS), 700)] + 0.0
    repeated[400:] += 0.01 * rng.normal(size=(300, 34, 3))
    table = pose_distances(TRUTHS, repeated, "cartesian")
    for count in (100, 255, 256, 257, 600, 700):
        expected = table[:, :count].min(axis=1).mean()
        assert coverage(TRUTHS, repeated, counts=[count])[0] == pytest.approx(expected, abs=1e-13)
    # Poses that agree in one joint only are not repeated.
    truth = rng.standard_normal((4, 6, 3))
    draws = np.concatenate([rng.standard_normal((3, 6, 3)), truth])
    assert coverage(truth, draws - draws[:, :1]) == pytest.approx(0, abs=1e-9)


def test_degenerate_poses_have_finite_distances():
    flat = np.concatenate([TRUTHS[:3] * np.array([1.0, 1.0, 0.0]), np.zeros((1, 34, 3))])
    flat = np.concatenate([flat, TRUTHS[:1, [0] * 17 + list(range(17, 34))]])
    for measure in MEASURES:
        table = pose_distances(flat, flat, measure)
        assert np.isfinite(table).all()
        np.testing.assert_allclose(np.diag(table), 0, atol=1e-7)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"measure": "euclid"}, "measure must be one of interaction, cartesian, .*got 'euclid'"),
        ({"draws": DRAWS[:0]}, "draws must have at least one entry, got 0"),
        ({"ground_truth": TRUTHS[:0]}, "ground_truth must have at least one entry"),
        ({"counts": [5, 31]}, "counts must be at most the 20 draws, got 31"),
        ({"counts": [0]}, "counts must be an integer of at least 1, got 0"),
        ({"counts": []}, "counts must have at least one entry, got 0"),
        ({"draws": DRAWS[:, :33]}, r"draws must have shape \(S, 34, 3\), got \(20, 33, 3\)"),
        ({"draws": BROKEN}, "draws must be finite, got 1 values"),
    ],
)
def test_invalid_arguments(changes, message):
    with pytest.raises(ValueError, match=message):
        coverage(**({"ground_truth": TRUTHS, "draws": DRAWS} | changes))
