"""The ancestral loop that `ancestral3d`, `mas` and `mvpc` share.

From noise at level T down to a clean motion: at every level the state gives an estimate of the
clean motion, and the next state is drawn from the DDPM posterior around it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from probmotion.posteriors.noise_schedule import NoiseSchedule, PosteriorStep
from probmotion.seeds import NormalStreams

__all__ = [
    "Corrector",
    "Guide",
    "MotionState",
    "State",
    "StateDenoiser",
    "Watch",
    "ancestral",
    "cosine_schedule",
    "sigma",
]


class StateDenoiser(Protocol):
    """A denoiser of one noisy 3D motion, exact or made of 2D ones."""

    gram: np.ndarray
    counts: dict[str, int]

    def denoise(self, x_t: np.ndarray, alpha_bar: float) -> np.ndarray:
        """Return the estimate of the clean motion, all arrays (B, L, J, 3)."""

    def covariance_product(
        self, x_t: np.ndarray, alpha_bar: float, vectors: np.ndarray
    ) -> np.ndarray:
        """Return (symmetric) covariance of the clean motion times v, all arrays (B, L, J, 3)."""


Guide = Callable[[np.ndarray, float, np.ndarray, PosteriorStep], np.ndarray]
"""(x_t, ᾱ, estimate, posterior step) → the estimate given the evidence, (B, L, J, 3)."""


class State(Protocol):
    """What the loop carries from level to level."""

    schedule: NoiseSchedule
    counts: dict[str, int]

    def noise(self, streams: NormalStreams, t: int) -> np.ndarray:
        """Return fresh unit noise for a state at level t."""

    def estimate(self, x_t: np.ndarray, t: int) -> np.ndarray:
        """Return the estimate of the clean motion from the state at level t, (B, L, J, 3)."""

    def embed(self, motions: np.ndarray) -> np.ndarray:
        """Return clean motions (B, L, J, 3) in the state's form."""


class MotionState:
    """One noisy 3D motion per draw, (B, L, J, 3).

    Parameters
    ----------
    denoiser : StateDenoiser
        What estimates the clean motion.
    schedule : NoiseSchedule
        The noise levels.
    shape : tuple of int
        (L, J, 3).
    guide : Guide, optional
        Corrects the estimate for the evidence.
    noise_factor : callable, optional
        σ → a matrix F (3, 3) by which unit noise ε is turned into F ε, or ``None`` for ε itself.
    """

    def __init__(
        self,
        denoiser: StateDenoiser,
        schedule: NoiseSchedule,
        shape: tuple[int, ...],
        guide: Guide | None = None,
        noise_factor: Callable[[float], np.ndarray | None] | None = None,
    ) -> None:
        self.denoiser = denoiser
        self.counts = denoiser.counts
        self.schedule = schedule
        self.shape = shape
        self.guide = guide
        self.noise_factor = noise_factor

    def noise(self, streams: NormalStreams, t: int) -> np.ndarray:
        """Return F(σ_t) ε, ε ~ N(0, I)."""
        noise = streams.normal(*self.shape)
        factor = None if self.noise_factor is None else self.noise_factor(sigma(self.schedule, t))
        return noise if factor is None else noise @ factor.T

    def estimate(self, x_t: np.ndarray, t: int) -> np.ndarray:
        """Return the denoiser's estimate, given the evidence where there is any."""
        alpha_bar = float(self.schedule.alpha_bar[t])
        clean = self.denoiser.denoise(x_t, alpha_bar)
        if self.guide is None:
            return clean
        return self.guide(x_t, alpha_bar, clean, self.schedule.posterior(t))

    def embed(self, motions: np.ndarray) -> np.ndarray:
        """Return the motions as they are."""
        return motions


Corrector = Callable[[State, NormalStreams, np.ndarray, int], np.ndarray]
"""(state, streams, x_t, t) → another state at the same level t."""

Watch = Callable[[np.ndarray | None, np.ndarray | None], None]
"""(estimate, unit noise added to it): first (None, the first noise), last (the result, None)."""


def cosine_schedule(steps: int, trained_steps: int | None, power: int) -> NoiseSchedule:
    """Return ``steps`` levels of a cosine schedule of ``trained_steps`` (``steps`` by default)."""
    if trained_steps is None:
        return NoiseSchedule.cosine(steps, power=power)
    return NoiseSchedule.cosine(trained_steps, power=power).strided(steps)


def ancestral(
    state: State,
    streams: NormalStreams,
    tick: Callable[[], Any],
    *,
    stop: int = 1,
    variance_for_deviation: bool = False,
    corrector: Corrector | None = None,
    watch: Watch | None = None,
) -> np.ndarray:
    """Return one motion per stream, (B, L, J, 3): the last estimate.

    Parameters
    ----------
    state : State
        What is carried, and how to denoise it.
    streams : NormalStreams
        One per draw.
    tick : callable
        Called after every level.
    stop : int
        The level whose estimate is returned.
    variance_for_deviation : bool
        Multiply the noise by β̃_t, as MAS's Algorithm 1 is printed, in place of √β̃_t.
    corrector : Corrector, optional
        Applied to every new state.
    watch : Watch, optional
        Told every estimate and every noise.
    """
    schedule = state.schedule
    x = state.noise(streams, schedule.steps)
    if watch is not None:
        watch(None, x)
    for t in range(schedule.steps, stop, -1):
        clean = state.estimate(x, t)
        step = schedule.posterior(t)
        noise = state.noise(streams, t - 1)
        deviation = step.deviation**2 if variance_for_deviation else step.deviation
        x = step.clean * state.embed(clean) + step.noisy * x + deviation * noise
        if watch is not None:
            watch(clean, noise)
        if corrector is not None:
            x = corrector(state, streams, x, t - 1)
        tick()
    # Level 0 is the estimate itself: q(x₀ | x₁, x̂₀) has all its mass there.
    clean = state.estimate(x, stop)
    if watch is not None:
        watch(clean, None)
    tick()
    return clean


def sigma(schedule: NoiseSchedule, t: int) -> float:
    """Return the noise level σ = √((1−ᾱ)/ᾱ)."""
    alpha_bar = float(schedule.alpha_bar[t])
    return float(np.sqrt((1 - alpha_bar) / alpha_bar))
