"""Batched decoding of NumPy or torch arrays by a torch decoder."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from array_api_compat import is_jax_array, is_numpy_array, is_torch_array

from probmotion.arrays import Array, to_numpy
from probmotion.extras import torch
from probmotion.validation import check_finite, check_shape

__all__ = ["decode_rows"]


def decode_rows(
    decode: Callable[[torch.Tensor], torch.Tensor],
    theta: Array,
    dim: int,
    shape: tuple[int, ...],
    rows: int,
) -> Array:
    """Return decoded θ, ``(…, dim) → (…, *shape)``, as an array of the same library.

    ``decode`` maps ``(B, dim) → (B, *shape)`` in the precision of its input. NumPy arrays are
    decoded in single or double precision, without gradients, ``rows`` at a time to limit memory.

    Raises
    ------
    TypeError
        If θ is neither a NumPy array nor a torch tensor.
    ValueError
        If θ has the wrong length, or a NumPy array is not finite.
    """
    if not (is_numpy_array(theta) or is_torch_array(theta)):
        kind = "JAX array" if is_jax_array(theta) else type(theta).__name__
        raise TypeError(f"theta must be a NumPy or torch array, got a {kind}")
    check_shape("theta", theta, ("…", dim))
    full = (*theta.shape[:-1], *shape)
    if is_torch_array(theta):
        return decode(theta.reshape(-1, dim)).reshape(full)
    check_finite("theta", theta)
    dtype = theta.dtype if theta.dtype == np.float32 else np.float64
    with torch.no_grad():
        flat = torch.as_tensor(np.ascontiguousarray(theta, dtype)).reshape(-1, dim)
        parts = [to_numpy(decode(part)) for part in flat.split(rows)]
    return np.concatenate(parts).reshape(full)
