"""`decode_rows`: batches of any shape through a decoder of rows, for NumPy's and torch's arrays."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from probmotion.models.latent.row_decoding import decode_rows


class Decoder:
    """θ ↦ [θ, θ²], (B, 3) → (B, 2, 3), which notes what it is given."""

    def __init__(self):
        self.given = []

    def __call__(self, theta):
        self.given.append(theta)
        return torch.stack([theta, theta**2], dim=1)

    def at(self, theta):
        return decode_rows(self, theta, 3, (2, 3), 4)


@pytest.fixture
def decoder():
    return Decoder()


@pytest.mark.parametrize("batch", [(), (1,), (4,), (9,), (2, 5), (2, 0)])
@pytest.mark.parametrize("kind", [np.float64, np.float32])
def test_any_batch_is_decoded_in_its_own_precision(decoder, batch, kind):
    theta = np.random.default_rng(0).normal(size=(*batch, 3)).astype(kind)
    wanted = np.stack([theta, theta**2], axis=-2)
    found = decoder.at(theta)
    assert found.dtype == kind
    np.testing.assert_array_equal(found, wanted)
    # Never more rows at a time than asked for.
    assert max(len(rows) for rows in decoder.given) <= 4
    whole = decoder.at(torch.tensor(theta))
    assert isinstance(whole, torch.Tensor)
    np.testing.assert_array_equal(whole, wanted)


def test_integers_and_strided_arrays_are_decoded_in_double(decoder):
    found = decoder.at(np.arange(6).reshape(3, 2).T)
    assert found.dtype == np.float64
    np.testing.assert_array_equal(found[1], [[1, 3, 5], [1, 9, 25]])


def test_torch_keeps_its_gradient_and_numpy_needs_none(decoder):
    theta = torch.ones(2, 3, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(decoder.at(theta).sum(), theta)
    torch.testing.assert_close(gradient, torch.full_like(theta, 3.0))
    weight = torch.ones(3, dtype=torch.float64, requires_grad=True)
    found = decode_rows(lambda rows: (rows * weight)[:, None], np.ones(3), 3, (1, 3), 4)
    np.testing.assert_array_equal(found, np.ones((1, 3)))


def test_what_is_no_theta_is_refused_in_a_sentence(decoder):
    sentence = "expected NumPy's or torch's: this prior is torch's$"
    with pytest.raises(TypeError, match=f"^theta is a list, {sentence}"):
        decoder.at([0.0, 0.0, 0.0])
    jax = pytest.importorskip("jax")
    with pytest.raises(TypeError, match=f"^theta is a JAX array, {sentence}"):
        decoder.at(jax.numpy.zeros(3))
    for wrong in (np.zeros((2, 4)), torch.zeros(2, 4)):
        with pytest.raises(ValueError, match=r"^theta has shape \(2, 4\), expected"):
            decoder.at(wrong)
    with pytest.raises(ValueError, match=r"^theta .*finite"):
        decoder.at(np.full((1, 3), np.nan))
    assert decoder.given == []
