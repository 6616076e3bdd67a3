"""Spread of draws: standard deviations, colours, scale and the true motion."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex

from probmotion.data.synthetic.gaits import make_gait
from probmotion.plots.spread import joint_sd, plot_spread
from probmotion.plots.style import GREY

WALK = make_gait("walk", frames=20).centred()
TRUTH, SKELETON = WALK.positions, WALK.skeleton
NOISE = np.random.default_rng(0).normal(size=(400, *TRUTH.shape))


def draws(sd):
    return TRUTH + sd * NOISE


def bones(axes):
    """Return the collections of bones of the truth, if any, and of the draws."""
    return [item for item in axes.collections if isinstance(item, LineCollection)]


def panels(figure):
    return [axes for axes in figure.axes if axes.get_aspect() == 1.0]


def test_joint_sd_is_the_root_of_the_total_variance():
    sd = joint_sd(draws(0.03))
    assert sd.shape == TRUTH.shape[:2]
    np.testing.assert_allclose(sd, 0.03 * np.sqrt(3), rtol=0.15)
    np.testing.assert_allclose(joint_sd(draws(0.03) + 5.0), sd)


def test_bones_have_the_colour_of_the_sd_of_all_draws():
    figure = plot_spread({"exact": draws(0.03), "mas": draws(0.015)}, SKELETON, draws=7, moments=2)
    exact, mas = (bones(axes)[0] for axes in panels(figure))
    # All draws are measured and at most 7 are drawn, in 2 frames.
    assert len(mas.get_segments()) == 7 * 2 * len(SKELETON.bones)
    np.testing.assert_allclose(mas.get_array(), 0.5 * exact.get_array())
    ends = np.array(SKELETON.bones)
    of_joints = 100 * joint_sd(draws(0.03))[[0, -1]]
    np.testing.assert_allclose(
        exact.get_array()[: 2 * len(ends)], of_joints[:, ends].mean(2).ravel()
    )
    assert exact.norm is mas.norm
    assert exact.norm.vmax == pytest.approx(100 * joint_sd(draws(0.03)).max())


@pytest.mark.parametrize(("sd", "unit"), [(0.001, "mm"), (0.03, "cm")])
def test_units_and_root_mean_square_are_written(sd, unit):
    figure = plot_spread({"nuts": draws(sd)}, SKELETON)
    rms = np.sqrt(np.mean(joint_sd(draws(sd)) ** 2)) * {"mm": 1000, "cm": 100}[unit]
    assert f"nuts ({rms:.2g} {unit})" in [text.get_text() for text in figure.texts]
    assert f"({unit})" in figure.axes[-1].get_xlabel()


def test_truth_is_grey_and_at_its_position_among_the_draws():
    moved = draws(1e-6) + np.array([0.2, 0.1, 0.0])
    figure = plot_spread({"mas": moved}, SKELETON, truth=TRUTH, moments=1, draws=1)
    truth, draw = bones(panels(figure)[0])
    assert to_hex(truth.get_color()[0]).upper() == GREY
    apart = np.array(draw.get_segments()) - np.array(truth.get_segments())
    np.testing.assert_allclose(apart, np.broadcast_to([0.2, 0.1], apart.shape), atol=1e-4)


def test_nine_samplers_fit_a_page():
    figure = plot_spread({f"sampler {k}": draws(0.03)[:20] for k in range(9)}, SKELETON)
    width, height = figure.get_size_inches()
    assert width <= 6.9
    assert height <= 9.0
    figure.draw_without_rendering()
    boxes = [text.get_window_extent() for text in figure.texts if text.get_text()]
    assert all(figure.bbox.x0 <= box.x0 and box.x1 <= figure.bbox.x1 for box in boxes)
