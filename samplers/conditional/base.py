"""Base class of samplers of posteriors with linear Gaussian observations."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, ClassVar, Literal, get_args

import numpy as np

from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import Denoises2D, Denoises3D
from probmotion.posteriors.sampling import UnsupportedPosterior, suited
from probmotion.samplers.diffusion import views
from probmotion.samplers.diffusion.guidance import (
    LinearisedObservations,
    LinearObservations,
    MomentMatched,
    can_guide,
)
from probmotion.samplers.diffusion.noise_levels import NoiseLevels
from probmotion.samplers.diffusion.views import MotionDenoiser, StateDenoiser, view_sets
from probmotion.samplers.independent import Batches, IndependentSampler
from probmotion.seeds import NormalStreams

__all__ = ["AnnealedSampler", "ConditionalSampler", "DenoiserChoice", "VarianceExploding"]

DenoiserChoice = Literal["any", "3d", "2d"]


class VarianceExploding:
    """Denoiser as a function of y = X₀ + σ ε, which is x_t/√ᾱ_t."""

    def __init__(self, denoiser: StateDenoiser) -> None:
        self.denoiser = denoiser

    def __call__(self, y: np.ndarray, sigma: float) -> np.ndarray:
        """Return E[X₀ | y]: ``(B, L, J, 3) → (B, L, J, 3)``, normalised units."""
        alpha_bar = 1 / (1 + sigma**2)
        return self.denoiser.denoise(math.sqrt(alpha_bar) * y, alpha_bar)

    def condition(
        self,
        observations: LinearObservations | LinearisedObservations,
        y: np.ndarray,
        sigma: float,
        estimate: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the moment-matched conditional mean and the squared residual, (B,)."""
        alpha_bar = 1 / (1 + sigma**2)
        x_t = math.sqrt(alpha_bar) * y
        return MomentMatched().condition(observations, self.denoiser, x_t, alpha_bar, estimate)


class ConditionalSampler(IndependentSampler):
    """Base class of samplers of posteriors with linear Gaussian observations.

    Subclasses are frozen dataclasses with the setting ``denoiser``.
    """

    requires: ClassVar[tuple[Any, ...]] = (Denoises3D | Denoises2D,)
    effort: ClassVar[tuple[str, ...]] = ("steps",)
    least_effort: ClassVar[int] = 2

    denoiser: DenoiserChoice

    def __post_init__(self) -> None:
        if self.denoiser not in get_args(DenoiserChoice):
            raise ValueError(
                f"denoiser must be one of {', '.join(get_args(DenoiserChoice))}, "
                f"got {self.denoiser!r}"
            )

    @staticmethod
    def draws_from(posterior: MotionPosterior) -> bool:
        """Return whether the posterior has linear Gaussian observations."""
        return posterior.likelihood is not None and can_guide(posterior)

    def _observations(self, posterior: MotionPosterior) -> LinearObservations:
        if posterior.likelihood is None:
            raise UnsupportedPosterior(
                self.name,
                "needs observations",
                word="no observations",
                others=suited(posterior),
            )
        observations = LinearObservations.of(self, posterior)
        self._check_observed(observations.precision)
        return observations

    @staticmethod
    def _check_observed(precision: np.ndarray) -> None:
        if not precision.any():
            raise ValueError(
                "likelihood must contain an observed entry, got none; sample the prior instead"
            )

    def _pools(
        self,
        posterior: MotionPosterior,
        n_views: int = 5,
        elevation: float | None = None,
        rings: int = 1,
    ) -> list[VarianceExploding]:
        """Return the 3D denoiser, or one pool of 2D denoisers for each set of views."""
        prior = posterior.prior
        needed = {"3d": Denoises3D, "2d": Denoises2D}.get(self.denoiser)
        if needed is not None and not isinstance(prior, needed):
            raise UnsupportedPosterior(
                self.name,
                f"with denoiser={self.denoiser!r} needs a prior with {needed.__name__}, got "
                f"{type(prior).__name__}",
                word=needed.__name__,
            )
        if self.denoiser != "2d" and isinstance(prior, Denoises3D):
            return [VarianceExploding(MotionDenoiser(prior))]
        assert isinstance(prior, Denoises2D)
        views.warn_of_mirror_images(self.name, elevation, stacklevel=4)
        sets = view_sets(prior, n_views, elevation, rings)
        return [VarianceExploding(pool) for pool in views.pools(prior, sets)]


class AnnealedSampler(NoiseLevels, ConditionalSampler):
    """Base class of conditional samplers that step through falling noise levels once.

    With a 2D denoiser, levels alternate between pools of views as in ``mvpc``.
    """

    def __post_init__(self) -> None:
        NoiseLevels.__post_init__(self)
        ConditionalSampler.__post_init__(self)

    @property
    def sigmas(self) -> np.ndarray:
        """Noise levels, falling, (T,)."""
        return np.array([self.schedule.sigma(t) for t in range(self.steps, 0, -1)])

    def _batches(self, posterior: MotionPosterior, seed: int, progress: bool) -> Batches:
        observations = self._observations(posterior)
        pools = self._pools(posterior)
        shape = (posterior.frames, posterior.skeleton.n_joints, 3)
        sigmas = self.sigmas

        def draw(streams: NormalStreams, tick: Callable[[], Any]) -> np.ndarray:
            return self._draw(pools, observations, shape, sigmas, streams, tick)

        scale = posterior.prior.scale  # type: ignore[attr-defined]
        return Batches(draw, self.batch, self.steps, scale, pools[0].denoiser.counts)

    def _draw(
        self,
        pools: list[VarianceExploding],
        observations: LinearObservations,
        shape: tuple[int, ...],
        sigmas: np.ndarray,
        streams: NormalStreams,
        tick: Callable[[], Any],
    ) -> np.ndarray:
        """Return one motion per stream, (B, L, J, 3), normalised units; σ falls, (T,)."""
        raise NotImplementedError
