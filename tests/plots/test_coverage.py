"""Classical scaling of known configurations, and figures of coverage."""

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


def test_configurations_are_projected_onto_their_principal_axes():
    cloud = np.random.default_rng(1).normal(size=(40, 5)) * [5, 3, 1, 0.5, 0.1]
    centred = cloud - cloud.mean(axis=0)
    left, sizes, _ = np.linalg.svd(centred, full_matrices=False)
    result = classical_scaling(cdist(cloud, cloud), dim=3)
    signs = np.sign((result * left[:, :3]).sum(axis=0))
    np.testing.assert_allclose(result * signs, left[:, :3] * sizes[:3], atol=1e-9)
    assert (result[np.abs(result).argmax(axis=0), range(3)] > 0).all()


def test_asymmetric_distances_are_averaged_and_negative_eigenvalues_zero(points):
    distances = cdist(points, points)
    skew = np.triu(np.full(distances.shape, 0.1), 1)
    result = classical_scaling(distances + skew - skew.T)
    np.testing.assert_allclose(result, classical_scaling(distances), atol=1e-12)
    not_a_metric = np.array([[0, 1, 1, 1], [1, 0, 9, 2], [1, 9, 0, 2], [1, 2, 2, 0.0]])
    assert np.isfinite(classical_scaling(not_a_metric, dim=4)).all()


def offsets(figure, panel):
    return {dots.get_label(): dots.get_offsets() for dots in figure.axes[panel].collections}


def test_panels_have_the_given_number_of_draws_and_all_real_poses(points):
    figure = draw_embedding(points, KINDS, counts={"few": 2, "more": 7})
    for panel, count in enumerate((2, 7)):
        shown = offsets(figure, panel)
        np.testing.assert_array_equal(shown["real"], points[:10])
        np.testing.assert_array_equal(shown["prior"], points[10:16][:count])
        np.testing.assert_array_equal(shown["posterior"], points[16:24][:count])
        np.testing.assert_array_equal(shown["seed"], points[24:])
    (axes,) = draw_embedding(points, KINDS).axes
    assert sum(len(dots.get_offsets()) for dots in axes.collections) == 25


def test_measures_have_panels_and_densities_lines():
    table = pd.DataFrame(
        {"measure": measure, "density": density, "draws": draws, "coverage": coverage + error}
        for measure in ("interaction", "cartesian")
        for density, coverage in (("posterior", 0.2), ("prior", 0.3))
        for draws in (100, 10_000)
        for error in (-0.01, 0.01)
    )
    figure = draw_coverage(table)
    assert len(figure.axes) == 2
    for axes in figure.axes:
        assert axes.get_xscale() == "log"
        lines = {bar.get_label(): bar.lines for bar in axes.containers}
        assert set(lines) == {"posterior", "prior"}
        line, _, (bars,) = lines["posterior"]
        np.testing.assert_allclose(line.get_xydata(), [[100, 0.2], [10_000, 0.2]])
        np.testing.assert_allclose(bars.get_segments()[0], [[100, 0.19], [100, 0.21]])
