"""Compiled distances of projections to annotations against the reference formulas."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from probmotion.interaction.geometry import nearest, nearest_kernels
from probmotion.interaction.geometry.coordinates import (
    align_rigidly,
    cartesian_distance,
    dissimilarity,
)
from probmotion.interaction.geometry.graphs import GRAPHS, graph_edges
from probmotion.interaction.geometry.nearest import MEASURES, PairComparer
from probmotion.interaction.geometry.shape_context import shape_context_distance, shape_contexts
from probmotion.threads import one_thread

J = 34


def rng(seed=0):
    return np.random.default_rng(seed)


def random_pairs(*shape, seed):
    return 0.6 * rng(seed).standard_normal((*shape, J, 2))


def annotated_pairs(n, hidden, seed, joints=J):
    visible = rng(seed).random((n, joints)) >= hidden
    return 0.6 * rng(seed + 1).standard_normal((n, joints, 2)) + 3.0, visible


def compared(annotations, candidates):
    return PairComparer(*annotations).nearest(np.zeros((1, 1, J, 2)), candidates)


def reference(projection, keypoints, visible, measure, graph, epsilon):
    """Return one distance by the reference implementations."""
    if measure == "cartesian":
        return float(cartesian_distance(projection, keypoints, visible))
    aligned = align_rigidly(projection, keypoints, visible)
    if measure == "shape-context":
        pairs = (np.where(visible[:, None], x, 0.0) for x in (aligned, keypoints))
        first, second = (shape_contexts(pair, visible) for pair in pairs)
        return float(shape_context_distance(first, second, visible))
    indices = np.flatnonzero(visible)
    annotated = indices[graph_edges(keypoints[indices], graph)]
    edges = graph_edges(projection, graph)
    return float(dissimilarity(aligned, keypoints, edges, annotated, epsilon, visible))


@pytest.mark.parametrize("hidden", [0.0, 0.3])
@pytest.mark.parametrize(
    ("measure", "graph"),
    [("interaction", graph) for graph in GRAPHS]
    + [("cartesian", "delaunay"), ("shape-context", "delaunay")],
)
def test_distances_equal_the_reference(measure, graph, hidden):
    keypoints, visible = annotated_pairs(12, hidden, seed=1)
    # Projections close to an annotation exercise early stopping.
    close = keypoints[:3] + 0.05 * rng(2).standard_normal((3, J, 2))
    projections = np.concatenate([close, random_pairs(3, seed=3)])
    candidates = np.array([[0, 5, 2, 9, 1, 7], [11, 3, 4, 2, 1, 0]])
    given = np.where(visible[..., None], keypoints, np.nan), visible
    comparer = PairComparer(*given, measure=measure, graph=graph, epsilon=0.07)
    annotations = list(zip(keypoints, visible, strict=True))
    expected = np.array(
        [[reference(p, k, v, measure, graph, 0.07) for k, v in annotations] for p in projections]
    )
    np.testing.assert_allclose(comparer.distances(projections), expected, rtol=0, atol=1e-12)
    distances, indices = comparer.nearest(projections.reshape(3, 2, J, 2), candidates)
    for item, view in np.ndindex(3, 2):
        row = expected[2 * item + view][candidates[view]]
        assert indices[item, view] == candidates[view][row.argmin()]
        np.testing.assert_allclose(distances[item, view], row.min(), rtol=0, atol=1e-12)


def test_results_are_bit_identical_for_any_threads_and_batch():
    comparer = PairComparer(*annotated_pairs(40, 0.1, seed=5))
    arguments = random_pairs(7, 4, seed=6), rng(7).integers(0, 40, (4, 16))
    batch = comparer.nearest(*arguments)
    for pose in range(7):
        single = comparer.nearest(arguments[0][pose : pose + 1], arguments[1])
        for result, expected in zip(single, batch, strict=True):
            np.testing.assert_array_equal(result[0], expected[pose])
    before = numba.get_num_threads()
    try:
        for threads in range(1, numba.config.NUMBA_NUM_THREADS + 1):
            numba.set_num_threads(threads)
            for kernel in ("nearest_in_batch", "nearest_in_batch_on_threads"):
                results = getattr(nearest_kernels, kernel)(*arguments, comparer.prepared)
                for result, expected in zip(results, batch, strict=True):
                    np.testing.assert_array_equal(result, expected)
    finally:
        numba.set_num_threads(before)


def test_serial_kernel_is_used_on_one_thread(monkeypatch):
    used = []
    for name in ("nearest_in_batch", "nearest_in_batch_on_threads"):
        monkeypatch.setattr(nearest, name, lambda *_, name=name: used.append(name))
    monkeypatch.setattr(nearest.numba, "get_num_threads", lambda: 4)
    comparer = PairComparer(*annotated_pairs(3, 0.0, seed=5))
    arguments = random_pairs(2, 2, seed=6), np.zeros((2, 1), dtype=int)
    with one_thread():
        comparer.nearest(*arguments)
    comparer.nearest(*arguments)
    assert used == ["nearest_in_batch", "nearest_in_batch_on_threads"]


def test_candidates_beyond_the_limit_are_not_returned():
    comparer = PairComparer(*annotated_pairs(9, 0.1, seed=5))
    given = random_pairs(seed=6), np.arange(9), comparer.prepared
    distance, index = nearest_kernels.nearest_candidate(*given, np.inf)
    assert index == comparer.distances(given[0][None])[0].argmin()
    assert nearest_kernels.nearest_candidate(*given, distance) == (distance, index)
    assert nearest_kernels.nearest_candidate(*given, np.nextafter(distance, 0))[1] == -1


def test_ties_go_to_the_first_candidate():
    keypoints, visible = annotated_pairs(3, 0.0, seed=8)
    comparer = PairComparer(np.tile(keypoints, (2, 1, 1)), np.tile(visible, (2, 1)))
    projection = keypoints[1][None, None] + 0.02 * rng(9).standard_normal((1, 2, J, 2))
    _, indices = comparer.nearest(projection, np.array([[0, 4, 1, 2], [5, 1, 4, 3]]))
    assert indices.tolist() == [[4, 1]]


def test_distance_without_a_shared_edge_is_infinite():
    keypoints, visible = annotated_pairs(3, 0.0, seed=14)
    visible[0] = False
    visible[1] = np.arange(J) == 4
    # Two visible joints at opposite ends of the projection share no edge of its triangulation.
    projection = random_pairs(seed=15)
    projection[3], projection[30] = (-9.0, 0.0), (9.0, 0.0)
    visible[2] = np.isin(np.arange(J), [3, 30])
    comparer = PairComparer(keypoints, visible)
    assert np.isinf(comparer.distances(projection[None])).all()
    distances, indices = comparer.nearest(projection[None, None], np.array([[2, 0, 1]]))
    assert np.isinf(distances).all()
    assert indices.tolist() == [[2]]
    cartesian = PairComparer(keypoints, visible, measure="cartesian").distances(projection[None])
    assert np.isinf(cartesian).tolist() == [[True, False, False]]


@pytest.mark.parametrize("graph", GRAPHS)
def test_degenerate_projections_are_compared_and_counted(graph):
    generic = random_pairs(seed=17)
    duplicates = np.concatenate([generic[:17], generic[:17]])
    line = np.outer(np.arange(J), [0.1, 0.2])
    projections = np.stack([np.zeros((J, 2)), line, duplicates, generic])
    comparer = PairComparer(projections, np.ones((4, J), dtype=bool), graph=graph)
    distances = comparer.distances(projections)
    assert np.isfinite(distances).all()
    np.testing.assert_allclose(np.diagonal(distances), 0.0, atol=1e-12)
    assert comparer.degenerate(projections.reshape(2, 2, J, 2)) == (3 if graph == "delaunay" else 0)


@pytest.mark.parametrize("joints", [1, 2, 3, 5])
@pytest.mark.parametrize("measure", MEASURES)
def test_few_joints_are_compared(measure, joints):
    keypoints, visible = annotated_pairs(3, 0.0, seed=18, joints=joints)
    distances = PairComparer(keypoints, visible, measure=measure).distances(keypoints)
    undefined = joints == 1 and measure != "cartesian"
    np.testing.assert_allclose(np.diagonal(distances), np.inf if undefined else 0.0, atol=1e-12)
    assert np.isfinite(distances).all() != undefined


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda x: compared(x, [[3]]), "candidates must be from 0 to 2, got 3 to 3"),
        (lambda x: compared(x, np.zeros((1, 0), int)), "at least one annotation per view, got"),
        (lambda x: compared(x, [[0.5]]), "candidates must be integers, got float64"),
        (lambda x: PairComparer(*x, measure="angles"), "measure must be one of .*, got 'angles'"),
        (lambda x: PairComparer(x[0][:0], x[1][:0]), r"one annotation .*, got shape \(0, 34, 2\)"),
    ],
)
def test_invalid_arguments_are_rejected(call, message):
    with pytest.raises(ValueError, match=message):
        call(annotated_pairs(3, 0.0, seed=20))
