"""Rotations against SciPy, group axioms and edge cases."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from probmotion.geometry import rotations as r

ORDERS = ["".join(o) for o in product("XYZ", repeat=3) if o[0] != o[1] and o[1] != o[2]]


def rotation_vectors():
    """Return rotation vectors with angles from 0 to π, including very small ones."""
    rng = np.random.default_rng(3)
    axes = rng.standard_normal((60, 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    axes[:6] = np.concatenate([np.eye(3), -np.eye(3)])
    sizes = [0.0, 1e-30, 1e-12, 1e-8, 9.9e-4, 1.01e-3, 0.1, 1.0, 3.0]
    half_turns = [np.pi - gap for gap in (1e-3, 1e-6, 1e-9, 0.0)]
    return np.concatenate([size * axes for size in sizes + half_turns])


VECTORS = rotation_vectors()
ORACLE = Rotation.from_rotvec(VECTORS)


def test_conversions_agree_with_scipy(library):
    vectors, matrices = library.array(VECTORS), library.array(ORACLE.as_matrix())
    quaternions = library.array(ORACLE.as_quat(scalar_first=True))
    run = library.compiled
    library.assert_close(run(r.vector_to_matrix)(vectors), ORACLE.as_matrix())
    library.assert_close(run(r.quaternion_to_matrix)(3.0 * quaternions), ORACLE.as_matrix())
    six_d = run(r.matrix_to_rotation_6d)(matrices)
    np.testing.assert_allclose(
        np.asarray(six_d), np.asarray(matrices)[..., :2].swapaxes(-1, -2).reshape(-1, 6)
    )
    library.assert_close(run(r.rotation_6d_to_matrix)(2.0 * six_d), ORACLE.as_matrix())
    # Products of entries are equal for q and −q.
    expected = ORACLE.as_quat(scalar_first=True)
    expected = expected[..., :, None] * expected[..., None, :]
    for got in (run(r.vector_to_quaternion)(vectors), run(r.matrix_to_quaternion)(matrices)):
        library.assert_close(got[..., :, None] * got[..., None, :], expected)
    # At half a turn both signs of the vector are correct.
    short = np.linalg.norm(VECTORS, axis=-1) < 3.1
    for got in (run(r.matrix_to_vector)(matrices), run(r.quaternion_to_vector)(-2 * quaternions)):
        np.testing.assert_allclose(
            np.asarray(got)[short], VECTORS[short], rtol=0, atol=library.tolerance
        )
        library.assert_close(run(r.vector_to_matrix)(got), ORACLE.as_matrix())
        assert np.linalg.norm(np.asarray(got), axis=-1).max() <= np.pi * (1 + 1e-6)


def test_small_angles_are_exact_to_double_precision():
    np.testing.assert_allclose(r.vector_to_matrix(VECTORS), ORACLE.as_matrix(), rtol=0, atol=2e-15)
    recovered = r.quaternion_to_vector(r.vector_to_quaternion(VECTORS))
    short = np.linalg.norm(VECTORS, axis=-1) < 3.1
    np.testing.assert_allclose(recovered[short], VECTORS[short], rtol=1e-14, atol=0)


def euler_samples(order):
    rng = np.random.default_rng(5)
    angles = rng.uniform(-1.4, 1.4, (40, 3))
    if order[0] == order[2]:
        angles[:, 1] = rng.uniform(0.1, 3.0, 40)
    return angles, Rotation.from_euler(order, angles).as_matrix()


@pytest.mark.parametrize("order", ORDERS)
def test_euler_angles_agree_with_scipy(order):
    angles, matrices = euler_samples(order)
    np.testing.assert_allclose(r.euler_to_matrix(angles, order), matrices, rtol=0, atol=1e-12)
    wanted = Rotation.from_matrix(matrices).as_euler(order)
    np.testing.assert_allclose(r.matrix_to_euler(matrices, order), wanted, rtol=0, atol=1e-12)


@pytest.mark.parametrize("order", ["ZXY", "XYX"])
def test_euler_angles_agree_between_libraries(library, order):
    angles, matrices = euler_samples(order)
    library.assert_close(r.euler_to_matrix(library.array(angles), order), matrices)
    run = library.compiled(lambda m: r.matrix_to_euler(m, order))
    library.assert_close(run(library.array(matrices)), angles)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("gap", [0.0, 1e-12, 1e-9, 1e-5])
def test_euler_angles_round_trip_at_gimbal_lock(order, gap):
    locks = [0.0, np.pi] if order[0] == order[2] else [np.pi / 2, -np.pi / 2]
    rng = np.random.default_rng(6)
    angles = rng.uniform(-3, 3, (20, 3))
    for lock in locks:
        angles[:, 1] = lock - gap * np.sign(lock - 1e-3)
        matrices = r.euler_to_matrix(angles, order)
        back = r.euler_to_matrix(r.matrix_to_euler(matrices, order), order)
        np.testing.assert_allclose(back, matrices, rtol=0, atol=1e-14)
        if gap == 0.0 and lock == 0.0:
            assert (r.matrix_to_euler(matrices, order)[:, 0] == 0).all()


def test_invalid_orders_and_shapes_are_refused():
    for order in ("XXY", "ZYY", "XY", "XYZX", "XYW", ""):
        with pytest.raises(ValueError, match=r"order must be three of X, Y and Z .*, got"):
            r.euler_to_matrix(np.zeros(3), order)
    with pytest.raises(ValueError, match=r"vector must have shape \(…, 3\), got \(4,\)"):
        r.vector_to_matrix(np.zeros(4))
    with pytest.raises(ValueError, match=r"matrix must have shape \(…, 3, 3\), got \(3, 2\)"):
        r.matrix_to_quaternion(np.zeros((3, 2)))
    with pytest.raises(ValueError, match=r"second must have shape \(…, 4\), got \(3,\)"):
        r.quaternion_product(np.ones(4), np.ones(3))


@pytest.mark.parametrize("form", ["matrix", "quaternion"])
def test_round_trip_has_identity_gradient(differentiable, form):
    sizes = np.array([0.0, 1e-20, 1e-9, 9.99e-4, 1.001e-3, 0.5, 3.0, np.pi - 1e-5])
    vectors = np.broadcast_to(sizes[:, None, None] * np.array([0.48, -0.6, 0.64]), (8, 3, 3))
    forward = getattr(r, f"vector_to_{form}")
    inverse = getattr(r, f"{form}_to_vector")
    weights = differentiable.array(np.eye(3))
    gradient = differentiable.gradient(lambda v: (weights * inverse(forward(v))).sum(), vectors)
    np.testing.assert_allclose(gradient, np.tile(np.eye(3), (8, 1, 1)), rtol=0, atol=1e-8)


def test_gradients_are_finite_at_singularities(differentiable):
    half_turn = np.diag([1.0, -1.0, -1.0])
    locked = r.euler_to_matrix(np.array([0.3, np.pi / 2, 0.2]), "XYZ")
    eye = differentiable.array(np.eye(3))

    def sum_of_outputs(m):
        return (
            r.matrix_to_vector(m).sum()
            + r.matrix_to_euler(m, "XYZ").sum()
            + r.matrix_to_euler(m, "XYX").sum()
            + r.geodesic_angle(eye, m).sum()
        )

    at = np.stack([np.eye(3), half_turn, locked])
    assert np.isfinite(differentiable.gradient(sum_of_outputs, at)).all()


def test_empty_batches_yield_empty_results():
    empty = np.zeros((0, 3, 3))
    assert r.vector_to_matrix(empty[:, 0]).shape == (0, 3, 3)
    assert r.vector_to_quaternion(np.zeros((2, 0, 3))).shape == (2, 0, 4)
    assert r.rotation_6d_to_matrix(np.zeros((0, 6))).shape == (0, 3, 3)
    assert r.matrix_to_euler(empty, "ZXY").shape == r.matrix_to_vector(empty).shape == (0, 3)
    assert r.geodesic_angle(empty, empty).shape == (0,)
    assert r.slerp(empty, empty, np.zeros(0)).shape == (0, 3, 3)


def test_slerp_and_geodesic_angle_agree_with_scipy(library):
    first = Rotation.random(30, rng=1)
    # The last six pairs of rotations are close to each other.
    sizes = np.where(np.arange(30) < 24, 1.0, 1e-4)
    step = sizes[:, None] * (first.inv() * Rotation.random(30, rng=2)).as_rotvec()
    fraction = np.linspace(0, 1, 30)
    expected = (first * Rotation.from_rotvec(fraction[:, None] * step)).as_matrix()
    second = (first * Rotation.from_rotvec(step)).as_matrix()
    a, b = library.array(first.as_matrix()), library.array(second)
    library.assert_close(library.compiled(r.slerp)(a, b, library.array(fraction)), expected)
    angle = library.compiled(r.geodesic_angle)(a, b)
    library.assert_close(angle, np.linalg.norm(step, axis=-1))


random_rotations = arrays(np.float64, 3, elements=st.floats(-1, 1, width=64)).map(
    lambda v: r.vector_to_matrix(np.pi * v)
)


@settings(max_examples=60)
@given(random_rotations, random_rotations)
def test_matrices_are_rotations_and_quaternions_multiply_like_them(a, b):
    np.testing.assert_allclose(a @ a.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(a) == pytest.approx(1)
    np.testing.assert_allclose(r.rotation_6d_to_matrix(r.matrix_to_rotation_6d(a)), a, atol=1e-14)
    np.testing.assert_allclose(r.vector_to_matrix(r.matrix_to_vector(a)), a, atol=1e-12)
    product = r.quaternion_product(r.matrix_to_quaternion(a), r.matrix_to_quaternion(b))
    np.testing.assert_allclose(r.quaternion_to_matrix(product), a @ b, atol=1e-14)
