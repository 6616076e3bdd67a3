"""Stick figures of pose-pairs: positions and colours."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.colors import to_hex

from probmotion import Skeleton
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.plots.pairs import draw_pairs
from probmotion.plots.style import LEFT, RIGHT

PAIR = Skeleton.preset("pair17")
POSES = synthetic_dances(1)[0].positions[::20]


def bones(figure, colour, panel=0):
    """Return the bones of a colour in a panel, (n, 2, 2), metres."""
    found = [
        np.array(lines.get_segments())
        for lines in figure.axes[panel].collections
        if to_hex(lines.get_color()[0]).upper() == colour
    ]
    return np.concatenate(found)


def test_characters_have_their_colour_and_all_bones():
    figure = draw_pairs({"real": POSES}, PAIR)
    assert len(figure.axes) == len(POSES)
    for panel, pose in enumerate(POSES):
        for colour, person in ((LEFT, 0), (RIGHT, 1)):
            drawn = bones(figure, colour, panel)
            assert len(drawn) == 16
            # Seen from +Z, the axes are the world's x and y, shifted.
            lengths = np.linalg.norm(drawn[:, 1] - drawn[:, 0], axis=1)
            ends = [bone for bone in PAIR.bones if bone[0] // 17 == person]
            wanted = [np.linalg.norm(pose[j, :2] - pose[parent, :2]) for j, parent in ends]
            np.testing.assert_allclose(sorted(lengths), sorted(wanted), atol=1e-12)


def test_characters_keep_their_relative_position_and_stand_on_the_ground():
    figure = draw_pairs({"real": POSES[:1] + np.array([0.0, 3.0, 0.0])}, PAIR)
    first, second = bones(figure, LEFT), bones(figure, RIGHT)
    wanted = POSES[0, 17:34, 0].max() - POSES[0, :17, 0].max()
    assert second[..., 0].max() - first[..., 0].max() == pytest.approx(wanted)
    assert min(first[..., 1].min(), second[..., 1].min()) == pytest.approx(0, abs=1e-12)


def test_all_panels_have_the_same_scale():
    rows = {"real": POSES, "half": 0.5 * POSES[:2], "annotated": 0.7 * POSES[:3, :, :2]}
    figure = draw_pairs(rows, PAIR, columns=3)
    assert len(figure.axes) == 3 + 2 + 3
    figure.draw_without_rendering()
    scales = [np.diag(axes.transData.get_matrix())[:2] for axes in figure.axes]
    np.testing.assert_allclose(scales, np.full((8, 2), scales[0][0]), rtol=1e-9)


def test_annotations_are_dashed_without_occluded_joints():
    annotation = POSES[:1, :, :2].copy()
    annotation[0, 7] = np.nan  # a wrist: one bone
    annotation[0, 6] = np.nan  # its elbow: one more
    figure = draw_pairs({"draw": POSES[:1], "annotation": annotation}, PAIR)
    assert len(bones(figure, LEFT, 1)) == 14
    assert len(bones(figure, RIGHT, 1)) == 16
    solid, dashed = (
        [lines.get_linestyle()[0][1] for lines in axes.collections] for axes in figure.axes
    )
    assert all(style is None for style in solid)
    assert all(style is not None for style in dashed)
    # Only 3D poses have a ground line.
    assert [len(axes.lines) for axes in figure.axes] == [1, 0]
