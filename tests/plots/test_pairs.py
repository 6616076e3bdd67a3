"""Stick figures of pose-pairs: positions and colours."""

from __future__ import annotations

import numpy as np
from matplotlib.colors import to_hex

from probmotion import Skeleton
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.plots.pairs import draw_pairs
from probmotion.plots.style import LEFT, RIGHT

PAIR = Skeleton.preset("pair17")
POSES = synthetic_dances(1)[0].positions[::20]


def bones(figure, colour, panel=0):
    """Return the bones of a colour in a panel, (n, 2, 2), metres."""
    segments = [
        np.array(lines.get_segments())
        for lines in figure.axes[panel].collections
        if to_hex(lines.get_color()[0]).upper() == colour
    ]
    return np.concatenate(segments)


def test_characters_have_their_colour_and_relative_position_on_the_ground():
    figure = draw_pairs({"real": POSES + np.array([0.0, 3.0, 0.0])}, PAIR)
    assert len(figure.axes) == len(POSES)
    for panel, pose in enumerate(POSES):
        # Seen from +Z, the axes are the world's x and y, shifted by the same vector.
        joints = pose[:, :2] - [0.5 * (pose[:, 0].min() + pose[:, 0].max()), pose[:, 1].min()]
        for colour, person in ((LEFT, 0), (RIGHT, 1)):
            drawn = bones(figure, colour, panel)
            ends = [joints[list(bone)] for bone in PAIR.bones if bone[0] // 17 == person]
            assert len(drawn) == len(ends)
            apart = np.abs(drawn[:, None] - ends).max(axis=(-2, -1))
            assert apart.min(axis=0).max() < 1e-12


def test_all_panels_have_the_same_scale():
    rows = {"real": POSES, "half": 0.5 * POSES[:2], "annotated": 0.7 * POSES[:3, :, :2]}
    figure = draw_pairs(rows, PAIR, columns=3)
    assert len(figure.axes) == 3 + 2 + 3
    figure.draw_without_rendering()
    scales = [np.diag(axes.transData.get_matrix())[:2] for axes in figure.axes]
    np.testing.assert_allclose(scales, np.full((8, 2), scales[0][0]), rtol=1e-9)


def test_annotations_are_dashed_without_occluded_joints():
    annotation = POSES[:1, :, :2].copy()
    annotation[0, [6, 7]] = np.nan  # an elbow and its wrist: two bones
    figure = draw_pairs({"draw": POSES[:1], "annotation": annotation}, PAIR)
    assert [len(bones(figure, colour, 1)) for colour in (LEFT, RIGHT)] == [14, 16]
    for axes, dashed in zip(figure.axes, (False, True), strict=True):
        styles = [lines.get_linestyle()[0][1] for lines in axes.collections]
        assert all((style is not None) == dashed for style in styles)
        # Only 3D poses have a ground line.
        assert len(axes.lines) == (not dashed)
