"""The picture of ranks: bars, lines and bands are what they are said to be."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from probmotion.metrics.uniformity import ecdf_band, evaluation_points
from probmotion.plots.ranks import draw_ranks

NAMES = ("direction 1", "speed", "log density", "distance")


def ranks(n=120, seed=0):
    rng = np.random.default_rng(seed)
    return {name: rng.random(n) for name in NAMES}


def panels(figure, title):
    return [axes for axes in figure.axes if axes.get_title(loc="left") == title]


def test_it_is_written(tmp_path):
    path = tmp_path / "ranks.png"
    draw_ranks({"exact": {"speed": ranks()["speed"]}}, path)
    assert path.read_bytes().startswith(b"\x89PNG")


def test_every_truth_is_in_a_bar_and_every_sampler_has_a_title():
    figure = draw_ranks({"exact: right": ranks(), "mas: too sure": ranks(60)})
    assert [part.get_suptitle() for part in figure.subfigs] == ["exact: right", "mas: too sure"]
    for name in NAMES:
        heights = [sum(bar.get_height() for bar in axes.containers[0])
                   for axes in panels(figure, name)]  # fmt: skip
        assert heights == [120, 60]


def test_lines_are_distribution_functions_and_coverage():
    held = ranks()
    figure = draw_ranks({"exact": held})
    (difference,) = panels(figure, "distribution function less uniform")
    (coverage,) = panels(figure, "truths within credible sets")
    points = evaluation_points(120)
    drawn = [line.get_ydata() for line in difference.lines if len(line.get_xdata()) == len(points)]
    for values, line in zip(held.values(), drawn, strict=True):
        np.testing.assert_allclose(line, (values[:, None] <= points).mean(axis=0) - points)
    levels = {
        "highest density": 1 - held["log density"],
        "balls (TARP)": held["distance"],
    }
    for line in coverage.lines:
        if line.get_label() in levels:
            own = levels[line.get_label()]
            np.testing.assert_allclose(line.get_ydata(), (own[:, None] <= points).mean(axis=0))
    labels = [text.get_text() for text in coverage.get_legend().get_texts()]
    assert labels == ["highest density", "balls (TARP)", "central intervals"]


def test_the_band_is_that_of_the_test():
    figure = draw_ranks({"exact": ranks()})
    points, (lower, upper) = evaluation_points(120), ecdf_band(120)
    for title, less in (
        ("distribution function less uniform", 1),
        ("truths within credible sets", 0),
    ):
        (axes,) = panels(figure, title)
        (band,) = axes.collections
        corners = band.get_paths()[0].vertices
        assert corners[:, 1].max() == pytest.approx((upper - less * points).max())
        assert corners[:, 1].min() == pytest.approx((lower - less * points).min())


def test_nothing_is_cut_off_or_drawn_over():
    many = {f"direction {k}": values for k, values in enumerate([*ranks().values()] * 2)}
    figure = draw_ranks({"exact: right": many, "mas: too sure " * 20: ranks(150)})
    FigureCanvasAgg(figure).draw()
    renderer = figure.canvas.get_renderer()
    for part in figure.subfigs:
        shown = [axes for axes in figure.axes if axes.get_visible() and axes.figure in part.subfigs]
        boxes = [axes.get_tightbbox(renderer) for axes in shown]
        assert len(boxes) >= 6
        for box in boxes:
            assert part.bbox.x0 <= box.x0 < box.x1 <= part.bbox.x1
            assert part.bbox.y0 <= box.y0 < box.y1 < part._suptitle.get_window_extent(renderer).y0
        for one, other in itertools.combinations(boxes, 2):
            assert one.x1 < other.x0 or other.x1 < one.x0 or one.y1 < other.y0 or other.y1 < one.y0


def test_wrong_input_is_named():
    with pytest.raises(ValueError, match="blocks must contain at least one sampler, got none"):
        draw_ranks({})
    with pytest.raises(ValueError, match=r"blocks\['mas'\] is empty"):
        draw_ranks({"mas": {}})
    with pytest.raises(ValueError, match=r"blocks\['mas'\]\['speed'\] has shape \(2, 2\)"):
        draw_ranks({"mas": {"speed": np.zeros((2, 2))}})
