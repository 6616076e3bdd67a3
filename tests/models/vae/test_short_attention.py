"""Attention of our own: its value is torch's, its gradient that of finite differences."""

from __future__ import annotations

import pytest
import torch
from torch.nn.functional import scaled_dot_product_attention

from probmotion.models.vae.short_attention import short_attention


def some(dtype: torch.dtype) -> torch.Tensor:
    """Q, K and V of three items, five tokens and two heads of four numbers."""
    rng = torch.Generator().manual_seed(0)
    return torch.randn(3, 5, 24, generator=rng, dtype=torch.float64).to(dtype).requires_grad_()


def theirs(asked_keys_values: torch.Tensor, seen: torch.Tensor | None) -> torch.Tensor:
    asked, keys, values = asked_keys_values.unflatten(-1, (3, 2, 4)).permute(2, 0, 3, 1, 4)
    mask = None if seen is None else seen[:, None, None]
    found = scaled_dot_product_attention(asked, keys, values, attn_mask=mask)
    return found.transpose(1, 2).flatten(2)


def half_hidden() -> torch.Tensor:
    seen = torch.ones(3, 5, dtype=torch.bool)
    seen[1, 2:] = False
    return seen


@pytest.mark.parametrize("seen", [None, half_hidden()])
def test_value_and_gradient_are_torch_s(seen):
    own, other = some(torch.bfloat16), some(torch.float64)
    found, wanted = short_attention(own, 2, seen), theirs(other, seen)
    assert found.dtype == torch.bfloat16
    torch.testing.assert_close(found.double(), wanted, rtol=0.02, atol=0.02)
    pull = torch.linspace(-1, 1, wanted.numel()).reshape(wanted.shape)
    found.backward(pull.to(torch.bfloat16))
    wanted.backward(pull.double())
    torch.testing.assert_close(own.grad.double(), other.grad, rtol=0.03, atol=0.03)


def test_the_gradient_is_that_of_finite_differences(monkeypatch):
    """In double precision: what is rounded to single for the softmax is left as it is."""
    monkeypatch.setattr(torch.Tensor, "float", lambda self: self.clone())
    assert torch.autograd.gradcheck(short_attention, (some(torch.float64), 2, half_hidden()))


def test_what_all_values_have_in_common_pulls_at_no_score():
    """Scores feel differences of values alone, though rounded weights do not add up to 1."""
    errors, in_common = [], torch.arange(24) >= 16
    pull = torch.randn(3, 5, 8, generator=torch.Generator().manual_seed(1))
    for common in (0.0, 8.0):
        own, other = some(torch.bfloat16), some(torch.float64)
        short_attention(own + common * in_common, 2).backward(pull.to(torch.bfloat16))
        theirs(other, None).backward(pull.double())
        errors.append(float((own.grad.double() - other.grad)[..., :8].norm()))
    assert errors[1] < 6 * errors[0]


def test_what_is_not_seen_gets_no_gradient():
    own = some(torch.bfloat16)
    short_attention(own, 2, half_hidden()).float().square().sum().backward()
    keys, values = own.grad[..., 8:16], own.grad[..., 16:]
    assert (keys[1, 2:] == 0).all()
    assert (values[1, 2:] == 0).all()
    assert (values[1, :2] != 0).any()
