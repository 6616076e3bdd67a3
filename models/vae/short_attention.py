"""Attention over few tokens in bfloat16 on the CPU, with a custom backward pass.

For short sequences, data movement costs more than the matrix products. This implementation splits
and merges the heads once per pass and saves only Q, K, V and the bfloat16 weights for autograd.
"""

from __future__ import annotations

from typing import Any

from probmotion.extras import torch

__all__ = ["short_attention"]


def short_attention(
    packed: torch.Tensor, heads: int, seen: torch.Tensor | None = None
) -> torch.Tensor:
    """Return softmax(Q Kᵀ/√d) V (Vaswani et al. 2017, eq. 1) with a single-precision softmax.

    ``packed`` (N, K, 3 · heads · d) contains Q, K and V, each with concatenated heads. ``seen``
    (N, K) is True for tokens to attend to, at least one per row. The result is (N, K, heads · d).
    """
    return _ShortAttention.apply(packed, heads, seen)


class _ShortAttention(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, packed: torch.Tensor, heads: int, seen: torch.Tensor | None
    ) -> torch.Tensor:
        split = packed.unflatten(-1, (3, heads, -1)).permute(2, 0, 3, 1, 4)
        split = split.flatten(1, 2)
        queries, keys, values = split
        ctx.heads, ctx.scale = heads, queries.shape[-1] ** -0.5
        scores = torch.bmm(queries, keys.mT).float().mul_(ctx.scale)
        if seen is not None:
            scores.masked_fill_(~seen.repeat_interleave(heads, dim=0)[:, None], -torch.inf)
        weights = scores.softmax(dim=-1).to(values.dtype)
        ctx.save_for_backward(split, weights)
        return torch.bmm(weights, values).unflatten(0, (-1, heads)).transpose(1, 2).flatten(2)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        split, weights = ctx.saved_tensors
        queries, keys, values = split
        gradient = gradient.unflatten(-1, (ctx.heads, -1)).transpose(1, 2).flatten(0, 1)
        of_weights = torch.bmm(gradient, values.mT).float()
        weighted = of_weights.mul_(weights)
        # Rounded weights do not sum to 1; normalise so that a common offset of V cancels.
        mean = weighted.sum(dim=-1, keepdim=True) / weights.float().sum(dim=-1, keepdim=True)
        # Masked tokens have weight 0 and hence gradient 0.
        of_scores = weighted.sub_(weights * mean)
        of_scores = of_scores.mul_(ctx.scale).to(weights.dtype)
        of_split = torch.empty_like(split)
        torch.bmm(of_scores, keys, out=of_split[0])
        torch.bmm(of_scores.mT, queries, out=of_split[1])
        torch.bmm(weights.mT, gradient, out=of_split[2])
        merged = of_split.unflatten(1, (-1, ctx.heads)).permute(1, 3, 0, 2, 4).flatten(2)
        return merged, None, None
