"""Shape contexts: bins by hand and invariances."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion.interaction.geometry.shape_context import (
    N_ANGLES,
    shape_context_distance,
    shape_contexts,
)

J = 34
both_dimensions = pytest.mark.parametrize("axes", [2, 3])


def joints(*shape, seed=0):
    return 0.5 * np.random.default_rng(seed).standard_normal(shape)


def test_2d_bins_by_hand():
    """The other joints are close on the right, far above, and in the outermost ring."""
    points = np.array([[0.0, 0.0], [0.1, 0.01], [-0.01, 1.0], [-9.0, -0.1]])
    first = shape_contexts(points)[0].reshape(5, N_ANGLES)
    assert np.argwhere(first).tolist() == [[0, 0], [3, 3], [4, 6]]
    assert first.sum() == 3


def test_3d_bins_by_hand():
    """With heading +x, the other joints are above, ahead, and to the side (+z)."""
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.4, 0.001], [0.2, 0.001, 0.01], [9.0, 0.1, 0.1]])
    first = shape_contexts(points)[0].reshape(5, 4, 8)
    rings, bands, _ = np.nonzero(first)
    assert rings.tolist() == [1, 2, 4]
    assert bands.tolist() == [2, 3, 2]


@both_dimensions
def test_every_other_joint_is_counted_once(axes):
    counts = shape_contexts(joints(3, J, axes))
    assert counts.dtype == np.uint8
    assert (counts.sum(axis=-1) == J - 1).all()
    visible = np.arange(J) % 4 != 0
    counts = shape_contexts(joints(3, J, axes), visible)
    assert (counts.sum(axis=-1) == np.where(visible, visible.sum() - 1, 0)).all()


def test_rotation_by_one_bin_shifts_2d_histograms():
    points = joints(J, 2)
    angle = 2 * np.pi / N_ANGLES
    c, s = np.cos(angle), np.sin(angle)
    before = shape_contexts(points).reshape(J, 5, N_ANGLES)
    after = shape_contexts(points @ np.array([[c, s], [-s, c]])).reshape(J, 5, N_ANGLES)
    np.testing.assert_array_equal(after, np.roll(before, 1, axis=-1))


def test_3d_histograms_are_invariant_to_position_and_heading():
    points = joints(J, 3)
    expected = shape_contexts(points)
    for angle in (0.7, 3.0, 5.5):
        c, s = np.cos(angle), np.sin(angle)
        matrix = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
        np.testing.assert_array_equal(shape_contexts(points @ matrix + [4.0, 0.5, -9.0]), expected)
    assert (shape_contexts(points * [1.0, -1.0, -1.0]) != expected).any()  # upside down


def test_distance_by_hand():
    """The distance is the mean over joints of ½ Σ (h − g)² / (h + g), normalised histograms."""
    first, second = np.array([[3, 1, 0], [2, 2, 0]]), np.array([[1, 1, 2], [2, 2, 0]])
    expected = 0.5 * (0.5**2 / 1.0 + 0.5**2 / 0.5) / 2
    assert shape_context_distance(first, second) == pytest.approx(expected)
    assert shape_context_distance(second, first) == pytest.approx(expected)


def test_distance_is_one_without_common_bins():
    """The second pose is the first, mirrored and scaled by 1000."""
    pose = joints(6, 2) * 0.02
    contexts = shape_contexts(pose), shape_contexts(-1000.0 * pose)
    assert shape_context_distance(*contexts) == pytest.approx(1.0)


def test_only_visible_joints_are_compared():
    first, second = joints(J, 2), joints(J, 2, seed=1)
    visible = np.arange(J) >= 17
    distance = shape_context_distance(
        shape_contexts(first, visible), shape_contexts(second, visible), visible
    )
    expected = shape_context_distance(shape_contexts(first[17:]), shape_contexts(second[17:]))
    assert distance == pytest.approx(expected)
    single = np.arange(J) == 3
    assert np.isinf(shape_context_distance(shape_contexts(first), shape_contexts(second), single))


def test_invalid_points_are_rejected():
    with pytest.raises(ValueError, match="points must have at most 256 joints, got 257"):
        shape_contexts(joints(257, 2))
    with pytest.raises(ValueError, match=r"points must have shape \(…, J, 2\), got \(34, 4\)"):
        shape_contexts(joints(J, 4))
