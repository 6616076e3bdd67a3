"""Attention of our own: its value is torch's, its gradient that of finite differences."""

from __future__ import annotations

import pytest
import torch
from torch.nn.functional import scaled_dot_product_attention

from probmotion.models.short_attention import short_attention


def some(dtype: torch.dtype, queries: int = 5) -> tuple[torch.Tensor, ...]:
    rng = torch.Generator().manual_seed(0)
    shapes = ((3, 2, queries, 4), (3, 2, 5, 4), (3, 2, 5, 4))
    return tuple(
        torch.randn(shape, generator=rng, dtype=torch.float64).to(dtype).requires_grad_()
        for shape in shapes
    )


def half_hidden() -> torch.Tensor:
    seen = torch.ones(3, 1, 1, 5, dtype=torch.bool)
    seen[1, ..., 2:] = False
    return seen


@pytest.mark.parametrize("seen", [None, half_hidden()])
@pytest.mark.parametrize("queries", [1, 5])
def test_value_and_gradient_are_torch_s(seen, queries):
    ours, theirs = some(torch.bfloat16, queries), some(torch.float64, queries)
    found = short_attention(*ours, seen)
    wanted = scaled_dot_product_attention(*theirs, attn_mask=seen)
    assert found.dtype == torch.bfloat16
    torch.testing.assert_close(found.double(), wanted, rtol=0.02, atol=0.02)
    pull = torch.linspace(-1, 1, wanted.numel()).reshape(wanted.shape)
    found.backward(pull.to(torch.bfloat16))
    wanted.backward(pull.double())
    for own, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(own.grad.double(), other.grad, rtol=0.03, atol=0.03)


def test_the_gradient_is_that_of_finite_differences(monkeypatch):
    """In double precision: what is rounded to single for the softmax is left as it is."""
    monkeypatch.setattr(torch.Tensor, "float", lambda self: self.clone())
    assert torch.autograd.gradcheck(short_attention, (*some(torch.float64), half_hidden()))


def test_what_all_values_have_in_common_pulls_at_no_score():
    """Scores feel differences of values alone, though rounded weights do not add up to 1."""
    errors = []
    for common in (0.0, 8.0):
        ours, theirs = some(torch.bfloat16), some(torch.float64)
        pull = torch.randn(3, 2, 5, 4, generator=torch.Generator().manual_seed(1))
        short_attention(ours[0], ours[1], ours[2] + common).backward(pull.to(torch.bfloat16))
        scaled_dot_product_attention(*theirs).backward(pull.double())
        errors.append(float((ours[0].grad.double() - theirs[0].grad).norm()))
    assert errors[1] < 6 * errors[0]


def test_what_is_not_seen_gets_no_gradient():
    asked, keys, values = some(torch.bfloat16)
    short_attention(asked, keys, values, half_hidden()).float().square().sum().backward()
    assert (keys.grad[1, :, 2:] == 0).all()
    assert (values.grad[1, :, 2:] == 0).all()
    assert (values.grad[1, :, :2] != 0).any()
