"""`decode_rows`: a torch decoder of rows, for any batch of NumPy's or torch's arrays."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from array_api_compat import is_jax_array, is_numpy_array, is_torch_array

from probmotion.arrays import Array, to_numpy
from probmotion.validation import check_finite, check_shape

__all__ = ["decode_rows"]


def decode_rows(
    decode: Callable[[torch.Tensor], torch.Tensor],
    theta: Array,
    dim: int,
    shape: tuple[int, ...],
    rows: int,
) -> Array:
    """Return what a decoder makes of θ, of θ's kind of array.

    Parameters
    ----------
    decode : callable
        ``(B, dim) → (B, *shape)``, in the precision of what it is given.
    theta : ndarray or Tensor, (…, dim)
        NumPy's are decoded in their own precision, single or double, without a gradient; torch's
        keep theirs.
    dim : int
        Length of θ.
    shape : tuple of int
        Of what is decoded of one θ.
    rows : int
        Of a NumPy array, how many are decoded at a time: memory stays small.

    Returns
    -------
    ndarray or Tensor, (…, *shape)

    Raises
    ------
    TypeError
        If θ is no array of NumPy's or torch's.
    ValueError
        If θ has another length, or a NumPy array is not finite.
    """
    if not (is_numpy_array(theta) or is_torch_array(theta)):
        kind = "JAX array" if is_jax_array(theta) else type(theta).__name__
        raise TypeError(f"theta is a {kind}, expected NumPy's or torch's: this prior is torch's")
    check_shape("theta", theta, ("…", dim))
    whole = (*theta.shape[:-1], *shape)
    if is_torch_array(theta):
        return decode(theta.reshape(-1, dim)).reshape(whole)
    check_finite("theta", theta)
    kept = theta.dtype if theta.dtype == np.float32 else np.float64
    with torch.no_grad():
        flat = torch.as_tensor(np.ascontiguousarray(theta, kept)).reshape(-1, dim)
        found = [to_numpy(decode(some)) for some in flat.split(rows)]
    return np.concatenate(found).reshape(whole)
