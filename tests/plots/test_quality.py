"""Quality against cost: points, legible labels and missing samplers."""

from __future__ import annotations

import itertools

import numpy as np
import pandas as pd
import pytest

from probmotion.plots.quality import plot_quality_against_cost
from probmotion.plots.style import style_of

SAMPLERS = {
    "exact": (0.01, 1.0), "ancestral3d": (3.0, 1.03), "mas": (4.0, 1.6), "mvpc": (4.2, 1.1),
    "sds": (40.0, 2.3), "mh": (2.0, 1.3), "nuts": (9.0, 1.02), "ensemble": (1.5, 1.05),
}  # fmt: skip


def table(problems=("gait",), seeds=3, spread=0.1):
    rng = np.random.default_rng(0)
    rows = [
        (problem, name, seed, metric, value * np.exp(spread * rng.normal()))
        for problem in problems
        for name, values in SAMPLERS.items()
        for seed in range(seeds)
        for metric, value in zip(("seconds", "swd_ratio"), values, strict=True)
    ]
    return pd.DataFrame(rows, columns=["problem", "sampler", "seed", "metric", "value"])


def words(axes):
    return {text.get_text(): text for text in axes.texts if text.get_text()}


def test_points_are_means_and_bars_span_the_seeds():
    assert len({style_of(place) for place in range(12)}) == 12
    data = table()
    axes = plot_quality_against_cost(data).axes[0]
    drawn = sorted(
        (bars.lines[0].get_xdata()[0], bars.lines[0].get_ydata()[0]) for bars in axes.containers
    )
    means = data.pivot_table(index="sampler", columns="metric", values="value")
    np.testing.assert_allclose(drawn, sorted(means[["seconds", "swd_ratio"]].to_numpy().tolist()))
    mas = data[(data["sampler"] == "mas") & (data["metric"] == "swd_ratio")]["value"]
    spans = [span.get_segments()[0][:, 1] for bars in axes.containers for span in bars.lines[2]]
    assert any(np.allclose(span, [mas.min(), mas.max()]) for span in spans)


@pytest.mark.parametrize("spread", [0.0, 0.4])
def test_labels_neither_overlap_nor_leave_the_panel(spread):
    figure = plot_quality_against_cost(table(("gait", "gait-monocular"), spread=spread))
    for axes in figure.axes:
        labels = words(axes)
        assert set(labels) == set(SAMPLERS)
        boxes = [text.get_window_extent() for text in labels.values()]
        assert all(axes.bbox.x0 <= box.x0 and box.x1 <= axes.bbox.x1 + 1 for box in boxes)
        assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2))


def test_samplers_without_a_point_are_listed_with_the_reason():
    data = table(seeds=1)
    data = data[~data["sampler"].isin(["sds", "nuts"])]
    data.loc[100] = ("gait", "sds", 0, "unsupported", 1.0)
    data.loc[101] = ("gait", "nuts", 0, "failed", 1.0)
    data.attrs["words"] = {"gait/sds": "observations"}
    # Values without a logarithm.
    data.loc[(data["sampler"] == "mas") & (data["metric"] == "swd_ratio"), "value"] = np.inf
    data.loc[(data["sampler"] == "mh") & (data["metric"] == "seconds"), "value"] = 0.0
    axes = plot_quality_against_cost(data).axes[0]
    assert set(words(axes)) == set(SAMPLERS) - {"mas", "mh", "nuts", "sds"}
    reasons = {"mas": "not measured", "mh": "not measured", "sds": "observations", "nuts": "failed"}
    listed = ", ".join(f"{name} ({reason})" for name, reason in reasons.items())
    assert axes.get_xlabel().split() == f"seconds no point: {listed}".split()
