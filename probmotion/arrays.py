"""One source for NumPy, PyTorch and JAX: namespaces, constants and a few products.

Geometry, kinematics and densities are written against the Python Array API standard; the
functions here are what that standard leaves out.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from array_api_compat import array_namespace, device, is_jax_array, is_torch_array

__all__ = ["Array", "array_namespace", "constant", "dot", "logsumexp", "to_numpy"]

Array = Any
"""An array of any library that follows the Python Array API standard."""


def constant(value: Any, like: Array) -> Array:
    """Return ``value`` as an array of the library, dtype and device of ``like``.

    Parameters
    ----------
    value : array_like
        Numbers of any shape, NumPy arrays or lists.
    like : Array
        A floating-point array that says where the result will be used.
    """
    xp = array_namespace(like)
    if is_jax_array(like):
        return xp.asarray(np.asarray(value), dtype=like.dtype)
    return xp.asarray(np.asarray(value), dtype=like.dtype, device=device(like))


def to_numpy(x: Array) -> np.ndarray:
    """Return ``x`` as a NumPy array, detached from any gradient."""
    if is_torch_array(x):
        x = x.detach().cpu()
    return np.asarray(x)


def dot(a: Array, b: Array) -> Array:
    """Return the inner product over the last axis, batch axes broadcast: ``(…, D) → (…)``."""
    xp = array_namespace(a, b)
    return xp.sum(a * b, axis=-1)


def logsumexp(x: Array, axis: int = -1) -> Array:
    """Return ``log Σ exp(x)`` over ``axis`` without overflow; ``-inf`` where every entry is."""
    xp = array_namespace(x)
    top = xp.max(x, axis=axis, keepdims=True)
    top = xp.where(xp.isfinite(top), top, xp.zeros_like(top))
    total = xp.sum(xp.exp(x - top), axis=axis, keepdims=True)
    return xp.squeeze(xp.log(total) + top, axis=axis)
