"""`MultiViewPredictorCorrector`: MAS that looks back.

MAS combines one-view estimates and goes on, so that views which disagree about the mode leave the
3D state off the manifold. Here a Langevin step at every level makes the views agree:

    D(X, t) = M⁻¹ Σ_v P_vᵀ E[x₀ | P_v X, t],   M = Σ_v P_vᵀ P_v,   Λ = V M⁻¹,   σ = √((1−ᾱ)/ᾱ)
    predictor  X ← DDPM posterior step with D(X, t), noise ~ N(0, Λ^γ(σ))
    corrector  X ← X + ε (√ᾱ D(X) − X) + √(2ε(1−ᾱ)) ξ,   ξ ~ N(0, Λ^γ(σ))

√ᾱ D(X) − X is (1−ᾱ) M⁻¹ ∇ Σ_v log p_v(P_v X), so with γ = 1 the corrector is Langevin dynamics,
preconditioned by Λ, whose stationary density is the pool Π_v p_v(P_v X)^(1/V) of the noisy 2D
marginals. The price: an isotropic Gaussian, which MAS draws exactly, is no longer exact. Hence
γ = ½ at high noise, where the views choose a mode, and 0 below: mixtures fitted to real clips,
whose small noise is large, are then drawn better than by MAS as well.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import ClassVar

import numpy as np

from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.noise_schedule import NoiseSchedule
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import Denoises2D
from probmotion.posteriors.sampling import require
from probmotion.samplers.diffusion.ancestral import (
    Corrector,
    MotionState,
    State,
    ancestral,
    cosine_schedule,
    sigma,
)
from probmotion.samplers.diffusion.guidance import (
    AnyGuidance,
    MomentMatched,
    can_guide,
    guide_towards,
)
from probmotion.samplers.diffusion.views import (
    MultiViewDenoiser,
    Views,
    symmetric_power,
    views_around,
    warn_of_level_views,
)
from probmotion.samplers.independent import draw_independently, refuse_initial
from probmotion.seeds import NormalStreams
from probmotion.validation import check_count, check_positive

__all__ = ["MultiViewPredictorCorrector"]


@dataclass(frozen=True)
class MultiViewPredictorCorrector:
    """Multi-view predictor-corrector sampling with a 2D denoiser.

    A budget sets ``steps`` (:mod:`probmotion.comparison.results.budgets`).

    Parameters
    ----------
    steps : int
        Number of levels T.
    corrector_steps : int
        n: corrector steps at every level.
    corrector_size : float
        ε, in (0, 1].
    n_views : int
        V, orthographic, evenly around the motion; two are 120° apart.
    elevation : float
        Of all views, radians. Views that never tilt cannot tell a motion from its mirror image.
    gamma : float
        γ at high noise, at least 0.
    gamma_from : float
        The noise level σ below which γ is 0.
    corrected_from : float
        The noise level σ below which no corrector is run.
    trained_steps : int, optional
        Steps of the schedule that the T levels are taken from; ``steps`` by default.
    schedule_power : int
        Of the cosine schedule: 2 as published, 4 in the MAS authors' code.
    guidance : AnyGuidance
        How evidence enters.
    batch : int
        Draws at a time; changes memory and speed, never the draws.

    Raises
    ------
    ValueError
        If a number is out of range.
    """

    name: ClassVar[str] = "mvpc"
    requires: ClassVar[tuple[type, ...]] = (Denoises2D,)
    draws_from = staticmethod(can_guide)
    effort: ClassVar[tuple[str, ...]] = ("steps",)
    least_effort: ClassVar[int] = 2

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
        check_count("n_views", self.n_views, least=2)
        check_count("corrector_steps", self.corrector_steps, least=0)
        check_count("batch", self.batch)
        check_positive("corrector_size", self.corrector_size)
        if self.corrector_size > 1:
            raise ValueError(f"corrector_size must be at most 1, got {self.corrector_size}")
        for name in ("gamma", "gamma_from", "corrected_from"):
            value = getattr(self, name)
            if not 0 <= value < math.inf:
                raise ValueError(f"{name} must be a finite number of at least 0, got {value}")
        cosine_schedule(self.steps, self.trained_steps, self.schedule_power)

    @classmethod
    def accurate(cls) -> MultiViewPredictorCorrector:
        """Return the settings for three times the default's evaluations and a smaller error."""
        return cls(steps=100, corrector_steps=2, corrector_size=0.4)

    @property
    def schedule(self) -> NoiseSchedule:
        """The noise levels."""
        return cosine_schedule(self.steps, self.trained_steps, self.schedule_power)

    def gamma_at(self, level: float) -> float:
        """Return γ at a noise level σ."""
        return self.gamma if level >= self.gamma_from else 0.0

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
            If the elevation is 0.

        Raises
        ------
        UnsupportedPosterior
            If the prior has no 2D denoiser, the evidence is not linear with Gaussian noise, or
            the guidance needs what the prior lacks.
        """
        require(self, posterior)
        refuse_initial(self, initial)
        warn_of_level_views(self.name, self.elevation)
        prior = posterior.prior
        assert isinstance(prior, Denoises2D)
        views = Views(views_around(self.n_views, self.elevation))
        denoiser = MultiViewDenoiser(prior, views)
        guide = guide_towards(self, posterior, self.guidance, denoiser)
        shape = (posterior.frames, posterior.skeleton.n_joints, 3)
        state = MotionState(denoiser, self.schedule, shape, guide, self._noise_factor(views))
        return draw_independently(
            self,
            posterior,
            lambda streams, tick: ancestral(state, streams, tick, corrector=self._corrector()),
            draws=draws,
            chains=chains,
            seed=seed,
            batch=self.batch,
            steps=self.steps,
            scale=prior.scale,
            counts=state.counts,
            progress=progress,
        )

    def _noise_factor(self, views: Views) -> Callable[[float], np.ndarray | None]:
        """Return σ → Λ^(γ(σ)/2); ``None`` where it is the identity."""
        spread = views.n_views * np.linalg.inv(views.gram)

        @cache
        def power(gamma: float) -> np.ndarray | None:
            return symmetric_power(spread, gamma / 2) if gamma else None

        return lambda level: power(self.gamma_at(level))

    def _corrector(self) -> Corrector | None:
        if self.corrector_steps == 0:
            return None
        size = self.corrector_size

        def correct(state: State, streams: NormalStreams, x: np.ndarray, t: int) -> np.ndarray:
            if sigma(state.schedule, t) < self.corrected_from:
                return x
            alpha_bar = float(state.schedule.alpha_bar[t])
            for _ in range(self.corrector_steps):
                drift = math.sqrt(alpha_bar) * state.estimate(x, t) - x
                kick = math.sqrt(2 * size * (1 - alpha_bar)) * state.noise(streams, t)
                x = x + size * drift + kick
            return x

        return correct
