"""Multi-view predictor-corrector sampling.

MAS averages the estimates of single views, so the state is off-manifold if views favour different
modes. Langevin steps with step size ε at high noise levels make the views consistent, and views of
exact denoisers, which alternate between levels, cover the sphere
(:func:`~probmotion.samplers.diffusion.views.view_sets`):

    D(X, t) = M⁻¹ Σ_v P_vᵀ E[x₀ | P_v X, t],   M = Σ_v P_vᵀ P_v,   Λ = V M⁻¹,   σ = √((1−ᾱ)/ᾱ)
    predictor  X ← step of the integrator with D(X, t), noise ~ N(0, Λ^γ(σ))
    corrector  X ← X + ε (√ᾱ D(X) − X) + √(2ε(1−ᾱ)) ξ,   ξ ~ N(0, Λ^γ(σ))

√ᾱ D(X) − X = (1−ᾱ) M⁻¹ ∇ Σ_v log p_v(P_v X), so for γ = 1 the corrector is Langevin dynamics
preconditioned by Λ with stationary density Π_v p_v(P_v X)^(1/V), the logarithmic pool of the noisy
2D marginals. For γ = 0 and views that weight all directions equally, it is Π_v p_v(P_v X)^(3/2V).

Each view has two thirds of the coordinates. A direction of motion that all views see equally is
counted once with γ = 1 and one and a half times with γ = 0, so that its variance is too small.
Noise of single coordinates is counted two thirds of a time with γ = 1 and once with γ = 0; γ = 0 is
therefore exact for an isotropic Gaussian. By default, γ is 1 at the noise levels at which most of
the variance is determined, and 0 below and above, where it would add variance. With observations,
more draws would end in a wrong mode; γ is ½ at all high noise levels. Horizontal views all have the
vertical coordinate, which γ > 0 would make vary too much; γ is 0 for them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, partial
from typing import Any, ClassVar

import numpy as np

from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import Denoises2D
from probmotion.samplers.diffusion.ancestral import AncestralSampler
from probmotion.samplers.diffusion.guidance import AnyGuidance, MomentMatched, guide_towards
from probmotion.samplers.diffusion.integrators import DDPM, AnyIntegrator, SecondOrderSDE
from probmotion.samplers.diffusion.noise_levels import AnyLevels, Cosine, Karras
from probmotion.samplers.diffusion.states import MotionState, State
from probmotion.samplers.diffusion.views import (
    Views,
    elevation_of_views,
    pools,
    symmetric_power,
    view_sets,
)
from probmotion.seeds import NormalStreams
from probmotion.validation import check_count, check_not_negative, check_positive

__all__ = ["MultiViewPredictorCorrector"]

GAMMA_BELOW = 4.0  # noise level σ from which the default γ is 0 without observations


@dataclass(frozen=True)
class MultiViewPredictorCorrector(AncestralSampler):
    """Multi-view predictor-corrector sampling with a 2D denoiser.

    Parameters
    ----------
    steps : int
        Number of noise levels T. With fewer than about 30, second-order steps overshoot, and the
        variance is too large.
    corrector_steps : int
        Number of corrector steps per level.
    corrector_size : float
        Step size ε of the corrector, in (0, 1].
    n_views : int
        Number of views of learnt denoisers, evenly spaced in azimuth.
    elevation : float, optional
        Elevation of these views, radians; by default that of the prior's training. Exact denoisers
        hold for any view, and by default alternate between five sets of three orthogonal views.
    gamma : float, optional
        Exponent γ for σ ≥ ``gamma_from``, in [0, 1]. By default ½ with observations; without, 1
        for σ < 4 and 0 from there on, or 0 at all levels if the views are at elevation 0.
    gamma_from : float
        Noise level σ below which γ is 0.
    corrected_from : float
        Noise level σ below which corrector steps are skipped.
    levels : AnyLevels
        Spacing of the noise levels.
    integrator : AnyIntegrator
        Integrator of the reverse diffusion.
    guidance : AnyGuidance
        Method of conditioning on the observations.
    batch : int
        Maximum batch size; does not affect the draws.
    """

    name: ClassVar[str] = "mvpc"
    requires: ClassVar[tuple[type, ...]] = (Denoises2D,)
    least_effort: ClassVar[int] = 30

    steps: int = 97
    corrector_steps: int = 1
    corrector_size: float = 0.6
    n_views: int = 5
    elevation: float | None = None
    gamma: float | None = None
    gamma_from: float = 1.0
    corrected_from: float = 1.0
    levels: AnyLevels = field(default_factory=partial(Karras, smallest=0.01))
    integrator: AnyIntegrator = field(default_factory=SecondOrderSDE)
    guidance: AnyGuidance = field(default_factory=MomentMatched)
    batch: int = 256

    def __post_init__(self) -> None:
        super().__post_init__()
        check_count("n_views", self.n_views, least=2)
        check_count("corrector_steps", self.corrector_steps, least=0)
        check_positive("corrector_size", self.corrector_size)
        if self.corrector_size > 1:
            raise ValueError(f"corrector_size must be at most 1, got {self.corrector_size}")
        if self.gamma is not None:
            check_not_negative("gamma", self.gamma)
            if self.gamma > 1:
                raise ValueError(f"gamma must be at most 1, got {self.gamma}")
        check_not_negative("gamma_from", self.gamma_from)
        check_not_negative("corrected_from", self.corrected_from)

    @classmethod
    def accurate(cls) -> MultiViewPredictorCorrector:
        """Return a sampler with more levels and smaller corrector steps, at triple the cost."""
        return cls(steps=200, corrector_steps=2, corrector_size=0.4)

    @classmethod
    def learnt(cls) -> MultiViewPredictorCorrector:
        """Return a sampler for learnt denoisers, with first-order steps through their levels.

        Networks err most at low noise, where the defaults, which suit exact denoisers, have most of
        their levels.
        """
        return cls(
            steps=50,
            levels=Cosine(),
            integrator=DDPM(),
            corrector_size=0.5,
            gamma=0.5,
            gamma_from=0.5,
            corrected_from=0.15,
        )

    def gamma_at(self, level: float, *, observed: bool = False, horizontal: bool = False) -> float:
        """Return γ at a noise level σ.

        ``observed``: whether there are observations; ``horizontal``: whether all views are.
        """
        if level < self.gamma_from:
            return 0.0
        if self.gamma is not None:
            return self.gamma
        if observed:
            return 0.5
        return 1.0 if level < GAMMA_BELOW and not horizontal else 0.0

    def _state(self, posterior: MotionPosterior) -> State:
        prior = posterior.prior
        assert isinstance(prior, Denoises2D)
        sets = view_sets(prior, self.n_views, self.elevation)
        denoisers = pools(prior, sets)
        guides = [guide_towards(self, posterior, self.guidance, each) for each in denoisers]
        shape = (posterior.frames, posterior.skeleton.n_joints, 3)
        horizontal = elevation_of_views(prior, self.elevation) == 0
        factor = self._noise_factor(sets[0], posterior.likelihood is not None, horizontal)
        return MotionState(denoisers, self.schedule, shape, guides, factor)

    def _options(self) -> dict[str, Any]:
        return {"corrector": self._correct} if self.corrector_steps else {}

    def _noise_factor(
        self, views: Views, observed: bool, horizontal: bool
    ) -> Callable[[float], np.ndarray | None]:
        """Return the function σ → Λ^(γ(σ)/2), with ``None`` for the identity."""
        covariance = views.n_views * np.linalg.inv(views.gram)

        @cache
        def power(gamma: float) -> np.ndarray | None:
            return symmetric_power(covariance, gamma / 2) if gamma else None

        return lambda level: power(self.gamma_at(level, observed=observed, horizontal=horizontal))

    def _correct(self, state: State, streams: NormalStreams, x: np.ndarray, t: int) -> np.ndarray:
        """Return the state after the corrector steps at level t."""
        if state.schedule.sigma(t) < self.corrected_from:
            return x
        size, alpha_bar = self.corrector_size, float(state.schedule.alpha_bar[t])
        for _ in range(self.corrector_steps):
            drift = math.sqrt(alpha_bar) * state.estimate(x, t) - x
            noise = math.sqrt(2 * size * (1 - alpha_bar)) * state.noise(streams, t)
            x = x + size * drift + noise
        return x
