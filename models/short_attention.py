"""Attention among few tokens in bfloat16 on the CPU, with a backward pass of its own.

Torch's own attention takes several times as long there, and what its autograd keeps and writes of
the plain products takes more than the products: here the weights alone are kept, in bfloat16.
"""

from __future__ import annotations

from typing import Any

import torch
from torch.autograd import Function
from torch.autograd.function import once_differentiable

__all__ = ["short_attention"]


def short_attention(
    asked: torch.Tensor,
    keys: torch.Tensor,
    values: torch.Tensor,
    seen: torch.Tensor | None = None,
) -> torch.Tensor:
    """Return softmax(Q Kᵀ/√d) V (Vaswani et al. 2017, eq. 1), the softmax in single precision.

    Parameters
    ----------
    asked : Tensor, (N, heads, Q, d)
        Q.
    keys, values : Tensor, (N, heads, K, d)
        K and V.
    seen : Tensor of bool, (N, 1, 1, K), optional
        Tokens that may be looked at, one at least; all by default.

    Returns
    -------
    Tensor, (N, heads, Q, d)
    """
    return _ShortAttention.apply(asked, keys, values, seen)


class _ShortAttention(Function):
    @staticmethod
    def forward(
        ctx: Any,
        asked: torch.Tensor,
        keys: torch.Tensor,
        values: torch.Tensor,
        seen: torch.Tensor | None,
    ) -> torch.Tensor:
        ctx.scale = asked.shape[-1] ** -0.5
        scores = (asked @ keys.mT).float().mul_(ctx.scale)
        if seen is not None:
            scores.masked_fill_(~seen, -torch.inf)
        weights = scores.softmax(dim=-1).to(values.dtype)
        ctx.save_for_backward(asked, keys, values, weights)
        return weights @ values

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        asked, keys, values, weights = ctx.saved_tensors
        of_weights = (gradient @ values.mT).float()
        weighted = of_weights.mul_(weights)
        # Rounded weights do not add up to 1: what all values have in common would pull at scores.
        mean = weighted.sum(dim=-1, keepdim=True) / weights.float().sum(dim=-1, keepdim=True)
        # Of what is not seen the weight is 0, and so is all that comes of it.
        of_scores = weighted.sub_(weights * mean)
        of_scores = of_scores.mul_(ctx.scale).to(weights.dtype)
        return of_scores @ keys, of_scores.mT @ asked, weights.mT @ gradient, None
