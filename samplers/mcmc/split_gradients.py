"""Gradients of the log prior and the log likelihood of batches of points, with JAX or torch."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from probmotion import seeds
from probmotion.arrays import Array, to_numpy
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import NotConjugate

__all__ = ["SplitGradient", "split_gradient"]

SplitGradient = Callable[[np.ndarray], tuple[np.ndarray, ...]]
"""θ (n, dim) → log p(θ) and log p(y | θ), (n,), and the gradients of both, (n, dim)."""

_BLOCKS = 64, 16
"""Numbers of points of the compiled functions. The last block of a batch is padded."""


@lru_cache(maxsize=8)
def split_gradient(posterior: MotionPosterior) -> SplitGradient | None:
    """Return the gradient function, or ``None`` if neither JAX nor torch differentiates both parts.

    JAX compiles the function here, so that measured run times exclude compilation.

    Raises
    ------
    NotConjugate
        If the prior has no closed form of the likelihood.
    """
    if posterior.truncated or not posterior.differentiable:
        return None
    prior: Any = posterior.prior
    parts: list[Callable[[Array], Array]] = [prior.log_density]
    if posterior.likelihood is not None:
        parts.append(posterior.log_likelihood)
    theta = posterior.initial(seeds.generator(0, "probe"), 1)
    for library in (_jax_gradient, _torch_gradient):
        split = library(parts)
        try:
            for n in _BLOCKS:
                split(theta.repeat(n, axis=0))
        except NotConjugate:
            raise
        except Exception:
            # A density that does not accept an array type may raise any exception.
            continue
        return split
    return None


def _jax_gradient(parts: Sequence[Callable[[Array], Array]]) -> SplitGradient:
    from probmotion.extras import jax

    def evaluate(theta: Any) -> list[Any]:
        values, gradients = [], []
        for part in parts:
            value, pull = jax.vjp(part, theta)
            values.append(value)
            gradients.append(pull(jax.numpy.ones_like(value))[0])
        return [*values, *gradients]

    compiled = jax.jit(evaluate)

    def split(theta: np.ndarray) -> tuple[np.ndarray, ...]:
        with jax.enable_x64(True):
            rows = [[np.asarray(values)[:n] for values in compiled(b)] for b, n in _blocks(theta)]
        return _complete([np.concatenate(values) for values in zip(*rows, strict=True)])

    return split


def _torch_gradient(parts: Sequence[Callable[[Array], Array]]) -> SplitGradient:
    from probmotion.extras import torch

    def block(theta: np.ndarray) -> list[np.ndarray]:
        point = torch.tensor(theta, dtype=torch.float64, requires_grad=True)
        values = [part(point) for part in parts]
        gradients = [torch.autograd.grad(value.sum(), point)[0] for value in values]
        return [to_numpy(array) for array in (*values, *gradients)]

    def split(theta: np.ndarray) -> tuple[np.ndarray, ...]:
        # Blocks limit memory.
        starts = range(0, len(theta), _BLOCKS[0])
        rows = [block(theta[start : start + _BLOCKS[0]]) for start in starts]
        return _complete([np.concatenate(values) for values in zip(*rows, strict=True)])

    return split


def _complete(parts: list[np.ndarray]) -> tuple[np.ndarray, ...]:
    """Return log prior, log likelihood and their gradients; zeros without a likelihood."""
    if len(parts) == 2:
        value, gradient = parts
        return value, np.zeros_like(value), gradient, np.zeros_like(gradient)
    return tuple(parts)


def _blocks(theta: np.ndarray) -> Iterator[tuple[np.ndarray, int]]:
    """Yield padded blocks of points and their numbers of points."""
    large, small = _BLOCKS
    start = 0
    while start < len(theta):
        size = large if len(theta) - start > large - small else small
        block = theta[start : start + size]
        yield np.pad(block, [(0, size - len(block)), (0, 0)], mode="edge"), len(block)
        start += size
