"""Figure of the metrics of generators."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd

from probmotion.plots.generation import draw_generation

TABLE = pd.DataFrame(
    {
        "name": ["2D model", "MAS", "SDS"],
        "fid": [5.0, 6.0, 60.0],
        "fid_sd": [0.1, 0.2, 3.0],
        "fid_side": [math.nan, 6.5, 70.0],
        "fid_side_sd": [math.nan, 0.2, 4.0],
        "recall": [0.8, 0.6, 0.01],
    }
)


def markers(axes):
    """Return x and y of every row of markers."""
    return [np.array(container[0].get_xydata()) for container in axes.containers]


def test_markers_and_error_bars_show_the_numbers():
    figure = draw_generation(TABLE, {"fid": "FID", "recall": "Recall"}, logarithmic=["fid"])
    fid, recall = figure.axes
    around, side = markers(fid)
    np.testing.assert_array_equal(around[:, 0], TABLE["fid"])
    np.testing.assert_array_equal(side[:, 0], TABLE["fid_side"])
    assert (np.diff(around[:, 1]) < 0).all(), "the first row is at the top"
    (alone,) = markers(recall)
    np.testing.assert_array_equal(alone[:, 0], TABLE["recall"])
    np.testing.assert_array_equal(np.round(alone[:, 1]), np.round(around[:, 1]))
    assert [label.get_text() for label in fid.get_yticklabels()] == list(TABLE["name"])
    assert fid.get_xscale() == "log"
    assert recall.get_xlim()[0] < 0, "a marker at 0 is not clipped"
    (bars,) = fid.containers[0][2]
    low, high = (np.array([segment[end, 0] for segment in bars.get_segments()]) for end in (0, 1))
    np.testing.assert_allclose((high - low) / 2, TABLE["fid_sd"])
