"""Figure of an error decomposition: bars, lines and intervals."""

from __future__ import annotations

import numpy as np
import pandas as pd

from probmotion.plots.error_plots import draw_error_decomposition

COLUMNS = ["setting", "measure", "part", "mean", "low", "high"]
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
    columns=COLUMNS,
)


def test_parts_are_stacked_upwards_and_negative_ones_downwards():
    figure = draw_error_decomposition(TABLE, words={"off": "off the manifold"})
    spread, off = figure.axes
    assert (spread.get_title(loc="left"), off.get_title(loc="left")) == (
        "spread",
        "off the manifold",
    )
    for axes, spans in (
        (spread, [(-0.2, 0.0), (0.0, 0.5), (0.5, 0.8)]),
        (off, [(-1.0, 0.0), (0.0, 2.0), (-1.5, -1.0)]),
    ):
        drawn = [sorted((bar.get_y(), bar.get_y() + bar.get_height())) for bar in axes.patches]
        np.testing.assert_allclose(drawn, spans, atol=1e-12)


def test_the_sum_and_all_intervals_are_drawn():
    axes = draw_error_decomposition(TABLE).axes[0]
    across = [line for line in axes.lines if len(set(line.get_ydata())) == 1]
    assert any(np.allclose(line.get_ydata(), 0.6) and len(line.get_xdata()) == 2 for line in across)
    spans = [tuple(line.get_ydata()) for line in axes.lines if len(set(line.get_ydata())) == 2]
    assert spans == [(-0.3, -0.1), (0.4, 0.6), (-0.1, 0.7), (0.5, 0.7)]


def test_parts_whose_interval_contains_zero_are_pale():
    figure = draw_error_decomposition(TABLE)
    opaque = [[bar.get_alpha() > 0.5 for bar in axes.patches] for axes in figure.axes]
    assert opaque == [[True, True, False], [True, True, True]]


def test_colours_of_parts_do_not_depend_on_other_parts():
    some = TABLE[TABLE["part"] != "discretisation"]
    one, other = (draw_error_decomposition(table).axes[0].patches for table in (TABLE, some))
    assert [bar.get_facecolor() for bar in one[1:]] == [bar.get_facecolor() for bar in other]
    assert len({bar.get_facecolor()[:3] for bar in one}) == 3


def test_notes_and_setting_are_shown():
    figure = draw_error_decomposition(
        TABLE, notes=["network is no part: no learnt denoiser was given"]
    )
    assert figure.get_suptitle() == "V = 5"
    (key,) = figure.legends
    assert key.get_title().get_text() == "network is no part: no learnt denoiser was given"
    words = [text.get_text() for text in key.get_texts()]
    assert words[:4] == ["discretisation", "single view", "guidance", "whole"]
