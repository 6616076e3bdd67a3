"""Filmstrips: positions, colours and scale."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from matplotlib.colors import to_hex

from probmotion import Skeleton
from probmotion.data.synthetic.gaits import make_gait
from probmotion.plots.skeletons import draw_skeletons
from probmotion.plots.style import GREY, LEFT, RIGHT

WALK = make_gait("walk", frames=20).centred()


def bones(figure, colour, strip=0):
    """Return the bones of a colour in a strip, (n, 2, 2), metres."""
    found = [
        np.array(lines.get_segments())
        for lines in figure.axes[strip].collections
        if to_hex(lines.get_color()[0]).upper() == colour
    ]
    return np.concatenate(found)


def test_bones_have_their_projected_length():
    figure = draw_skeletons({"walk": WALK.positions[None]}, WALK.skeleton, moments=1, draws=1)
    left_shin = WALK.positions[0, [WALK.skeleton.index("left_ankle"), 5]]
    # Seen from +Z, the axes are the world's x and y.
    drawn = bones(figure, LEFT)
    lengths = np.linalg.norm(drawn[:, 1] - drawn[:, 0], axis=-1)
    wanted = np.linalg.norm((left_shin[0] - left_shin[1])[:2])
    assert np.abs(lengths - wanted).min() < 1e-12
    wrists = drawn[:, 0, 1]
    heights = WALK.positions[0, [j for j, _ in WALK.skeleton.mirrored_pairs], 1]
    np.testing.assert_allclose(sorted(wrists), sorted(heights))


def test_left_and_right_have_different_colours():
    figure = draw_skeletons({"walk": WALK.positions[None]}, WALK.skeleton, moments=1, draws=1)
    left, right = bones(figure, LEFT), bones(figure, RIGHT)
    assert len(left) == len(right) == len(WALK.skeleton.mirrored_pairs)
    # The body faces the camera at +Z, so its left is on the right.
    assert left[:, 0, 0].mean() > right[:, 0, 0].mean() + 0.1


def test_heading_undoes_any_yaw():
    turned = np.stack([WALK.turned(yaw).positions for yaw in (0.0, 1.0, 4.0)])
    figure = draw_skeletons({"walk": turned}, WALK.skeleton, heading=np.pi / 2, draws=3)
    first, second, third = (bones(figure, LEFT, strip) for strip in range(3))
    np.testing.assert_allclose(second, first, atol=1e-12)
    np.testing.assert_allclose(third, first, atol=1e-12)
    plain = draw_skeletons({"walk": turned}, WALK.skeleton, draws=3)
    assert np.abs(bones(plain, LEFT, 1) - bones(plain, LEFT, 0)).max() > 0.1


def test_all_strips_have_the_same_scale():
    rows = {"walk": WALK.positions[None], "half": 0.5 * WALK.positions[None]}
    figure = draw_skeletons(rows, WALK.skeleton)
    figure.draw_without_rendering()
    scales = [np.diag(axes.transData.get_matrix())[:2] for axes in figure.axes]
    np.testing.assert_allclose(scales, np.full((2, 2), scales[0][0]), rtol=1e-9)
    heights = [np.ptp(bones(figure, LEFT, strip)[..., 1]) for strip in (0, 1)]
    assert heights[0] == pytest.approx(2 * heights[1])


def test_truth_is_drawn_at_its_relative_position():
    moved = WALK.positions + np.array([0.25, 0.0, 0.0])
    figure = draw_skeletons(
        {"moved": moved[None]}, WALK.skeleton, truth=WALK.positions, moments=1, draws=1
    )
    truth = bones(figure, GREY)
    apart = np.concatenate([bones(figure, LEFT), bones(figure, RIGHT)])[:, 0, 0].mean()
    sides = [joint for pair in WALK.skeleton.mirrored_pairs for joint in pair]
    order = [joint for joint, _ in WALK.skeleton.bones]
    apart -= truth[[order.index(joint) for joint in sides], 0, 0].mean()
    assert apart == pytest.approx(0.25)


def test_global_settings_of_matplotlib_are_unchanged(tmp_path):
    import matplotlib

    before = dict(matplotlib.rcParams)
    draw_skeletons({"walk": WALK.positions[None]}, WALK.skeleton, tmp_path / "walk.png")
    assert dict(matplotlib.rcParams) == before
    assert (
        "matplotlib.pyplot" not in sys.modules
        or sys.modules["matplotlib.pyplot"].get_fignums() == []
    )


def test_skeletons_without_sides_are_drawn_without_heading():
    skeleton = Skeleton(["hub", "rim"], [-1, 0])
    motions = np.random.default_rng(0).normal(size=(2, 5, 2, 3))
    figure = draw_skeletons({"wheel": motions}, skeleton)
    assert len(figure.axes) == 2
    with pytest.raises(ValueError, match="heading must be None"):
        draw_skeletons({"wheel": motions}, skeleton, heading=0.0)
