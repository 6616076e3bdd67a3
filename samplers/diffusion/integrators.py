"""Integrators of the reverse diffusion.

All have the form x_{t−1} = noisy x_t + clean D + deviation ε, where D combines estimates of the
clean motion. With σ = √((1−ᾱ)/ᾱ) and λ = −log σ:

- DDPM and DDIM are first order in the step h = λ_{t−1} − λ_t
- SDE-DPM-Solver++ 2M is second order: it extrapolates D from the estimates of two levels
- Heun's method is second order for the probability-flow ODE, with two estimates per step
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from probmotion.samplers.diffusion.states import State

__all__ = ["DDIM", "DDPM", "AnyIntegrator", "Heun", "SecondOrderSDE", "Transition"]

MAX_RATIO = 2.0  # of consecutive steps, beyond which extrapolation is limited


class Transition(NamedTuple):
    """Transition x_{t−1} = ``noisy`` x_t + ``clean`` ``combined`` + ``deviation`` ε.

    ``estimate`` is the estimate of the clean motion at level t, (B, L, J, 3); ``combined`` is that
    of the integrator.
    """

    estimate: np.ndarray
    combined: np.ndarray
    noisy: float
    clean: float
    deviation: float


@dataclass(frozen=True)
class DDPM:
    """Ancestral sampling (Ho et al. 2020, algorithm 2): draws from q(x_{t−1} | x_t, D).

    Parameters
    ----------
    variance_for_deviation : bool
        Multiply the noise by the variance β̃_t, as printed in line 8 of algorithm 1 of MAS, instead
        of its standard deviation.
    """

    kind: str = field(default="ddpm", init=False)
    variance_for_deviation: bool = False

    def transition(
        self, state: State, x: np.ndarray, t: int, before: np.ndarray | None
    ) -> Transition:
        """Return the transition from level t; ``before`` is the estimate at level t + 1."""
        estimate = state.estimate(x, t)
        step = state.schedule.posterior(t)
        deviation = step.deviation**2 if self.variance_for_deviation else step.deviation
        return Transition(estimate, estimate, step.noisy, step.clean, deviation)


@dataclass(frozen=True)
class SecondOrderSDE:
    """SDE-DPM-Solver++ 2M (Lu et al. 2022): the DDPM step with an extrapolated estimate.

    The first step, which has no previous estimate, is a DDPM step; samplers require at least
    three levels.
    """

    kind: str = field(default="second-order-sde", init=False)

    def transition(
        self, state: State, x: np.ndarray, t: int, before: np.ndarray | None
    ) -> Transition:
        """Return the transition from level t; ``before`` is the estimate at level t + 1."""
        combined = estimate = state.estimate(x, t)
        schedule = state.schedule
        step = schedule.posterior(t)
        if before is not None and t > 1:
            now = math.log(schedule.sigma(t) / schedule.sigma(t - 1))
            earlier = math.log(schedule.sigma(t + 1) / schedule.sigma(t))
            combined = estimate + 0.5 * min(now / earlier, MAX_RATIO) * (estimate - before)
        return Transition(estimate, combined, step.noisy, step.clean, step.deviation)


@dataclass(frozen=True)
class DDIM:
    """Deterministic DDIM step (Song et al. 2021): Euler's method for the probability-flow ODE."""

    kind: str = field(default="ddim", init=False)

    def transition(
        self, state: State, x: np.ndarray, t: int, before: np.ndarray | None
    ) -> Transition:
        """Return the transition from level t; ``before`` is the estimate at level t + 1."""
        estimate = state.estimate(x, t)
        ratio, signal = _ratio(state, t)
        noisy = ratio * signal / math.sqrt(state.schedule.alpha_bar[t])
        return Transition(estimate, estimate, noisy, (1 - ratio) * signal, 0.0)


@dataclass(frozen=True)
class Heun:
    """Heun's method for the probability-flow ODE (Karras et al. 2022, algorithm 1).

    Only the initial state is random. Every step takes two estimates.
    """

    kind: str = field(default="heun", init=False)

    def transition(
        self, state: State, x: np.ndarray, t: int, before: np.ndarray | None
    ) -> Transition:
        """Return the transition from level t; ``before`` is the estimate at level t + 1."""
        step = DDIM().transition(state, x, t, before)
        if t == 1:
            return step
        euler = step.noisy * x + step.clean * state.embed(step.estimate)
        change = state.estimate(euler, t - 1) - step.estimate
        return step._replace(combined=step.estimate + change / (2 * _ratio(state, t)[0]))


AnyIntegrator = DDPM | DDIM | SecondOrderSDE | Heun


def _ratio(state: State, t: int) -> tuple[float, float]:
    """Return σ_{t−1}/σ_t and √ᾱ_{t−1}."""
    schedule = state.schedule
    return schedule.sigma(t - 1) / schedule.sigma(t), math.sqrt(schedule.alpha_bar[t - 1])
