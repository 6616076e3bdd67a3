"""`ScoreDistillation`: SDS, the adaptation of DreamFusion that MAS is compared with.

The motion is optimised directly: see it from a random view, add noise, ask the 2D denoiser what
the noise was, and descend w(t) (ε_φ(x_t) − ε) ∂p/∂X (MAS, sections 5 and 6.3; Poole et al. 2022).
It seeks modes rather than drawing from the prior. A prior that denoises its own coordinates is
optimised in those, with evidence or without
(:mod:`~probmotion.samplers.diffusion.coordinate_distillation`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, get_args

import numpy as np

from probmotion import seeds
from probmotion.geometry.cameras import Cameras
from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.noise_schedule import NoiseSchedule
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import Denoises2D, DenoisesCoordinates
from probmotion.posteriors.sampling import UnsupportedPosterior, require, suited
from probmotion.samplers.adam import Adam
from probmotion.samplers.diffusion.coordinate_distillation import distil_coordinates
from probmotion.samplers.diffusion.views import Views
from probmotion.samplers.independent import draw_independently, refuse_initial
from probmotion.seeds import NormalStreams
from probmotion.validation import check_count, check_positive

__all__ = ["ScoreDistillation", "score_distillation_gradient"]

Levels = Literal["uniform", "annealed"]
Weighting = Literal["constant", "variance", "residual"]


@dataclass(frozen=True)
class ScoreDistillation:
    """Score distillation sampling with a 2D denoiser, or one of the prior's own coordinates.

    Every draw has its own start and its own noise. The level t and the views of an iteration are
    those of all draws of a run, because a denoiser takes one level at a time. It seeks modes: draws
    of a posterior huddle at its modes, and their spread is far too small (over-confident).

    In coordinates there are no views: ``n_views``, ``elevation``, ``azimuths``, ``arc`` and
    ``shared_noise`` are of a 2D denoiser only.

    A budget sets ``iterations`` (:mod:`probmotion.comparison.results.budgets`).

    Parameters
    ----------
    iterations : int
        Gradient steps per draw.
    n_views : int
        Views per iteration, at different random azimuths.
    elevation : float
        Of all views, radians.
    azimuths : int
        The views are drawn from this many azimuths evenly along the arc; an exact prior prepares
        each of them once.
    arc : float
        Radians of the circle that azimuths are drawn from, from 0; all by default.
    shared_noise : bool
        Project one 3D noise into the views of an iteration, rather than independent noise.
    levels : {"uniform", "annealed"}
        t ~ U{1..T−1}, or t falling from T − 1 to 1 over the iterations.
    weighting : {"constant", "variance", "residual"}
        w(t): 1; 1 − ᾱ_t (DreamFusion); √(1−ᾱ_t)/√ᾱ_t, with which the gradient is the residual
        p(X) − x̂₀, that of MAS's loss (appendix B).
    learning_rate : float
        Of Adam, normalised units; in coordinates, units of θ.
    steps : int
        T of the cosine schedule.
    schedule_power : int
        Of the cosine schedule: 2 as published, 4 in the MAS authors' code.
    batch : int
        Draws at a time; changes memory and speed, never the draws.

    Raises
    ------
    ValueError
        If a number is out of range or a name unknown.
    """

    name: ClassVar[str] = "sds"
    requires: ClassVar[tuple[Any, ...]] = (Denoises2D | DenoisesCoordinates,)
    effort: ClassVar[tuple[str, ...]] = ("iterations",)

    iterations: int = 10_000
    n_views: int = 1
    elevation: float = math.pi / 16
    azimuths: int = 36
    arc: float = 2 * math.pi
    shared_noise: bool = False
    levels: Levels = "uniform"
    weighting: Weighting = "constant"
    learning_rate: float = 0.01
    steps: int = 100
    schedule_power: int = 2
    batch: int = 256

    def __post_init__(self) -> None:
        for name in ("iterations", "n_views", "batch"):
            check_count(name, getattr(self, name))
        check_count("steps", self.steps, least=2)
        check_count("azimuths", self.azimuths, least=self.n_views)
        check_positive("learning_rate", self.learning_rate)
        check_positive("arc", self.arc)
        if self.arc > 2 * math.pi:
            raise ValueError(f"arc must be at most the circle, 2 pi, got {self.arc}")
        for name, known in (("levels", Levels), ("weighting", Weighting)):
            if getattr(self, name) not in get_args(known):
                raise ValueError(
                    f"{name} is {getattr(self, name)!r}, expected one of "
                    f"{', '.join(get_args(known))}"
                )

    @classmethod
    def reference_code(cls) -> ScoreDistillation:
        """Return the settings of the MAS authors' released code, where they differ from the paper.

        Its azimuths, uniform on [0, 1), are radians, so that it sees a sixth of the circle.
        """
        return cls(iterations=1000, weighting="residual", arc=1.0, schedule_power=4)

    @property
    def schedule(self) -> NoiseSchedule:
        """The noise levels."""
        return NoiseSchedule.cosine(self.steps, power=self.schedule_power)

    @staticmethod
    def draws_from(posterior: MotionPosterior) -> bool:
        """Return whether the evidence, if any, has a place in what it optimises."""
        return posterior.likelihood is None or not isinstance(posterior.prior, Denoises2D)

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
        """Return ``chains`` × ``draws`` motions, each optimised from its own start.

        Raises
        ------
        UnsupportedPosterior
            If the prior has neither denoiser; if there is evidence, and the prior's denoiser is of
            2D views, or the log likelihood has no gradient by torch.
        """
        require(self, posterior)
        refuse_initial(self, initial)
        prior = posterior.prior
        if not isinstance(prior, Denoises2D):
            return distil_coordinates(
                self, posterior, draws=draws, chains=chains, seed=seed, progress=progress
            )
        if not self.draws_from(posterior):
            raise UnsupportedPosterior(
                self.name,
                "optimises towards the modes of the prior and has no place for evidence",
                word="observations",
                others=suited(posterior),
            )
        counts = {"denoiser": 0}
        shape = (posterior.frames, posterior.skeleton.n_joints, 3)

        def draw_batch(streams: NormalStreams, tick: Callable[[], Any]) -> np.ndarray:
            counts["denoiser"] += len(streams.generators) * self.iterations * self.n_views
            return self._optimise(prior, streams, shape, seed, tick)

        return draw_independently(
            self,
            posterior,
            draw_batch,
            draws=draws,
            chains=chains,
            seed=seed,
            batch=self.batch,
            steps=self.iterations,
            scale=prior.scale,
            counts=counts,
            progress=progress,
        )

    def weight(self, alpha_bar: float) -> float:
        """Return w(t)."""
        if self.weighting == "constant":
            return 1.0
        if self.weighting == "variance":
            return 1 - alpha_bar
        return math.sqrt((1 - alpha_bar) / alpha_bar)

    def plan(self, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """Return t (iterations,) and the views' azimuth numbers (iterations, V) of a run."""
        rng = seeds.generator(seed, "views")
        views = np.stack(
            [rng.permutation(self.azimuths)[: self.n_views] for _ in range(self.iterations)]
        )
        if self.levels == "uniform":
            return rng.integers(1, self.steps, self.iterations), views
        fall = np.linspace(self.steps - 1, 1, self.iterations)
        return np.round(fall).astype(int), views

    def _optimise(
        self,
        prior: Denoises2D,
        streams: NormalStreams,
        shape: tuple[int, ...],
        seed: int,
        tick: Callable[[], Any],
    ) -> np.ndarray:
        schedule = self.schedule
        motions = streams.normal(*shape)
        adam = Adam(motions, self.learning_rate)
        for t, numbers in zip(*self.plan(seed), strict=True):
            azimuth = self.arc * numbers / self.azimuths
            views = Views(Cameras.around(azimuth, np.full(self.n_views, self.elevation)))
            if self.shared_noise:
                noise = views.project(streams.normal(*shape))
            else:
                noise = streams.normal(self.n_views, *shape[:-1], 2)
            alpha_bar = float(schedule.alpha_bar[t])
            gradient = score_distillation_gradient(prior, views, motions, noise, alpha_bar)
            adam.descend(self.weight(alpha_bar) * gradient)
            tick()
        return motions


def score_distillation_gradient(
    prior: Denoises2D, views: Views, motions: np.ndarray, noise: np.ndarray, alpha_bar: float
) -> np.ndarray:
    """Return Σ_v (ε_φ(x_t) − ε) ∂p/∂X, x_t = √ᾱ p(X) + √(1−ᾱ) ε: ``(B, L, J, 3)``.

    Parameters
    ----------
    prior : Denoises2D
        Its estimate x̂₀ is ε_φ in other words: x_t = √ᾱ x̂₀ + √(1−ᾱ) ε_φ.
    views : Views
        The V views.
    motions : ndarray, (B, L, J, 3)
        X, normalised units.
    noise : ndarray, (B, V, L, J, 2)
        ε.
    alpha_bar : float
        ᾱ.
    """
    signal, spread = math.sqrt(alpha_bar), math.sqrt(1 - alpha_bar)
    noisy = signal * views.project(motions) + spread * noise
    clean = prior.denoise(noisy, alpha_bar, views.cameras)
    return views.scatter((noisy - signal * clean) / spread - noise)
