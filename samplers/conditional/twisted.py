"""Twisted diffusion sampler (TDS, Wu et al. 2023): sequential Monte Carlo with guided proposals."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, ClassVar, NamedTuple

import numpy as np

from probmotion.posteriors.protocols import DenoiserCovariance2D, DenoiserCovariance3D
from probmotion.samplers.conditional.base import (
    AnnealedSampler,
    DenoiserChoice,
    VarianceExploding,
)
from probmotion.samplers.conditional.keypoints import Observations
from probmotion.samplers.diffusion.guidance import LinearObservations
from probmotion.samplers.diffusion.integrators import MAX_RATIO
from probmotion.samplers.diffusion.noise_levels import AnyLevels, Karras
from probmotion.seeds import NormalStreams
from probmotion.validation import check_count

__all__ = ["Particles", "TwistedDiffusion"]


class Particles(NamedTuple):
    """Weighted particles of B systems.

    ``estimate`` and ``guided`` are D and D given y, (B P, L, J, 3); ``log_twist`` and
    ``log_weights`` are (B, P). Weights include the twisting function.
    """

    estimate: np.ndarray
    guided: np.ndarray
    log_twist: np.ndarray
    log_weights: np.ndarray

    def chosen(self, streams: NormalStreams) -> np.ndarray:
        """Return D given y of one particle of each system, chosen by weight, (B, L, J, 3)."""
        B, P = self.log_weights.shape
        last = _resampled(self.log_weights, streams)[:, 0]
        return self.guided.reshape(B, P, *self.guided.shape[1:])[np.arange(B), last]


@dataclass(frozen=True)
class TwistedDiffusion(AnnealedSampler):
    """Twisted diffusion sampler (Wu et al. 2023, algorithm 1), one particle system per draw.

    The twisting function is exp(−½ rᵀ (A C Aᵀ + W⁻¹)⁻¹ r) with r = y − A D and the covariance C of
    the denoiser (moment matching): with C replaced by 0, as published, proposals diverge for
    precise observations. Exact as the number of particles grows, if the denoiser is exact.

    Parameters
    ----------
    steps : int
        Number of noise levels T.
    particles : int
        Number of particles of a system, of which one is returned.
    levels : AnyLevels
        Spacing of the noise levels.
    denoiser : {"any", "3d", "2d"}
        Kind of denoiser; "any" is the 3D denoiser if the prior has one.
    batch : int
        Maximum number of particle systems at a time; does not affect the draws.
    """

    name: ClassVar[str] = "tds"
    requires: ClassVar[tuple[Any, ...]] = (
        *AnnealedSampler.requires,
        DenoiserCovariance3D | DenoiserCovariance2D,
    )

    steps: int = 50
    particles: int = 8
    levels: AnyLevels = field(default_factory=Karras)
    denoiser: DenoiserChoice = "any"
    batch: int = 32

    def __post_init__(self) -> None:
        super().__post_init__()
        check_count("particles", self.particles, least=2)

    def _draw(
        self,
        pools: list[VarianceExploding],
        observations: LinearObservations,
        shape: tuple[int, ...],
        sigmas: np.ndarray,
        streams: NormalStreams,
        tick: Callable[[], Any],
    ) -> np.ndarray:
        particles = self.filtered(pools, observations, shape, streams, tick)
        estimate, log_twist = particles.estimate, particles.log_twist
        B, P = log_twist.shape
        residual = observations.target - observations.observe(estimate)
        square = (observations.precision[..., None] * residual**2).sum(axis=(1, 2, 3, 4))
        log_weights = particles.log_weights - log_twist - 0.5 * square.reshape(B, P)
        last = _resampled(log_weights, streams)[:, 0]
        tick()
        return estimate.reshape(B, P, *shape)[np.arange(B), last]

    def filtered(
        self,
        pools: list[VarianceExploding],
        observations: LinearObservations | Observations,
        shape: tuple[int, ...],
        streams: NormalStreams,
        tick: Callable[[], Any],
        *,
        second_order: bool = False,
    ) -> Particles:
        """Return the particles at the last noise level; ``tick`` is called after every other.

        With ``second_order``, estimates are extrapolated from those of two levels (Lu et al. 2022),
        for the prior's steps and for the proposals.
        """
        B, P, sigmas = len(streams.generators), self.particles, self.sigmas
        rows = np.arange(B)[:, None]

        def fresh() -> np.ndarray:
            return streams.normal(P, *shape).reshape(B * P, *shape)

        def twisted(x: np.ndarray, level: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            """Return D, D given y, and the log twisting function, (B, P)."""
            clean, sigma = pools[level % len(pools)], sigmas[level]
            estimate = clean(x, sigma)
            local = observations.about(estimate)
            guided, square = clean.condition(local, x, sigma, estimate)
            return estimate, guided, -0.5 * square.reshape(B, P)

        x = sigmas[0] * fresh()
        estimate, guided, log_twist = twisted(x, 0)
        log_weights = log_twist
        earlier: tuple[np.ndarray, np.ndarray] | None = None
        for level, (now, after) in enumerate(pairwise(sigmas), start=1):
            chosen = _resampled(log_weights, streams)
            flat = (rows * P + chosen).reshape(-1)
            x, estimate, guided = x[flat], estimate[flat], guided[flat]
            parts = guided, estimate
            if second_order:
                if earlier is not None:
                    growth = math.log(now / after) / math.log(sigmas[level - 2] / now)
                    parts = tuple(
                        part + 0.5 * min(growth, MAX_RATIO) * (part - past[flat])
                        for part, past in zip(parts, earlier, strict=True)
                    )
                earlier = guided, estimate
            before = log_twist[rows, chosen]
            share = (after / now) ** 2
            deviation = after * math.sqrt(1 - share)
            noise = fresh()
            mean, target = (part + share * (x - part) for part in parts)
            x = mean + deviation * noise
            estimate, guided, log_twist = twisted(x, level)
            # log p(x_{t−1} | x_t) − log p̃(x_{t−1} | x_t, y), both of the same variance.
            proposed = (noise**2).sum(axis=(1, 2, 3))
            ratio = 0.5 * (proposed - (((x - target) / deviation) ** 2).sum(axis=(1, 2, 3)))
            log_weights = ratio.reshape(B, P) + log_twist - before
            tick()
        return Particles(estimate, guided, log_twist, log_weights)


def _resampled(log_weights: np.ndarray, streams: NormalStreams) -> np.ndarray:
    """Return ancestors of each system by systematic resampling, ``(B, P) → (B, P)``.

    The first ancestor is at a random position, so that it has the distribution of the weights.
    """
    P = log_weights.shape[1]
    weights = np.exp(log_weights - log_weights.max(axis=1, keepdims=True))
    cumulative = np.cumsum(weights / weights.sum(axis=1, keepdims=True), axis=1)
    points = (np.arange(P) / P + streams.uniform(1)) % 1.0
    ancestors = (cumulative[:, None, :] <= points[:, :, None]).sum(axis=2)
    return np.minimum(ancestors, P - 1)
