"""Which quality a comparison's plot shows, and where it shows none."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from probmotion.comparison import figures as comparisons


class Measured:
    """A comparison of which only the table is there."""

    def __init__(self, **values: float) -> None:
        rows = [("walk", "mas", 0, name, value) for name, value in values.items()]
        self.rows = pd.DataFrame(rows, columns=["problem", "sampler", "seed", "metric", "value"])

    def table(self) -> pd.DataFrame:
        return self.rows


@pytest.mark.parametrize(
    ("values", "plotted"),
    [
        ({"swd_ratio": 1.2, "coverage_interaction": 0.1, "fid": 30.0}, "swd_ratio"),
        ({"coverage_interaction": 0.1, "fid": 30.0}, "coverage_interaction"),
        ({"fid": 30.0}, "fid"),
        # What has no logarithm has no place.
        ({"swd_ratio": np.inf, "fid": 30.0}, "fid"),
        ({"swd_ratio": 0.0, "fid": 30.0}, "fid"),
        ({"swd_ratio": np.nan}, None),
        ({"diversity": 0.7}, None),
        ({}, None),
    ],
)
def test_the_plot_is_of_the_first_quality_that_was_measured(
    tmp_path, monkeypatch, values, plotted
) -> None:
    asked = []
    draw = comparisons.plot_quality_against_cost

    def note(table, path, *, quality):
        asked.append(quality)
        return draw(table, path, quality=quality)

    monkeypatch.setattr(comparisons, "plot_quality_against_cost", note)
    written = comparisons.draw_comparison(Measured(seconds=2.0, **values), [], tmp_path)
    assert asked == ([] if plotted is None else [plotted])
    assert written == ([] if plotted is None else [tmp_path / "quality_against_cost.png"])
    assert list(tmp_path.iterdir()) == written
