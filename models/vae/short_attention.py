"""Attention among few tokens in bfloat16 on the CPU, with a backward pass of its own.

Products of so few tokens take less time than what moves numbers about between them. Here heads are
parted once and put together once each way, and of what autograd would keep beside Q, K and V the
weights alone are kept, in bfloat16.
"""

from __future__ import annotations

from typing import Any

import torch
from torch.autograd import Function
from torch.autograd.function import once_differentiable

__all__ = ["short_attention"]


def short_attention(
    asked_keys_values: torch.Tensor, heads: int, seen: torch.Tensor | None = None
) -> torch.Tensor:
    """Return softmax(Q Kᵀ/√d) V (Vaswani et al. 2017, eq. 1), the softmax in single precision.

    Parameters
    ----------
    asked_keys_values : Tensor, (N, K, 3 · heads · d)
        Q, K and V side by side, and heads side by side in each.
    heads : int
        Heads.
    seen : Tensor of bool, (N, K), optional
        Tokens that may be looked at, one at least; all by default.

    Returns
    -------
    Tensor, (N, K, heads · d)
    """
    return _ShortAttention.apply(asked_keys_values, heads, seen)


class _ShortAttention(Function):
    @staticmethod
    def forward(
        ctx: Any, asked_keys_values: torch.Tensor, heads: int, seen: torch.Tensor | None
    ) -> torch.Tensor:
        parted = asked_keys_values.unflatten(-1, (3, heads, -1)).permute(2, 0, 3, 1, 4)
        parted = parted.flatten(1, 2)
        asked, keys, values = parted
        ctx.heads, ctx.scale = heads, asked.shape[-1] ** -0.5
        scores = torch.bmm(asked, keys.mT).float().mul_(ctx.scale)
        if seen is not None:
            scores.masked_fill_(~seen.repeat_interleave(heads, dim=0)[:, None], -torch.inf)
        weights = scores.softmax(dim=-1).to(values.dtype)
        ctx.save_for_backward(parted, weights)
        return torch.bmm(weights, values).unflatten(0, (-1, heads)).transpose(1, 2).flatten(2)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        parted, weights = ctx.saved_tensors
        asked, keys, values = parted
        gradient = gradient.unflatten(-1, (ctx.heads, -1)).transpose(1, 2).flatten(0, 1)
        of_weights = torch.bmm(gradient, values.mT).float()
        weighted = of_weights.mul_(weights)
        # Rounded weights do not add up to 1: what all values have in common would pull at scores.
        mean = weighted.sum(dim=-1, keepdim=True) / weights.float().sum(dim=-1, keepdim=True)
        # Of what is not seen the weight is 0, and so is all that comes of it.
        of_scores = weighted.sub_(weights * mean)
        of_scores = of_scores.mul_(ctx.scale).to(weights.dtype)
        of_parted = torch.empty_like(parted)
        torch.bmm(of_scores, keys, out=of_parted[0])
        torch.bmm(of_scores.mT, asked, out=of_parted[1])
        torch.bmm(weights.mT, gradient, out=of_parted[2])
        together = of_parted.unflatten(1, (-1, ctx.heads)).permute(1, 3, 0, 2, 4).flatten(2)
        return together, None, None
