"""Graphs over joints: what each is by definition, and joints that lie degenerately."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, strategies as st
from hypothesis.extra.numpy import arrays

from probmotion.interaction.geometry.graphs import (
    GRAPHS,
    graph_edges,
    is_degenerate,
    joggle_offsets,
)


def joints(n: int, axes: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((n, axes))


def as_set(edges: np.ndarray) -> set[tuple[int, int]]:
    return {(int(i), int(j)) for i, j in edges}


def circumball(corners: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the centre and the radius of the sphere through D + 1 points."""
    legs = corners[1:] - corners[0]
    to_centre = np.linalg.solve(2 * legs, (legs**2).sum(axis=1))
    return corners[0] + to_centre, float(np.sqrt((to_centre**2).sum()))


def is_connected(edges: np.ndarray, n: int) -> bool:
    reached, front = {0}, [0]
    while front:
        joint = front.pop()
        for i, j in edges.tolist():
            for a, b in ((i, j), (j, i)):
                if a == joint and b not in reached:
                    reached.add(b)
                    front.append(b)
    return len(reached) == n


@pytest.mark.parametrize("axes", [2, 3])
def test_delaunay_edges_are_those_of_empty_circumballs(axes: int) -> None:
    points = joints(11, axes)
    wanted = set()
    for corners in itertools.combinations(range(11), axes + 1):
        centre, radius = circumball(points[list(corners)])
        others = np.delete(points, corners, axis=0)
        if (np.linalg.norm(others - centre, axis=1) > radius).all():
            wanted |= set(itertools.combinations(corners, 2))
    assert as_set(graph_edges(points)) == wanted


@pytest.mark.parametrize("axes", [2, 3])
def test_gabriel_edges_are_those_of_empty_balls_on_a_diameter(axes: int) -> None:
    points = joints(20, axes)
    wanted = set()
    for i, j in itertools.combinations(range(20), 2):
        middle, radius = 0.5 * (points[i] + points[j]), 0.5 * np.linalg.norm(points[i] - points[j])
        others = np.delete(points, (i, j), axis=0)
        if (np.linalg.norm(others - middle, axis=1) >= radius).all():
            wanted.add((i, j))
    gabriel = as_set(graph_edges(points, "gabriel"))
    assert gabriel == wanted
    assert gabriel < as_set(graph_edges(points))


@pytest.mark.parametrize("axes", [2, 3])
def test_neighbours_are_six_each_at_least(axes: int) -> None:
    points = joints(34, axes)
    edges = graph_edges(points, "nearest-neighbours")
    wanted = set()
    for i in range(34):
        near = np.argsort(np.linalg.norm(points - points[i], axis=1))[1:7]
        wanted |= {(min(i, int(j)), max(i, int(j))) for j in near}
    assert as_set(edges) == wanted
    assert np.bincount(edges.ravel(), minlength=34).min() >= 6


@pytest.mark.parametrize("graph", GRAPHS)
@pytest.mark.parametrize("axes", [2, 3])
def test_edges_are_ordered_and_follow_the_joints(graph: str, axes: int) -> None:
    points = joints(34, axes, seed=3)
    edges = graph_edges(points, graph)
    assert (edges[:, 0] < edges[:, 1]).all()
    assert list(map(tuple, edges.tolist())) == sorted(as_set(edges))
    assert is_connected(edges, 34)
    # Numbering the joints otherwise, moving, turning and scaling them leaves the graph alone.
    order = np.random.default_rng(4).permutation(34)
    turn, _ = np.linalg.qr(joints(axes, axes, seed=5))
    relabelled = np.sort(order[graph_edges(3.0 * points[order] @ turn + 2.0, graph)], axis=1)
    assert as_set(relabelled) == as_set(edges)


def test_the_complete_graph_has_every_edge() -> None:
    assert len(graph_edges(joints(34, 2), "complete")) == 34 * 33 // 2


DEGENERATE = {
    "one point": np.zeros((12, 2)),
    "a line": np.outer(np.arange(12), [0.3, 0.1]),
    "a lattice": np.stack(np.meshgrid(np.arange(4.0), np.arange(3.0)), axis=-1).reshape(-1, 2),
    "twins": np.tile(joints(6, 2, seed=6), (2, 1)),
    "one at a point": np.concatenate([joints(6, 2, seed=7), np.ones((6, 2))]),
}


@pytest.mark.parametrize("name", DEGENERATE)
@pytest.mark.parametrize("graph", GRAPHS)
@pytest.mark.parametrize("axes", [2, 3])
def test_degenerate_joints_have_a_graph_all_the_same(name: str, graph: str, axes: int) -> None:
    """In space they lie in a plane as well."""
    points = np.pad(DEGENERATE[name], ((0, 0), (0, axes - 2)))
    assert is_degenerate(points)
    edges = graph_edges(points, graph)
    np.testing.assert_array_equal(edges, graph_edges(points, graph))
    if graph != "nearest-neighbours":  # clusters of joints at one place have neighbours enough
        assert is_connected(edges, 12)


def test_a_joint_between_two_others_is_no_degenerate_case() -> None:
    """A pelvis midway between hips, on the hull: the hips' own edge is left out."""
    for seed in range(100):
        points = joints(20, 2, seed)
        points[0] = 0.5 * (points[11] + points[14])
        assert not is_degenerate(points)
        points[[11, 14]] = (-9.1, -9.3), (9.7, -9.2)
        points[0] = 0.5 * (points[11] + points[14])
        assert not is_degenerate(points)
        edges = as_set(graph_edges(points))
        assert {(0, 11), (0, 14)} <= edges
        assert (11, 14) not in edges


@pytest.mark.parametrize("axes", [2, 3])
def test_too_few_joints_for_a_triangle_are_all_joined(axes: int) -> None:
    for n in range(1, axes + 2):
        points = joints(n, axes)
        assert not is_degenerate(points)
        assert len(graph_edges(points)) == n * (n - 1) // 2
    assert is_degenerate(np.zeros((2, axes)))


def test_offsets_are_fixed() -> None:
    offsets = joggle_offsets(34, 3)
    np.testing.assert_array_equal(joggle_offsets(17, 2), offsets[:17, :2])
    assert np.abs(offsets).max() <= 1
    assert len(np.unique(offsets)) == offsets.size


@given(arrays(float, (9, 3), elements=st.integers(-2, 2).map(float)))
def test_joints_on_a_small_lattice_never_fail(points: np.ndarray) -> None:
    for lying in (points, points[:, :2]):
        assert is_connected(graph_edges(lying), 9)


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="graph must be one of delaunay, got 'tree'"):
        graph_edges(joints(5, 2), "tree")
    with pytest.raises(ValueError, match=r"points must have shape \(J, 2\), got \(5, 4\)"):
        graph_edges(joints(5, 4))
    with pytest.raises(ValueError, match="points must be finite, got 1 values that are NaN"):
        graph_edges(np.array([[0.0, np.nan], [1.0, 2.0]]))
