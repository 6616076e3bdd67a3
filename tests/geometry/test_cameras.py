"""Cameras: projection, placement and validation."""

import numpy as np
import pytest
from hypothesis import given, strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from probmotion import Cameras


def points(*shape, seed=0):
    return np.random.default_rng(seed).standard_normal((*shape, 3))


def projected(cameras, world):
    """Return f (X, Y) / Z + c (orthographic: without Z), with (X, Y, Z) = R X + t, per point."""
    frames, joints = world.shape[:2]
    image = np.zeros((cameras.n_views, frames, joints, 2))
    for view, frame, joint in np.ndindex(image.shape[:3]):
        x, y, z = cameras.rotation[view] @ world[frame, joint] + cameras.translation[view]
        depth = 1.0 if cameras.orthographic else z
        image[view, frame, joint] = cameras.focal[view] * np.array([x, y]) / depth
        image[view, frame, joint] += cameras.centre[view]
    return image


def random_cameras(orthographic):
    rng = np.random.default_rng(4)
    return Cameras(
        Rotation.random(3, rng=4).as_matrix(),
        np.array([0.0, 0.0, 20.0]) + rng.standard_normal((3, 3)),
        rng.uniform(0.5, 2.0 if orthographic else 1000.0, 3),
        rng.uniform(-50, 50, (3, 2)),
        orthographic,
    )


@pytest.mark.parametrize("orthographic", [True, False])
def test_projection_agrees_with_its_definition(library, orthographic):
    cameras = random_cameras(orthographic)
    world = points(2, 4, 5)
    image = library.compiled(cameras.project)(library.array(world))
    assert image.shape == (2, 3, 4, 5, 2)
    size = float(np.abs(np.asarray(image)).max())
    for batch in range(2):
        library.assert_close(image[batch, ...] / size, projected(cameras, world[batch]) / size)
    assert cameras.project(np.zeros((2, 4, 0, 3))).shape == (2, 3, 4, 0, 2)
    assert cameras.project(np.zeros((0, 5, 3))).shape == (3, 0, 5, 2)


@given(st.integers(1, 8), st.floats(-1.5, 1.5), st.floats(-3, 3))
def test_orthographic_projection_preserves_standard_noise(n_views, elevation, start):
    """Cov(P ε) = P Pᵀ = I₂ in every view, for ε ~ N(0, I₃) (MAS, appendix C)."""
    axes = Cameras.ring(n_views, elevation=elevation, start=start).image_axes
    covariance = axes @ np.swapaxes(axes, -1, -2)
    np.testing.assert_allclose(covariance, np.tile(np.eye(2), (n_views, 1, 1)), atol=1e-14)


@given(
    arrays(np.float64, 3, elements=st.floats(-1, 1)),
    st.floats(1.5, 100),
    st.floats(-1.5, 1.5),
    st.floats(-3, 3),
)
def test_perspective_differs_from_orthographic_by_at_most_one_over_distance(
    point, distance, elevation, start
):
    """|p_orth(X) − p_persp(X)| ≤ 1/(d − 1) for ‖X‖ ≤ 1 (MAS, appendix C)."""
    point = point / max(1.0, float(np.linalg.norm(point)))
    placement = {"elevation": elevation, "start": start, "distance": distance}
    perspective = Cameras.ring(3, perspective=True, **placement)
    flat = Cameras.ring(3, **placement).project(point[None, None])
    gap = np.linalg.norm(flat - perspective.project(point[None, None]), axis=-1)
    assert gap.max() <= 1 / (distance - 1) + 1e-12
    np.testing.assert_allclose(perspective.as_orthographic().project(point[None, None]), flat)


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-1.4, 1.4), st.booleans())
def test_rotating_the_world_equals_moving_the_camera(azimuth, psi, elevation, perspective):
    """A camera at azimuth φ projects R_y(ψ) X as camera 0 projects R_y(ψ − φ) X."""

    def yaw(angle):
        return Rotation.from_rotvec([0, angle, 0]).as_matrix()

    world = points(1, 6)
    placement = {"elevation": elevation, "perspective": perspective, "distance": 9.0}
    from_side = Cameras.ring(1, start=azimuth, **placement).project(world @ yaw(psi).T)
    from_front = Cameras.ring(1, **placement).project(world @ yaw(psi - azimuth).T)
    np.testing.assert_allclose(from_side, from_front, atol=1e-12)


def test_ring_placement_and_image_axes():
    cameras = Cameras.ring(4, distance=7.0)
    centres = -np.swapaxes(cameras.rotation, -1, -2) @ cameras.translation[..., None]
    expected = 7.0 * np.array([[0, 0, 1], [1, 0, 0], [0, 0, -1], [-1, 0, 0]])
    np.testing.assert_allclose(centres[..., 0], expected, atol=1e-14)
    image = cameras.project(np.eye(3)[None])[0, 0]
    np.testing.assert_allclose(image, [[1, 0], [0, -1], [0, 0]], atol=1e-15)  # y is down
    for perspective in (True, False):
        raised = Cameras.ring(5, elevation=0.3, start=0.2, perspective=perspective)
        np.testing.assert_allclose(raised.elevation, 0.3)
        np.testing.assert_allclose(np.unwrap(raised.azimuth), 0.2 + 2 * np.pi / 5 * np.arange(5))
        above = -np.swapaxes(raised.rotation, -1, -2) @ raised.translation[..., None]
        np.testing.assert_allclose(above[:, 1, 0], 7 * np.sin(0.3))
        origin = np.zeros((1, 1, 3))
        np.testing.assert_allclose(raised.project(origin), 0, atol=1e-15)
        np.testing.assert_allclose(raised.depth(origin), 7.0)


def test_view_selects_one_camera():
    cameras = random_cameras(False)
    world = points(2, 3)
    for index in (0, 1, 2, -1):
        one = cameras.view(index).project(world)
        np.testing.assert_array_equal(one, cameras.project(world)[index][None])


def test_points_behind_a_perspective_camera_are_refused(library):
    cameras = Cameras.ring(2, distance=2.0, perspective=True)
    world = np.zeros((3, 4, 3))
    for behind in (2.0, 2.5):
        world[1, 2, 2] = -behind
        with pytest.raises(ValueError, match=r"points must be in front .* in camera 1"):
            cameras.project(library.array(world))
    world[1, 2, 2] = -1.9
    assert np.isfinite(np.asarray(cameras.project(library.array(world)))).all()
    world[1, 2, 2] = -5.0
    Cameras.ring(2, distance=2.0).project(library.array(world))  # orthographic: no error


EYE, ZERO, ONE = np.eye(3)[None], np.zeros((1, 3)), np.ones(1)
POSITIVE, ORTHONORMAL = "must be a finite number above 0, got", "rotation must be orthonormal to"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((np.eye(3), ZERO, ONE), r"rotation must have shape \(V, 3, 3\), got \(3, 3\)"),
        ((np.zeros((0, 3, 3)), ZERO[:0], ONE[:0]), "rotation must contain at least one camera"),
        ((EYE, np.zeros((2, 3)), ONE), r"translation must have shape \(1, 3\), got \(2, 3\)"),
        ((EYE, ZERO, np.ones(2)), r"focal must have shape \(1\), got \(2,\)"),
        ((EYE, ZERO, ONE, ZERO), r"centre must have shape \(1, 2\), got \(1, 3\)"),
        ((EYE, ZERO, np.zeros(1)), f"focal {POSITIVE} 0.0"),
        ((EYE, ZERO, np.full(1, np.inf)), f"focal {POSITIVE} inf"),
        ((np.nan * EYE, ZERO, ONE), "rotation must be finite, got 9 values"),
        ((EYE, ZERO + np.inf, ONE), "translation must be finite, got 3 values"),
        ((EYE, ZERO, ONE, np.full((1, 2), np.nan)), "centre must be finite, got 2 values"),
        ((2 * EYE, ZERO, ONE), ORTHONORMAL),
        ((EYE + 1e-3, ZERO, ONE), ORTHONORMAL),
        ((-EYE, ZERO, ONE), "rotation must have determinant 1, got a reflection"),
    ],
)
def test_invalid_cameras_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Cameras(*arguments)


def test_invalid_ring_and_points_are_refused():
    for distance in (0.0, -7.0, np.nan):
        with pytest.raises(ValueError, match=f"distance {POSITIVE}"):
            Cameras.ring(2, distance=distance)
    with pytest.raises(ValueError, match="n_views must be an integer of at least 1, got 0"):
        Cameras.ring(0)
    for shape in ((5, 2), (3,), (4, 5)):
        with pytest.raises(ValueError, match=r"points must have shape \(…, L, J, 3\), got"):
            Cameras.ring(1).project(np.zeros(shape))
