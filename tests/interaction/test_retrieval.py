"""Indirect lifting finds the draw that a 2D pair is a picture of."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion import Skeleton
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.interaction.annotations.views import project_to_views
from probmotion.interaction.geometry.coordinates import interaction_distance
from probmotion.interaction.retrieval import retrieve, view_grid, views_around

PAIR = Skeleton.preset("pair17")
DRAWS = np.concatenate([dance.positions[::9] for dance in synthetic_dances(4)])
VIEWS = view_grid(6, 1)


def picture(draw, view, turn=0.0, shift=(0.0, 0.0)):
    """Return a draw's projection, turned and shifted in the image."""
    seen = project_to_views(DRAWS[draw][None], VIEWS[view][None], PAIR)[0, 0]
    c, s = np.cos(turn), np.sin(turn)
    return seen @ np.array([[c, s], [-s, c]]) + np.array(shift)


def test_a_picture_finds_its_draw_and_its_view():
    for draw, view in ((0, 0), (13, 4), (39, 5)):
        found = retrieve(picture(draw, view, 0.3, (2.0, -1.0)), DRAWS, PAIR, views=VIEWS, n=3)
        assert found.indices.shape == found.distances.shape == (3,)
        assert found.indices[0] == draw
        np.testing.assert_array_equal(found.views[0], VIEWS[view])
        assert found.distances[0] < 1e-9 < 0.01 < found.distances[1] <= found.distances[2]


def test_distances_are_the_least_over_views_by_the_plain_formula():
    query = picture(5, 2) + np.random.default_rng(0).normal(scale=0.05, size=(34, 2))
    found = retrieve(query, DRAWS[:4], PAIR, views=VIEWS, n=4)
    pictures = project_to_views(DRAWS[:4], VIEWS, PAIR)
    plain = np.array(
        [[float(interaction_distance(query, seen)) for seen in draw] for draw in pictures]
    )
    np.testing.assert_array_equal(found.indices, plain.min(axis=1).argsort())
    np.testing.assert_allclose(found.distances, np.sort(plain.min(axis=1)), atol=1e-9)
    np.testing.assert_array_equal(found.views, VIEWS[plain.argmin(axis=1)[found.indices]])


def test_hidden_joints_are_never_read():
    visible = np.ones(34, dtype=bool)
    visible[[6, 7, 20]] = False
    query = picture(8, 1)
    wild = np.where(visible[:, None], query, np.nan)
    found = retrieve(wild, DRAWS, PAIR, views=VIEWS, visible=visible)
    assert found.indices[0] == 8
    assert found.distances[0] < 1e-9
    other = np.where(visible[:, None], query, 7.0)
    again = retrieve(other, DRAWS, PAIR, views=VIEWS, visible=visible)
    assert again.distances == found.distances


def test_many_pairs_at_once_are_each_looked_up_alone():
    queries = np.stack([[picture(1, 0), picture(2, 1), picture(30, 5)]])
    together = retrieve(queries, DRAWS, PAIR, views=VIEWS, n=2)
    assert together.indices.shape == (1, 3, 2)
    assert together.views.shape == (1, 3, 2, 2)
    for place in range(3):
        alone = retrieve(queries[0, place], DRAWS, PAIR, views=VIEWS, n=2)
        for many, one in zip(together, alone, strict=True):
            np.testing.assert_array_equal(many[0, place], one)


def test_blocks_change_nothing(monkeypatch):
    whole = retrieve(picture(1, 0), DRAWS, PAIR, views=VIEWS, n=5)
    monkeypatch.setattr("probmotion.interaction.retrieval._PICTURES", 13)
    for small, large in zip(
        retrieve(picture(1, 0), DRAWS, PAIR, views=VIEWS, n=5), whole, strict=True
    ):
        np.testing.assert_array_equal(small, large)


def test_a_repeated_pose_counts_once_by_its_first_index():
    repeated = DRAWS[[4, 4, 9, 4, 9, 2]]
    found = retrieve(picture(9, 3), repeated, PAIR, views=VIEWS, n=3)
    assert found.indices[0] == 2
    assert sorted(found.indices) == [0, 2, 5]
    with pytest.raises(ValueError, match="n must be at most 3, the different draws, got 4"):
        retrieve(picture(9, 3), repeated, PAIR, views=VIEWS, n=4)


def test_the_default_views_go_round_the_pair():
    views = view_grid()
    assert views.shape == (48, 2)
    assert np.unique(views, axis=0).shape == (48, 2)
    assert np.degrees(views[:, 1]).min() == pytest.approx(50)
    assert np.degrees(views[:, 1]).max() == pytest.approx(100)
    # Between two views of the grid a pair still finds itself first.
    between = project_to_views(DRAWS[11][None], views[[20]] + 0.15, PAIR)[0, 0]
    assert retrieve(between, DRAWS[::3][:9], PAIR).distances[0] > 1e-3
    assert retrieve(between, DRAWS, PAIR).indices[0] in (10, 11, 12)


def test_bad_input_is_refused_in_a_sentence():
    query = picture(0, 0)
    with pytest.raises(ValueError, match=r"keypoints must have shape \(…, 34, 2\), got \(33, 2\)"):
        retrieve(query[:33], DRAWS, PAIR)
    with pytest.raises(ValueError, match="views must contain at least one, got none"):
        retrieve(query, DRAWS, PAIR, views=np.empty((0, 2)))
    with pytest.raises(ValueError, match="visible shares no edge with 1 of the draws that were"):
        retrieve(query, DRAWS, PAIR, views=VIEWS, visible=np.arange(34) == 3)
    broken = DRAWS.copy()
    broken[0, 0, 0] = np.inf
    with pytest.raises(
        ValueError, match="draws must be finite, got 1 values that are NaN or infinite"
    ):
        retrieve(query, broken, PAIR)


def test_views_around_an_estimate_hold_it_and_what_is_near():
    views = views_around(np.array([0.3, 1.2]))
    assert views.shape == (15, 2)
    assert np.abs(views - [0.3, 1.2]).sum(axis=1).min() < 1e-12
    assert np.degrees(np.abs(views - [0.3, 1.2]).max(axis=0)) == pytest.approx([30, 15])
    with pytest.raises(ValueError, match="view must be finite, got 1 values that are NaN"):
        views_around(np.array([np.nan, 1.0]))
