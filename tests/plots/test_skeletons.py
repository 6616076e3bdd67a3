"""Filmstrips: positions, colours and scale."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from matplotlib.collections import LineCollection, PatchCollection
from matplotlib.colors import to_hex

from probmotion import Skeleton
from probmotion.data.synthetic.animals import synthetic_animals
from probmotion.data.synthetic.gaits import make_gait
from probmotion.plots.skeletons import draw_skeletons, joint_sides
from probmotion.plots.style import GREY, LEFT, RIGHT

WALK = make_gait("walk", frames=20).centred()


ROW = WALK.positions[None]


def bones(figure, colour, strip=0):
    """Return the bones of a colour in a strip, (n, 2, 2), metres."""
    segments = [
        np.array(lines.get_segments())
        for lines in figure.axes[strip].collections
        if isinstance(lines, LineCollection) and to_hex(lines.get_color()[0]).upper() == colour
    ]
    return np.concatenate(segments)


def test_bones_have_their_projected_position_and_the_colour_of_their_side():
    figure = draw_skeletons({"walk": ROW}, WALK.skeleton, moments=1, draws=1)
    for side, colour in enumerate((LEFT, RIGHT)):
        joints = [pair[side] for pair in WALK.skeleton.mirrored_pairs]
        ends = np.array([bone for bone in WALK.skeleton.bones if bone[0] in joints])
        # Seen from +Z, the axes are the world's x and y, shifted in x.
        drawn, wanted = bones(figure, colour), WALK.positions[0, ends, :2]
        shift = drawn[0, 0] - wanted[0, 0]
        assert shift[1] == pytest.approx(0, abs=1e-12)
        np.testing.assert_allclose(drawn, wanted + shift, atol=1e-12)


def test_heading_undoes_any_yaw():
    turned = np.stack([WALK.turned(yaw).positions for yaw in (0.0, 1.0, 4.0)])
    figure = draw_skeletons({"walk": turned}, WALK.skeleton, heading=np.pi / 2, draws=3)
    for strip in (1, 2):
        drawn = bones(figure, LEFT, strip)
        np.testing.assert_allclose(drawn, bones(figure, LEFT), atol=1e-12)
    plain = draw_skeletons({"walk": turned}, WALK.skeleton, draws=3)
    assert np.abs(bones(plain, LEFT, 1) - bones(plain, LEFT, 0)).max() > 0.1


def test_all_strips_have_the_same_scale():
    figure = draw_skeletons({"walk": ROW, "half": 0.5 * ROW}, WALK.skeleton)
    figure.draw_without_rendering()
    scales = [np.diag(axes.transData.get_matrix())[:2] for axes in figure.axes]
    np.testing.assert_allclose(scales, np.full((2, 2), scales[0][0]), rtol=1e-9)


def test_heads_are_whole():
    """An animal's head is above the rest of it, and larger than the margin."""
    animal = synthetic_animals(1, seed=3)[0]
    figure = draw_skeletons({"animal": animal.positions[None, :10]}, animal.skeleton)
    for axes in figure.axes:
        heads = [each for each in axes.collections if isinstance(each, PatchCollection)]
        assert heads
        top = max(path.get_extents().y1 for each in heads for path in each.get_paths())
        assert top <= axes.get_ylim()[1]


def test_truth_is_drawn_at_its_relative_position():
    options = {"truth": WALK.positions, "moments": 1, "draws": 1}
    figure = draw_skeletons({"moved": ROW + np.array([0.25, 0, 0])}, WALK.skeleton, **options)
    joints = [joint for joint, _ in WALK.skeleton.bones]
    left = [joints.index(joint) for joint in joints if joint_sides(WALK.skeleton)[joint] == "left"]
    apart = bones(figure, LEFT) - bones(figure, GREY)[left]
    np.testing.assert_allclose(apart, np.broadcast_to([0.25, 0], apart.shape), atol=1e-12)


def test_global_settings_of_matplotlib_are_unchanged(tmp_path):
    import matplotlib

    before = dict(matplotlib.rcParams)
    draw_skeletons({"walk": ROW}, WALK.skeleton, tmp_path / "walk.png")
    assert dict(matplotlib.rcParams) == before
    pyplot = sys.modules.get("matplotlib.pyplot")
    assert pyplot is None or pyplot.get_fignums() == []


def test_skeletons_without_sides_are_drawn_without_heading():
    skeleton = Skeleton(["hub", "rim"], [-1, 0])
    motions = np.random.default_rng(0).normal(size=(2, 5, 2, 3))
    assert len(draw_skeletons({"wheel": motions}, skeleton).axes) == 2
    with pytest.raises(ValueError, match="heading must be None"):
        draw_skeletons({"wheel": motions}, skeleton, heading=0.0)
