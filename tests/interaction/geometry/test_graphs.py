"""Graphs over joints: definitions, compiled versions and degenerate configurations."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, strategies as st
from hypothesis.extra.numpy import arrays
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull

from probmotion.interaction.geometry.delaunay import delaunay_edges, max_planar_edges
from probmotion.interaction.geometry.graph_kernels import write_graph
from probmotion.interaction.geometry.graphs import (
    GRAPHS,
    graph_edges,
    is_degenerate,
    joggle_offsets,
)

both_dimensions = pytest.mark.parametrize("axes", [2, 3])


def joints(n, axes, seed=0):
    return np.random.default_rng(seed).standard_normal((n, axes))


def as_set(edges):
    return {(int(i), int(j)) for i, j in edges}


def circumball(corners):
    """Return the centre and radius of the sphere through D + 1 points."""
    differences = corners[1:] - corners[0]
    to_centre = np.linalg.solve(2 * differences, (differences**2).sum(axis=1))
    return corners[0] + to_centre, float(np.sqrt((to_centre**2).sum()))


def is_connected(edges, n):
    adjacency = np.zeros((n, n))
    adjacency[tuple(edges.T)] = 1
    return connected_components(adjacency, directed=False)[0] == 1


@both_dimensions
def test_delaunay_circumballs_are_empty(axes):
    points = joints(11, axes)
    expected = set()
    for corners in itertools.combinations(range(11), axes + 1):
        centre, radius = circumball(points[list(corners)])
        others = np.delete(points, corners, axis=0)
        if (np.linalg.norm(others - centre, axis=1) > radius).all():
            expected |= set(itertools.combinations(corners, 2))
    assert as_set(graph_edges(points)) == expected


@both_dimensions
def test_gabriel_balls_are_empty(axes):
    points = joints(20, axes)
    expected = set()
    for i, j in itertools.combinations(range(20), 2):
        middle, radius = 0.5 * (points[i] + points[j]), 0.5 * np.linalg.norm(points[i] - points[j])
        others = np.delete(points, (i, j), axis=0)
        if (np.linalg.norm(others - middle, axis=1) >= radius).all():
            expected.add((i, j))
    gabriel = as_set(graph_edges(points, "gabriel"))
    assert gabriel == expected
    assert gabriel < as_set(graph_edges(points))


@both_dimensions
def test_each_joint_has_its_six_nearest_neighbours(axes):
    points = joints(34, axes)
    expected = set()
    for i in range(34):
        near = np.argsort(np.linalg.norm(points - points[i], axis=1))[1:7]
        expected |= {(min(i, int(j)), max(i, int(j))) for j in near}
    assert as_set(graph_edges(points, "nearest-neighbours")) == expected


@pytest.mark.parametrize("graph", GRAPHS)
@both_dimensions
def test_edges_are_sorted_connected_and_invariant(graph, axes):
    points = joints(34, axes, seed=3)
    edges = graph_edges(points, graph)
    assert (edges[:, 0] < edges[:, 1]).all()
    assert list(map(tuple, edges.tolist())) == sorted(as_set(edges))
    assert is_connected(edges, 34)
    if graph == "complete":
        assert len(edges) == 34 * 33 // 2
    order = np.random.default_rng(4).permutation(34)
    rotation, _ = np.linalg.qr(joints(axes, axes, seed=5))
    relabelled = np.sort(order[graph_edges(3.0 * points[order] @ rotation + 2.0, graph)], axis=1)
    assert as_set(relabelled) == as_set(edges)


@both_dimensions
def test_too_few_joints_for_a_triangle_are_all_connected(axes):
    for n in range(1, axes + 2):
        points = joints(n, axes)
        assert not is_degenerate(points)
        assert len(graph_edges(points)) == n * (n - 1) // 2
        if n <= 3 and axes == 2:
            assert delaunay_edges(points)[0].tolist() == graph_edges(points).tolist()
    assert is_degenerate(np.zeros((2, axes)))
    assert delaunay_edges(np.zeros((2, 2)))[1]


@given(arrays(float, (9, 3), elements=st.integers(-2, 2).map(float)))
def test_joints_on_a_small_lattice_are_triangulated(points):
    for joints_in_space_or_plane in (points, points[:, :2]):
        assert is_connected(graph_edges(joints_in_space_or_plane), 9)


def test_invalid_arguments_are_rejected():
    with pytest.raises(ValueError, match=r"graph must be one of delaunay, .*, got 'tree'"):
        graph_edges(joints(5, 2), "tree")
    with pytest.raises(ValueError, match=r"points must have shape \(J, 2\), got \(5, 4\)"):
        graph_edges(joints(5, 4))


def assert_scipys_edges(points):
    edges, degenerate = delaunay_edges(points)
    assert not degenerate
    np.testing.assert_array_equal(edges, graph_edges(points))


@pytest.mark.parametrize("n", [3, 4, 5, 10, 34, 64])
def test_random_joints_have_scipys_edges(n):
    rng = np.random.default_rng(n)
    for scale, shift in ((1.0, 0.0), (1e-3, 5.0), (1e3, -7.0)):
        for _ in range(100 if n == 34 else 40):
            assert_scipys_edges(scale * rng.standard_normal((n, 2)) + shift)


def test_collinear_joints_of_annotations_are_not_degenerate():
    """The pelvis is the midpoint of the hips; the spine is on the line from pelvis to neck."""
    rng = np.random.default_rng(1)
    for _ in range(150):
        points = rng.standard_normal((34, 2))
        for body in (points[:17], points[17:]):
            body[0], body[3] = 0.5 * (body[11] + body[14]), 0.5 * (body[5] + body[8])
            body[1], body[2] = (2 * body[0] + body[3]) / 3, (body[0] + 2 * body[3]) / 3
        assert_scipys_edges(points)
        assert not is_degenerate(points)
        points[[11, 14]] = (-9.1, -9.3), (9.7, -9.2)
        points[0] = 0.5 * (points[11] + points[14])
        assert_scipys_edges(points)
        assert {(0, 11), (0, 14)} == as_set(graph_edges(points)) & {(0, 11), (0, 14), (11, 14)}


RANDOM = np.random.default_rng(2).standard_normal((34, 2))
LATTICE = np.stack(np.meshgrid(np.arange(6.0), np.arange(6.0)), axis=-1).reshape(-1, 2)
ANGLE = 2 * np.pi * np.arange(34) / 34
DEGENERATE = {
    "one point": np.full((34, 2), 2.5),
    "a line": np.outer(np.arange(34), [0.3, -0.7]),
    "a lattice": 0.1 * LATTICE[:34],
    "a circle": np.stack([np.cos(ANGLE), np.sin(ANGLE)], axis=-1),
    "duplicates": np.concatenate([RANDOM[:17], RANDOM[:17]]),
    "half at one point": np.concatenate([RANDOM[:17], np.tile(RANDOM[17], (17, 1))]),
    "two points": np.repeat(RANDOM[:2], 17, axis=0),
}


@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_joints_have_scipys_joggled_edges(name):
    points = DEGENERATE[name]
    edges, degenerate = delaunay_edges(points)
    assert degenerate
    np.testing.assert_array_equal(edges, graph_edges(points))
    np.testing.assert_array_equal(edges, delaunay_edges(points)[0])
    for axes in (2, 3):  # in 3D the joints are also coplanar
        padded = np.pad(points, ((0, 0), (0, axes - 2)))
        assert is_degenerate(padded)
        for graph in ("delaunay", "gabriel", "complete"):
            assert is_connected(graph_edges(padded, graph), 34)


@given(
    arrays(float, st.tuples(st.integers(3, 24), st.just(2)), elements=st.integers(-3, 3).map(float))
)
def test_compiled_triangulation_of_a_small_lattice(points):
    edges, degenerate = delaunay_edges(points)
    if degenerate:
        extent = np.ptp(points, axis=0).max() or 1.0
        joggled = points / extent + 1e-5 * joggle_offsets(len(points), 2)
        assert len(edges) == 3 * len(points) - 3 - len(ConvexHull(joggled).vertices)
        assert is_connected(edges, len(points))
    else:
        assert_scipys_edges(points)


@given(arrays(float, (12, 2), elements=st.floats(-1, 1)), st.floats(-8, 0))
def test_arbitrarily_close_joints_are_triangulated(points, exponent):
    points[6:] = points[:6] + 10.0**exponent * points[6:]
    edges, _ = delaunay_edges(points)
    assert len(np.unique(edges)) == 12
    assert len(edges) <= max_planar_edges(12)


@pytest.mark.parametrize("graph", GRAPHS)
def test_compiled_graphs_equal_the_reference(graph):
    rng = np.random.default_rng(3)
    for n in (2, 5, 34):
        for points in (rng.standard_normal((n, 2)), rng.integers(0, 4, (n, 2)).astype(float)):
            edges = np.empty((n * (n - 1) // 2 + 3 * n, 2), dtype=np.uint16)
            n_edges, _ = write_graph(points, GRAPHS.index(graph), joggle_offsets(n, 2), edges)
            assert sorted(edges[:n_edges].tolist()) == graph_edges(points, graph).tolist()
