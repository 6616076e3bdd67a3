"""Classical scaling against configurations that are known, and what is drawn of coverage."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.distance import cdist

from probmotion.plots.coverage import classical_scaling, draw_coverage, draw_embedding

KINDS = ["real"] * 10 + ["prior"] * 6 + ["posterior"] * 8 + ["seed"]


@pytest.fixture
def points():
    return np.random.default_rng(0).normal(size=(25, 2)) * [3.0, 1.0]


def test_a_planar_configuration_comes_back_up_to_a_rigid_motion(points):
    found = classical_scaling(cdist(points, points))
    np.testing.assert_allclose(cdist(found, found), cdist(points, points), atol=1e-10)
    np.testing.assert_allclose(found.mean(axis=0), 0, atol=1e-12)
    assert found[:, 0].var() > found[:, 1].var()


def test_more_dimensions_are_projected_on_the_principal_axes():
    cloud = np.random.default_rng(1).normal(size=(40, 5)) * [5, 3, 1, 0.5, 0.1]
    centred = cloud - cloud.mean(axis=0)
    left, sizes, _ = np.linalg.svd(centred, full_matrices=False)
    found = classical_scaling(cdist(cloud, cloud), dim=3)
    signs = np.sign((found * left[:, :3]).sum(axis=0))
    np.testing.assert_allclose(found * signs, left[:, :3] * sizes[:3], atol=1e-9)


def test_asymmetric_distances_count_by_their_mean(points):
    distances = cdist(points, points)
    skew = np.triu(np.full(distances.shape, 0.1), 1)
    found = classical_scaling(distances + skew - skew.T)
    np.testing.assert_allclose(found, classical_scaling(distances), atol=1e-12)


def test_distances_that_no_points_have_are_borne():
    star = np.array([[0, 1, 1, 1], [1, 0, 2, 2], [1, 2, 0, 2], [1, 2, 2, 0.0]])
    triangle_broken = star.copy()
    triangle_broken[1, 2] = triangle_broken[2, 1] = 9.0
    assert np.isfinite(classical_scaling(triangle_broken, dim=4)).all()


def offsets(figure, panel):
    return {dots.get_label(): dots.get_offsets() for dots in figure.axes[panel].collections}


def test_every_panel_has_so_many_draws_and_all_real_poses(points, tmp_path):
    path = tmp_path / "embedding.png"
    figure = draw_embedding(points, KINDS, path, counts={"few": 2, "more": 7}, title="draws")
    for panel, count in enumerate((2, 7)):
        shown = offsets(figure, panel)
        np.testing.assert_array_equal(shown["real"], points[:10])
        np.testing.assert_array_equal(shown["prior"], points[10:16][:count])
        np.testing.assert_array_equal(shown["posterior"], points[16:24][:count])
        np.testing.assert_array_equal(shown["seed"], points[24:])
    assert path.read_bytes().startswith(b"\x89PNG")
    (whole,) = draw_embedding(points, KINDS).axes
    assert sum(len(dots.get_offsets()) for dots in whole.collections) == 25


def table():
    return pd.DataFrame(
        {"measure": measure, "density": density, "draws": draws, "coverage": coverage + 0.01 * seed}
        for measure in ("interaction", "cartesian")
        for density, coverage in (("posterior", 0.2), ("prior", 0.3))
        for draws in (100, 10_000)
        for seed in (-1, 1)
    )


def test_a_panel_per_measure_and_a_line_per_density(tmp_path):
    figure = draw_coverage(table(), tmp_path / "coverage.png", title="coverage")
    assert len(figure.axes) == 2
    for axes in figure.axes:
        assert axes.get_xscale() == "log"
        lines = {bar.get_label(): bar.lines for bar in axes.containers}
        assert set(lines) == {"posterior", "prior"}
        line, _, (bars,) = lines["posterior"]
        np.testing.assert_allclose(line.get_xydata(), [[100, 0.2], [10_000, 0.2]])
        np.testing.assert_allclose(bars.get_segments()[0], [[100, 0.19], [100, 0.21]])
    assert (tmp_path / "coverage.png").read_bytes().startswith(b"\x89PNG")


def test_bad_input_is_refused_in_a_sentence(points):
    with pytest.raises(ValueError, match=r"distances must have shape \(3, 3\), got \(3, 4\)"):
        classical_scaling(np.zeros((3, 4)))
    with pytest.raises(ValueError, match="distances is of 1 points, expected at least dim=2"):
        classical_scaling(np.zeros((1, 1)))
    with pytest.raises(ValueError, match=r"kinds has \['truth'\], expected some of real, prior"):
        draw_embedding(points, ["truth", *KINDS[1:]])
    with pytest.raises(ValueError, match=r"kinds must have shape \(25\), got \(24,\)"):
        draw_embedding(points, KINDS[1:])
    with pytest.raises(ValueError, match=r"table lacks the columns \['coverage'\], expected"):
        draw_coverage(table().drop(columns="coverage"))
    with pytest.raises(ValueError, match="table has no row"):
        draw_coverage(table()[:0])
    with pytest.raises(ValueError, match="table has 0 draws, expected at least 1"):
        draw_coverage(table().assign(draws=0))
