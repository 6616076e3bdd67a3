"""Coverage and the distances below it, against plain formulas, SciPy and cases known in advance."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation

from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.interaction.geometry.coordinates import align_rigidly
from probmotion.interaction.geometry.pose_distances import MEASURES
from probmotion.interaction.geometry.rigid_kernels import align, residual
from probmotion.interaction.geometry.shape_context import shape_context_distance, shape_contexts
from probmotion.metrics.coverage import coverage, nearest_draw_distances, pose_distances

PAIRS = np.concatenate([dance.positions[::9] for dance in synthetic_dances(6)])
TRUTHS, DRAWS = PAIRS[:12], PAIRS[20:50]


def moved(poses, seed=0, upright=False):
    """Return poses, each turned and shifted its own way."""
    rng = np.random.default_rng(seed)
    turns = Rotation.random(len(poses), rng=rng)
    if upright:
        turns = Rotation.from_rotvec(rng.uniform(0, 6, (len(poses), 1)) * [0.0, 1.0, 0.0])
    return poses @ np.swapaxes(turns.as_matrix(), 1, 2) + rng.normal(size=(len(poses), 1, 3))


def plain_interaction(first, second):
    """Eq. 8 in space, straight from SciPy's tetrahedra and its rotation."""
    first, second = first - first.mean(axis=0), second - second.mean(axis=0)
    second = Rotation.align_vectors(first, second)[0].apply(second)
    total = 0.0
    for own in (first, second):
        edges = {
            tuple(sorted((int(i), int(j))))
            for simplex in Delaunay(own).simplices
            for i in simplex
            for j in simplex
            if i != j
        }
        weights = [1 / max(0.05, np.linalg.norm(own[i] - own[j])) for i, j in edges]
        apart = [np.linalg.norm(first[i] - first[j] - second[i] + second[j]) for i, j in edges]
        total += np.average(apart, weights=weights)
    return total


def plain_cartesian(first, second):
    first, second = first - first.mean(axis=0), second - second.mean(axis=0)
    return Rotation.align_vectors(first, second)[1] / np.sqrt(len(first))


def plain_shape_context(first, second):
    return float(
        shape_context_distance(shape_contexts(first), shape_contexts(align_rigidly(second, first)))
    )


PLAIN = {
    "interaction": plain_interaction,
    "cartesian": plain_cartesian,
    "shape-context": plain_shape_context,
}


@pytest.mark.parametrize("measure", MEASURES)
def test_distances_are_those_of_the_plain_formula(measure):
    first, second = moved(TRUTHS[:5], 1), moved(DRAWS[:7], 2)
    wanted = [[PLAIN[measure](a, b) for b in second] for a in first]
    np.testing.assert_allclose(pose_distances(first, second, measure), wanted, atol=1e-7)


@pytest.mark.parametrize("measure", MEASURES)
def test_distances_do_not_see_a_rigid_motion(measure):
    table = pose_distances(TRUTHS, DRAWS, measure)
    np.testing.assert_allclose(pose_distances(TRUTHS, moved(DRAWS), measure), table, atol=1e-10)
    # Shape contexts keep the first pose's vertical.
    turned = moved(TRUTHS, 3, upright=measure == "shape-context")
    np.testing.assert_allclose(pose_distances(turned, DRAWS, measure), table, atol=1e-10)
    assert table.min() > 0.01


@pytest.mark.parametrize("measure", MEASURES)
def test_a_mirror_image_is_another_pose(measure):
    mirrored = TRUTHS * np.array([-1.0, 1.0, 1.0])
    assert pose_distances(TRUTHS, mirrored, measure).min() > 0.05


@pytest.mark.parametrize("measure", ["interaction", "cartesian"])
def test_distances_are_symmetric(measure):
    table = pose_distances(TRUTHS, moved(DRAWS), measure)
    np.testing.assert_allclose(pose_distances(moved(DRAWS), TRUTHS, measure).T, table, atol=1e-12)


def test_shape_contexts_of_upright_poses_are_nearly_symmetric():
    table = pose_distances(DRAWS, DRAWS, "shape-context")
    # Aligned poses lean against each other, which moves a few joints to another bin.
    assert np.abs(table - table.T).mean() < 0.05 * table.mean()


def test_cartesian_distance_of_a_moved_joint():
    pose = np.zeros((4, 3))
    pose[:3] = np.eye(3)
    stretched = 1.1 * pose
    centred = pose - pose.mean(axis=0)
    wanted = 0.1 * np.sqrt((centred**2).sum() / 4)
    assert pose_distances(pose[None], stretched[None], "cartesian")[0, 0] == pytest.approx(wanted)
    # Every difference u is a tenth of what it was: twice the weighted mean of such.
    lengths = np.array([1.0, 1.0, 1.0, np.sqrt(2), np.sqrt(2), np.sqrt(2)])
    mean = np.average(0.1 * lengths, weights=1 / lengths)
    found = pose_distances(pose[None], stretched[None], "interaction")[0, 0]
    assert found == pytest.approx(2 * mean)


def test_the_rotation_is_the_best_proper_one_of_any_poses():
    rng = np.random.default_rng(4)
    rotation, horn = np.empty((3, 3)), np.empty((4, 4))
    for trial in range(400):
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
        least = (first**2).sum() + (second**2).sum() - 2 * sizes.sum()
        found = align(first, second, rotation, horn)
        apart = np.empty_like(first)
        assert abs(found - least) < 1e-10
        assert abs(residual(first, second, rotation, apart) - least) < 1e-10
        np.testing.assert_allclose(apart, first - second @ rotation.T, atol=1e-14)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-13)
        assert np.linalg.det(rotation) > 0


@pytest.mark.parametrize("measure", MEASURES)
def test_coverage_is_the_mean_least_distance(measure):
    table = pose_distances(TRUTHS, DRAWS, measure)
    assert coverage(TRUTHS, DRAWS, measure) == pytest.approx(table.min(axis=1).mean(), abs=1e-12)
    assert coverage(TRUTHS, DRAWS[:1], measure) == pytest.approx(table[:, 0].mean(), abs=1e-12)
    found = nearest_draw_distances(TRUTHS, DRAWS, measure, [7, 30])
    wanted = [table[:, :7].min(axis=1), table.min(axis=1)]
    np.testing.assert_allclose(found, wanted, atol=1e-12)


@pytest.mark.parametrize("measure", MEASURES)
def test_draws_that_hold_the_truths_cover_them(measure):
    draws = np.concatenate([DRAWS, moved(TRUTHS, 5)])
    assert coverage(TRUTHS, draws, measure) < 1e-7


@pytest.mark.parametrize("measure", MEASURES)
def test_counts_take_the_first_draws_and_only_improve(measure):
    counts = [30, 1, 10, 3]
    found = coverage(TRUTHS, DRAWS, measure, counts)
    alone = [coverage(TRUTHS, DRAWS[:count], measure) for count in counts]
    np.testing.assert_array_equal(found, alone)
    assert (np.diff(found[[1, 3, 2, 0]]) < 0).all()


def test_blocks_and_repeats_change_nothing():
    rng = np.random.default_rng(6)
    repeated = DRAWS[rng.integers(0, len(DRAWS), 700)] + 0.0
    repeated[400:] += 0.01 * rng.normal(size=(300, 34, 3))
    table = pose_distances(TRUTHS, repeated, "cartesian")
    for count in (100, 255, 256, 257, 600, 700):
        wanted = table[:, :count].min(axis=1).mean()
        assert coverage(TRUTHS, repeated, counts=[count])[0] == pytest.approx(wanted, abs=1e-13)


def test_a_repeated_pose_is_triangulated_once(monkeypatch):
    from probmotion.interaction.geometry import pose_distances as module

    measured = []
    plain = module.graph_edges
    monkeypatch.setattr(
        module, "graph_edges", lambda pose, graph: measured.append(1) or plain(pose, graph)
    )
    coverage(TRUTHS[:2], np.repeat(DRAWS[:3], 200, axis=0), "interaction")
    assert len(measured) == 2 + 3


def test_degenerate_poses_are_measured():
    flat = np.concatenate([TRUTHS[:3] * np.array([1.0, 1.0, 0.0]), np.zeros((1, 34, 3))])
    flat = np.concatenate([flat, TRUTHS[:1, [0] * 17 + list(range(17, 34))]])
    for measure in MEASURES:
        table = pose_distances(flat, flat, measure)
        assert np.isfinite(table).all()
        np.testing.assert_allclose(np.diag(table), 0, atol=1e-7)


def test_bad_input_is_refused_in_a_sentence():
    with pytest.raises(ValueError, match="measure must be one of interaction, carte, got 'euclid'"):
        coverage(TRUTHS, DRAWS, "euclid")
    with pytest.raises(ValueError, match="draws must contain at least one pose, got none"):
        coverage(TRUTHS, DRAWS[:0])
    with pytest.raises(ValueError, match="ground_truth is empty"):
        coverage(TRUTHS[:0], DRAWS)
    with pytest.raises(ValueError, match="counts has 31, expected at most 30, the draws"):
        coverage(TRUTHS, DRAWS, counts=[5, 31])
    with pytest.raises(ValueError, match="counts must be an integer of at least 1, got 0"):
        coverage(TRUTHS, DRAWS, counts=[0])
    with pytest.raises(ValueError, match="counts is empty"):
        coverage(TRUTHS, DRAWS, counts=[])
    with pytest.raises(ValueError, match=r"draws must have shape \(S, 34, 3\), got \(30, 33, 3\)"):
        coverage(TRUTHS, DRAWS[:, :33])
    broken = DRAWS.copy()
    broken[4, 2, 1] = np.nan
    with pytest.raises(
        ValueError, match="draws must be finite, got 1 values that are NaN or infinite"
    ):
        coverage(TRUTHS, broken)
    with pytest.raises(ValueError, match="second must be finite, got 1 values that are NaN"):
        pose_distances(TRUTHS, broken, "cartesian")


def test_draws_that_share_a_joint_are_different_draws():
    """A repeat is one in every joint: two poses with one place of the root are not."""
    rng = np.random.default_rng(5)
    truth = rng.standard_normal((4, 6, 3))
    draws = np.concatenate([rng.standard_normal((3, 6, 3)), truth])
    draws -= draws[:, :1]
    assert coverage(truth, draws) == pytest.approx(0, abs=1e-9)
