"""The compiled comparison of projections with annotations, against the plain formulas."""

from __future__ import annotations

from pathlib import Path

import numba
import numpy as np
import pytest

from probmotion.interaction.geometry.coordinates import (
    align_rigidly,
    cartesian_distance,
    dissimilarity,
)
from probmotion.interaction.geometry.graphs import GRAPHS, graph_edges
from probmotion.interaction.geometry.nearest import MEASURES, PairComparer
from probmotion.interaction.geometry.shape_context import shape_context_distance, shape_contexts

J = 34


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def turned(points: np.ndarray, angle: float, shift: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return points @ np.array([[c, s], [-s, c]]) + np.array(shift)


def plain(
    projection: np.ndarray,
    keypoints: np.ndarray,
    visible: np.ndarray,
    measure: str,
    graph: str,
    epsilon: float,
) -> float:
    """Return one distance by the reference path: SciPy's graphs and the array formulas."""
    if measure == "cartesian":
        return float(cartesian_distance(projection, keypoints, visible))
    aligned = align_rigidly(projection, keypoints, visible)
    if measure == "shape-context":
        first, second = (
            shape_contexts(np.where(visible[:, None], x, 0.0), visible)
            for x in (aligned, keypoints)
        )
        return float(shape_context_distance(first, second, visible))
    shown = np.flatnonzero(visible)
    own = shown[graph_edges(keypoints[shown], graph)]
    edges = graph_edges(projection, graph)
    return float(dissimilarity(aligned, keypoints, edges, own, epsilon, visible))


def annotated_pairs(
    n: int, hidden: float, seed: int, joints: int = J
) -> tuple[np.ndarray, np.ndarray]:
    visible = rng(seed).random((n, joints)) >= hidden
    return 0.6 * rng(seed + 1).standard_normal((n, joints, 2)) + 3.0, visible


@pytest.mark.parametrize("hidden", [0.0, 0.3])
@pytest.mark.parametrize(
    ("measure", "graph"),
    [("interaction", graph) for graph in GRAPHS]
    + [("cartesian", "delaunay"), ("shape-context", "delaunay")],
)
def test_it_agrees_with_the_plain_formulas(measure: str, graph: str, hidden: float) -> None:
    keypoints, visible = annotated_pairs(12, hidden, seed=1)
    # Half of the projections are near an annotation, so that candidates are abandoned too.
    near = keypoints[:3] + 0.05 * rng(2).standard_normal((3, J, 2))
    far = 0.6 * rng(3).standard_normal((3, J, 2))
    projections = np.concatenate([near, far]).reshape(3, 2, J, 2)
    candidates = np.array([[0, 5, 2, 9, 1, 7], [11, 3, 4, 2, 1, 0]])
    comparer = PairComparer(keypoints, visible, measure=measure, graph=graph, epsilon=0.07)
    wanted = np.array(
        [
            [plain(p, k, v, measure, graph, 0.07) for k, v in zip(keypoints, visible, strict=True)]
            for p in projections.reshape(-1, J, 2)
        ]
    )
    found = comparer.distances(projections.reshape(-1, J, 2))
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-12)
    distances, indices = comparer.nearest(projections, candidates)
    for item in range(3):
        for view in range(2):
            of_view = wanted[2 * item + view][candidates[view]]
            assert indices[item, view] == candidates[view][of_view.argmin()]
            np.testing.assert_allclose(distances[item, view], of_view.min(), rtol=0, atol=1e-12)


@pytest.mark.parametrize("measure", MEASURES)
def test_an_annotation_is_at_no_distance_from_itself_turned_and_moved(measure: str) -> None:
    """The paper's M takes rotation and translation away, and a mirror image stays apart."""
    keypoints, visible = annotated_pairs(6, 0.2, seed=4)
    comparer = PairComparer(keypoints, visible, measure=measure)
    moved = np.stack([turned(p, 2.5, (7.0, -3.0)) for p in keypoints])
    itself = np.diagonal(comparer.distances(keypoints))
    np.testing.assert_allclose(itself, 0.0, atol=1e-12)
    np.testing.assert_allclose(np.diagonal(comparer.distances(moved)), 0.0, atol=1e-12)
    mirrored = keypoints * np.array([-1.0, 1.0])
    assert np.diagonal(comparer.distances(mirrored)).min() > 0.1


def test_the_result_depends_on_neither_threads_nor_batch() -> None:
    keypoints, visible = annotated_pairs(40, 0.1, seed=5)
    projections = 0.6 * rng(6).standard_normal((7, 4, J, 2))
    candidates = rng(7).integers(0, 40, (4, 16))
    comparer = PairComparer(keypoints, visible)
    whole = comparer.nearest(projections, candidates)
    for pose in range(7):
        alone = comparer.nearest(projections[pose : pose + 1], candidates)
        for one, other in zip(alone, whole, strict=True):
            np.testing.assert_array_equal(one[0], other[pose])
    before = numba.get_num_threads()
    try:
        for threads in range(1, numba.config.NUMBA_NUM_THREADS + 1):
            numba.set_num_threads(threads)
            for one, other in zip(comparer.nearest(projections, candidates), whole, strict=True):
                np.testing.assert_array_equal(one, other)
    finally:
        numba.set_num_threads(before)


def test_the_kernel_for_threads_gives_the_same_bits() -> None:
    from probmotion.interaction.geometry import nearest_kernels

    keypoints, visible = annotated_pairs(40, 0.1, seed=5)
    comparer = PairComparer(keypoints, visible)
    arguments = (
        0.6 * rng(6).standard_normal((5, 4, J, 2)),
        rng(7).integers(0, 40, (4, 16)),
        comparer.prepared,
        *comparer.options,
    )
    serial = nearest_kernels.nearest_in_batch(*arguments)
    parallel = nearest_kernels.nearest_in_batch_on_threads(*arguments)
    for one, other in zip(serial, parallel, strict=True):
        np.testing.assert_array_equal(one, other)


def test_only_what_is_within_is_found() -> None:
    """At the distance itself there is one still; nearer there is none."""
    from probmotion.interaction.geometry.nearest_kernels import nearest_of

    keypoints, visible = annotated_pairs(9, 0.1, seed=5)
    comparer = PairComparer(keypoints, visible)
    projection, candidates = 0.6 * rng(6).standard_normal((J, 2)), np.arange(9)
    given = (projection, candidates, comparer.prepared, *comparer.options)
    distance, index = nearest_of(*given, np.inf)
    assert index == comparer.distances(projection[None])[0].argmin()
    assert nearest_of(*given, distance) == (distance, index)
    assert nearest_of(*given, np.nextafter(distance, 0))[1] == -1


def test_of_equal_annotations_the_first_candidate_is_named() -> None:
    keypoints, visible = annotated_pairs(3, 0.0, seed=8)
    keypoints = np.concatenate([keypoints, keypoints])
    comparer = PairComparer(keypoints, np.concatenate([visible, visible]))
    projection = keypoints[1][None, None] + 0.02 * rng(9).standard_normal((1, 2, J, 2))
    _, indices = comparer.nearest(projection, np.array([[0, 4, 1, 2], [5, 1, 4, 3]]))
    assert indices.tolist() == [[4, 1]]


def test_relabelling_the_characters_on_both_sides_changes_nothing() -> None:
    keypoints, visible = annotated_pairs(8, 0.2, seed=10)
    projections = 0.6 * rng(11).standard_normal((5, J, 2))
    swap = np.roll(np.arange(J), J // 2)
    for measure in MEASURES:
        before = PairComparer(keypoints, visible, measure=measure).distances(projections)
        after = PairComparer(keypoints[:, swap], visible[:, swap], measure=measure)
        np.testing.assert_allclose(after.distances(projections[:, swap]), before, atol=1e-12)


def test_hidden_keypoints_are_never_read() -> None:
    keypoints, visible = annotated_pairs(8, 0.3, seed=12)
    projections = 0.6 * rng(13).standard_normal((3, J, 2))
    spoilt = np.where(visible[..., None], keypoints, np.nan)
    for measure in MEASURES:
        clean = PairComparer(keypoints, visible, measure=measure).distances(projections)
        np.testing.assert_array_equal(
            PairComparer(spoilt, visible, measure=measure).distances(projections), clean
        )


def test_without_a_shared_edge_the_distance_is_infinite() -> None:
    keypoints, visible = annotated_pairs(3, 0.0, seed=14)
    visible[0] = False
    visible[1] = np.arange(J) == 4
    # Two visible joints at opposite ends of the projection: no edge of its triangulation.
    projection = 0.6 * rng(15).standard_normal((J, 2))
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
def test_degenerate_projections_are_compared_and_counted(graph: str) -> None:
    keypoints, _ = annotated_pairs(4, 0.1, seed=16)
    generic = 0.6 * rng(17).standard_normal((J, 2))
    point, line, twins = np.zeros((J, 2)), np.outer(np.arange(J), [0.1, 0.2]), generic.copy()
    twins[17:] = twins[:17]
    projections = np.stack([point, line, twins, generic])
    annotated = np.concatenate([keypoints, projections])
    comparer = PairComparer(annotated, np.ones((8, J), dtype=bool), graph=graph)
    found = comparer.distances(projections)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(np.diagonal(found[:, 4:]), 0.0, atol=1e-12)
    assert comparer.degenerate(projections.reshape(2, 2, J, 2)) == (3 if graph == "delaunay" else 0)


@pytest.mark.parametrize("joints", [1, 2, 3, 5])
@pytest.mark.parametrize("measure", MEASURES)
def test_few_joints_do(measure: str, joints: int) -> None:
    keypoints, visible = annotated_pairs(3, 0.0, seed=18, joints=joints)
    found = PairComparer(keypoints, visible, measure=measure).distances(keypoints)
    if joints == 1 and measure != "cartesian":
        assert np.isinf(found).all()
    else:
        np.testing.assert_allclose(np.diagonal(found), 0.0, atol=1e-12)
        assert np.isfinite(found).all()


def test_no_projection_is_no_result() -> None:
    comparer = PairComparer(*annotated_pairs(3, 0.0, seed=19))
    distances, indices = comparer.nearest(np.zeros((0, 2, J, 2)), np.zeros((2, 3), dtype=int))
    assert distances.shape == indices.shape == (0, 2)
    assert comparer.distances(np.zeros((0, J, 2))).shape == (0, 3)
    assert comparer.degenerate(np.zeros((0, 2, J, 2))) == 0


def test_what_does_not_fit_is_refused() -> None:
    keypoints, visible = annotated_pairs(3, 0.0, seed=20)
    comparer = PairComparer(keypoints, visible)
    one = np.zeros((1, 1, J, 2))
    for arguments, message in (
        ((np.zeros((1, J, 2)), [[0]]), r"projections must have shape \(B, V, 34, got \(1, 34, 2\)"),
        ((one, [[0], [1]]), r"candidates must have shape \(1, N\), got \(2, 1\)"),
        ((one, [[3]]), "candidates holds 3 to 3, expected 0 to 2"),
        ((one, np.zeros((1, 0), int)), r"candidates must have shape at least one, got \(1, 0\)"),
        ((one, [[0.5]]), "candidates has dtype float64, expected integers"),
        (
            (one + np.inf, [[0]]),
            "projections must be finite, got 68 values that are NaN or infinite",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            comparer.nearest(*arguments)
    with pytest.raises(ValueError, match="measure must be one of interaction, got 'angles'"):
        PairComparer(keypoints, visible, measure="angles")
    with pytest.raises(ValueError, match="graph must be one of delaunay, got 'tree'"):
        PairComparer(keypoints, visible, graph="tree")
    with pytest.raises(ValueError, match="epsilon must be a finite number above 0, got 0"):
        PairComparer(keypoints, visible, epsilon=0)
    with pytest.raises(ValueError, match=r"visible must have shape \(3, 34\), got \(2, 34\)"):
        PairComparer(keypoints, visible[:2])
    with pytest.raises(ValueError, match=r"keypoints must have shape at least, got \(0, 34, 2\)"):
        PairComparer(keypoints[:0], visible[:0])


def test_real_pairs_agree_with_the_plain_formulas(real_data: Path) -> None:
    archive = np.load(real_data / "cmu_salsa_pairs" / "cmu_60_61_02.npz")
    pairs = archive["positions"][::40, :, :17].reshape(-1, J, 3).astype(float)
    keypoints, projections = pairs[:8, :, :2], pairs[8:14][:, :, [2, 1]]
    visible = rng(21).random((8, J)) > 0.1
    found = PairComparer(keypoints, visible).distances(projections)
    for p, row in zip(projections, found, strict=True):
        for k, v, distance in zip(keypoints, visible, row, strict=True):
            wanted = plain(p, k, v, "interaction", "delaunay", 0.05)
            assert distance == pytest.approx(wanted, abs=1e-12)


def test_kept_code_for_several_threads_is_not_found_by_one() -> None:
    """Numba's files go by a function's name: two that share it would be given either's code."""
    from probmotion.interaction.geometry import nearest_kernels

    serial = nearest_kernels.nearest_in_batch.py_func
    parallel = nearest_kernels.nearest_in_batch_on_threads.py_func
    assert serial.__qualname__ != parallel.__qualname__


def test_inside_one_thread_the_serial_kernel_runs(monkeypatch) -> None:
    """As under a comparison's clock, whatever the number of cores."""
    from probmotion.interaction.geometry import nearest
    from probmotion.threads import one_thread

    used = []
    for name in ("nearest_in_batch", "nearest_in_batch_on_threads"):
        monkeypatch.setattr(nearest, name, lambda *_, name=name: used.append(name))
    monkeypatch.setattr(nearest.numba, "get_num_threads", lambda: 4)
    rng = np.random.default_rng(0)
    comparer = PairComparer(rng.random((3, 5, 2)), np.ones((3, 5), dtype=bool))
    with one_thread():
        comparer.nearest(rng.random((2, 2, 5, 2)), np.zeros((2, 1), dtype=int))
    comparer.nearest(rng.random((2, 2, 5, 2)), np.zeros((2, 1), dtype=int))
    assert used == ["nearest_in_batch", "nearest_in_batch_on_threads"]
