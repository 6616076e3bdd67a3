"""Reverse diffusion from noise to clean motions.

Sampling starts from noise at level T. At every level the denoiser estimates the clean motion, and
the integrator computes the state at the next level.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np

from probmotion.posteriors.posterior import MotionPosterior
from probmotion.samplers.diffusion.guidance import AnyGuidance, ExactGuidance, can_guide
from probmotion.samplers.diffusion.integrators import AnyIntegrator, SecondOrderSDE, Transition
from probmotion.samplers.diffusion.noise_levels import NoiseLevels, check_object
from probmotion.samplers.diffusion.states import State
from probmotion.samplers.diffusion.views import elevation_of_views, warn_of_mirror_images
from probmotion.samplers.independent import Batches, IndependentSampler
from probmotion.seeds import NormalStreams

__all__ = ["AncestralSampler", "Corrector", "ancestral", "check_integrator", "reverse_diffusion"]


Corrector = Callable[[State, NormalStreams, np.ndarray, int], np.ndarray]
"""Function (state, streams, x_t, t) → corrected state at level t."""


def ancestral(
    state: State,
    streams: NormalStreams,
    tick: Callable[[], Any],
    integrator: AnyIntegrator,
    *,
    stop: int = 1,
    corrector: Corrector | None = None,
    watch: Callable[[Transition | None, np.ndarray], None] | None = None,
) -> np.ndarray:
    """Return one motion per stream, (B, L, J, 3), from noise at level T.

    Arguments are those of :func:`reverse_diffusion`; ``watch`` is first called with (None, initial
    noise).
    """
    x = state.noise(streams, state.schedule.steps)
    if watch is not None:
        watch(None, x)
    return reverse_diffusion(
        state, streams, x, tick, integrator, stop=stop, corrector=corrector, watch=watch
    )


def reverse_diffusion(
    state: State,
    streams: NormalStreams,
    x: np.ndarray,
    tick: Callable[[], Any],
    integrator: AnyIntegrator,
    *,
    stop: int = 1,
    corrector: Corrector | None = None,
    watch: Callable[[Transition | None, np.ndarray], None] | None = None,
) -> np.ndarray:
    """Return the estimate at level ``stop``, (B, L, J, 3), from the state ``x`` at level T.

    ``tick`` is called after every level. ``corrector`` is applied to every new state. ``watch`` is
    called with the transition and the unit noise of every step.
    """
    schedule, before = state.schedule, None
    for t in range(schedule.steps, stop, -1):
        step = integrator.transition(state, x, t, before)
        before = step.estimate
        x = step.noisy * x
        x += step.clean * state.embed(step.combined)
        noise = state.noise(streams, t - 1)
        if step.deviation > 0:
            x += step.deviation * noise
        if watch is not None:
            watch(step, noise)
        if corrector is not None:
            x = corrector(state, streams, x, t - 1)
        tick()
    # Given level 1, level 0 is the estimate itself.
    clean = state.estimate(x, stop)
    tick()
    return clean


def check_integrator(integrator: object, steps: int) -> None:
    """Raise ``ValueError`` unless the argument is an integrator for this number of steps."""
    check_object("integrator", integrator, AnyIntegrator)
    if isinstance(integrator, SecondOrderSDE) and steps < 3:
        raise ValueError(
            f"steps must be at least 3 with integrator SecondOrderSDE(), got {steps}; use more "
            "steps or integrator=DDPM()"
        )


class AncestralSampler(NoiseLevels, IndependentSampler):
    """Base class of diffusion samplers of 3D motions."""

    draws_from = staticmethod(can_guide)
    effort: ClassVar[tuple[str, ...]] = ("steps",)
    least_effort: ClassVar[int] = 3

    integrator: AnyIntegrator
    guidance: AnyGuidance

    def __post_init__(self) -> None:
        super().__post_init__()
        check_object("guidance", self.guidance, AnyGuidance)
        check_integrator(self.integrator, self.schedule.steps)

    def _batches(self, posterior: MotionPosterior, seed: int, progress: bool) -> Batches:
        if hasattr(self, "elevation"):
            elevation = elevation_of_views(posterior.prior, self.elevation)
            warn_of_mirror_images(self.name, elevation, stacklevel=3)
        state, options = self._state(self._target(posterior)), self._options()

        def draw(streams: NormalStreams, tick: Callable[[], Any]) -> np.ndarray:
            return ancestral(state, streams, tick, self.integrator, **options)

        steps = self.steps - options.get("stop", 1) + 1
        scale = posterior.prior.scale  # type: ignore[attr-defined]
        return Batches(draw, self.batch, steps, scale, state.counts)

    def _target(self, posterior: MotionPosterior) -> MotionPosterior:
        """Return the posterior, with exact guidance as a prior."""
        if isinstance(self.guidance, ExactGuidance):
            return self.guidance.condition(self, posterior)
        return posterior

    def _state(self, posterior: MotionPosterior) -> State:
        raise NotImplementedError

    def _options(self) -> dict[str, Any]:
        """Return the options of :func:`ancestral`."""
        return {}
