"""Score distillation in a prior's own coordinates, where evidence has a place.

Noise θ_t = √ᾱ θ + √(1−ᾱ) ε, ask the prior what the noise was, ε_φ = (θ_t − √ᾱ E[θ | θ_t])/√(1−ᾱ),
and descend

    w(t) (ε_φ − ε) − g(t) ∇ log p(y | θ),    g(t) = w(t) √(ᾱ(1−ᾱ)).

By Tweedie's formula E_ε[ε_φ − ε] = −√(1−ᾱ) E_ε[∇ log p_t(θ_t)]: of θ ~ N(0, I) that is √(ᾱ(1−ᾱ)) θ,
which is −√(ᾱ(1−ᾱ)) ∇ log p(θ). With g(t) both terms so have one weight, and every level descends
g(t) times −∇ log p(θ | y), whatever w(t) is: the iterates settle around a mode of the posterior.
(With g = 1 the prior would count √(ᾱ(1−ᾱ)) w(t) times, which depends on the level.)
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
from probmotion.posteriors.sampling import Interrupted, Sampler, UnsupportedPosterior, suited
from probmotion.samplers.adam import Adam
from probmotion.samplers.densities import not_conjugate
from probmotion.samplers.independent import draw_independently, with_coordinates
from probmotion.seeds import NormalStreams
from probmotion.validation import check_finite

__all__ = ["coordinate_distillation_gradient", "distil_coordinates"]


class DistillationSettings(Sampler, Protocol):
    """What is read of :class:`~probmotion.samplers.diffusion.sds.ScoreDistillation`."""

    @property
    def iterations(self) -> int:
        """Gradient steps per draw."""

    @property
    def batch(self) -> int:
        """Draws at a time."""

    @property
    def learning_rate(self) -> float:
        """Of Adam."""

    @property
    def schedule(self) -> NoiseSchedule:
        """The noise levels."""

    def plan(self, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the levels and the azimuths of all iterations."""

    def weight(self, alpha_bar: float) -> float:
        """Return w(t)."""


def distil_coordinates(
    sampler: DistillationSettings,
    posterior: MotionPosterior,
    *,
    draws: int,
    chains: int,
    seed: int,
    progress: bool,
) -> MotionDraws:
    """Return ``chains`` × ``draws`` points near modes of the posterior, each from its own start.

    They are not draws from it: all that start in the basin of one mode end around that mode, with
    a spread that is Adam's and not the posterior's, so that they are over-confident. ``gradient``
    counts gradients of the likelihood, ``denoiser`` estimates of E[θ | θ_t], ``density`` the log
    densities at the end.

    Parameters
    ----------
    sampler : DistillationSettings
        Its iterations, levels, weighting, learning rate and batch.
    posterior : MotionPosterior
        Its prior is one of :class:`~probmotion.posteriors.protocols.DenoisesCoordinates`.
    draws, chains, seed, progress
        As in :class:`~probmotion.posteriors.sampling.Sampler`.

    Raises
    ------
    UnsupportedPosterior
        If the log likelihood has no gradient by torch.
    ValueError
        If the gradient is NaN or infinite somewhere.
    Interrupted
        At Ctrl-C, with the draws of the finished batches.
    """
    _require_gradient(sampler, posterior)
    counts = {"denoiser": 0, "gradient": 0, "density": 0}
    ended: list[np.ndarray] = []

    def draw_batch(streams: NormalStreams, tick: Callable[[], Any]) -> np.ndarray:
        theta = _optimise(sampler, posterior, streams, seed, tick)
        evaluations = len(theta) * sampler.iterations
        counts["denoiser"] += evaluations
        counts["gradient"] += 0 if posterior.likelihood is None else evaluations
        counts["density"] += len(theta)
        ended.append(theta)
        return posterior.complete(streams, theta)

    try:
        found = draw_independently(
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
        )
    except Interrupted as stop:
        raise Interrupted(with_coordinates(stop.draws, posterior, ended)) from stop
    return with_coordinates(found, posterior, ended)


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
            share = math.sqrt(alpha_bar * (1 - alpha_bar))
            gradient -= share * _likelihood_gradient(sampler, posterior, theta)
        adam.descend(sampler.weight(alpha_bar) * gradient)
        tick()
    return theta


def coordinate_distillation_gradient(
    prior: DenoisesCoordinates, theta: np.ndarray, noise: np.ndarray, alpha_bar: float
) -> np.ndarray:
    """Return ε_φ(θ_t) − ε, θ_t = √ᾱ θ + √(1−ᾱ) ε: ``(…, dim) → (…, dim)``.

    Parameters
    ----------
    prior : DenoisesCoordinates
        Its estimate is ε_φ in other words: θ_t = √ᾱ E[θ | θ_t] + √(1−ᾱ) ε_φ.
    theta, noise : ndarray, (…, dim)
        θ and ε.
    alpha_bar : float
        ᾱ, between 0 and 1.
    """
    signal, spread = math.sqrt(alpha_bar), math.sqrt(1 - alpha_bar)
    noisy = signal * theta + spread * noise
    clean = to_numpy(prior.denoise_coordinates(noisy, alpha_bar))
    return (noisy - signal * clean) / spread - noise


def _require_gradient(sampler: DistillationSettings, posterior: MotionPosterior) -> None:
    if posterior.likelihood is None:
        return
    for part in (posterior.prior, posterior.likelihood):
        if not getattr(part, "differentiable", True):
            raise _no_gradient(sampler, posterior, f"which {type(part).__name__} has not")


def _no_gradient(
    sampler: DistillationSettings, posterior: MotionPosterior, reason: str
) -> UnsupportedPosterior:
    return UnsupportedPosterior(
        sampler.name,
        f"needs a log likelihood with a gradient by torch, {reason}",
        word="gradient",
        others=[name for name in suited(posterior) if name != sampler.name],
    )


def _likelihood_gradient(
    sampler: DistillationSettings, posterior: MotionPosterior, theta: np.ndarray
) -> np.ndarray:
    """Return ∇ log p(y | θ), ``(n, dim) → (n, dim)``: rows know nothing of each other."""
    import torch

    # A copy: Adam changes θ in place.
    point = torch.tensor(theta, requires_grad=True)
    try:
        value = posterior.log_likelihood(point)
    except NotConjugate as error:
        raise not_conjugate(sampler, error) from error
    except (TypeError, RuntimeError) as error:
        # What NumPy and torch raise where a prior or likelihood is not made of torch's functions.
        raise _no_gradient(
            sampler, posterior, f"but met {type(error).__name__}: {str(error).splitlines()[0]}"
        ) from error
    if not getattr(value, "requires_grad", False):
        raise _no_gradient(
            sampler, posterior, f"which {type(posterior.prior).__name__} does not pass through"
        )
    (gradient,) = torch.autograd.grad(value.sum(), point)
    check_finite("gradient of the log likelihood", gradient)
    return to_numpy(gradient)
