"""Retrieval of draws for 2D pairs, and completion of occluded joints."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from probmotion import Skeleton
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.interaction import retrieval
from probmotion.interaction.annotations.views import project_to_views
from probmotion.interaction.completion import (
    blend,
    complete,
    complete_keypoints,
    nearest_annotation_completion,
    occluded_joint_error,
)
from probmotion.interaction.geometry.coordinates import interaction_distance
from probmotion.interaction.retrieval import view_grid, views_around

PAIR = Skeleton.preset("pair17")
DANCES = synthetic_dances(9)
DRAWS = np.concatenate([dance.positions[::5] for dance in DANCES[:8]])
POSES = np.concatenate([dance.positions[::9] for dance in DANCES[:4]])
TRUTH = DANCES[8].positions[40]
VIEWS = view_grid(6, 1)
OCCLUDED = np.isin(np.arange(34), [6, 7, 12, 13, 26, 27])


def masked(pose, hidden=OCCLUDED):
    """Set the occluded joints to NaN."""
    return np.where(hidden[:, None], np.nan, pose)


def completed(draws=DRAWS, pose=TRUTH, visible=~OCCLUDED, **options):
    return complete(masked(pose, ~visible), visible, draws, PAIR, **{"n_nearest": 10} | options)


def transformed(poses, seed=0):
    rng = np.random.default_rng(seed)
    matrices = Rotation.random(len(poses), rng=rng).as_matrix()
    return poses @ np.swapaxes(matrices, 1, 2) + rng.normal(size=(len(poses), 1, 3))


def test_true_pose_among_the_draws_is_recovered():
    draws = transformed(np.concatenate([DRAWS[:60], np.repeat(TRUTH[None], 20, axis=0)]))
    result = completed(draws, n_nearest=20)
    np.testing.assert_allclose(result.positions, TRUTH, atol=1e-9)
    assert sorted(result.indices) == list(range(60, 80))


def test_completion_is_invariant_to_rigid_motion_and_better_than_the_mean_pose():
    result, other = completed(), completed(transformed(DRAWS))
    np.testing.assert_array_equal(result.positions[~OCCLUDED], TRUTH[~OCCLUDED])
    np.testing.assert_array_equal(other.indices, result.indices)
    np.testing.assert_allclose(other.positions, result.positions, atol=1e-9)
    error = occluded_joint_error(TRUTH, result.positions, OCCLUDED)
    mean_pose = completed(n_nearest=len(DRAWS)).positions
    assert error < 0.8 * occluded_joint_error(TRUTH, mean_pose, OCCLUDED)


def test_median_is_robust_to_an_outlier():
    draws = TRUTH + np.random.default_rng(0).normal(scale=0.005, size=(9, 34, 3))
    draws[0, OCCLUDED] += 5.0
    result = completed(draws, n_nearest=9)
    assert occluded_joint_error(TRUTH, result.positions, OCCLUDED) < 0.02


def test_blend_moves_occluded_joints_by_the_gaussian_weighted_mean():
    median = np.array([[0.0, 0.0], [1.0, 0.0], [0.25, 0.0]])
    target = np.array([[0.0, 0.4], [1.0, -0.2], [np.nan, np.nan]])
    blended = blend(median, target, np.array([True, True, False]), bandwidth=0.5)
    w0, w1 = np.exp(-(0.25**2) / 0.5), np.exp(-(0.75**2) / 0.5)
    expected = (0.4 * w0 - 0.2 * w1) / (w0 + w1)
    np.testing.assert_allclose(blended, [[0.0, 0.4], [1.0, -0.2], [0.25, expected]])
    median[2] = 500.0  # a distant joint follows the nearest joint
    assert blend(median, target, np.array([True, True, False]), 0.1)[2, 1] == pytest.approx(499.8)


def test_projection_of_a_draw_is_recovered():
    projection = project_to_views(DRAWS[[7]], VIEWS[[2]], PAIR)[0, 0]
    result = complete_keypoints(
        masked(projection), ~OCCLUDED, DRAWS[:40], PAIR, views=VIEWS, n_nearest=1
    )
    np.testing.assert_allclose(result.positions, projection, atol=1e-9)
    assert result.indices.tolist() == [7]


def test_nearest_annotation_completes_occluded_joints():
    annotated = project_to_views(DRAWS[:30], VIEWS[[1]], PAIR)[:, 0]
    c, s = np.cos(0.4), np.sin(0.4)
    query = annotated[12] @ np.array([[c, s], [-s, c]]) + 1.0
    given = masked(query), ~OCCLUDED, annotated, PAIR
    result = nearest_annotation_completion(*given)
    np.testing.assert_allclose(result.positions, query, atol=1e-9)
    assert result.indices.tolist() == [12]
    known = np.ones((30, 34), dtype=bool)
    known[12, 6] = False
    other = nearest_annotation_completion(*given, known)
    assert other.indices.tolist() != [12]
    np.testing.assert_array_equal(other.positions[~OCCLUDED], query[~OCCLUDED])
    known[:, 26] = False
    with pytest.raises(ValueError, match="annotated must contain a pair with every occluded joint"):
        nearest_annotation_completion(*given, known)


def test_error_is_the_mean_distance_of_occluded_joints():
    estimate = TRUTH.copy()
    estimate[6] += [0.3, 0.0, 0.4]
    estimate[0] += 9.0
    assert occluded_joint_error(TRUTH, estimate, OCCLUDED) == pytest.approx(0.5 / 6)


def retrieve(keypoints, draws=POSES, **options):
    return retrieval.retrieve(keypoints, draws, PAIR, **{"views": VIEWS} | options)


def projection(draw, view, angle=0.0, shift=(0.0, 0.0)):
    """Project a draw, then rotate and shift it in the image."""
    image = project_to_views(POSES[draw][None], VIEWS[view][None], PAIR)[0, 0]
    c, s = np.cos(angle), np.sin(angle)
    return image @ np.array([[c, s], [-s, c]]) + np.array(shift)


@pytest.mark.parametrize(("draw", "view"), [(0, 0), (13, 4), (39, 5)])
def test_projection_retrieves_its_draw_and_view(draw, view):
    result = retrieve(projection(draw, view, 0.3, (2.0, -1.0)), n=3)
    assert result.indices.shape == result.distances.shape == (3,)
    assert result.indices[0] == draw
    np.testing.assert_array_equal(result.views[0], VIEWS[view])
    assert result.distances[0] < 1e-9 < 0.01 < result.distances[1] <= result.distances[2]


def test_distances_are_minima_over_views():
    query = projection(5, 2) + np.random.default_rng(0).normal(scale=0.05, size=(34, 2))
    result = retrieve(query, POSES[:4], n=4)
    expected = interaction_distance(query, project_to_views(POSES[:4], VIEWS, PAIR))
    np.testing.assert_array_equal(result.indices, expected.min(axis=1).argsort())
    np.testing.assert_allclose(result.distances, np.sort(expected.min(axis=1)), atol=1e-9)
    np.testing.assert_array_equal(result.views, VIEWS[expected.argmin(axis=1)[result.indices]])


def test_occluded_joints_are_ignored():
    result = retrieve(masked(projection(8, 1)), visible=~OCCLUDED)
    assert result.indices[0] == 8
    assert result.distances[0] < 1e-9


def test_batches_and_blocks_do_not_change_the_result(monkeypatch):
    queries = np.stack([[projection(1, 0), projection(2, 1), projection(30, 5)]])
    batch = retrieve(queries, n=2)
    assert batch.indices.shape == (1, 3, 2)
    assert batch.views.shape == (1, 3, 2, 2)
    monkeypatch.setattr(retrieval, "_BLOCK", 13)
    for index, query in enumerate(queries[0]):
        for of_batch, of_query in zip(batch, retrieve(query, n=2), strict=True):
            np.testing.assert_array_equal(of_batch[0, index], of_query)


def test_repeated_poses_count_once_by_their_first_index():
    repeated = POSES[[4, 4, 9, 4, 9, 2]]
    result = retrieve(projection(9, 3), repeated, n=3)
    assert result.indices[0] == 2
    assert sorted(result.indices) == [0, 2, 5]
    with pytest.raises(ValueError, match="n must be at most the 3 distinct draws, got"):
        retrieve(projection(9, 3), repeated, n=4)


def test_grids_of_views():
    views = view_grid()
    assert np.unique(views, axis=0).shape == (48, 2)
    assert np.degrees(views[[0, -1]]) == pytest.approx(np.array([[-180, 50], [157.5, 100]]))
    offsets = np.degrees(views_around(np.array([0.3, 1.2])) - [0.3, 1.2])
    assert offsets[[0, 7, 14]] == pytest.approx(np.array([[-30, -15], [0, 0], [30, 15]]))


FOURTH = np.arange(34) == 3


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: completed(visible=FOURTH), "visible must mark at least 4 joints, got 1"),
        (lambda: completed(DRAWS[:20], n_nearest=100), "n_nearest must be at most 20, .*, got 100"),
        (lambda: completed(pose=masked(TRUTH, FOURTH)), "pose must be finite, got 3 values"),
        (lambda: occluded_joint_error(TRUTH, TRUTH, OCCLUDED & False), "must mark at least one"),
        (lambda: retrieve(TRUTH[:, :2], views=np.empty((0, 2))), "must contain at least one view"),
        (lambda: retrieve(TRUTH[:, :2], visible=FOURTH), "visible must share an edge with"),
    ],
)
def test_invalid_arguments_are_rejected(call, message):
    with pytest.raises(ValueError, match=message):
        call()
