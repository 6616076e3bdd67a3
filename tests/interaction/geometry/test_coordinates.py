"""Interaction coordinates: the formulas by hand, invariances, and every array library."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from probmotion.interaction.geometry.coordinates import (
    align_rigidly,
    cartesian_distance,
    dissimilarity,
    interaction_coordinates,
    interaction_distance,
)
from probmotion.interaction.geometry.graphs import GRAPHS, graph_edges

J = 14


def joints(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(shape)


def rotation(axes: int, seed: int = 0) -> np.ndarray:
    if axes == 3:
        return Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    c, s = np.cos(seed + 2.0), np.sin(seed + 2.0)
    return np.array([[c, -s], [s, c]])


@pytest.mark.parametrize("axes", [2, 3])
def test_alignment_undoes_a_rigid_motion(axes: int) -> None:
    target = joints(5, J, axes)
    source = target @ rotation(axes) + joints(axes, seed=1)
    np.testing.assert_allclose(align_rigidly(source, target), target, atol=1e-12)


@pytest.mark.parametrize("axes", [2, 3])
def test_no_rigid_motion_does_better(axes: int) -> None:
    """Nor is a mirror image reached by reflection: the motion's own determinant is 1."""
    source, target = joints(J, axes), joints(J, axes, seed=1)
    mirror = np.array([-1.0] + [1.0] * (axes - 1))
    for aim in (target, target * mirror, source * mirror):
        aligned = align_rigidly(source, aim)
        least = ((aligned - aim) ** 2).sum()
        centre = aligned.mean(axis=0)
        np.testing.assert_allclose(centre, aim.mean(axis=0), atol=1e-12)
        for seed in range(50):
            other = (source - source.mean(axis=0)) @ rotation(axes, seed) + centre
            assert ((other - aim) ** 2).sum() >= least - 1e-12
        matrix = np.linalg.lstsq(source - source.mean(axis=0), aligned - centre)[0]
        assert np.linalg.det(matrix) == pytest.approx(1.0)


@pytest.mark.parametrize("axes", [2, 3])
def test_hidden_joints_move_along_and_do_not_count(axes: int) -> None:
    visible = np.arange(J) % 3 != 0
    target = joints(J, axes)
    source = target @ rotation(axes) + 2.0
    spoilt = np.where(visible[:, None], target, np.nan)
    np.testing.assert_allclose(align_rigidly(source, spoilt, visible), target, atol=1e-12)
    np.testing.assert_allclose(cartesian_distance(source, spoilt, visible), 0.0, atol=1e-12)


def test_the_dissimilarity_by_hand() -> None:
    """Three joints in a row against three in an angle; one edge shorter than ε."""
    first = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.01]])
    second = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0]])
    # u₁ = (−1, 0), (0, −.01); u₂ = (−2, 0), (0, −2), with 2 and 0 for the second graph's other edge
    first_edges, second_edges = [[0, 1], [1, 2]], [[0, 1], [0, 2]]
    w_first = np.array([1.0, 1 / 0.05])
    apart_first = np.array([1.0, 1.99])
    w_second = np.array([1 / 2, 1 / np.sqrt(8)])
    apart_second = np.array([1.0, np.hypot(1.0, 1.99)])
    wanted = (w_first @ apart_first) / w_first.sum() + (w_second @ apart_second) / w_second.sum()
    assert dissimilarity(first, second, first_edges, second_edges) == pytest.approx(wanted)
    u = interaction_coordinates(first, first_edges)
    np.testing.assert_allclose(u, [[-1.0, 0.0], [0.0, -0.01]])


@pytest.mark.parametrize("graph", GRAPHS)
@pytest.mark.parametrize("axes", [2, 3])
def test_the_distance_is_symmetric_invariant_and_zero_for_equals(graph: str, axes: int) -> None:
    first, second = joints(J, axes), joints(J, axes, seed=1)
    distance = interaction_distance(first, second, graph)
    assert distance > 0.1
    assert interaction_distance(second, first, graph) == pytest.approx(distance)
    moved = second @ rotation(axes) + 5.0
    assert interaction_distance(first, moved, graph) == pytest.approx(distance)
    assert interaction_distance(second, moved, graph) == pytest.approx(0.0, abs=1e-12)
    swap = np.roll(np.arange(J), J // 2)
    relabelled = interaction_distance(first[swap], second[swap], graph)
    assert relabelled == pytest.approx(distance)


def test_translation_alone_changes_nothing_without_alignment() -> None:
    first, second = joints(J, 3), joints(J, 3, seed=1)
    edges = graph_edges(first), graph_edges(second)
    distance = dissimilarity(first, second, *edges)
    assert dissimilarity(first + 3.0, second, *edges) == pytest.approx(distance)
    assert dissimilarity(first @ rotation(3), second, *edges) != pytest.approx(distance)


def test_scaling_the_pairs_and_epsilon_scales_the_distance() -> None:
    first, second = joints(J, 2), joints(J, 2, seed=1)
    for scale in (0.01, 3.0):
        scaled = interaction_distance(scale * first, scale * second, epsilon=scale * 0.3)
        unscaled = interaction_distance(first, second, epsilon=0.3)
        assert scaled == pytest.approx(scale * unscaled)


def test_scaling_the_pairs_alone_scales_it_where_all_edges_exceed_epsilon() -> None:
    first, second = joints(J, 2), joints(J, 2, seed=1)
    longest = 1e-4
    unscaled = interaction_distance(first, second, epsilon=longest)
    doubled = interaction_distance(2 * first, 2 * second, epsilon=longest)
    assert doubled == pytest.approx(2 * unscaled)
    # Below ε weights are levelled, and scale matters: the mean is another one.
    levelled = interaction_distance(first, second, epsilon=0.5)
    doubled = interaction_distance(2 * first, 2 * second, epsilon=0.5)
    assert doubled != pytest.approx(2 * levelled, rel=1e-3)


def test_hidden_ends_take_their_edges_away() -> None:
    visible = np.arange(J) != 4
    first, second = joints(J, 2), joints(J, 2, seed=1)
    edges = graph_edges(first), graph_edges(second)
    seen = [e[(e != 4).all(axis=1)] for e in edges]
    wanted = dissimilarity(first, second, *seen)
    spoilt = np.where(visible[:, None], second, np.nan)
    assert dissimilarity(first, spoilt, *edges, visible=visible) == pytest.approx(wanted)


def test_nothing_to_compare_is_infinitely_far() -> None:
    first, second = joints(J, 2), joints(J, 2, seed=1)
    edges, none = graph_edges(first), np.zeros((0, 2), dtype=int)
    assert np.isinf(dissimilarity(first, second, none, edges))
    assert np.isinf(dissimilarity(first, second, edges, none))
    hidden = np.zeros(J, dtype=bool)
    assert np.isinf(dissimilarity(first, second, edges, edges, visible=hidden))
    assert np.isinf(cartesian_distance(first, second, hidden))


def test_cartesian_distance_by_hand() -> None:
    """Four joints at the corners of a square, against a square twice as large and turned."""
    first = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
    second = 2 * first @ rotation(2) + 7.0
    assert cartesian_distance(first, second) == pytest.approx(np.sqrt(2.0))


def test_batches_hold_what_single_ones_do() -> None:
    first, second = joints(3, 1, J, 2), joints(2, J, 2, seed=1)
    for distance in (interaction_distance, cartesian_distance):
        found = distance(first, second)
        assert found.shape == (3, 2)
        for i in range(3):
            for j in range(2):
                assert found[i, j] == pytest.approx(distance(first[i, 0], second[j]))
    assert interaction_distance(first[:0], second).shape == (0, 2)


@pytest.mark.parametrize("axes", [2, 3])
def test_every_library_agrees(library: Any, axes: int) -> None:
    visible = np.arange(J) % 5 != 0
    first, second = joints(4, J, axes), joints(4, J, axes, seed=1)
    edges = graph_edges(first[0]), graph_edges(second[0])
    for function in (
        lambda a, b: align_rigidly(a, b, visible),
        lambda a, b: dissimilarity(a, b, *edges, visible=visible),
        cartesian_distance,
    ):
        found = library.compiled(function)(library.array(first), library.array(second))
        library.assert_close(found, function(first, second))


def test_every_library_agrees_where_the_distance_triangulates_itself(library: Any) -> None:
    pairs = joints(J, 3), joints(J, 3, seed=1)
    found = interaction_distance(*map(library.array, pairs))
    library.assert_close(found, interaction_distance(*pairs))


def test_gradients_are_finite_even_between_equals(differentiable: Any) -> None:
    second = joints(J, 3, seed=1)
    edges = graph_edges(second)
    target = differentiable.array(second)
    for first in (joints(J, 3), second):
        gradient = differentiable.gradient(
            lambda x: dissimilarity(align_rigidly(x, target), target, edges, edges), first
        )
        assert np.isfinite(gradient).all()


def test_what_does_not_fit_is_refused() -> None:
    first, edges = joints(J, 2), graph_edges(joints(J, 2))
    with pytest.raises(ValueError, match=r"second must have shape \(…, 14, 2\), got \(14, 3\)"):
        align_rigidly(first, joints(J, 3))
    with pytest.raises(ValueError, match=r"visible must have shape \(…, 14\), got \(3,\)"):
        cartesian_distance(first, first, np.ones(3, dtype=bool))
    with pytest.raises(ValueError, match=r"edges must have shape \(E, 2\), got \(3,\)"):
        interaction_coordinates(first, np.arange(3))
    with pytest.raises(ValueError, match="epsilon must be a finite number above 0, got -1"):
        dissimilarity(first, first, edges, edges, -1)
    with pytest.raises(ValueError, match="graph must be one of delaunay, got 'tree'"):
        interaction_distance(first, first, "tree")
