"""Batched decoding by a torch decoder, for NumPy and torch arrays."""

import jax
import numpy as np
import pytest
import torch

from probmotion.models.latent.row_decoding import decode_rows


class Decoder:
    """Decoder θ ↦ [θ, θ²], (B, 3) → (B, 2, 3), that records its inputs."""

    def __init__(self):
        self.inputs = []

    def __call__(self, theta):
        self.inputs.append(theta)
        return torch.stack([theta, theta**2], dim=1)

    def decode(self, theta):
        return decode_rows(self, theta, 3, (2, 3), 4)


@pytest.fixture
def decoder():
    return Decoder()


@pytest.mark.parametrize("batch", [(), (4,), (9,), (2, 5), (2, 0)])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_batches_are_decoded_in_their_own_precision(decoder, batch, dtype):
    theta = np.random.default_rng(0).normal(size=(*batch, 3)).astype(dtype)
    expected = np.stack([theta, theta**2], axis=-2)
    decoded = decoder.decode(theta)
    assert decoded.dtype == dtype
    np.testing.assert_array_equal(decoded, expected)
    assert max(len(rows) for rows in decoder.inputs) <= 4
    tensor = decoder.decode(torch.tensor(theta))
    assert isinstance(tensor, torch.Tensor)
    np.testing.assert_array_equal(tensor, expected)


def test_integers_and_strided_arrays_are_decoded_in_double_precision(decoder):
    decoded = decoder.decode(np.arange(6).reshape(3, 2).T)
    assert decoded.dtype == np.float64
    np.testing.assert_array_equal(decoded[1], [[1, 3, 5], [1, 9, 25]])


def test_gradients_flow_for_torch_only(decoder):
    theta = torch.ones(2, 3, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(decoder.decode(theta).sum(), theta)
    torch.testing.assert_close(gradient, torch.full_like(theta, 3.0))
    weight = torch.ones(3, dtype=torch.float64, requires_grad=True)
    decoded = decode_rows(lambda rows: (rows * weight)[:, None], np.ones(3), 3, (1, 3), 4)
    np.testing.assert_array_equal(decoded, np.ones((1, 3)))


@pytest.mark.parametrize(
    ("theta", "error", "message"),
    [
        ([0.0, 0.0, 0.0], TypeError, "theta must be a NumPy or torch array, got a list"),
        (jax.numpy.zeros(3), TypeError, "theta must be a NumPy or torch array, got a JAX array"),
        (np.zeros((2, 4)), ValueError, r"theta must have shape .*, got \(2, 4\)"),
        (torch.zeros(2, 4), ValueError, r"theta must have shape .*, got \(2, 4\)"),
        (np.full((1, 3), np.nan), ValueError, "theta must be finite"),
    ],
)
def test_invalid_theta_is_rejected(decoder, theta, error, message):
    with pytest.raises(error, match=message):
        decoder.decode(theta)
    assert decoder.inputs == []
