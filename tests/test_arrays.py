"""What the array standard leaves out."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import special

from probmotion.arrays import constant, dot, jax_from_torch, logsumexp, to_numpy


def test_constants_follow_the_array_they_meet(library: Any) -> None:
    like = library.array(np.zeros(3))
    got = constant([[1, 2], [3, 4]], like)
    assert type(got) is type(like)
    library.assert_close(got, [[1.0, 2.0], [3.0, 4.0]])


def test_products_and_sums_agree(library: Any) -> None:
    rng = np.random.default_rng(0)
    a, b = rng.standard_normal((2, 1, 4)), rng.standard_normal((3, 4))
    wanted = np.einsum("xyi,yi->xy", np.broadcast_to(a, (2, 3, 4)), b)
    library.assert_close(dot(library.array(a), library.array(b)), wanted)
    values = np.array([[1e4, 1e4 - 1.0], [-np.inf, 0.0], [-1e4, -1e4]]) / 100
    for axis in (0, 1):
        got = library.compiled(lambda x, axis=axis: logsumexp(x, axis=axis))(library.array(values))
        library.assert_close(got / 100, special.logsumexp(values, axis=axis) / 100)
    nothing = logsumexp(library.array(np.full((2, 3), -np.inf)))
    assert (np.asarray(nothing) == -np.inf).all()
    assert logsumexp(library.array(np.zeros((0, 3)))).shape == (0,)


def test_numbers_come_out_without_their_gradients() -> None:
    import torch

    point = torch.ones(3, requires_grad=True)
    assert isinstance(to_numpy(2 * point), np.ndarray)


def test_a_torch_function_is_a_jax_function() -> None:
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
