"""Completion: exact where the truth is among the draws, and better than one annotation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from probmotion import Skeleton
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.interaction.annotations.views import project_to_views
from probmotion.interaction.completion import (
    blend,
    complete,
    complete_keypoints,
    nearest_annotation_completion,
    occluded_joint_error,
)
from probmotion.interaction.retrieval import view_grid

PAIR = Skeleton.preset("pair17")
DRAWS = np.concatenate([dance.positions[::5] for dance in synthetic_dances(8)])
TRUTH = synthetic_dances(9)[8].positions[40]
VIEWS = view_grid(6, 1)
HIDDEN = np.isin(np.arange(34), [6, 7, 12, 13, 26, 27])


def without(pose, hidden=HIDDEN):
    """Return a pose whose hidden joints are NaN: nobody may read them."""
    return np.where(hidden[:, None], np.nan, pose)


def turned(poses, seed=0):
    rng = np.random.default_rng(seed)
    matrices = Rotation.random(len(poses), rng=rng).as_matrix()
    return poses @ np.swapaxes(matrices, 1, 2) + rng.normal(size=(len(poses), 1, 3))


def test_a_truth_that_was_drawn_often_is_found_exactly():
    draws = np.concatenate([turned(DRAWS[:60]), turned(np.repeat(TRUTH[None], 20, axis=0), 1)])
    done = complete(without(TRUTH), ~HIDDEN, draws, PAIR, n_nearest=20)
    np.testing.assert_allclose(done.positions, TRUTH, atol=1e-9)
    assert sorted(done.indices) == list(range(60, 80))


def test_visible_joints_stay_exactly_as_they_were():
    done = complete(without(TRUTH), ~HIDDEN, DRAWS, PAIR, n_nearest=10)
    np.testing.assert_array_equal(done.positions[~HIDDEN], TRUTH[~HIDDEN])
    assert np.isfinite(done.positions).all()
    assert len(done.indices) == 10


def test_where_and_how_the_draws_stand_is_no_matter():
    plain = complete(without(TRUTH), ~HIDDEN, DRAWS, PAIR, n_nearest=10)
    moved = complete(without(TRUTH), ~HIDDEN, turned(DRAWS), PAIR, n_nearest=10)
    np.testing.assert_array_equal(moved.indices, plain.indices)
    np.testing.assert_allclose(moved.positions, plain.positions, atol=1e-9)


def test_one_wild_draw_does_not_move_the_median():
    """A median forgives what a mean would not."""
    near = TRUTH + np.random.default_rng(0).normal(scale=0.005, size=(9, 34, 3))
    wild = near[0].copy()
    wild[HIDDEN] += 5.0
    done = complete(without(TRUTH), ~HIDDEN, np.stack([*near[1:], wild]), PAIR, n_nearest=9)
    assert occluded_joint_error(TRUTH, done.positions, HIDDEN) < 0.02


def test_dances_of_the_same_kind_tell_hidden_joints_better_than_the_mean_pose():
    done = complete(without(TRUTH), ~HIDDEN, DRAWS, PAIR, n_nearest=10)
    error = occluded_joint_error(TRUTH, done.positions, HIDDEN)
    everything = complete(without(TRUTH), ~HIDDEN, DRAWS, PAIR, n_nearest=len(DRAWS))
    assert error < 0.8 * occluded_joint_error(TRUTH, everything.positions, HIDDEN)


def test_blending_moves_hidden_joints_by_the_gaussian_weighted_mean():
    median = np.array([[0.0, 0.0], [1.0, 0.0], [0.25, 0.0]])
    target = np.array([[0.0, 0.4], [1.0, -0.2], [np.nan, np.nan]])
    visible = np.array([True, True, False])
    blended = blend(median, target, visible, bandwidth=0.5)
    w0, w1 = np.exp(-(0.25**2) / 0.5), np.exp(-(0.75**2) / 0.5)
    wanted = (0.4 * w0 - 0.2 * w1) / (w0 + w1)
    np.testing.assert_allclose(blended, [[0.0, 0.4], [1.0, -0.2], [0.25, wanted]])


def test_blending_a_shift_shifts_and_a_far_joint_follows_its_nearest():
    shift = np.array([0.3, -0.1, 0.2])
    np.testing.assert_allclose(blend(TRUTH, without(TRUTH + shift), ~HIDDEN, 0.3), TRUTH + shift)
    median = np.array([[0.0, 0, 0], [1.0, 0, 0], [500.0, 0, 0]])
    target = np.array([[0.0, 1, 0], [1.0, 2, 0], [np.nan] * 3])
    assert blend(median, target, np.array([True, True, False]), 0.1)[2, 1] == pytest.approx(2)


def test_a_picture_of_a_draw_is_completed_exactly():
    picture = project_to_views(DRAWS[[7]], VIEWS[[2]], PAIR)[0, 0]
    done = complete_keypoints(without(picture), ~HIDDEN, DRAWS[:40], PAIR, views=VIEWS, n_nearest=1)
    np.testing.assert_allclose(done.positions, picture, atol=1e-9)
    assert done.indices.tolist() == [7]


def test_visible_keypoints_stay_exactly_as_they_were():
    picture = project_to_views(TRUTH[None], VIEWS[[3]], PAIR)[0, 0]
    done = complete_keypoints(without(picture), ~HIDDEN, DRAWS[:40], PAIR, views=VIEWS, n_nearest=5)
    np.testing.assert_array_equal(done.positions[~HIDDEN], picture[~HIDDEN])
    assert occluded_joint_error(picture, done.positions, HIDDEN) < 0.3


def test_the_nearest_annotation_lends_its_hidden_joints():
    pictures = project_to_views(DRAWS[:30], VIEWS[[1]], PAIR)[:, 0]
    c, s = np.cos(0.4), np.sin(0.4)
    query = pictures[12] @ np.array([[c, s], [-s, c]]) + 1.0
    done = nearest_annotation_completion(without(query), ~HIDDEN, pictures, PAIR)
    np.testing.assert_allclose(done.positions, query, atol=1e-9)
    assert done.indices.tolist() == [12]
    # One that lacks a hidden joint cannot lend it.
    known = np.ones((30, 34), dtype=bool)
    known[12, 6] = False
    other = nearest_annotation_completion(without(query), ~HIDDEN, pictures, PAIR, known)
    assert other.indices.tolist() != [12]
    np.testing.assert_array_equal(other.positions[~HIDDEN], query[~HIDDEN])
    known[:, 26] = False
    with pytest.raises(ValueError, match="annotated has no pair with every hidden joint"):
        nearest_annotation_completion(without(query), ~HIDDEN, pictures, PAIR, known)


def test_the_error_is_the_mean_distance_of_hidden_joints():
    estimate = TRUTH.copy()
    estimate[6] += [0.3, 0.0, 0.4]
    estimate[0] += 9.0
    assert occluded_joint_error(TRUTH, estimate, HIDDEN) == pytest.approx(0.5 / 6)
    with pytest.raises(ValueError, match="hidden has no joint, expected at least one"):
        occluded_joint_error(TRUTH, estimate, ~HIDDEN & HIDDEN)


def test_bad_input_is_refused_in_a_sentence():
    with pytest.raises(ValueError, match="visible has 3 joints, expected at least 4"):
        complete(TRUTH, np.arange(34) < 3, DRAWS, PAIR)
    with pytest.raises(ValueError, match="n_nearest must be at most 20, the draws, got 100"):
        complete(TRUTH, ~HIDDEN, DRAWS[:20], PAIR)
    with pytest.raises(
        ValueError, match="pose must be finite, got 3 values that are NaN or infinite"
    ):
        complete(without(TRUTH, np.arange(34) == 0), ~HIDDEN, DRAWS, PAIR)
    with pytest.raises(ValueError, match=r"draws must have shape \(S, 34, 3\), got \(144, 17, 3\)"):
        complete(TRUTH, ~HIDDEN, DRAWS[:, :17], PAIR)
    with pytest.raises(ValueError, match=r"bandwidth must be a finite number above 0, got 0\.0"):
        complete(TRUTH, ~HIDDEN, DRAWS, PAIR, bandwidth=0.0)
