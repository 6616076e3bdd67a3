"""Histograms of log densities."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion.plots.calibration_curves import draw_calibration


def test_each_term_has_a_panel_and_a_single_pose_a_line():
    rng = np.random.default_rng(0)
    levels = {
        kind: {"prior": -rng.random(n), "likelihood": -5 * rng.random(n)}
        for kind, n in (("real", 50), ("draws", 30), ("seed", 1))
    }
    figure = draw_calibration(levels)
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["prior", "likelihood"]
    (line,) = figure.axes[0].lines
    assert line.get_xdata()[0] == levels["seed"]["prior"][0]
    # Every pose is in some bin.
    for bars in figure.axes[1].containers:
        assert sum(bar.get_height() for bar in bars) == pytest.approx(1)
