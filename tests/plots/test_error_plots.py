"""Figure of an error decomposition: bars, lines and intervals."""

from __future__ import annotations

import numpy as np
import pandas as pd

from probmotion.plots.error_plots import draw_error_decomposition

TABLE = pd.DataFrame(
    [
        ("V = 5", "spread", "floor", 0.1, 0.0, 0.2),
        ("V = 5", "spread", "discretisation", -0.2, -0.3, -0.1),
        ("V = 5", "spread", "single view", 0.5, 0.4, 0.6),
        ("V = 5", "spread", "guidance", 0.3, -0.1, 0.7),
        ("V = 5", "spread", "whole", 0.6, 0.5, 0.7),
        ("V = 5", "off", "floor", 0.0, -0.1, 0.1),
        ("V = 5", "off", "discretisation", -1.0, -1.1, -0.9),
        ("V = 5", "off", "single view", 2.0, 1.5, 2.5),
        ("V = 5", "off", "guidance", -0.5, -0.6, -0.4),
        ("V = 5", "off", "whole", 0.5, -0.2, 1.2),
    ],
    columns=["setting", "measure", "part", "mean", "low", "high"],
)
NOTE = "no network part: no learnt denoiser was given"


def test_parts_are_stacked_and_those_whose_interval_contains_zero_pale():
    figure = draw_error_decomposition(TABLE, words={"off": "off the manifold"}, notes=[NOTE])
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles == ["spread", "off the manifold"]
    stacks = [[(-0.2, 0.0), (0.0, 0.5), (0.5, 0.8)], [(-1.0, 0.0), (0.0, 2.0), (-1.5, -1.0)]]
    for axes, stack in zip(figure.axes, stacks, strict=True):
        drawn = [sorted((bar.get_y(), bar.get_y() + bar.get_height())) for bar in axes.patches]
        np.testing.assert_allclose(drawn, stack, atol=1e-12)
    opaque = [[bar.get_alpha() > 0.5 for bar in axes.patches] for axes in figure.axes]
    assert opaque == [[True, True, False], [True, True, True]]
    assert figure.get_suptitle() == "V = 5"
    (key,) = figure.legends
    assert key.get_title().get_text() == NOTE
    words = [text.get_text() for text in key.get_texts()]
    assert words[:4] == ["discretisation", "single view", "guidance", "whole"]


def test_the_sum_and_all_intervals_are_drawn():
    axes = draw_error_decomposition(TABLE).axes[0]
    lines = [(line.get_xdata(), line.get_ydata()) for line in axes.lines]
    assert any(len(x) == 2 and np.allclose(y, 0.6) for x, y in lines)
    spans = [tuple(y) for _, y in lines if len(set(y)) == 2]
    assert spans == [(-0.3, -0.1), (0.4, 0.6), (-0.1, 0.7), (0.5, 0.7)]


def test_colours_of_parts_do_not_depend_on_other_parts():
    fewer = TABLE[TABLE["part"] != "discretisation"]
    bars, others = (draw_error_decomposition(table).axes[0].patches for table in (TABLE, fewer))
    assert [bar.get_facecolor() for bar in bars[1:]] == [bar.get_facecolor() for bar in others]
    assert len({bar.get_facecolor()[:3] for bar in bars}) == 3
