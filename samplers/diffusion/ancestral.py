"""DDPM ancestral sampling (Ho et al. 2020, algorithm 2).

From noise at level T to a clean motion: at every level the clean motion is estimated, and the next
state is drawn from the DDPM posterior around the estimate.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol

import numpy as np

from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.noise_schedule import NoiseSchedule
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.sampling import require
from probmotion.samplers.diffusion.guidance import Guide, can_guide
from probmotion.samplers.diffusion.views import StateDenoiser
from probmotion.samplers.independent import draw_independently, refuse_initial
from probmotion.seeds import NormalStreams
from probmotion.validation import check_count

__all__ = [
    "AncestralSampler",
    "Corrector",
    "MotionState",
    "State",
    "ancestral",
    "cosine_schedule",
    "sigma",
]


class State(Protocol):
    """Representation of a noisy motion in the loop, one motion or several views."""

    schedule: NoiseSchedule
    counts: dict[str, int]

    def noise(self, streams: NormalStreams, t: int) -> np.ndarray:
        """Return unit noise for a state at level t."""

    def estimate(self, x_t: np.ndarray, t: int) -> np.ndarray:
        """Return the estimate of the clean motion from the state at level t, (B, L, J, 3)."""

    def embed(self, motions: np.ndarray) -> np.ndarray:
        """Convert clean motions (B, L, J, 3) to the representation of the state."""


@dataclass
class MotionState:
    """One noisy 3D motion per draw, (B, L, J, 3), with ``shape`` (L, J, 3).

    ``guide`` corrects the estimate of the clean motion for the observations. ``noise_factor`` maps
    σ to a matrix F, (3, 3), for noise F ε, or to ``None`` for the identity.
    """

    denoiser: StateDenoiser
    schedule: NoiseSchedule
    shape: tuple[int, ...]
    guide: Guide | None = None
    noise_factor: Callable[[float], np.ndarray | None] | None = None
    counts: dict[str, int] = field(init=False)

    def __post_init__(self) -> None:
        self.counts = self.denoiser.counts

    def noise(self, streams: NormalStreams, t: int) -> np.ndarray:
        """Return F(σ_t) ε, ε ~ N(0, I)."""
        noise = streams.normal(*self.shape)
        factor = None if self.noise_factor is None else self.noise_factor(sigma(self.schedule, t))
        return noise if factor is None else noise @ factor.T

    def estimate(self, x_t: np.ndarray, t: int) -> np.ndarray:
        """Return the guided estimate of the clean motion."""
        alpha_bar = float(self.schedule.alpha_bar[t])
        clean = self.denoiser.denoise(x_t, alpha_bar)
        if self.guide is None:
            return clean
        return self.guide(x_t, alpha_bar, clean, self.schedule.posterior(t))

    def embed(self, motions: np.ndarray) -> np.ndarray:
        """Return the motions."""
        return motions


Corrector = Callable[[State, NormalStreams, np.ndarray, int], np.ndarray]
"""(state, streams, x_t, t) → another state at the same level t."""


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
    watch: Callable[[np.ndarray | None, np.ndarray | None], None] | None = None,
) -> np.ndarray:
    """Return one motion per stream, (B, L, J, 3): the estimate at level ``stop``.

    ``tick`` is called after every level. With ``variance_for_deviation`` the noise is multiplied
    by β̃_t, as printed in algorithm 1 of MAS, instead of √β̃_t. ``corrector`` is applied to every
    new state. ``watch`` is called with every estimate and the unit noise added to it: first with
    (None, initial noise), last with (result, None).
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
    """Return the noise level σ = √((1−ᾱ)/ᾱ)."""
    alpha_bar = float(schedule.alpha_bar[t])
    return float(np.sqrt((1 - alpha_bar) / alpha_bar))


class AncestralSampler:
    """Base of the ancestral samplers of 3D motions: frozen dataclasses with these settings."""

    name: ClassVar[str]
    requires: ClassVar[tuple[type, ...]]
    draws_from = staticmethod(can_guide)
    effort: ClassVar[tuple[str, ...]] = ("steps",)
    least_effort: ClassVar[int] = 2

    steps: int
    trained_steps: int | None
    schedule_power: int
    batch: int

    def __post_init__(self) -> None:
        check_count("batch", self.batch)
        cosine_schedule(self.steps, self.trained_steps, self.schedule_power)

    @property
    def schedule(self) -> NoiseSchedule:
        """The noise levels."""
        return cosine_schedule(self.steps, self.trained_steps, self.schedule_power)

    def sample(
        self,
        posterior: MotionPosterior,
        *,
        draws: int = 1000,
        chains: int = 1,
        seed: int = 0,
        initial: MotionDraws | np.ndarray | None = None,
        progress: bool = True,
    ) -> MotionDraws:
        """Return ``chains`` × ``draws`` independent draws.

        Warns
        -----
        UserWarning
            If the sampler uses views with elevation 0.

        Raises
        ------
        UnsupportedPosterior
            If the prior lacks the denoiser, the likelihood is not linear Gaussian, or the guidance
            or the views do not support the prior or observations.
        """
        require(self, posterior)
        refuse_initial(self, initial)
        state = self._state(posterior)
        return draw_independently(
            self,
            posterior,
            lambda streams, tick: self._run(state, streams, tick),
            draws=draws,
            chains=chains,
            seed=seed,
            batch=self.batch,
            steps=self.steps - self._last_level + 1,
            scale=posterior.prior.scale,  # type: ignore[attr-defined]
            counts=state.counts,
            progress=progress,
        )

    @property
    def _last_level(self) -> int:
        return 1

    def _state(self, posterior: MotionPosterior) -> State:
        raise NotImplementedError

    def _run(
        self, state: State, streams: NormalStreams, tick: Callable[[], Any], **options: Any
    ) -> np.ndarray:
        return ancestral(state, streams, tick, stop=self._last_level, **options)
