"""Multi-view ancestral sampling (MAS, algorithm 1).

A 2D denoiser is applied to V views of one 3D motion. At every step the V estimates are triangulated
to one 3D motion, which is reprojected to the views.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from probmotion.geometry.cameras import Cameras
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import Denoises2D
from probmotion.posteriors.sampling import UnsupportedPosterior, require
from probmotion.samplers.diffusion.ancestral import (
    AncestralSampler,
    ancestral,
    check_integrator,
)
from probmotion.samplers.diffusion.guidance import AnyGuidance, MomentMatched, guide_towards
from probmotion.samplers.diffusion.integrators import DDPM, AnyIntegrator, Transition
from probmotion.samplers.diffusion.noise_levels import AnyLevels, Cosine
from probmotion.samplers.diffusion.separate_views import SeparateViews
from probmotion.samplers.diffusion.states import MotionState, State
from probmotion.samplers.diffusion.views import MultiViewDenoiser, Views, views_around
from probmotion.seeds import NormalStreams
from probmotion.validation import check_count, check_positive, check_shape

__all__ = ["MultiViewAncestral", "MultiViewTrace"]


@dataclass(frozen=True)
class MultiViewAncestral(AncestralSampler):
    """Multi-view ancestral sampling (MAS, algorithm 1) with a 2D denoiser.

    With orthographic views and shared noise, the V noisy views are projections of one noisy 3D
    motion, which is the state of the sampler.

    Parameters
    ----------
    steps : int
        Number of denoising steps T.
    n_views : int
        Number of views V, evenly spaced in azimuth; 120° apart if V = 2.
    elevation : float
        Elevation of all views, radians.
    perspective : bool
        Use perspective views, with orthographic projection of the noise (section 4.2). Exact
        denoisers do not support perspective views.
    distance : float
        Distance of perspective views from the origin, metres.
    shared_noise : bool
        Project one 3D noise array to all views instead of drawing independent noise per view.
    view_weights : tuple of float, optional
        Weights of the views in the triangulation; 1 by default.
    levels : AnyLevels
        Spacing of the noise levels: cosine with power 2 as published, 4 in the authors' code.
    integrator : AnyIntegrator
        Integrator of the reverse diffusion: DDPM as published.
    stop_level : int
        Last noise level, whose estimate is returned; 2 in the authors' code.
    guidance : AnyGuidance
        Method of conditioning on the observations.
    batch : int
        Maximum batch size; does not affect the draws.

    Notes
    -----
    Line 8 of algorithm 1 also swaps the factors of x_t and of the reprojected estimate; this
    implementation uses the factors of Ho et al. (2020, equation 7).
    """

    name: ClassVar[str] = "mas"
    requires: ClassVar[tuple[type, ...]] = (Denoises2D,)

    steps: int = 100
    n_views: int = 5
    elevation: float = math.pi / 16
    perspective: bool = False
    distance: float = 7.0
    shared_noise: bool = True
    view_weights: tuple[float, ...] | None = None
    levels: AnyLevels = field(default_factory=Cosine)
    integrator: AnyIntegrator = field(default_factory=DDPM)
    stop_level: int = 1
    guidance: AnyGuidance = field(default_factory=MomentMatched)
    batch: int = 256

    def __post_init__(self) -> None:
        super().__post_init__()
        check_count("n_views", self.n_views, least=2)
        check_count("stop_level", self.stop_level)
        check_positive("distance", self.distance)
        if self.stop_level > self.schedule.steps:
            raise ValueError(
                f"stop_level must be at most steps, {self.steps}, got {self.stop_level}"
            )
        check_integrator(self.integrator, self.schedule.steps - self.stop_level + 1)
        if self.view_weights is not None:
            check_shape("view_weights", np.asarray(self.view_weights), (self.n_views,))
            for weight in self.view_weights:
                check_positive("view_weights", weight)

    @classmethod
    def reference_code(cls) -> MultiViewAncestral:
        """Return the settings of the authors' released code.

        The early-stopped optimiser in its triangulation is not reproduced.
        """
        return cls(n_views=7, perspective=True, levels=Cosine(power=4), stop_level=2)

    @property
    def cameras(self) -> Cameras:
        """Cameras of the V views."""
        return views_around(
            self.n_views, self.elevation, distance=self.distance, perspective=self.perspective
        )

    def trace(self, posterior: MotionPosterior, *, draws: int, seed: int = 0) -> MultiViewTrace:
        """Return the estimates and noise of all draws in the first chain of :meth:`sample`."""
        require(self, posterior)
        if not self.shared_noise:
            raise ValueError("shared_noise must be True to compute new views, got False")
        state = self._state(self._target(posterior))
        steps: list[Transition] = []
        noises: list[np.ndarray] = []

        def watch(step: Transition | None, noise: np.ndarray) -> None:
            if step is not None:
                steps.append(step)
            noises.append(noise)

        streams = NormalStreams.of_draws(seed, [(0, draw) for draw in range(draws)])
        result = ancestral(
            state, streams, lambda: None, self.integrator, watch=watch, **self._options()
        )
        if noises[0].shape[-1] == 2:
            noises = [Views(self.cameras).combine(noise) for noise in noises]
        scale = posterior.prior.scale  # type: ignore[attr-defined]
        return MultiViewTrace(self, tuple(steps), np.stack(noises), result, scale)

    def _options(self) -> dict[str, Any]:
        return {"stop": self.stop_level}

    def _state(self, posterior: MotionPosterior) -> State:
        prior = posterior.prior
        assert isinstance(prior, Denoises2D)
        shape = (posterior.frames, posterior.skeleton.n_joints, 3)
        if self.shared_noise and not self.perspective:
            denoiser = MultiViewDenoiser(prior, Views(self.cameras, self.view_weights))
            guide = guide_towards(self, posterior, self.guidance, denoiser)
            return MotionState([denoiser], self.schedule, shape, [guide])
        if posterior.likelihood is not None:
            raise UnsupportedPosterior(
                self.name,
                "supports observations only with perspective=False and shared_noise=True, got "
                f"perspective={self.perspective} and shared_noise={self.shared_noise}",
                word="observations",
            )
        return SeparateViews(
            prior, self.cameras, self.view_weights, self.schedule, shape, self.shared_noise
        )


@dataclass(frozen=True, eq=False)
class MultiViewTrace:
    """Estimates and noise of a MAS run, used to compute new views (appendix D).

    Parameters
    ----------
    sampler : MultiViewAncestral
        Settings of the run.
    steps : tuple of Transition, (T − stop_level,)
        Steps from level T to stop_level; estimates are triangulated, in normalised units.
    noises : ndarray, (T − stop_level + 1, B, L, J, 3)
        ε₃D⁽ⁱ⁾: initial noise, then the noise added after each step.
    result : ndarray, (B, L, J, 3)
        Motions, the estimates at stop_level, in normalised units.
    scale : float
        Metres per normalised unit.
    """

    sampler: MultiViewAncestral
    steps: tuple[Transition, ...]
    noises: np.ndarray
    result: np.ndarray
    scale: float

    def replay(self, cameras: Cameras, level: int = 0) -> np.ndarray:
        """Return the noisy 2D motion at a level in new views.

        Parameters
        ----------
        cameras : Cameras
            New views.
        level : int
            Noise level between T (pure noise) and 0 (clean motion).

        Returns
        -------
        ndarray, (B, V, L, J, 2)
            2D motions in normalised units.

        Raises
        ------
        ValueError
            If the run does not include the level.
        """
        sampler, schedule = self.sampler, self.sampler.schedule
        if level not in [0, *range(sampler.stop_level, schedule.steps + 1)]:
            raise ValueError(
                f"level must be 0 or between {sampler.stop_level} and {schedule.steps}, got {level}"
            )
        if level == 0:
            return self._project(cameras, self.result)
        views = Views(cameras)
        x = views.project(self.noises[0])
        for step, noise in zip(self.steps[: schedule.steps - level], self.noises[1:], strict=False):
            clean = step.clean * self._project(cameras, step.combined)
            x = clean + step.noisy * x + step.deviation * views.project(noise)
        return x

    def _project(self, cameras: Cameras, motions: np.ndarray) -> np.ndarray:
        if cameras.orthographic:
            return Views(cameras).project(motions)
        return cameras.project(motions * self.scale) / self.scale
