"""Array helpers: agreement of the libraries."""

import numpy as np
import pytest
from scipy import special

from probmotion.arrays import constant, jax_from_torch, logsumexp, to_numpy


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
    nothing = logsumexp(library.array(np.full((2, 3), -np.inf)))
    assert (np.asarray(nothing) == -np.inf).all()
    assert logsumexp(library.array(np.zeros((0, 3)))).shape == (0,)


def test_to_numpy_detaches_gradients():
    import torch

    point = torch.ones(3, requires_grad=True)
    assert isinstance(to_numpy(2 * point), np.ndarray)


def test_jax_from_torch_agrees_with_jax_under_jit_grad_and_vmap():
    import jax
    import jax.numpy as jnp
    import torch

    with jax.enable_x64(True):
        bridged = jax_from_torch(lambda x: torch.sum(torch.sin(x) * x))
        own = lambda x: jnp.sum(jnp.sin(x) * x)  # noqa: E731
        point = jnp.asarray(np.random.default_rng(0).standard_normal(5))
        assert float(jax.jit(bridged)(point)) == pytest.approx(float(own(point)), abs=1e-12)
        np.testing.assert_allclose(
            jax.jit(jax.grad(bridged))(point), jax.grad(own)(point), rtol=0, atol=1e-12
        )
        batch = jnp.stack([point, 2 * point])
        np.testing.assert_allclose(jax.vmap(bridged)(batch), jax.vmap(own)(batch), atol=1e-12)
