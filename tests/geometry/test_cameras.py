"""Cameras: what they see, from where, and what they refuse."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from probmotion import Cameras


def yaw(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def points(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((*shape, 3))


def by_definition(cameras: Cameras, world: np.ndarray) -> np.ndarray:
    """x = f (X, Y) / Z + c (orthographic: without the Z) for (X, Y, Z) = R X + t, one by one."""
    assert cameras.centre is not None
    frames, joints = world.shape[:2]
    image = np.zeros((cameras.n_views, frames, joints, 2))
    for view, frame, joint in np.ndindex(image.shape[:3]):
        x, y, z = cameras.rotation[view] @ world[frame, joint] + cameras.translation[view]
        depth = 1.0 if cameras.orthographic else z
        image[view, frame, joint] = cameras.focal[view] * np.array([x, y]) / depth
        image[view, frame, joint] += cameras.centre[view]
    return image


def odd_cameras(orthographic: bool) -> Cameras:
    """Three cameras that have nothing in common."""
    rng = np.random.default_rng(4)
    return Cameras(
        Rotation.random(3, rng=4).as_matrix(),
        np.array([0.0, 0.0, 20.0]) + rng.standard_normal((3, 3)),
        rng.uniform(0.5, 1000.0, 3) if not orthographic else rng.uniform(0.5, 2.0, 3),
        rng.uniform(-50, 50, (3, 2)),
        orthographic,
    )


@pytest.mark.parametrize("orthographic", [True, False])
def test_projection_is_the_definition_in_every_library(library: Any, orthographic: bool) -> None:
    cameras = odd_cameras(orthographic)
    world = points(2, 4, 5)
    image = library.compiled(cameras.project)(library.array(world))
    assert image.shape == (2, 3, 4, 5, 2)
    size = float(np.abs(np.asarray(image)).max())
    for batch in range(2):
        library.assert_close(image[batch, ...] / size, by_definition(cameras, world[batch]) / size)


def test_depth_is_the_third_coordinate(library: Any) -> None:
    cameras = odd_cameras(orthographic=False)
    world = points(4, 5)
    wanted = np.einsum("vi,lji->vlj", cameras.rotation[:, 2], world)
    wanted += cameras.translation[:, 2, None, None]
    library.assert_close(cameras.depth(library.array(world)) / 20, wanted / 20)


@pytest.mark.parametrize("orthographic", [True, False])
def test_empty_batches_stay_empty(library: Any, orthographic: bool) -> None:
    cameras = Cameras.ring(3, perspective=not orthographic)
    for shape in ((0, 4, 5, 3), (0, 5, 3), (2, 4, 0, 3)):
        image = cameras.project(library.array(np.zeros(shape)))
        assert image.shape == (*shape[:-3], 3, *shape[-3:-1], 2)


def test_projection_is_differentiable(differentiable: Any) -> None:
    for cameras in (odd_cameras(True), Cameras.ring(2, perspective=True, elevation=0.3)):
        world = points(2, 3)
        gradient = differentiable.gradient(
            lambda x, cameras=cameras: (cameras.project(x) ** 2).sum(), world
        )
        direction = points(2, 3, seed=1)
        step = 1e-6
        ahead, behind = (
            (cameras.project(world + sign * step * direction) ** 2).sum() for sign in (1, -1)
        )
        assert (gradient * direction).sum() == pytest.approx(
            (ahead - behind) / (2 * step), rel=1e-6
        )


# MAS, appendix C.


@given(st.integers(1, 8), st.floats(-1.5, 1.5), st.floats(-3, 3))
def test_orthographic_views_of_standard_noise_are_standard_noise(
    n_views: int, elevation: float, start: float
) -> None:
    """Cov(P ε) = P Pᵀ = I₂ in every view, for ε ~ N(0, I₃)."""
    axes = Cameras.ring(n_views, elevation=elevation, start=start).image_axes
    covariance = axes @ np.swapaxes(axes, -1, -2)
    np.testing.assert_allclose(covariance, np.tile(np.eye(2), (n_views, 1, 1)), atol=1e-14)


@given(
    arrays(np.float64, 3, elements=st.floats(-1, 1)),
    st.floats(1.5, 100),
    st.floats(-1.5, 1.5),
    st.floats(-3, 3),
)
def test_orthographic_and_perspective_views_differ_by_one_over_distance(
    point: np.ndarray, distance: float, elevation: float, start: float
) -> None:
    """|p_orth(X) − p_persp(X)| ≤ 1/(d − 1) for ‖X‖ ≤ 1."""
    point = point / max(1.0, float(np.linalg.norm(point)))
    placed = {"elevation": elevation, "start": start, "distance": distance}
    perspective = Cameras.ring(3, perspective=True, **placed)
    flat = Cameras.ring(3, **placed).project(point[None, None])
    gap = np.linalg.norm(flat - perspective.project(point[None, None]), axis=-1)
    assert gap.max() <= 1 / (distance - 1) + 1e-12
    np.testing.assert_allclose(perspective.as_orthographic().project(point[None, None]), flat)


def test_the_bound_is_of_the_right_size() -> None:
    """At d = 2 the farthest point of the unit ball is off by 0.4 of it."""
    cameras = Cameras.ring(1, distance=2.0)
    along = np.linspace(0, np.pi, 400)
    circle = np.stack([np.sin(along), 0 * along, np.cos(along)], axis=-1)[None]
    near = Cameras.ring(1, distance=2.0, perspective=True)
    gap = np.linalg.norm(cameras.project(circle) - near.project(circle), axis=-1)
    assert gap.max() > 0.4


# Where the cameras of a ring stand.


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-1.4, 1.4), st.booleans())
def test_turning_the_world_is_turning_the_camera_back(
    azimuth: float, psi: float, elevation: float, perspective: bool
) -> None:
    """A camera at azimuth φ sees R_y(ψ) X as camera 0 sees R_y(ψ − φ) X."""
    world = points(1, 6)
    placed = {"elevation": elevation, "perspective": perspective, "distance": 9.0}
    there = Cameras.ring(1, start=azimuth, **placed).project(world @ yaw(psi).T)
    front = Cameras.ring(1, **placed).project(world @ yaw(psi - azimuth).T)
    np.testing.assert_allclose(there, front, atol=1e-12)


def test_the_first_camera_stands_on_the_z_axis_and_sees_x_to_the_right_and_y_up() -> None:
    cameras = Cameras.ring(4, distance=7.0)
    centres = -np.swapaxes(cameras.rotation, -1, -2) @ cameras.translation[..., None]
    wanted = 7.0 * np.array([[0, 0, 1], [1, 0, 0], [0, 0, -1], [-1, 0, 0]])
    np.testing.assert_allclose(centres[..., 0], wanted, atol=1e-14)
    image = cameras.project(np.eye(3)[None])[0, 0]
    np.testing.assert_allclose(image, [[1, 0], [0, -1], [0, 0]], atol=1e-15)  # y is down
    raised = Cameras.ring(5, elevation=0.3, start=0.2)
    np.testing.assert_allclose(raised.elevation, 0.3)
    np.testing.assert_allclose(np.diff(np.unwrap(raised.azimuth)), 2 * np.pi / 5)
    assert raised.azimuth[0] == pytest.approx(0.2)
    above = -np.swapaxes(raised.rotation, -1, -2) @ raised.translation[..., None]
    np.testing.assert_allclose(above[:, 1, 0], 7 * np.sin(0.3))


@pytest.mark.parametrize("perspective", [True, False])
def test_every_camera_of_a_ring_looks_at_the_origin(perspective: bool) -> None:
    cameras = Cameras.ring(6, elevation=0.4, perspective=perspective)
    np.testing.assert_allclose(cameras.project(np.zeros((1, 1, 3))), 0, atol=1e-15)
    np.testing.assert_allclose(cameras.depth(np.zeros((1, 1, 3))), 7.0)
    assert cameras.upright
    assert not odd_cameras(True).upright


def test_one_view_is_that_camera() -> None:
    cameras = odd_cameras(False)
    world = points(2, 3)
    together = cameras.project(world)
    for index in (0, 1, 2, -1):
        np.testing.assert_array_equal(cameras.view(index).project(world)[0], together[index])
    assert [cameras.view(i).n_views for i in (0, -1)] == [1, 1]


def test_linear_form_of_orthographic_cameras() -> None:
    cameras = odd_cameras(True)
    world = points(2, 3)
    by_axes = np.einsum("vai,lji->vlja", cameras.image_axes, world)
    np.testing.assert_allclose(
        cameras.project(world), by_axes + cameras.offset[:, None, None], atol=1e-13
    )


# What is refused.


def test_a_camera_inside_or_behind_the_motion_is_refused(library: Any) -> None:
    cameras = Cameras.ring(2, distance=2.0, perspective=True)
    world = np.zeros((3, 4, 3))
    for behind in (2.0, 2.5):
        world[1, 2, 2] = -behind
        with pytest.raises(ValueError, match=r"points has a joint .* m in front of camera 1, exp"):
            cameras.project(library.array(world))
    world[1, 2, 2] = -1.9
    assert np.isfinite(np.asarray(cameras.project(library.array(world)))).all()
    world[1, 2, 2] = -5.0
    Cameras.ring(2, distance=2.0).project(library.array(world))  # no depth, no matter


def test_wrong_cameras_are_refused_in_one_sentence() -> None:
    eye, zero, one = np.eye(3)[None], np.zeros((1, 3)), np.ones(1)
    with pytest.raises(ValueError, match=r"rotation must have shape \(V, 3, 3\), got \(3, 3\)"):
        Cameras(np.eye(3), zero, one)
    with pytest.raises(ValueError, match="rotation has no camera, expected at least one"):
        Cameras(np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0))
    with pytest.raises(ValueError, match=r"translation must have shape \(1, 3\), got \(2, 3\)"):
        Cameras(eye, np.zeros((2, 3)), one)
    with pytest.raises(ValueError, match=r"focal must have shape \(1\), got \(2,\)"):
        Cameras(eye, zero, np.ones(2))
    with pytest.raises(ValueError, match=r"centre must have shape \(1, 2\), got \(1, 3\)"):
        Cameras(eye, zero, one, np.zeros((1, 3)))
    for focal in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match=r"focal is .*expected a finite number above 0"):
            Cameras(eye, zero, np.array([focal]))
    for name, broken in (
        ("rotation", (np.nan * eye, zero, one)),
        ("translation", (eye, np.inf * np.ones((1, 3)), one)),
        ("centre", (eye, zero, one, np.full((1, 2), np.nan))),
    ):
        with pytest.raises(ValueError, match=f"{name} has . values that are NaN or infinite"):
            Cameras(*broken)
    for bad in (2 * eye, -eye, eye + 1e-3):
        with pytest.raises(
            ValueError, match=r"rotation (is off an orthonormal matrix by|has a reflection)"
        ):
            Cameras(bad, zero, one)
    for distance in (0.0, -7.0, np.nan):
        with pytest.raises(ValueError, match=r"distance is .*expected a finite number above 0"):
            Cameras.ring(2, distance=distance)
    for count in (0, -1, 2.0, True):
        with pytest.raises(ValueError, match=r"n_views is .*expected an integer of at least 1"):
            Cameras.ring(count)  # type: ignore[arg-type]


def test_points_of_the_wrong_shape_are_refused() -> None:
    for shape in ((5, 2), (3,), (4, 5)):
        with pytest.raises(ValueError, match=r"points has shape .*expected \(…, L, J, 3\)"):
            Cameras.ring(1).project(np.zeros(shape))


def test_farther_cameras_are_nearer_to_orthographic() -> None:
    world = points(1, 8) / 4
    flat = Cameras.ring(1).project(world)
    gaps = [
        np.abs(Cameras.ring(1, distance=d, perspective=True).project(world) - flat).max()
        for d in (4.0, 8.0, 16.0, 32.0)
    ]
    for gap, next_gap in pairwise(gaps):
        assert next_gap == pytest.approx(gap / 2, rel=0.3)
