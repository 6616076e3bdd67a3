"""Views of a pair in its own frame: the equations, their inverse, pictures and the density."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate, stats
from scipy.spatial.transform import Rotation

from probmotion import Skeleton
from probmotion.interaction.annotations.local_frames import (
    frames_are_sound,
    local_frames,
    pair_frames,
)
from probmotion.interaction.annotations.views import (
    ViewDistribution,
    image_axes,
    project_to_views,
    view_angles,
    view_directions,
    view_vectors,
)

PAIR = Skeleton.preset("pair17")


def poses(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((n, PAIR.n_joints, 3))


def some_views(n: int, seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.stack([rng.uniform(-np.pi, np.pi, n), np.arccos(rng.uniform(-1, 1, n))], axis=-1)


def angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(axis=-1))


# Frames and angles, equations 3 and 4.


def test_frame_of_two_upright_characters_beside_each_other() -> None:
    roots = np.array([[0.0, 1.0, 0.0], [0.0, 1.0, -2.0]])
    upright = np.array([[0.0, 0.5, 0.0], [0.0, 0.2, 0.0]])
    frame = local_frames(roots, upright)
    np.testing.assert_allclose(frame[:, 0], [0, 0, -1])
    np.testing.assert_allclose(frame[:, 1], [0, 1, 0])
    np.testing.assert_allclose(frame[:, 2], [1, 0, 0])  # -z × y


def test_backbones_count_by_direction_alone() -> None:
    roots = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    leaning = np.array([[0.0, 3.0, 0.0], [0.0, 0.0, 0.1]])
    j = local_frames(roots, leaning)[:, 1]
    np.testing.assert_allclose(j, np.array([0, 1, 1]) / np.sqrt(2))


def test_a_third_character_joins_the_backbones_but_not_i() -> None:
    roots = np.random.default_rng(0).standard_normal((3, 3))
    backbones = np.random.default_rng(1).standard_normal((3, 3))
    i, j, _ = local_frames(roots, backbones).T
    assert angle(i, roots[1] - roots[0]) < 1e-7
    units = backbones / np.linalg.norm(backbones, axis=-1, keepdims=True)
    assert angle(j, units.sum(axis=0)) < 1e-7


def test_view_by_the_definition() -> None:
    """Solve [i j k](a, b, c) = d, one pair and one direction at a time."""
    frames = pair_frames(poses(20), PAIR)
    directions = np.random.default_rng(5).standard_normal((20, 3))
    views = view_angles(frames, directions)
    for frame, direction, (phi, theta) in zip(frames, directions, views, strict=True):
        a, b, c = np.linalg.inv(frame) @ direction
        assert phi == pytest.approx(np.arctan2(c, a))
        assert theta == pytest.approx(np.arccos(b / np.sqrt(a**2 + b**2 + c**2)))


def test_view_from_the_side_from_above_and_along_the_line_of_the_characters() -> None:
    roots = np.array([[0.0, 1.0, 0.0], [1.0, 1.0, 0.0]])
    frame = local_frames(roots, np.array([[0.0, 1.0, 0.0]] * 2))  # i, j, k = x, y, z
    np.testing.assert_allclose(view_angles(frame, np.array([0, 0, 2.0])), [np.pi / 2, np.pi / 2])
    np.testing.assert_allclose(view_angles(frame, np.array([3.0, 0, 0])), [0, np.pi / 2])
    assert view_angles(frame, np.array([0, 1.0, 0]))[1] == pytest.approx(0)
    assert view_angles(frame, np.array([0, -1.0, 0]))[1] == pytest.approx(np.pi)


def test_angles_and_directions_are_inverses() -> None:
    frames = pair_frames(poses(30), PAIR)
    views = some_views(40)
    directions = view_directions(frames[:, np.newaxis], views)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1)
    again = view_angles(frames[:, np.newaxis], directions)
    np.testing.assert_allclose(again, np.broadcast_to(views, again.shape), atol=1e-9)
    given = np.random.default_rng(3).standard_normal((30, 3))
    back = view_directions(frames, view_angles(frames, given))
    np.testing.assert_allclose(back, given / np.linalg.norm(given, axis=-1, keepdims=True))


def test_views_turn_with_the_pair() -> None:
    """A rigid motion of the pair and the camera changes no view."""
    positions, turn = poses(6), Rotation.random(rng=2).as_matrix()
    direction = np.array([0.3, -0.2, 0.9])
    views = view_angles(pair_frames(positions, PAIR), direction)
    moved = pair_frames(positions @ turn.T + [1.0, 2.0, 3.0], PAIR)
    np.testing.assert_allclose(view_angles(moved, turn @ direction), views, atol=1e-9)


# Pictures.


def test_a_picture_is_what_an_explicit_camera_sees() -> None:
    positions, views = poses(5), some_views(7)
    pictures = project_to_views(positions, views, PAIR)
    assert pictures.shape == (5, 7, PAIR.n_joints, 2)
    frames = pair_frames(positions, PAIR)
    for pose, view in np.ndindex(5, 7):
        phi, theta = views[view]
        local = [np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)]
        towards = frames[pose] @ local
        towards /= np.linalg.norm(towards)
        up = frames[pose][:, 1] - (frames[pose][:, 1] @ towards) * towards
        up /= np.linalg.norm(up)
        camera = np.stack([np.cross(up, towards), up])
        np.testing.assert_allclose(pictures[pose, view], positions[pose] @ camera.T, atol=1e-12)


def test_image_axes_are_right_handed_with_the_viewer_in_front() -> None:
    frames, views = pair_frames(poses(9), PAIR), some_views(11)
    axes = image_axes(frames, views)
    right, up = np.moveaxis(axes, 1, -1)[..., 0, :], np.moveaxis(axes, 1, -1)[..., 1, :]
    towards = view_directions(frames[:, np.newaxis], views)
    np.testing.assert_allclose(np.cross(right, up), towards, atol=1e-12)
    np.testing.assert_allclose((right * up).sum(axis=-1), 0, atol=1e-12)


def test_an_annotation_is_its_pairs_picture_in_its_own_view_but_for_a_turn_in_the_image() -> None:
    positions, cameras = poses(12), Rotation.random(12, rng=8).as_matrix()
    seen = np.einsum("nai,nji->nja", cameras[:, :2], positions)
    views = view_angles(pair_frames(positions, PAIR), cameras[:, 2])
    for index in range(12):
        picture = project_to_views(positions[index : index + 1], views[[index]], PAIR)[0, 0]
        turn = np.linalg.lstsq(picture, seen[index], rcond=None)[0]
        np.testing.assert_allclose(picture @ turn, seen[index], atol=1e-10)
        np.testing.assert_allclose(turn @ turn.T, np.eye(2), atol=1e-10)
        assert np.linalg.det(turn) > 0  # no reflection


def test_pictures_change_smoothly_with_pose_and_view() -> None:
    positions, views = poses(4), some_views(5)
    change = np.random.default_rng(3).standard_normal(positions.shape)
    step = 1e-6
    there = project_to_views(positions + step * change, views + step, PAIR)
    gap = np.abs(there - project_to_views(positions, views, PAIR)).max()
    assert 0 < gap < 1e3 * step


def test_pictures_from_the_poles_are_orthonormal_too() -> None:
    positions = poses(3)
    for theta in (0.0, np.pi, 1e-9):
        axes = image_axes(pair_frames(positions, PAIR), np.array([[0.4, theta]]))[:, :, 0]
        product = np.swapaxes(axes, -1, -2) @ axes
        np.testing.assert_allclose(product, np.tile(np.eye(2), (3, 1, 1)), atol=1e-9)


def test_a_pose_has_the_same_pictures_in_any_company() -> None:
    positions, views = poses(8), some_views(6)
    together = project_to_views(positions, views, PAIR)
    for index in range(8):
        alone = project_to_views(positions[index : index + 1], views, PAIR)[0]
        np.testing.assert_array_equal(alone, together[index])


# Degenerate and wrong input.


def degenerate_poses() -> np.ndarray:
    """Roots coincide; backbones cancel; backbones along the line of the roots."""
    chest = [PAIR.index(f"person{p}:chest") for p in range(2)]
    root = list(PAIR.roots)
    positions = poses(3)
    positions[0, root[1]] = positions[0, root[0]]
    positions[1, chest[1]] = positions[1, root[1]] - 2 * (
        positions[1, chest[0]] - positions[1, root[0]]
    )
    line = positions[2, root[1]] - positions[2, root[0]]
    positions[2, chest] = positions[2, root] + line
    return positions


def test_degenerate_poses_are_known_and_stay_finite() -> None:
    frames = pair_frames(np.concatenate([poses(2), degenerate_poses()]), PAIR)
    assert frames_are_sound(frames).tolist() == [True, True, False, False, False]
    assert not frames_are_sound(np.full((3, 3), np.nan))
    assert np.isfinite(project_to_views(degenerate_poses(), some_views(9), PAIR)).all()
    with pytest.raises(ValueError, match=r"frames is degenerate at index 2, expected roots apart"):
        view_angles(frames, np.array([0.0, 0.0, 1.0]))


def test_wrong_input_is_refused_in_one_sentence() -> None:
    one = Skeleton.preset("person17")
    with pytest.raises(ValueError, match=r"has 1 character, expected at least two \(one person m"):
        pair_frames(np.zeros((17, 3)), one)
    chestless = Skeleton(["a:pelvis", "b:pelvis", "b:chest"], [-1, -1, 1])
    with pytest.raises(ValueError, match="skeleton has 0 chests in the tree of a:pelvis, expected"):
        pair_frames(np.zeros((3, 3)), chestless)
    with pytest.raises(ValueError, match=r"positions must have shape \(…, 34, 3\), got \(34, 2\)"):
        pair_frames(np.zeros((34, 2)), PAIR)
    frame = pair_frames(poses(1), PAIR)[0]
    with pytest.raises(ValueError, match="direction is no direction, expected a vector"):
        view_angles(frame, np.zeros(3))
    with pytest.raises(ValueError, match="views has 2 rows and none must be at least 1, got known"):
        ViewDistribution(np.full((2, 2), np.nan))
    with pytest.raises(
        ValueError, match=r"views has θ from -0\.1 to 0.5, expected it between 0 and"
    ):
        ViewDistribution(np.array([[0.0, 0.5], [0.0, -0.1]]))
    with pytest.raises(ValueError, match="bandwidth must be a finite number above 0, got 0"):
        ViewDistribution(np.zeros((1, 2)), bandwidth=0)


# The distribution of views, equation 5.


@pytest.mark.parametrize("bandwidth", [0.05, 0.5, 1.5, 4.0])
@pytest.mark.parametrize("theta", [0.0, 0.1, 1.4, np.pi])
def test_density_integrates_to_one(theta: float, bandwidth: float) -> None:
    distribution = ViewDistribution(np.array([[3.0, theta]]), bandwidth)
    phi, thetas = np.linspace(-np.pi, np.pi, 721), np.linspace(0, np.pi, 721)
    grid = np.stack(np.meshgrid(phi, thetas, indexing="ij"), axis=-1)
    density = np.exp(distribution.log_density(grid))
    total = integrate.simpson(integrate.simpson(density, x=thetas), x=phi)
    assert total == pytest.approx(1, abs=1e-5)


def test_density_far_from_poles_and_seam_is_the_plain_gaussian_mixture() -> None:
    centres = np.array([[0.2, 1.5], [-0.4, 1.7]])
    asked = np.array([[0.1, 1.4], [0.0, 1.6], [-0.6, 1.9]])
    wanted = np.mean(
        [stats.multivariate_normal(c, 0.15**2 * np.eye(2)).pdf(asked) for c in centres], axis=0
    )
    found = ViewDistribution(centres, 0.15).log_density(asked)
    np.testing.assert_allclose(np.exp(found), wanted, rtol=1e-9)


def test_density_knows_no_seam() -> None:
    distribution = ViewDistribution(np.array([[np.pi - 0.1, 1.0]]))
    asked = np.array([[np.pi - 0.1 + d, 1.0] for d in (-0.3, 0.3)])
    left, right = distribution.log_density(asked)
    assert left == pytest.approx(right)
    np.testing.assert_allclose(
        distribution.log_density(asked + np.array([2 * np.pi, 0])), [left, right], rtol=1e-12
    )
    assert distribution.log_density(np.array([0.0, -0.1])) == -np.inf


def test_density_does_not_depend_on_how_many_are_asked_for() -> None:
    distribution = ViewDistribution(some_views(3000))
    asked = some_views(800, seed=4)
    together = distribution.log_density(asked)
    np.testing.assert_array_equal(distribution.log_density(asked[700:]), together[700:])


@pytest.mark.parametrize("bandwidth", [0.5, 1.2])
def test_draws_follow_the_density(bandwidth: float) -> None:
    """χ² over a grid of cells, the cells' probabilities by integration."""
    views = np.array([[2.9, 0.15], [-1.0, 1.6], [0.3, 2.9]])
    distribution = ViewDistribution(views, bandwidth)
    n = 20_000
    draws = distribution.sample(np.random.default_rng(0), n)
    assert (np.abs(draws[:, 0]) <= np.pi).all()
    assert ((draws[:, 1] >= 0) & (draws[:, 1] <= np.pi)).all()
    edges = [np.linspace(-np.pi, np.pi, 9), np.linspace(0, np.pi, 7)]
    counts, *_ = np.histogramdd(draws, bins=edges)
    fine = [(np.arange(k) + 0.5) / k for k in (8 * 30, 6 * 30)]
    grid = np.stack(
        np.meshgrid(fine[0] * 2 * np.pi - np.pi, fine[1] * np.pi, indexing="ij"), axis=-1
    )
    density = np.exp(distribution.log_density(grid)).reshape(8, 30, 6, 30).mean(axis=(1, 3))
    expected = density / density.sum() * n
    assert stats.chisquare(counts.ravel(), expected.ravel()).pvalue > 1e-3


def test_views_that_are_unknown_are_never_drawn_and_never_near() -> None:
    views = some_views(50)
    views[::2] = np.nan
    distribution = ViewDistribution(views, 0.3)
    known = ViewDistribution(views[1::2], 0.3)
    asked = some_views(10, seed=7)
    np.testing.assert_allclose(distribution.log_density(asked), known.log_density(asked))
    np.testing.assert_array_equal(distribution.near(asked, 5), 2 * known.near(asked, 5) + 1)
    first, second = (d.sample(np.random.default_rng(0), 9) for d in (distribution, known))
    np.testing.assert_array_equal(first, second)


def test_near_is_brute_force() -> None:
    views, asked = some_views(400), some_views(30, seed=9)
    apart = angle(view_vectors(asked)[:, np.newaxis], view_vectors(views))
    near = ViewDistribution(views).near(asked, 12)
    np.testing.assert_array_equal(near, np.argsort(apart, axis=-1)[:, :12])


def test_near_annotations_of_one_view_come_by_index() -> None:
    views = np.tile([[0.3, 1.2]], (100, 1))
    near = ViewDistribution(views).near(np.array([[0.3, 1.2], [-2.0, 0.4]]), 7)
    np.testing.assert_array_equal(near, [range(7), range(7)])


def test_near_returns_all_where_there_are_fewer() -> None:
    distribution = ViewDistribution(np.array([[0.0, 1.0], [2.0, 1.0]]))
    near = distribution.near(np.array([[1.9, 1.0], [0.1, 1.1]]), 32)
    np.testing.assert_array_equal(near, [[1, 0], [0, 1]])
    one = ViewDistribution(np.array([[0.0, 1.0]]))
    np.testing.assert_array_equal(one.near(some_views(3), 32), [[0]] * 3)
