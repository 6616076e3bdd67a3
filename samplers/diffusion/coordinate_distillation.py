"""Score distillation in the coordinates of a prior, with or without observations.

Let θ_t = √ᾱ θ + √(1−ᾱ) ε and ε_φ = (θ_t − √ᾱ E[θ | θ_t])/√(1−ᾱ). Each iteration descends

    w(t) (ε_φ − ε) − g(t) ∇ log p(y | θ),    g(t) = w(t) √(ᾱ(1−ᾱ)).

By Tweedie's formula E_ε[ε_φ − ε] = −√(1−ᾱ) E_ε[∇ log p_t(θ_t)], which for θ ~ N(0, I) is
√(ᾱ(1−ᾱ)) θ = −√(ᾱ(1−ᾱ)) ∇ log p(θ). With this g(t) prior and likelihood have the same weight at
every level, so the iterates converge to a mode of the posterior.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from probmotion.arrays import to_numpy
from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.noise_schedule import NoiseSchedule
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import DenoisesCoordinates, NotConjugate
from probmotion.posteriors.sampling import Sampler, UnsupportedPosterior, suited
from probmotion.samplers.adam import Adam
from probmotion.samplers.densities import not_conjugate
from probmotion.samplers.independent import draw_independently
from probmotion.seeds import NormalStreams
from probmotion.validation import check_finite

__all__ = ["distil_coordinates"]


class DistillationSettings(Sampler, Protocol):
    """Settings that :class:`~probmotion.samplers.diffusion.sds.ScoreDistillation` provides."""

    @property
    def iterations(self) -> int: ...

    @property
    def batch(self) -> int: ...

    @property
    def learning_rate(self) -> float: ...

    @property
    def schedule(self) -> NoiseSchedule: ...

    def plan(self, seed: int) -> tuple[np.ndarray, np.ndarray]: ...

    def weight(self, alpha_bar: float) -> float: ...


def distil_coordinates(
    sampler: DistillationSettings,
    posterior: MotionPosterior,
    *,
    draws: int,
    chains: int,
    seed: int,
    progress: bool,
) -> MotionDraws:
    """Return ``chains`` × ``draws`` points close to modes of the posterior, from random starts.

    They are not draws from the posterior: their spread around a mode is that of Adam. The counts
    are ``gradient`` for gradients of the likelihood, ``denoiser`` for estimates of E[θ | θ_t] and
    ``density`` for final log densities. Raises :class:`UnsupportedPosterior` if torch cannot
    differentiate the log likelihood, and ``ValueError`` if its gradient is not finite.
    """
    if posterior.likelihood is not None and not posterior.differentiable:
        raise _no_gradient(sampler, posterior, "but it has no gradient")
    counts = {"denoiser": 0, "gradient": 0, "density": 0}
    thetas: list[np.ndarray] = []

    def draw_batch(streams: NormalStreams, tick: Callable[[], Any]) -> np.ndarray:
        theta = _optimise(sampler, posterior, streams, seed, tick)
        evaluations = len(theta) * sampler.iterations
        counts["denoiser"] += evaluations
        counts["gradient"] += 0 if posterior.likelihood is None else evaluations
        counts["density"] += len(theta)
        thetas.append(theta)
        return posterior.complete(streams, theta)

    return draw_independently(
        sampler,
        posterior,
        draw_batch,
        draws=draws,
        chains=chains,
        seed=seed,
        batch=sampler.batch,
        steps=sampler.iterations,
        scale=1.0,
        counts=counts,
        progress=progress,
        thetas=thetas,
    )


def _optimise(
    sampler: DistillationSettings,
    posterior: MotionPosterior,
    streams: NormalStreams,
    seed: int,
    tick: Callable[[], Any],
) -> np.ndarray:
    prior = posterior.prior
    assert isinstance(prior, DenoisesCoordinates)
    alpha_bars = sampler.schedule.alpha_bar
    theta = streams.normal(posterior.dim)
    adam = Adam(theta, sampler.learning_rate)
    levels, _ = sampler.plan(seed)
    for t in levels:
        alpha_bar = float(alpha_bars[t])
        noise = streams.normal(posterior.dim)
        gradient = coordinate_distillation_gradient(prior, theta, noise, alpha_bar)
        if posterior.likelihood is not None:
            weight = math.sqrt(alpha_bar * (1 - alpha_bar))
            gradient -= weight * _likelihood_gradient(sampler, posterior, theta)
        adam.descend(sampler.weight(alpha_bar) * gradient)
        tick()
    return theta


def coordinate_distillation_gradient(
    prior: DenoisesCoordinates, theta: np.ndarray, noise: np.ndarray, alpha_bar: float
) -> np.ndarray:
    """Return ε_φ(θ_t) − ε, (…, dim), for θ_t = √ᾱ θ + √(1−ᾱ) ε = √ᾱ E[θ | θ_t] + √(1−ᾱ) ε_φ."""
    signal, spread = math.sqrt(alpha_bar), math.sqrt(1 - alpha_bar)
    noisy = signal * theta + spread * noise
    clean = to_numpy(prior.denoise_coordinates(noisy, alpha_bar))
    return (noisy - signal * clean) / spread - noise


def _no_gradient(
    sampler: DistillationSettings, posterior: MotionPosterior, reason: str
) -> UnsupportedPosterior:
    return UnsupportedPosterior(
        sampler.name,
        f"needs a log likelihood that torch can differentiate, {reason}",
        word="gradient",
        others=[name for name in suited(posterior) if name != sampler.name],
    )


def _likelihood_gradient(
    sampler: DistillationSettings, posterior: MotionPosterior, theta: np.ndarray
) -> np.ndarray:
    """Return ∇ log p(y | θ), ``(n, dim) → (n, dim)``."""
    import torch

    # A copy, because Adam changes θ in place.
    point = torch.tensor(theta, requires_grad=True)
    try:
        value = posterior.log_likelihood(point)
    except NotConjugate as error:
        raise not_conjugate(sampler, error) from error
    except (TypeError, RuntimeError) as error:
        # Raised by NumPy or torch if the prior or likelihood converts tensors to arrays.
        raise _no_gradient(
            sampler, posterior, f"but got {type(error).__name__}: {str(error).splitlines()[0]}"
        ) from error
    if not getattr(value, "requires_grad", False):
        raise _no_gradient(sampler, posterior, f"but {type(posterior.prior).__name__} returns none")
    (gradient,) = torch.autograd.grad(value.sum(), point)
    check_finite("gradient of the log likelihood", gradient)
    return to_numpy(gradient)
