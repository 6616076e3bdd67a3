"""Array helpers: agreement between array libraries."""

import numpy as np
import pytest
from scipy import special

from probmotion.arrays import constant, jax_from_torch, logsumexp


def test_constant_has_the_library_and_dtype_of_like(library):
    like = library.array(np.zeros(3))
    got = constant([[1, 2], [3, 4]], like)
    assert type(got) is type(like)
    library.assert_close(got, [[1.0, 2.0], [3.0, 4.0]])


def test_logsumexp_agrees_with_scipy(library):
    values = np.array([[1e4, 1e4 - 1.0], [-np.inf, 0.0], [-1e4, -1e4]]) / 100
    for axis in (0, 1):
        got = library.compiled(lambda x, axis=axis: logsumexp(x, axis=axis))(library.array(values))
        library.assert_close(got / 100, special.logsumexp(values, axis=axis) / 100)
    impossible = logsumexp(library.array(np.full((2, 3), -np.inf)))
    assert (np.asarray(impossible) == -np.inf).all()
    assert logsumexp(library.array(np.zeros((0, 3)))).shape == (0,)


def test_jax_from_torch_agrees_with_jax_under_jit_grad_and_vmap():
    import jax
    import jax.numpy as jnp
    import torch

    with jax.enable_x64(True):
        bridged = jax_from_torch(lambda x: torch.sum(torch.sin(x) * x))

        def native(x):
            return jnp.sum(jnp.sin(x) * x)

        point = jnp.asarray(np.random.default_rng(0).standard_normal(5))
        assert float(jax.jit(bridged)(point)) == pytest.approx(float(native(point)), abs=1e-12)
        np.testing.assert_allclose(
            jax.jit(jax.grad(bridged))(point), jax.grad(native)(point), rtol=0, atol=1e-12
        )
        batch = jnp.stack([point, 2 * point])
        np.testing.assert_allclose(jax.vmap(bridged)(batch), jax.vmap(native)(batch), atol=1e-12)
