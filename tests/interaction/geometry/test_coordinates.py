"""Interaction coordinates: formulas by hand, invariances and array libraries."""

from __future__ import annotations

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
both_dimensions = pytest.mark.parametrize("axes", [2, 3])


def joints(*shape, seed=0):
    return np.random.default_rng(seed).standard_normal(shape)


def rotation(axes, seed=0):
    if axes == 3:
        return Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    c, s = np.cos(seed + 2.0), np.sin(seed + 2.0)
    return np.array([[c, -s], [s, c]])


@both_dimensions
def test_alignment_undoes_a_rigid_motion_and_ignores_occluded_joints(axes):
    target = joints(5, J, axes)
    source = target @ rotation(axes) + joints(axes, seed=1)
    np.testing.assert_allclose(align_rigidly(source, target), target, atol=1e-12)
    visible = np.arange(J) % 3 != 0
    corrupted = np.where(visible[:, None], target, np.nan)
    np.testing.assert_allclose(align_rigidly(source, corrupted, visible), target, atol=1e-12)
    np.testing.assert_allclose(cartesian_distance(source, corrupted, visible), 0.0, atol=1e-12)


@both_dimensions
def test_alignment_is_the_best_proper_rigid_motion(axes):
    source, target = joints(J, axes), joints(J, axes, seed=1)
    mirror = np.array([-1.0] + [1.0] * (axes - 1))
    for reference in (target, target * mirror, source * mirror):
        aligned = align_rigidly(source, reference)
        minimum = ((aligned - reference) ** 2).sum()
        centre = aligned.mean(axis=0)
        np.testing.assert_allclose(centre, reference.mean(axis=0), atol=1e-12)
        for seed in range(50):
            other = (source - source.mean(axis=0)) @ rotation(axes, seed) + centre
            assert ((other - reference) ** 2).sum() >= minimum - 1e-12
        matrix = np.linalg.lstsq(source - source.mean(axis=0), aligned - centre)[0]
        assert np.linalg.det(matrix) == pytest.approx(1.0)


def test_dissimilarity_by_hand():
    """Both pairs have three joints; one edge is shorter than ε."""
    first = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.01]])
    second = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0]])
    first_edges, second_edges = [[0, 1], [1, 2]], [[0, 1], [0, 2]]
    w_first = np.array([1.0, 1 / 0.05])
    norms_1 = np.array([1.0, 1.99])
    w_second = np.array([1 / 2, 1 / np.sqrt(8)])
    norms_2 = np.array([1.0, np.hypot(1.0, 1.99)])
    expected = (w_first @ norms_1) / w_first.sum() + (w_second @ norms_2) / w_second.sum()
    assert dissimilarity(first, second, first_edges, second_edges) == pytest.approx(expected)
    u = interaction_coordinates(first, first_edges)
    np.testing.assert_allclose(u, [[-1.0, 0.0], [0.0, -0.01]])


@pytest.mark.parametrize("graph", GRAPHS)
@both_dimensions
def test_distance_is_symmetric_and_invariant(graph, axes):
    first, second = joints(J, axes), joints(J, axes, seed=1)
    distance = interaction_distance(first, second, graph)
    assert distance > 0.1
    assert interaction_distance(second, first, graph) == pytest.approx(distance)
    transformed = second @ rotation(axes) + 5.0
    assert interaction_distance(first, transformed, graph) == pytest.approx(distance)
    assert interaction_distance(second, transformed, graph) == pytest.approx(0.0, abs=1e-12)
    swap = np.roll(np.arange(J), J // 2)
    assert interaction_distance(first[swap], second[swap], graph) == pytest.approx(distance)


def test_edges_with_an_occluded_end_are_ignored():
    visible = np.arange(J) != 4
    first, second = joints(J, 2), joints(J, 2, seed=1)
    edges = graph_edges(first), graph_edges(second)
    expected = dissimilarity(first, second, *(e[(e != 4).all(axis=1)] for e in edges))
    corrupted = np.where(visible[:, None], second, np.nan)
    assert dissimilarity(first, corrupted, *edges, visible=visible) == pytest.approx(expected)


def test_distance_without_common_edges_is_infinite():
    first, second = joints(J, 2), joints(J, 2, seed=1)
    edges, none = graph_edges(first), np.zeros((0, 2), dtype=int)
    occluded = np.zeros(J, dtype=bool)
    assert np.isinf(dissimilarity(first, second, none, edges))
    assert np.isinf(dissimilarity(first, second, edges, none))
    assert np.isinf(dissimilarity(first, second, edges, edges, visible=occluded))
    assert np.isinf(cartesian_distance(first, second, occluded))


def test_cartesian_distance_by_hand():
    """The second pair is the first square, rotated and twice as large."""
    first = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
    second = 2 * first @ rotation(2) + 7.0
    assert cartesian_distance(first, second) == pytest.approx(np.sqrt(2.0))


def test_batches_broadcast():
    first, second = joints(3, 1, J, 2), joints(2, J, 2, seed=1)
    for distance in (interaction_distance, cartesian_distance):
        batch = distance(first, second)
        expected = [[distance(a[0], b) for b in second] for a in first]
        np.testing.assert_allclose(batch, expected)
    assert interaction_distance(first[:0], second).shape == (0, 2)


def test_array_libraries_agree(library):
    visible = np.arange(J) % 5 != 0
    first, second = joints(4, J, 3), joints(4, J, 3, seed=1)
    edges = graph_edges(first[0]), graph_edges(second[0])

    def all_three(a, b):
        aligned = align_rigidly(a, b, visible)
        return aligned, dissimilarity(a, b, *edges, visible=visible), cartesian_distance(a, b)

    results = library.compiled(all_three)(library.array(first), library.array(second))
    for got, expected in zip(results, all_three(first, second), strict=True):
        library.assert_close(got, expected)
    if library.name != "jax":  # without jit, JAX takes seconds
        got = interaction_distance(library.array(first), library.array(second))
        library.assert_close(got, interaction_distance(first, second))


def test_gradients_are_finite_for_equal_pairs(differentiable):
    second = joints(J, 3, seed=1)
    edges = graph_edges(second)
    target = differentiable.array(second)
    gradient = differentiable.gradient(
        lambda x: dissimilarity(align_rigidly(x, target), target, edges, edges), second
    )
    assert np.isfinite(gradient).all()


def test_pairs_of_different_dimensions_are_rejected():
    with pytest.raises(ValueError, match=r"second must have shape \(…, 14, 2\), got \(14, 3\)"):
        align_rigidly(joints(J, 2), joints(J, 3))
