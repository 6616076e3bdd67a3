"""DDPM ancestral sampling (Ho et al. 2020, algorithm 2).

Sampling starts from noise at level T. At every level the denoiser estimates the clean motion, and
the next state is drawn from the DDPM posterior given the estimate.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol

import numpy as np

from probmotion.posteriors.noise_schedule import NoiseSchedule
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.samplers.diffusion.guidance import Guide, can_guide
from probmotion.samplers.independent import Batches, IndependentSampler
from probmotion.seeds import NormalStreams
from probmotion.validation import check_count

__all__ = [
    "AncestralSampler", "Corrector", "MotionState", "NoiseLevels", "State", "ancestral", "sigma",
]  # fmt: skip


class State(Protocol):
    """Representation of a noisy motion during sampling, as a 3D motion or as several views."""

    schedule: NoiseSchedule
    counts: dict[str, int]

    def noise(self, streams: NormalStreams, t: int) -> np.ndarray:
        """Return unit noise for a state at level t."""

    def estimate(self, x_t: np.ndarray, t: int) -> np.ndarray:
        """Return the estimate of the clean motion from the state at level t, (B, L, J, 3)."""

    def embed(self, motions: np.ndarray) -> np.ndarray:
        """Convert clean motions (B, L, J, 3) to the representation of the state."""


class Denoiser(Protocol):
    """Denoiser that counts its evaluations."""

    counts: dict[str, int]

    def denoise(self, x_t: np.ndarray, alpha_bar: float) -> np.ndarray:
        """Return the estimate of the clean motion from ``x_t`` at ᾱ, of the same shape."""


@dataclass
class MotionState:
    """State with one noisy motion per draw, (B, L, J, 3) or (B, L, J, 2); ``shape`` excludes B.

    ``guide`` conditions the estimate of the clean motion on the observations. ``noise_factor`` maps
    σ to a matrix F, (3, 3), for noise F ε, or to ``None`` for the identity.
    """

    denoiser: Denoiser
    schedule: NoiseSchedule
    shape: tuple[int, ...]
    guide: Guide | None = None
    noise_factor: Callable[[float], np.ndarray | None] = lambda level: None
    counts: dict[str, int] = field(init=False)

    def __post_init__(self) -> None:
        self.counts = self.denoiser.counts

    def noise(self, streams: NormalStreams, t: int) -> np.ndarray:
        """Return F(σ_t) ε, ε ~ N(0, I)."""
        noise = streams.normal(*self.shape)
        factor = self.noise_factor(sigma(self.schedule, t))
        return noise if factor is None else noise @ factor.T

    def estimate(self, x_t: np.ndarray, t: int) -> np.ndarray:
        """Return the guided estimate of the clean motion."""
        alpha_bar = float(self.schedule.alpha_bar[t])
        clean = self.denoiser.denoise(x_t, alpha_bar)
        if self.guide is None:
            return clean
        return self.guide(x_t, alpha_bar, clean, self.schedule.posterior(t))

    def embed(self, motions: np.ndarray) -> np.ndarray:
        """Return the motions unchanged."""
        return motions


Corrector = Callable[[State, NormalStreams, np.ndarray, int], np.ndarray]
"""Function (state, streams, x_t, t) → corrected state at level t."""


def ancestral(
    state: State,
    streams: NormalStreams,
    tick: Callable[[], Any],
    *,
    stop: int = 1,
    variance_for_deviation: bool = False,
    corrector: Corrector | None = None,
    watch: Callable[[np.ndarray | None, np.ndarray | None], None] | None = None,
) -> np.ndarray:
    """Return one motion per stream, (B, L, J, 3): the estimate at level ``stop``.

    ``tick`` is called after every level. With ``variance_for_deviation`` the noise is multiplied
    by the variance β̃_t, as printed in algorithm 1 of MAS, instead of √β̃_t. ``corrector`` is
    applied to every new state. ``watch`` is called with (None, initial noise), then with the
    estimate and the unit noise of every step, and last with (result, None).
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
    # q(x₀ | x₁, x̂₀) is a point mass at the estimate.
    clean = state.estimate(x, stop)
    if watch is not None:
        watch(clean, None)
    tick()
    return clean


def sigma(schedule: NoiseSchedule, t: int) -> float:
    """Return the noise level σ = √((1−ᾱ)/ᾱ) at level t."""
    alpha_bar = float(schedule.alpha_bar[t])
    return float(np.sqrt((1 - alpha_bar) / alpha_bar))


class NoiseLevels:
    """Base class of frozen dataclasses with settings of the noise schedule."""

    steps: int
    trained_steps: int | None
    schedule_power: int
    batch: int

    def __post_init__(self) -> None:
        check_count("batch", self.batch)
        # Creating the schedule validates the other settings.
        check_count("steps", self.schedule.steps)

    @property
    def schedule(self) -> NoiseSchedule:
        """Noise schedule with ``steps`` of the ``trained_steps`` levels."""
        if self.trained_steps is None:
            return NoiseSchedule.cosine(self.steps, power=self.schedule_power)
        trained = NoiseSchedule.cosine(self.trained_steps, power=self.schedule_power)
        return trained.strided(self.steps)


class AncestralSampler(NoiseLevels, IndependentSampler):
    """Base class of ancestral samplers of 3D motions."""

    draws_from = staticmethod(can_guide)
    effort: ClassVar[tuple[str, ...]] = ("steps",)
    least_effort: ClassVar[int] = 2

    def _batches(self, posterior: MotionPosterior, seed: int, progress: bool) -> Batches:
        if getattr(self, "elevation", None) == 0:
            warnings.warn(
                f"{self.name} cannot distinguish a motion from its mirror image with elevation 0; "
                "use an elevation such as pi/16",
                stacklevel=3,
            )
        state, options = self._state(posterior), self._options()

        def draw(streams: NormalStreams, tick: Callable[[], Any]) -> np.ndarray:
            return ancestral(state, streams, tick, **options)

        steps = self.steps - options.get("stop", 1) + 1
        scale = posterior.prior.scale  # type: ignore[attr-defined]
        return Batches(draw, self.batch, steps, scale, state.counts)

    def _state(self, posterior: MotionPosterior) -> State:
        raise NotImplementedError

    def _options(self) -> dict[str, Any]:
        """Return the options of :func:`ancestral`."""
        return {}
