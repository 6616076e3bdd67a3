"""Views in local frames: equations, projections and the distribution of views."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate, stats

from probmotion import Skeleton
from probmotion.interaction.annotations import views as module
from probmotion.interaction.annotations.local_frames import local_frames, pair_frames, valid_frames
from probmotion.interaction.annotations.views import (
    ViewDistribution,
    image_axes,
    project_to_views,
    view_angles,
    view_vectors,
)

PAIR = Skeleton.preset("pair17")


def poses(n, seed=0):
    return np.random.default_rng(seed).standard_normal((n, PAIR.n_joints, 3))


def random_views(n, seed=1):
    rng = np.random.default_rng(seed)
    return np.stack([rng.uniform(-np.pi, np.pi, n), np.arccos(rng.uniform(-1, 1, n))], axis=-1)


def angle(a, b):
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(axis=-1))


def test_frame_of_three_people_sums_unit_backbones():
    roots, backbones = np.random.default_rng(0).standard_normal((2, 3, 3))
    i, j, k = local_frames(roots, backbones).T
    assert angle(i, roots[1] - roots[0]) < 1e-7
    units = backbones / np.linalg.norm(backbones, axis=-1, keepdims=True)
    assert angle(j, units.sum(axis=0)) < 1e-7
    np.testing.assert_allclose(k, np.cross(i, j))


def test_view_angles_equal_the_definition():
    """The definition is [i j k](a, b, c) = d, here solved for one pair and direction at a time."""
    frames = pair_frames(poses(20), PAIR)
    directions = np.random.default_rng(5).standard_normal((20, 3))
    views = view_angles(frames, directions)
    for frame, direction, (phi, theta) in zip(frames, directions, views, strict=True):
        a, b, c = np.linalg.inv(frame) @ direction
        assert phi == pytest.approx(np.arctan2(c, a))
        assert theta == pytest.approx(np.arccos(b / np.sqrt(a**2 + b**2 + c**2)))


def test_projections_equal_those_of_an_explicit_camera():
    positions, views = poses(5), random_views(7)
    projections = project_to_views(positions, views, PAIR)
    frames = pair_frames(positions, PAIR)
    for pose, view in np.ndindex(5, 7):
        phi, theta = views[view]
        local = [np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)]
        towards = frames[pose] @ local
        towards /= np.linalg.norm(towards)
        up = frames[pose][:, 1] - (frames[pose][:, 1] @ towards) * towards
        up /= np.linalg.norm(up)
        camera = np.stack([np.cross(up, towards), up])
        np.testing.assert_allclose(projections[pose, view], positions[pose] @ camera.T, atol=1e-12)
    for pose in range(5):  # bit-identical for any batch
        single = project_to_views(positions[pose : pose + 1], views, PAIR)[0]
        np.testing.assert_array_equal(single, projections[pose])


def test_image_axes_are_orthonormal_at_the_poles():
    views = np.array([[0.4, theta] for theta in (0.0, np.pi, 1e-9, 1.0)])
    axes = np.moveaxis(image_axes(pair_frames(poses(3), PAIR), views), 2, 1)
    products = np.swapaxes(axes, -1, -2) @ axes
    np.testing.assert_allclose(products, np.broadcast_to(np.eye(2), products.shape), atol=1e-9)


def test_degenerate_poses_are_detected_and_have_finite_projections():
    """Roots coincide, backbones cancel, or backbones are parallel to the line between roots."""
    chest, root = [PAIR.index(f"person{p}:chest") for p in range(2)], list(PAIR.roots)
    positions = poses(5)
    positions[2, root[1]] = positions[2, root[0]]
    backbone = positions[3, chest[0]] - positions[3, root[0]]
    positions[3, chest[1]] = positions[3, root[1]] - 2 * backbone
    positions[4, chest] = positions[4, root] + positions[4, root[1]] - positions[4, root[0]]
    frames = pair_frames(positions, PAIR)
    assert valid_frames(frames).tolist() == [True, True, False, False, False]
    assert not valid_frames(np.full((3, 3), np.nan))
    assert np.isfinite(project_to_views(positions, random_views(9), PAIR)).all()
    with pytest.raises(ValueError, match=r"frames must be non-degenerate, got .* at index \[2\]"):
        view_angles(frames, np.array([0.0, 0.0, 1.0]))


CHESTLESS = Skeleton(["a:pelvis", "b:pelvis", "b:chest"], [-1, -1, 1])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: pair_frames(np.zeros((3, 3)), CHESTLESS), "got 0 in the tree of a:pelvis"),
        (lambda: view_angles(np.eye(3), np.zeros(3)), "direction must be finite and nonzero"),
        (lambda: ViewDistribution(np.full((2, 2), np.nan)), "at least one known view, got none"),
        (lambda: ViewDistribution(np.array([[0.0, -0.1]])), r"θ from 0 to π, got -0\.1 to -0\.1"),
        (lambda: ViewDistribution(np.zeros((1, 2)), bandwidth=0), "bandwidth must be a finite"),
    ],
)
def test_invalid_arguments_are_rejected(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize(
    ("theta", "bandwidth"), [(0.0, 0.05), (0.1, 1.5), (1.4, 4.0), (np.pi, 0.5)]
)
def test_density_integrates_to_one(theta, bandwidth):
    distribution = ViewDistribution(np.array([[3.0, theta]]), bandwidth)
    phi, thetas = np.linspace(-np.pi, np.pi, 721), np.linspace(0, np.pi, 721)
    grid = np.stack(np.meshgrid(phi, thetas, indexing="ij"), axis=-1)
    density = np.exp(distribution.log_density(grid))
    total = integrate.simpson(integrate.simpson(density, x=thetas), x=phi)
    assert total == pytest.approx(1, abs=1e-5)


def test_density_is_a_gaussian_mixture_far_from_the_poles():
    centres = np.array([[0.2, 1.5], [-0.4, 1.7]])
    queries = np.array([[0.1, 1.4], [0.0, 1.6], [-0.6, 1.9]])
    expected = np.mean(
        [stats.multivariate_normal(c, 0.15**2 * np.eye(2)).pdf(queries) for c in centres], axis=0
    )
    log_density = ViewDistribution(centres, 0.15).log_density(queries)
    np.testing.assert_allclose(np.exp(log_density), expected, rtol=1e-9)


def test_density_is_periodic():
    distribution = ViewDistribution(np.array([[np.pi - 0.1, 1.0]]))
    queries = np.array([[np.pi - 0.4, 1.0], [np.pi + 0.2, 1.0], [-np.pi + 0.2, 1.0]])
    densities = distribution.log_density(queries)
    np.testing.assert_allclose(densities, densities[0], rtol=1e-12)
    assert distribution.log_density(np.array([0.0, -0.1])) == -np.inf


def test_density_is_bit_identical_for_any_block_size(monkeypatch):
    distribution, queries = ViewDistribution(random_views(300)), random_views(80, seed=4)
    batch = distribution.log_density(queries)
    monkeypatch.setattr(module, "_MAX_ELEMENTS", 10 * 300)
    np.testing.assert_array_equal(distribution.log_density(queries), batch)


def test_samples_follow_the_density():
    """A χ² test compares the draws with the density on a grid."""
    views = np.array([[2.9, 0.15], [-1.0, 1.6], [0.3, 2.9]])
    distribution, n = ViewDistribution(views, 1.2), 20_000
    draws = distribution.sample(np.random.default_rng(0), n)
    edges = [np.linspace(-np.pi, np.pi, 9), np.linspace(0, np.pi, 7)]
    counts, *_ = np.histogramdd(draws, bins=edges)
    assert counts.sum() == n  # all in range
    phi, theta = ((np.arange(k) + 0.5) / k for k in (8 * 30, 6 * 30))
    grid = np.stack(np.meshgrid(2 * np.pi * phi - np.pi, np.pi * theta, indexing="ij"), axis=-1)
    density = np.exp(distribution.log_density(grid)).reshape(8, 30, 6, 30).mean(axis=(1, 3))
    expected = density / density.sum() * n
    assert stats.chisquare(counts.ravel(), expected.ravel()).pvalue > 1e-3


def test_unknown_views_are_ignored():
    views = random_views(50)
    views[::2] = np.nan
    distribution, known = ViewDistribution(views, 0.3), ViewDistribution(views[1::2], 0.3)
    queries = random_views(10, seed=7)
    np.testing.assert_allclose(distribution.log_density(queries), known.log_density(queries))
    np.testing.assert_array_equal(distribution.near(queries, 5), 2 * known.near(queries, 5) + 1)
    first, second = (d.sample(np.random.default_rng(0), 9) for d in (distribution, known))
    np.testing.assert_array_equal(first, second)


def test_near_equals_brute_force():
    views, queries = random_views(400), random_views(30, seed=9)
    angles = angle(view_vectors(queries)[:, np.newaxis], view_vectors(views))
    for n in (12, 500):
        near = ViewDistribution(views).near(queries, n)
        np.testing.assert_array_equal(near, np.argsort(angles, axis=-1)[:, :n])


def test_near_breaks_ties_by_index():
    views = np.tile([[0.3, 1.2]], (100, 1))
    near = ViewDistribution(views).near(np.array([[0.3, 1.2], [-2.0, 0.4]]), 7)
    np.testing.assert_array_equal(near, [range(7), range(7)])
