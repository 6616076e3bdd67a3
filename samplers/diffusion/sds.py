"""Score distillation sampling (SDS) as adapted from DreamFusion in MAS.

Every iteration adds noise ε to a random view p(X) of motion X, estimates ε with a 2D denoiser,
and descends w(t) (ε_φ(x_t) − ε) ∂p/∂X (MAS, sections 5 and 6.3; Poole et al. 2022).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, get_args

import numpy as np

from probmotion import seeds
from probmotion.geometry.cameras import Cameras
from probmotion.posteriors.noise_schedule import NoiseSchedule
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import Denoises2D, DenoisesCoordinates
from probmotion.posteriors.sampling import UnsupportedPosterior, suited
from probmotion.samplers.adam import Adam
from probmotion.samplers.diffusion.coordinate_distillation import no_gradient, posterior_gradient
from probmotion.samplers.diffusion.views import Views
from probmotion.samplers.independent import Batches, IndependentSampler
from probmotion.seeds import NormalStreams
from probmotion.validation import check_count, check_positive

__all__ = ["ScoreDistillation"]

Levels = Literal["uniform", "annealed"]
Weighting = Literal["constant", "variance", "residual"]


@dataclass(frozen=True)
class ScoreDistillation(IndependentSampler):
    """Score distillation sampling with a denoiser of 2D motions or of prior coordinates.

    SDS is mode-seeking: its draws are overconfident, with a spread far below that of the posterior.
    Draws have independent starting points and noise, but all draws of a run share the level t and
    the views of an iteration. Priors without a 2D denoiser are optimised in their coordinates, with
    or without observations (:mod:`~probmotion.samplers.diffusion.coordinate_distillation`); the
    evaluation counts then include likelihood gradients and final log densities.

    Parameters
    ----------
    iterations : int
        Number of gradient steps per draw.
    n_views : int
        Number of views per iteration, at distinct random azimuths; 2D denoisers only.
    elevation : float
        Elevation of all views, radians; 2D denoisers only.
    azimuths : int
        Number of evenly spaced candidate azimuths; 2D denoisers only.
    arc : float
        Range of the azimuths from 0, radians; the full circle by default. 2D denoisers only.
    shared_noise : bool
        Project one 3D noise array to all views of an iteration, instead of drawing independent
        noise per view; 2D denoisers only.
    levels : {"uniform", "annealed"}
        Noise level t ~ U{1..T−1}, or decreasing from T − 1 to 1 over the iterations.
    weighting : {"constant", "variance", "residual"}
        Weight w(t): 1, 1 − ᾱ_t (DreamFusion) or √(1−ᾱ_t)/√ᾱ_t. With the last weight the gradient
        is the residual p(X) − x̂₀, as in the loss of MAS (appendix B).
    learning_rate : float
        Learning rate of Adam, in normalised units or units of θ.
    steps : int
        Number of levels T of the cosine schedule.
    schedule_power : int
        Power of the cosine schedule: 2 as published, 4 in the code of MAS.
    batch : int
        Maximum batch size; does not affect the draws.
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
            raise ValueError(f"arc must be at most 2 pi, got {self.arc}")
        for name, options in (("levels", get_args(Levels)), ("weighting", get_args(Weighting))):
            if (value := getattr(self, name)) not in options:
                raise ValueError(f"{name} must be one of {', '.join(options)}, got {value!r}")

    @classmethod
    def reference_code(cls) -> ScoreDistillation:
        """Return the settings of the released code of MAS.

        Azimuths are restricted to [0, 1) radians, a sixth of the circle.
        """
        return cls(iterations=1000, weighting="residual", arc=1.0, schedule_power=4)

    @property
    def schedule(self) -> NoiseSchedule:
        """Cosine noise schedule with ``steps`` levels."""
        return NoiseSchedule.cosine(self.steps, power=self.schedule_power)

    @staticmethod
    def draws_from(posterior: MotionPosterior) -> bool:
        """Return whether the posterior has no observations or its coordinates are optimised."""
        return posterior.likelihood is None or not isinstance(posterior.prior, Denoises2D)

    def _batches(self, posterior: MotionPosterior, seed: int, progress: bool) -> Batches:
        if not isinstance(posterior.prior, Denoises2D):
            return self._coordinate_batches(posterior, seed)
        if posterior.likelihood is not None:
            raise UnsupportedPosterior(
                self.name,
                "does not support observations with a 2D denoiser",
                word="observations",
                others=suited(posterior),
            )
        prior, counts = posterior.prior, {"denoiser": 0}
        shape = (posterior.frames, posterior.skeleton.n_joints, 3)
        elevation = np.full(self.n_views, self.elevation)

        def draw(streams: NormalStreams, tick: Callable[[], Any]) -> np.ndarray:
            motions = streams.normal(*shape)
            counts["denoiser"] += len(motions) * self.iterations * self.n_views

            def gradient(alpha_bar: float, indices: np.ndarray) -> np.ndarray:
                views = Views(Cameras.around(self.arc * indices / self.azimuths, elevation))
                if self.shared_noise:
                    noise = views.project(streams.normal(*shape))
                else:
                    noise = streams.normal(self.n_views, *shape[:-1], 2)
                return score_distillation_gradient(prior, views, motions, noise, alpha_bar)

            self._descend(motions, gradient, seed, tick)
            return motions

        return Batches(draw, self.batch, self.iterations, prior.scale, counts)

    def _coordinate_batches(self, posterior: MotionPosterior, seed: int) -> Batches:
        observed = posterior.likelihood is not None
        if observed and not posterior.differentiable:
            raise no_gradient(posterior, "but it has no gradient")
        counts = {"denoiser": 0, "gradient": 0, "density": 0}
        thetas: list[np.ndarray] = []

        def draw(streams: NormalStreams, tick: Callable[[], Any]) -> np.ndarray:
            theta = streams.normal(posterior.dim)

            def gradient(alpha_bar: float, indices: np.ndarray) -> np.ndarray:
                noise = streams.normal(posterior.dim)
                return posterior_gradient(posterior, theta, noise, alpha_bar)

            self._descend(theta, gradient, seed, tick)
            counts["denoiser"] += len(theta) * self.iterations
            counts["gradient"] += len(theta) * self.iterations * observed
            counts["density"] += len(theta)
            thetas.append(theta)
            return posterior.complete(theta, streams)

        return Batches(draw, self.batch, self.iterations, counts=counts, thetas=thetas)

    def weight(self, alpha_bar: float) -> float:
        """Return the weight w(t)."""
        if self.weighting == "constant":
            return 1.0
        if self.weighting == "variance":
            return 1 - alpha_bar
        return math.sqrt((1 - alpha_bar) / alpha_bar)

    def plan(self, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the levels t, (iterations,), and azimuth indices, (iterations, V), of a run."""
        rng = seeds.generator(seed, "views")
        views = np.stack(
            [rng.permutation(self.azimuths)[: self.n_views] for _ in range(self.iterations)]
        )
        if self.levels == "uniform":
            return rng.integers(1, self.steps, self.iterations), views
        levels = np.linspace(self.steps - 1, 1, self.iterations)
        return np.round(levels).astype(int), views

    def _descend(
        self,
        values: np.ndarray,
        gradient: Callable[[float, np.ndarray], np.ndarray],
        seed: int,
        tick: Callable[[], Any],
    ) -> None:
        """Optimise ``values`` in place with ``gradient``, a function of ᾱ and azimuth indices."""
        alpha_bars = self.schedule.alpha_bar
        adam = Adam(values, self.learning_rate)
        for t, indices in zip(*self.plan(seed), strict=True):
            alpha_bar = float(alpha_bars[t])
            adam.descend(self.weight(alpha_bar) * gradient(alpha_bar, indices))
            tick()


def score_distillation_gradient(
    prior: Denoises2D, views: Views, motions: np.ndarray, noise: np.ndarray, alpha_bar: float
) -> np.ndarray:
    """Return Σ_v (ε_φ(x_t) − ε) ∂p/∂X for x_t = √ᾱ p(X) + √(1−ᾱ) ε = √ᾱ x̂₀ + √(1−ᾱ) ε_φ.

    Motions X are (B, L, J, 3), in normalised units, and the noise ε is (B, V, L, J, 2).
    """
    signal, noise_scale = math.sqrt(alpha_bar), math.sqrt(1 - alpha_bar)
    noisy = signal * views.project(motions) + noise_scale * noise
    clean = prior.denoise(noisy, alpha_bar, views.cameras)
    return views.scatter((noisy - signal * clean) / noise_scale - noise)
