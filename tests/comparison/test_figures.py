"""Headline metrics, and the figures of a comparison."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from toy_samplers import generation, monocular

from probmotion.comparison.figures import draw_comparison
from probmotion.comparison.results.headline_metrics import headline_metric


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"swd_ratio": 1.2, "coverage_interaction": 0.1, "fid": 30.0}, "swd_ratio"),
        ({"fid": 30.0, "coverage_interaction": 0.1}, "coverage_interaction"),
        ({"g_mpjpe_mm": 3.0, "fid": 30.0}, "fid"),
        # Values without a logarithm cannot be plotted.
        ({"swd_ratio": np.inf, "fid": 30.0}, "fid"),
        ({"swd_ratio": 0.0, "g_mpjpe_mm": 3.0}, "g_mpjpe_mm"),
        ({"swd_ratio": np.nan}, None),
        ({"diversity": 0.7, "seconds": 2.0}, None),
        ({}, None),
    ],
)
def test_headline_metric_is_the_first_finite_positive_one(values, expected):
    assert headline_metric(pd.DataFrame({"metric": list(values), "value": values.values()})) == (
        expected
    )


def test_figures_are_written_for_every_problem_with_draws_or_references(grid, tmp_path):
    names = ["quality_against_cost.png", "skeletons_generation.png", "skeletons_monocular.png"]
    written = draw_comparison(grid, [generation(), monocular()], tmp_path)
    assert written == [tmp_path / name for name in names]
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in written)
