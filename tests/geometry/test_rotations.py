"""Rotations against SciPy, roma and jaxlie, and against what a group must satisfy."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from probmotion.geometry import rotations as r

ORDERS = [
    "".join(o) for o in product("XYZ", repeat=3) if o[0] != o[1] and o[1] != o[2]
]  # 6 with three axes, 6 with two


def rotation_vectors() -> np.ndarray:
    """Rotation vectors of every size: none, tiny, ordinary, near half a turn, half a turn."""
    rng = np.random.default_rng(3)
    axes = rng.standard_normal((60, 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    axes[:6] = np.concatenate([np.eye(3), -np.eye(3)])
    sizes = [0.0, 1e-30, 1e-12, 1e-8, 9.9e-4, 1.01e-3, 0.1, 1.0, 3.0]
    near = [np.pi - gap for gap in (1e-3, 1e-6, 1e-9, 0.0)]
    return np.concatenate([size * axes for size in sizes + near])


VECTORS = rotation_vectors()
ORACLE = Rotation.from_rotvec(VECTORS)


def up_to_sign(quaternions: np.ndarray) -> np.ndarray:
    """Products of a quaternion's entries, in which q and −q are the same."""
    return quaternions[..., :, None] * quaternions[..., None, :]


def test_every_form_agrees_with_scipy(library: Any) -> None:
    vectors, matrices = library.array(VECTORS), library.array(ORACLE.as_matrix())
    quaternions = library.array(ORACLE.as_quat(scalar_first=True))
    run = library.compiled
    library.assert_close(run(r.vector_to_matrix)(vectors), ORACLE.as_matrix())
    library.assert_close(run(r.quaternion_to_matrix)(3.0 * quaternions), ORACLE.as_matrix())
    six = run(r.matrix_to_six_numbers)(matrices)
    np.testing.assert_allclose(
        np.asarray(six), np.asarray(matrices)[..., :2].swapaxes(-1, -2).reshape(-1, 6)
    )
    library.assert_close(run(r.six_numbers_to_matrix)(2.0 * six), ORACLE.as_matrix())
    for got in (run(r.vector_to_quaternion)(vectors), run(r.matrix_to_quaternion)(matrices)):
        wanted = up_to_sign(ORACLE.as_quat(scalar_first=True))
        library.assert_close(got[..., :, None] * got[..., None, :], wanted)
    # At half a turn both signs of the vector are right; the matrix tells nothing more.
    short = np.linalg.norm(VECTORS, axis=-1) < 3.1
    for got in (run(r.matrix_to_vector)(matrices), run(r.quaternion_to_vector)(-2 * quaternions)):
        np.testing.assert_allclose(
            np.asarray(got)[short], VECTORS[short], rtol=0, atol=library.tolerance
        )
        library.assert_close(run(r.vector_to_matrix)(got), ORACLE.as_matrix())
        assert np.linalg.norm(np.asarray(got), axis=-1).max() <= np.pi * (1 + 1e-6)


def test_small_angles_lose_no_digit() -> None:
    """The series and the formulas meet: double precision to its end on both sides."""
    np.testing.assert_allclose(r.vector_to_matrix(VECTORS), ORACLE.as_matrix(), rtol=0, atol=2e-15)
    there = r.quaternion_to_vector(r.vector_to_quaternion(VECTORS))
    short = np.linalg.norm(VECTORS, axis=-1) < 3.1
    np.testing.assert_allclose(there[short], VECTORS[short], rtol=1e-14, atol=0)


@pytest.mark.parametrize("order", ORDERS)
def test_euler_angles_agree_with_scipy(library: Any, order: str) -> None:
    rng = np.random.default_rng(5)
    angles = rng.uniform(-1.4, 1.4, (40, 3))
    if order[0] == order[2]:
        angles[:, 1] = rng.uniform(0.1, 3.0, 40)
    matrices = Rotation.from_euler(order, angles).as_matrix()
    library.assert_close(r.euler_to_matrix(library.array(angles), order), matrices)
    library.assert_close(
        library.compiled(lambda m: r.matrix_to_euler(m, order))(library.array(matrices)),
        Rotation.from_matrix(matrices).as_euler(order),
    )


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("gap", [0.0, 1e-12, 1e-9, 1e-5])
def test_euler_angles_give_the_rotation_back_at_gimbal_lock(order: str, gap: float) -> None:
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


def test_orders_that_are_none_are_refused() -> None:
    for order in ("XXY", "ZYY", "XY", "XYZX", "XYW", ""):
        with pytest.raises(ValueError, match=r"order is .*expected three of X, Y and Z"):
            r.euler_to_matrix(np.zeros(3), order)


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"vector must have shape \(…, 3\), got \(4,\)"):
        r.vector_to_matrix(np.zeros(4))
    with pytest.raises(ValueError, match=r"matrix must have shape \(…, 3, 3\), got \(3, 2\)"):
        r.matrix_to_quaternion(np.zeros((3, 2)))
    with pytest.raises(ValueError, match=r"second must have shape \(…, 4\), got \(3,\)"):
        r.quaternion_product(np.ones(4), np.ones(3))


def test_a_quarter_turn_about_z_takes_x_to_y() -> None:
    quarter = r.vector_to_matrix(np.array([0.0, 0.0, np.pi / 2]))
    np.testing.assert_allclose(quarter @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-15)
    half = np.sqrt(0.5)
    np.testing.assert_allclose(r.matrix_to_quaternion(quarter), [half, 0, 0, half], atol=1e-15)
    # R_z R_x R_y, as BVH files write it.
    x, y, z = r.vector_to_matrix(np.diag([0.3, 0.5, 0.7]))
    np.testing.assert_allclose(
        r.euler_to_matrix(np.array([0.7, 0.3, 0.5]), "ZXY"), z @ x @ y, atol=1e-15
    )


def test_roma_agrees() -> None:
    roma = pytest.importorskip("roma")
    import torch

    vectors = torch.tensor(VECTORS)
    matrices = torch.tensor(ORACLE.as_matrix())
    rng = np.random.default_rng(8)
    numbers = torch.tensor(rng.standard_normal((50, 6)))
    columns = torch.stack([numbers[:, :3], numbers[:, 3:]], dim=-1)
    pairs = [
        (r.vector_to_matrix(vectors), roma.rotvec_to_rotmat(vectors)),
        (r.six_numbers_to_matrix(numbers), roma.special_gramschmidt(columns)),
    ]
    other = matrices.roll(17, 0)
    pairs.append(
        (r.geodesic_angle(matrices, other), roma.rotmat_geodesic_distance(matrices, other))
    )
    steps = torch.tensor([0.0, 0.3, 1.0], dtype=torch.float64)
    first, second = torch.tensor(Rotation.random(20, rng=1).as_matrix()), matrices[300:320]
    wanted = roma.rotmat_slerp(first, second, steps)
    pairs.append((r.slerp(first, second, steps[:, None]), wanted))
    for got, expected in pairs:
        np.testing.assert_allclose(got.numpy(), expected.numpy(), rtol=0, atol=1e-7)
    np.testing.assert_allclose(pairs[1][0].numpy(), pairs[1][1].numpy(), rtol=0, atol=1e-10)
    np.testing.assert_allclose(pairs[3][0].numpy(), pairs[3][1].numpy(), rtol=0, atol=1e-10)


def test_jaxlie_agrees() -> None:
    jaxlie = pytest.importorskip("jaxlie")
    import jax
    import jax.numpy as jnp

    with jax.enable_x64(True):
        vectors = jnp.asarray(VECTORS)
        oracle = jax.vmap(jaxlie.SO3.exp)(vectors)
        np.testing.assert_allclose(
            r.vector_to_matrix(vectors), jax.vmap(lambda o: o.as_matrix())(oracle), atol=1e-10
        )
        quaternions = r.vector_to_quaternion(vectors)
        np.testing.assert_allclose(quaternions, oracle.wxyz, atol=1e-10)
        other = jnp.roll(quaternions, 17, axis=0)
        wanted = jax.vmap(lambda a, b: (jaxlie.SO3(a) @ jaxlie.SO3(b)).wxyz)(quaternions, other)
        np.testing.assert_allclose(r.quaternion_product(quaternions, other), wanted, atol=1e-10)


@pytest.mark.parametrize("form", ["matrix", "quaternion"])
def test_there_and_back_has_the_identity_for_its_derivative(differentiable: Any, form: str) -> None:
    sizes = np.array([0.0, 1e-20, 1e-9, 9.99e-4, 1.001e-3, 0.5, 3.0, np.pi - 1e-5])
    vectors = np.broadcast_to(sizes[:, None, None] * np.array([0.48, -0.6, 0.64]), (8, 3, 3))
    there = getattr(r, f"vector_to_{form}")
    back = getattr(r, f"{form}_to_vector")
    weights = differentiable.array(np.eye(3))
    gradient = differentiable.gradient(lambda v: (weights * back(there(v))).sum(), vectors)
    np.testing.assert_allclose(gradient, np.tile(np.eye(3), (8, 1, 1)), rtol=0, atol=1e-8)


def test_gradients_are_finite_where_formulas_divide_by_zero(differentiable: Any) -> None:
    half_turn = np.diag([1.0, -1.0, -1.0])
    locked = r.euler_to_matrix(np.array([0.3, np.pi / 2, 0.2]), "XYZ")
    eye = differentiable.array(np.eye(3))

    def everything(m: Any) -> Any:
        return (
            r.matrix_to_vector(m).sum()
            + r.matrix_to_euler(m, "XYZ").sum()
            + r.matrix_to_euler(m, "XYX").sum()
            + r.geodesic_angle(eye, m).sum()
        )

    at = np.stack([np.eye(3), half_turn, locked])
    assert np.isfinite(differentiable.gradient(everything, at)).all()


def test_empty_batches_stay_empty(library: Any) -> None:
    assert r.vector_to_matrix(library.array(np.zeros((0, 3)))).shape == (0, 3, 3)
    assert r.vector_to_quaternion(library.array(np.zeros((2, 0, 3)))).shape == (2, 0, 4)
    assert r.quaternion_to_vector(library.array(np.zeros((0, 4)))).shape == (0, 3)
    assert r.six_numbers_to_matrix(library.array(np.zeros((0, 6)))).shape == (0, 3, 3)
    assert r.euler_to_matrix(library.array(np.zeros((0, 3))), "ZXY").shape == (0, 3, 3)
    none = library.array(np.zeros((0, 3, 3)))
    assert r.matrix_to_vector(none).shape == (0, 3)
    assert r.matrix_to_euler(none, "ZXY").shape == (0, 3)
    assert r.matrix_to_six_numbers(none).shape == (0, 6)
    assert r.geodesic_angle(none, none).shape == (0,)
    assert r.slerp(none, none, library.array(np.zeros(0))).shape == (0, 3, 3)


def test_slerp_and_angles_agree_between_libraries(library: Any) -> None:
    first, second = Rotation.random(30, rng=1), Rotation.random(30, rng=2)
    fraction = np.linspace(0, 1, 30)
    step = (first.inv() * second).as_rotvec()
    wanted = (first * Rotation.from_rotvec(fraction[:, None] * step)).as_matrix()
    a, b = library.array(first.as_matrix()), library.array(second.as_matrix())
    library.assert_close(library.compiled(r.slerp)(a, b, library.array(fraction)), wanted)
    library.assert_close(r.geodesic_angle(a, b), np.linalg.norm(step, axis=-1))
    p = library.array(first.as_quat(scalar_first=True))
    q = library.array(second.as_quat(scalar_first=True))
    between = library.compiled(r.slerp_quaternions)(p, q, library.array(fraction))
    library.assert_close(r.quaternion_to_matrix(between), wanted)
    np.testing.assert_allclose(np.asarray(between)[0], np.asarray(p)[0], atol=library.tolerance)


unit = st.floats(-1, 1, width=64)
turns = arrays(np.float64, 3, elements=unit).map(lambda v: r.vector_to_matrix(np.pi * v))


@settings(max_examples=60)
@given(turns, turns, turns)
def test_group_axioms(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> None:
    p, q, s = (r.matrix_to_quaternion(m) for m in (a, b, c))
    for m in (a, b, c):
        np.testing.assert_allclose(m @ m.T, np.eye(3), atol=1e-14)
        assert np.linalg.det(m) == pytest.approx(1)
        np.testing.assert_allclose(
            r.six_numbers_to_matrix(r.matrix_to_six_numbers(m)), m, atol=1e-14
        )
        np.testing.assert_allclose(r.vector_to_matrix(r.matrix_to_vector(m)), m, atol=1e-12)
    np.testing.assert_allclose(
        r.quaternion_to_matrix(r.quaternion_product(p, q)), a @ b, atol=1e-14
    )
    np.testing.assert_allclose(
        r.quaternion_product(r.quaternion_product(p, q), s),
        r.quaternion_product(p, r.quaternion_product(q, s)),
        atol=1e-14,
    )
    one = np.array([1.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(r.quaternion_product(one, p), p, atol=0)
    np.testing.assert_allclose(r.quaternion_product(p, p * [1, -1, -1, -1]), one, atol=1e-14)
    # The vector of the inverse is the opposite vector, up to the sign of a half turn.
    np.testing.assert_allclose(r.vector_to_matrix(-r.matrix_to_vector(a)), a.T, atol=1e-12)


@settings(max_examples=60)
@given(turns, turns, turns, st.floats(0, 1))
def test_the_angle_is_a_metric_and_slerp_its_geodesic(
    a: np.ndarray, b: np.ndarray, c: np.ndarray, fraction: float
) -> None:
    angle = r.geodesic_angle(a, b)
    assert 0 <= angle <= np.pi + 1e-12
    assert r.geodesic_angle(b, a) == pytest.approx(angle, abs=1e-12)
    assert r.geodesic_angle(a, c) <= angle + r.geodesic_angle(b, c) + 1e-12
    assert r.geodesic_angle(c @ a, c @ b) == pytest.approx(angle, abs=1e-7)
    between = r.slerp(a, b, np.asarray(fraction))
    assert r.geodesic_angle(a, between) == pytest.approx(fraction * angle, abs=1e-7)
    assert r.geodesic_angle(between, b) == pytest.approx((1 - fraction) * angle, abs=1e-7)
