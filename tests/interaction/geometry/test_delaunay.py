"""The compiled triangulation against SciPy's, and where it has to move joints."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial import ConvexHull

from probmotion.interaction.geometry.delaunay import delaunay_edges, most_edges
from probmotion.interaction.geometry.graph_kernels import graph_into
from probmotion.interaction.geometry.graphs import (
    GRAPHS,
    graph_edges,
    is_degenerate,
    joggle_offsets,
)


def is_triangulation(points: np.ndarray, edges: np.ndarray) -> bool:
    """Return whether a planar straight-line graph joins all joints and has faces of three."""
    n, hull = len(points), len(ConvexHull(points).vertices)
    p, q = points[edges[:, 0]], points[edges[:, 1]]

    def side(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
        u, v = b - a, c - a
        return np.sign(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0])

    apart = side(p[:, None], q[:, None], p) * side(p[:, None], q[:, None], q)
    crossing = (apart < 0) & (apart.T < 0)
    shared = (edges[:, None, :, None] == edges[None, :, None, :]).any(axis=(-1, -2))
    return len(edges) == 3 * n - 3 - hull and not (crossing & ~shared).any()


@pytest.mark.parametrize("n", [3, 4, 5, 10, 34, 64])
def test_it_has_scipys_edges(n: int) -> None:
    rng = np.random.default_rng(n)
    for scale, shift in ((1.0, 0.0), (1e-3, 5.0), (1e3, -7.0)):
        for _ in range(300 if n == 34 else 60):
            points = scale * rng.standard_normal((n, 2)) + shift
            edges, degenerate = delaunay_edges(points)
            assert not degenerate
            np.testing.assert_array_equal(edges, graph_edges(points))


def test_joints_on_their_bones_are_no_degenerate_case() -> None:
    """Annotations put the pelvis midway between the hips, the spine on the way to the neck."""
    rng = np.random.default_rng(1)
    for _ in range(300):
        points = rng.standard_normal((34, 2))
        for first in (0, 17):
            body = points[first : first + 17]
            body[0], body[3] = 0.5 * (body[11] + body[14]), 0.5 * (body[5] + body[8])
            body[1], body[2] = (2 * body[0] + body[3]) / 3, (body[0] + 2 * body[3]) / 3
        edges, degenerate = delaunay_edges(points)
        assert not degenerate
        assert not is_degenerate(points)
        np.testing.assert_array_equal(edges, graph_edges(points))


def degenerate_joints() -> dict[str, np.ndarray]:
    random = np.random.default_rng(2).standard_normal((34, 2))
    lattice = np.stack(np.meshgrid(np.arange(6.0), np.arange(6.0)), axis=-1).reshape(-1, 2)
    angle = 2 * np.pi * np.arange(34) / 34
    return {
        "one point": np.full((34, 2), 2.5),
        "a line": np.outer(np.arange(34), [0.3, -0.7]),
        "a lattice": 0.1 * lattice[:34],
        "a circle": np.stack([np.cos(angle), np.sin(angle)], axis=-1),
        "twins": np.concatenate([random[:17], random[:17]]),
        "one at a point": np.concatenate([random[:17], np.tile(random[17], (17, 1))]),
        "two points": np.repeat(random[:2], 17, axis=0),
    }


@pytest.mark.parametrize("name", degenerate_joints())
def test_degenerate_joints_are_triangulated_and_named(name: str) -> None:
    points = degenerate_joints()[name]
    edges, degenerate = delaunay_edges(points)
    assert degenerate
    assert is_degenerate(points)
    # Both paths move joints by the same offsets, hence to the same graph.
    np.testing.assert_array_equal(edges, graph_edges(points))
    np.testing.assert_array_equal(edges, delaunay_edges(points)[0])


@given(
    arrays(float, st.tuples(st.integers(3, 24), st.just(2)), elements=st.integers(-3, 3).map(float))
)
def test_joints_on_a_small_lattice_are_triangulated(points: np.ndarray) -> None:
    edges, degenerate = delaunay_edges(points)
    low, high = points.min(axis=0), points.max(axis=0)
    unit = (points - 0.5 * (low + high)) / (max((high - low).max(), 1e-300))
    moved = unit + 1e-5 * joggle_offsets(len(points), 2)
    if degenerate:
        assert is_triangulation(moved, edges)
    else:
        assert not is_degenerate(points)
        np.testing.assert_array_equal(edges, graph_edges(points))


@given(
    arrays(float, (12, 2), elements=st.floats(-1, 1)),
    st.floats(-8, 0),
)
def test_joints_as_near_as_one_likes_never_fail(points: np.ndarray, exponent: float) -> None:
    points[6:] = points[:6] + 10.0**exponent * points[6:]
    edges, _ = delaunay_edges(points)
    assert len(np.unique(edges)) == 12
    assert len(edges) <= most_edges(12)


def test_too_few_joints_for_a_triangle() -> None:
    for n, wanted in ((0, []), (1, []), (2, [[0, 1]])):
        points = np.arange(2.0 * n).reshape(n, 2) ** 2
        edges, degenerate = delaunay_edges(points)
        assert edges.tolist() == wanted
        assert not degenerate
    assert delaunay_edges(np.zeros((2, 2)))[1]


@pytest.mark.parametrize("graph", GRAPHS)
def test_the_other_compiled_graphs_are_the_reference_ones(graph: str) -> None:
    rng = np.random.default_rng(3)
    for n in (2, 5, 34):
        for points in (rng.standard_normal((n, 2)), rng.integers(0, 4, (n, 2)).astype(float)):
            edges = np.empty((n * (n - 1) // 2 + 3 * n, 2), dtype=np.uint16)
            n_edges, _ = graph_into(points, GRAPHS.index(graph), joggle_offsets(n, 2), edges)
            found = sorted(map(tuple, edges[:n_edges].tolist()))
            assert found == list(map(tuple, graph_edges(points, graph).tolist()))


def test_real_pairs_have_scipys_edges(real_data: Path) -> None:
    for file in sorted((real_data / "cmu_salsa_pairs").glob("*.npz")):
        pairs = np.load(file)["positions"][::25, :, :17].reshape(-1, 34, 3).astype(float)
        for view, pair in enumerate(pairs):
            c, s = np.cos(view), np.sin(view)
            points = np.stack([c * pair[:, 0] + s * pair[:, 2], pair[:, 1]], axis=-1)
            edges, degenerate = delaunay_edges(points)
            assert not degenerate
            np.testing.assert_array_equal(edges, graph_edges(points))


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match=r"points must have shape \(J, 2\), got \(5, 3\)"):
        delaunay_edges(np.zeros((5, 3)))
    with pytest.raises(
        ValueError, match="points must be finite, got 1 values that are NaN or infinite"
    ):
        delaunay_edges(np.array([[0.0, 1.0], [np.nan, 0.0], [1.0, 1.0]]))
