"""Shape contexts: what the bins hold, invariances, and the compiled distances."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion.interaction.geometry.shape_context import (
    N_ANGLES,
    shape_context_distance,
    shape_context_distances,
    shape_contexts,
)

J = 34


def joints(*shape: int, seed: int = 0) -> np.ndarray:
    return 0.5 * np.random.default_rng(seed).standard_normal(shape)


def about_vertical(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def test_the_bins_of_the_plane_by_hand() -> None:
    """From the first joint: one near to the right, one far above, one beyond every ring's edge."""
    points = np.array([[0.0, 0.0], [0.1, 0.01], [-0.01, 1.0], [-9.0, -0.1]])
    first = shape_contexts(points)[0].reshape(5, N_ANGLES)
    assert np.argwhere(first).tolist() == [[0, 0], [3, 3], [4, 6]]
    assert first.sum() == 3


def test_the_bins_of_space_by_hand() -> None:
    """The second half is towards +x: a joint above, one ahead, one beside towards +z."""
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.4, 0.001], [0.2, 0.001, 0.01], [9.0, 0.1, 0.1]])
    first = shape_contexts(points)[0].reshape(5, 4, 8)
    rings, bands, _ = np.nonzero(first)
    assert rings.tolist() == [1, 2, 4]
    assert bands.tolist() == [2, 3, 2]


@pytest.mark.parametrize("axes", [2, 3])
def test_every_other_joint_is_counted_once(axes: int) -> None:
    counts = shape_contexts(joints(3, J, axes))
    assert counts.dtype == np.uint8
    assert (counts.sum(axis=-1) == J - 1).all()
    visible = np.arange(J) % 4 != 0
    counts = shape_contexts(joints(3, J, axes), visible)
    assert (counts.sum(axis=-1) == np.where(visible, visible.sum() - 1, 0)).all()


def test_turning_by_a_bin_turns_the_histograms() -> None:
    points = joints(J, 2)
    angle = 2 * np.pi / N_ANGLES
    c, s = np.cos(angle), np.sin(angle)
    before = shape_contexts(points).reshape(J, 5, N_ANGLES)
    after = shape_contexts(points @ np.array([[c, s], [-s, c]])).reshape(J, 5, N_ANGLES)
    np.testing.assert_array_equal(after, np.roll(before, 1, axis=-1))


def test_in_space_neither_place_nor_heading_matters() -> None:
    points = joints(J, 3)
    wanted = shape_contexts(points)
    for angle in (0.7, 3.0, 5.5):
        moved = points @ about_vertical(angle) + np.array([4.0, 0.5, -9.0])
        np.testing.assert_array_equal(shape_contexts(moved), wanted)
    upside_down = points * np.array([1.0, -1.0, -1.0])
    assert (shape_contexts(upside_down) != wanted).any()


@pytest.mark.parametrize("axes", [2, 3])
def test_distances_are_a_bounded_symmetric_comparison(axes: int) -> None:
    counts = shape_contexts(joints(9, J, axes))
    found = shape_context_distances(counts, counts)
    np.testing.assert_allclose(found, found.T, atol=1e-14)
    np.testing.assert_array_equal(np.diagonal(found), 0.0)
    off = found[~np.eye(9, dtype=bool)]
    assert 0 < off.min() <= off.max() <= 1
    np.testing.assert_allclose(
        found, shape_context_distance(counts[:, None], counts[None]), atol=1e-14
    )


def test_the_distance_is_one_where_no_bin_is_shared() -> None:
    """All joints within 10 cm, against the same ten times as far apart and mirrored."""
    near = joints(6, 2) * 0.02
    apart = shape_contexts(near), shape_contexts(-1000.0 * near)
    assert shape_context_distance(*apart) == pytest.approx(1.0)
    assert shape_context_distances(apart[0][None], apart[1][None]) == pytest.approx(1.0)


@pytest.mark.parametrize("axes", [2, 3])
def test_relabelling_the_characters_on_both_sides_changes_nothing(axes: int) -> None:
    first, second = joints(J, axes), joints(J, axes, seed=1)
    swap = np.roll(np.arange(J), J // 2)
    wanted = shape_context_distance(shape_contexts(first), shape_contexts(second))
    found = shape_context_distance(shape_contexts(first[swap]), shape_contexts(second[swap]))
    assert found == pytest.approx(wanted)


def test_only_visible_joints_are_compared() -> None:
    first, second = joints(J, 2), joints(J, 2, seed=1)
    visible = np.arange(J) >= 17
    found = shape_context_distance(
        shape_contexts(first, visible), shape_contexts(second, visible), visible
    )
    wanted = shape_context_distance(shape_contexts(first[17:]), shape_contexts(second[17:]))
    assert found == pytest.approx(wanted)
    alone = np.arange(J) == 3
    assert np.isinf(shape_context_distance(shape_contexts(first), shape_contexts(second), alone))


def test_what_does_not_fit_is_refused() -> None:
    counts = shape_contexts(joints(2, J, 3))
    hidden = shape_contexts(joints(2, J, 3), np.arange(J) > 0)
    with pytest.raises(ValueError, match="second has joints whose counts do not sum to 33"):
        shape_context_distances(counts, hidden)
    with pytest.raises(ValueError, match=r"second must have shape \(m, 34, 160, got \(2, 34, 60\)"):
        shape_context_distances(counts, shape_contexts(joints(2, J, 2)))
    with pytest.raises(ValueError, match="points has 257 joints, expected at most 256"):
        shape_contexts(joints(257, 2))
    with pytest.raises(ValueError, match=r"points must have shape \(…, J, 2\), got \(34, 4\)"):
        shape_contexts(joints(J, 4))
