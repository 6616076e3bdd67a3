"""The picture of calibration: its panels and lines are what it was given."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion.plots.calibration_curves import draw_calibration


def test_it_has_a_panel_per_part_and_a_line_for_a_single_pose(tmp_path):
    rng = np.random.default_rng(0)
    levels = {
        kind: {"prior": -rng.random(n), "likelihood": -5 * rng.random(n)}
        for kind, n in (("real", 50), ("draws", 30), ("seed", 1))
    }
    figure = draw_calibration(levels, tmp_path / "levels.png", "calibration")
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["prior", "likelihood"]
    (line,) = figure.axes[0].lines
    assert line.get_xdata()[0] == levels["seed"]["prior"][0]
    # Every pose is in some bar.
    for bars in figure.axes[1].containers:
        assert sum(bar.get_height() for bar in bars) == pytest.approx(1)
    assert (tmp_path / "levels.png").stat().st_size > 5000


def test_wrong_input_is_named():
    with pytest.raises(ValueError, match="levels is empty"):
        draw_calibration({})
    with pytest.raises(ValueError, match=r"levels\['draws'\] has"):
        draw_calibration({"real": {"a": np.zeros(2)}, "draws": {"b": np.zeros(2)}})
