"""Figure of ranks: histograms, distribution functions, coverage and bands."""

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


def test_histograms_contain_all_ranks_and_blocks_have_titles():
    figure = draw_ranks({"exact: calibrated": ranks(), "mas: overconfident": ranks(60)})
    titles = [part.get_suptitle() for part in figure.subfigs]
    assert titles == ["exact: calibrated", "mas: overconfident"]
    for name in NAMES:
        bars = [axes.containers[0] for axes in panels(figure, name)]
        assert [sum(bar.get_height() for bar in block) for block in bars] == [120, 60]


def test_lines_are_distribution_functions_and_coverage():
    values_of = ranks()
    figure = draw_ranks({"exact": values_of})
    (difference,) = panels(figure, "ECDF minus uniform")
    (coverage,) = panels(figure, "coverage of credible sets")
    points = evaluation_points(120)
    drawn = [line.get_ydata() for line in difference.lines if len(line.get_xdata()) == len(points)]
    for values, line in zip(values_of.values(), drawn, strict=True):
        np.testing.assert_allclose(line, (values[:, None] <= points).mean(axis=0) - points)
    densities, distances = values_of["log density"], values_of["distance"]
    levels = {"highest density": 1 - densities, "balls (TARP)": distances}
    for line in coverage.lines:
        if line.get_label() in levels:
            inside = levels[line.get_label()][:, None] <= points
            np.testing.assert_allclose(line.get_ydata(), inside.mean(axis=0))
    labels = [text.get_text() for text in coverage.get_legend().get_texts()]
    assert labels == ["highest density", "balls (TARP)", "central intervals"]


def test_bands_are_those_of_the_uniformity_test():
    figure = draw_ranks({"exact": ranks()})
    points, (lower, upper) = evaluation_points(120), ecdf_band(120)
    titles = {"ECDF minus uniform": points, "coverage of credible sets": 0}
    for title, shift in titles.items():
        (axes,) = panels(figure, title)
        corners = axes.collections[0].get_paths()[0].vertices
        assert corners[:, 1].max() == pytest.approx((upper - shift).max())
        assert corners[:, 1].min() == pytest.approx((lower - shift).min())


def test_panels_and_titles_do_not_overlap():
    many = {f"direction {k}": values for k, values in enumerate([*ranks().values()] * 2)}
    figure = draw_ranks({"exact: calibrated": many, "mas: overconfident " * 20: ranks(150)})
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
