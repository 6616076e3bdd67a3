"""Array helpers for NumPy, PyTorch and JAX that the Python Array API standard lacks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import array_api_compat
import numpy as np
from array_api_compat import device, is_jax_array, is_torch_array

__all__ = ["Array", "array_namespace", "constant", "jax_from_torch", "logsumexp", "to_numpy"]

Array = Any
"""An array of any library that follows the Python Array API standard."""


def array_namespace(*arrays: Array) -> Any:
    """Return the namespace of the arrays' library, which follows the Array API standard."""
    if len(arrays) == 1 and isinstance(arrays[0], np.ndarray):
        return np
    return array_api_compat.array_namespace(*arrays)


def constant(value: Any, like: Array) -> Array:
    """Return ``value`` as an array of the library, dtype and device of the float array ``like``."""
    if isinstance(like, np.ndarray):
        return np.asarray(value, dtype=like.dtype)
    xp = array_namespace(like)
    options = {} if is_jax_array(like) else {"device": device(like)}
    return xp.asarray(np.asarray(value), dtype=like.dtype, **options)


def to_numpy(x: Array) -> np.ndarray:
    """Return ``x`` as a NumPy array, detached from any gradient."""
    if is_torch_array(x):
        x = x.detach().cpu()
    return np.asarray(x)


def logsumexp(x: Array, axis: int = -1) -> Array:
    """Return ``log Σ exp(x)`` over ``axis`` without overflow; ``-inf`` if all entries are -inf."""
    xp = array_namespace(x)
    top = xp.max(x, axis=axis, keepdims=True)
    top = xp.where(xp.isfinite(top), top, xp.zeros_like(top))
    total = xp.sum(xp.exp(x - top), axis=axis, keepdims=True)
    # Avoid NumPy's warning about log 0.
    empty = total == 0
    log_total = xp.log(xp.where(empty, xp.ones_like(total), total))
    log_total = xp.where(empty, xp.full_like(total, -float("inf")), log_total)
    return xp.squeeze(log_total + top, axis=axis)


def jax_from_torch(function: Callable[[Array], Array]) -> Callable[[Array], Array]:
    """Return a torch function of one float64 point, ``(dim,) → ()``, as a JAX function.

    The result supports jit, vmap and first-order gradients. Each call evaluates value and gradient
    with torch's autograd through ``jax.pure_callback``.
    """
    from probmotion.extras import jax, torch

    # XLA runs callbacks on its own thread, outside the caller's ``jax.enable_x64``, and would round
    # to float32. float64 numbers are therefore passed as pairs of 32-bit words.
    words, real = jax.numpy.uint32, np.float64

    def value_and_gradient(theta: Array) -> tuple[np.ndarray, np.ndarray]:
        point = torch.tensor(np.asarray(theta).view(real)[:, 0], requires_grad=True)
        value = function(point)
        (gradient,) = torch.autograd.grad(value, point)
        rows = (to_numpy(value).reshape(1), to_numpy(gradient)[:, None])
        return tuple(row.astype(real, copy=False).view(words) for row in rows)

    def call(theta: Array) -> tuple[Array, Array]:
        shapes = [jax.ShapeDtypeStruct((*shape, 2), words) for shape in ((), theta.shape)]
        encoded = jax.lax.bitcast_convert_type(theta, words)
        results = jax.pure_callback(value_and_gradient, shapes, encoded, vmap_method="sequential")
        return tuple(jax.lax.bitcast_convert_type(result, real) for result in results)

    bridged = jax.custom_vjp(lambda theta: call(theta)[0])
    bridged.defvjp(call, lambda gradient, cotangent: (cotangent * gradient,))
    return bridged
