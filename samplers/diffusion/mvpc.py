"""Multi-view predictor-corrector sampling.

MAS averages the estimates of single views, so the state is off-manifold if views favour different
modes. Langevin steps with step size ε at high noise levels make the views consistent:

    D(X, t) = M⁻¹ Σ_v P_vᵀ E[x₀ | P_v X, t],   M = Σ_v P_vᵀ P_v,   Λ = V M⁻¹,   σ = √((1−ᾱ)/ᾱ)
    predictor  X ← DDPM posterior step with D(X, t), noise ~ N(0, Λ^γ(σ))
    corrector  X ← X + ε (√ᾱ D(X) − X) + √(2ε(1−ᾱ)) ξ,   ξ ~ N(0, Λ^γ(σ))

√ᾱ D(X) − X = (1−ᾱ) M⁻¹ ∇ Σ_v log p_v(P_v X), so for γ = 1 the corrector is Langevin dynamics
preconditioned by Λ with stationary density Π_v p_v(P_v X)^(1/V), the logarithmic pool of the noisy
2D marginals. With γ > 0, sampling is not exact for an isotropic Gaussian. By default, γ is
therefore ½ only at high noise, where the mode is determined, and 0 at low noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import Any, ClassVar

import numpy as np

from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import Denoises2D
from probmotion.samplers.diffusion.ancestral import AncestralSampler, MotionState, State, sigma
from probmotion.samplers.diffusion.guidance import AnyGuidance, MomentMatched, guide_towards
from probmotion.samplers.diffusion.views import (
    MultiViewDenoiser,
    Views,
    symmetric_power,
    views_around,
)
from probmotion.seeds import NormalStreams
from probmotion.validation import check_count, check_positive

__all__ = ["MultiViewPredictorCorrector"]


@dataclass(frozen=True)
class MultiViewPredictorCorrector(AncestralSampler):
    """Multi-view predictor-corrector sampling with a 2D denoiser.

    Parameters
    ----------
    steps : int
        Number of noise levels T.
    corrector_steps : int
        Number of corrector steps per level.
    corrector_size : float
        Step size ε of the corrector, in (0, 1].
    n_views : int
        Number of orthographic views V, evenly spaced in azimuth; 120° apart if V = 2.
    elevation : float
        Elevation of all views, radians. At 0, a motion and its mirror image are indistinguishable.
    gamma : float
        Exponent γ at high noise, at least 0.
    gamma_from : float
        Noise level σ below which γ is 0.
    corrected_from : float
        Noise level σ below which corrector steps are skipped.
    trained_steps : int, optional
        Number of levels of the schedule from which T are selected; ``steps`` by default.
    schedule_power : int
        Power of the cosine schedule: 2 as published, 4 in the code of MAS.
    guidance : AnyGuidance
        Method of conditioning on the observations.
    batch : int
        Maximum batch size; does not affect the draws.
    """

    name: ClassVar[str] = "mvpc"
    requires: ClassVar[tuple[type, ...]] = (Denoises2D,)

    steps: int = 50
    corrector_steps: int = 1
    corrector_size: float = 0.5
    n_views: int = 5
    elevation: float = math.pi / 16
    gamma: float = 0.5
    gamma_from: float = 0.5
    corrected_from: float = 0.15
    trained_steps: int | None = None
    schedule_power: int = 2
    guidance: AnyGuidance = field(default_factory=MomentMatched)
    batch: int = 256

    def __post_init__(self) -> None:
        super().__post_init__()
        check_count("n_views", self.n_views, least=2)
        check_count("corrector_steps", self.corrector_steps, least=0)
        check_positive("corrector_size", self.corrector_size)
        if self.corrector_size > 1:
            raise ValueError(f"corrector_size must be at most 1, got {self.corrector_size}")
        for name in ("gamma", "gamma_from", "corrected_from"):
            value = getattr(self, name)
            if not 0 <= value < math.inf:
                raise ValueError(f"{name} must be a finite number of at least 0, got {value}")

    @classmethod
    def accurate(cls) -> MultiViewPredictorCorrector:
        """Return a sampler with a smaller error at three times the default cost."""
        return cls(steps=100, corrector_steps=2, corrector_size=0.4)

    def gamma_at(self, level: float) -> float:
        """Return γ at a noise level σ."""
        return self.gamma if level >= self.gamma_from else 0.0

    def _state(self, posterior: MotionPosterior) -> State:
        prior = posterior.prior
        assert isinstance(prior, Denoises2D)
        views = Views(views_around(self.n_views, self.elevation))
        denoiser = MultiViewDenoiser(prior, views)
        guide = guide_towards(self, posterior, self.guidance, denoiser)
        shape = (posterior.frames, posterior.skeleton.n_joints, 3)
        return MotionState(denoiser, self.schedule, shape, guide, self._noise_factor(views))

    def _options(self) -> dict[str, Any]:
        return {"corrector": self._correct} if self.corrector_steps else {}

    def _noise_factor(self, views: Views) -> Callable[[float], np.ndarray | None]:
        """Return the function σ → Λ^(γ(σ)/2), with ``None`` for the identity."""
        covariance = views.n_views * np.linalg.inv(views.gram)

        @cache
        def power(gamma: float) -> np.ndarray | None:
            return symmetric_power(covariance, gamma / 2) if gamma else None

        return lambda level: power(self.gamma_at(level))

    def _correct(self, state: State, streams: NormalStreams, x: np.ndarray, t: int) -> np.ndarray:
        """Return the state after the corrector steps at level t."""
        if sigma(state.schedule, t) < self.corrected_from:
            return x
        size, alpha_bar = self.corrector_size, float(state.schedule.alpha_bar[t])
        for _ in range(self.corrector_steps):
            drift = math.sqrt(alpha_bar) * state.estimate(x, t) - x
            noise = math.sqrt(2 * size * (1 - alpha_bar)) * state.noise(streams, t)
            x = x + size * drift + noise
        return x
