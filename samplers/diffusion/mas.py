"""`MultiViewAncestral`: multi-view ancestral sampling (MAS), Algorithm 1 of the paper.

V views of one 3D motion are denoised together by a 2D denoiser; after every step a consistency
block turns the V estimates into one 3D motion and back.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from probmotion.geometry.cameras import Cameras
from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.noise_schedule import NoiseSchedule
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import Denoises2D
from probmotion.posteriors.sampling import UnsupportedPosterior, require
from probmotion.samplers.diffusion.ancestral import MotionState, ancestral, cosine_schedule
from probmotion.samplers.diffusion.guidance import (
    AnyGuidance,
    MomentMatched,
    can_guide,
    guide_towards,
)
from probmotion.samplers.diffusion.separate_views import SeparateViews
from probmotion.samplers.diffusion.views import (
    MultiViewDenoiser,
    Views,
    views_around,
    warn_of_level_views,
)
from probmotion.samplers.independent import draw_independently, refuse_initial
from probmotion.seeds import NormalStreams
from probmotion.validation import check_count, check_positive, check_shape

__all__ = ["MultiViewAncestral", "MultiViewTrace"]


@dataclass(frozen=True)
class MultiViewAncestral:
    """Multi-view ancestral sampling (MAS, Algorithm 1) with a 2D denoiser.

    With orthographic views and shared noise the V noisy views are projections of one noisy 3D
    motion, which is kept in their place.

    A budget sets ``steps`` (:mod:`probmotion.comparison.results.budgets`).

    Parameters
    ----------
    steps : int
        Number of denoising steps T.
    n_views : int
        V, evenly around the motion; two are 120° apart.
    elevation : float
        Of all views, radians.
    perspective : bool
        Perspective views; the noise is projected orthographically in any case (section 4.2).
        The prior's denoiser must take them: an exact one does not.
    distance : float
        Metres from the views to the origin; matters to perspective views alone.
    shared_noise : bool
        Project one 3D noise into all views, rather than independent noise per view.
    view_weights : tuple of float, optional
        How much each view counts in the triangulation; 1 each by default.
    trained_steps : int, optional
        Steps of the schedule that the T levels are taken from; ``steps`` by default.
    schedule_power : int
        Of the cosine schedule: 2 as published, 4 in the authors' code.
    stop_level : int
        The level whose estimate is returned; the authors' code stops at 2.
    variance_for_deviation : bool
        Multiply the noise by the DDPM posterior's variance, as line 8 of Algorithm 1 is printed,
        rather than by its standard deviation.
    guidance : AnyGuidance
        How evidence enters.
    batch : int
        Draws at a time; changes memory and speed, never the draws.

    Raises
    ------
    ValueError
        If a number is out of range.

    Notes
    -----
    Line 8 of Algorithm 1 also prints the factors of x_t and of the reprojected estimate the wrong
    way round; here each has its own (Ho et al. 2020, equation 7).
    """

    name: ClassVar[str] = "mas"
    requires: ClassVar[tuple[type, ...]] = (Denoises2D,)
    draws_from = staticmethod(can_guide)
    effort: ClassVar[tuple[str, ...]] = ("steps",)
    least_effort: ClassVar[int] = 2

    steps: int = 100
    n_views: int = 5
    elevation: float = math.pi / 16
    perspective: bool = False
    distance: float = 7.0
    shared_noise: bool = True
    view_weights: tuple[float, ...] | None = None
    trained_steps: int | None = None
    schedule_power: int = 2
    stop_level: int = 1
    variance_for_deviation: bool = False
    guidance: AnyGuidance = field(default_factory=MomentMatched)
    batch: int = 256

    def __post_init__(self) -> None:
        check_count("n_views", self.n_views, least=2)
        check_count("batch", self.batch)
        check_count("stop_level", self.stop_level)
        check_positive("distance", self.distance)
        if self.stop_level > self.schedule.steps:
            raise ValueError(
                f"stop_level must be at most steps, {self.steps}, got {self.stop_level}"
            )
        if self.view_weights is not None:
            check_shape("view_weights", np.asarray(self.view_weights), (self.n_views,))
            for weight in self.view_weights:
                check_positive("view_weights", weight)

    @classmethod
    def reference_code(cls) -> MultiViewAncestral:
        """Return the settings of the authors' released code, where they differ from the paper.

        Not reproduced: its triangulation by an optimiser that stops before the minimum.
        """
        return cls(n_views=7, perspective=True, schedule_power=4, stop_level=2)

    @property
    def cameras(self) -> Cameras:
        """The V views."""
        return views_around(
            self.n_views, self.elevation, distance=self.distance, perspective=self.perspective
        )

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
            If the elevation is 0.

        Raises
        ------
        UnsupportedPosterior
            If the prior has no 2D denoiser or none for such views, the evidence is not linear
            with Gaussian noise, the guidance needs what the prior lacks, or there is evidence and
            the views are perspective or their noise is not shared.
        """
        require(self, posterior)
        refuse_initial(self, initial)
        warn_of_level_views(self.name, self.elevation)
        state = self._state(posterior)
        return draw_independently(
            self,
            posterior,
            lambda streams, tick: ancestral(
                state,
                streams,
                tick,
                stop=self.stop_level,
                variance_for_deviation=self.variance_for_deviation,
            ),
            draws=draws,
            chains=chains,
            seed=seed,
            batch=self.batch,
            steps=self.steps - self.stop_level + 1,
            scale=posterior.prior.scale,  # type: ignore[attr-defined]
            counts=state.counts,
            progress=progress,
        )

    def trace(self, posterior: MotionPosterior, *, draws: int, seed: int = 0) -> MultiViewTrace:
        """Return what :meth:`sample` estimates and adds on its way to its first chain's draws."""
        require(self, posterior)
        if not self.shared_noise:
            raise ValueError("shared_noise is False, expected True: a new view needs the 3D noise")
        state = self._state(posterior)
        views = Views(self.cameras)
        estimates: list[np.ndarray] = []
        noises: list[np.ndarray] = []

        def watch(clean: np.ndarray | None, noise: np.ndarray | None) -> None:
            if clean is not None:
                estimates.append(clean)
            if noise is not None:
                noises.append(noise if noise.shape[-1] == 3 else views.combine(noise))

        streams = NormalStreams.of_draws(seed, [(0, draw) for draw in range(draws)])
        ancestral(
            state,
            streams,
            lambda: None,
            stop=self.stop_level,
            variance_for_deviation=self.variance_for_deviation,
            watch=watch,
        )
        scale = posterior.prior.scale  # type: ignore[attr-defined]
        return MultiViewTrace(self, np.stack(estimates), np.stack(noises), scale)

    def _state(self, posterior: MotionPosterior) -> MotionState | SeparateViews:
        prior = posterior.prior
        assert isinstance(prior, Denoises2D)
        shape = (posterior.frames, posterior.skeleton.n_joints, 3)
        views = Views(self.cameras, self.view_weights)
        if self.shared_noise and not self.perspective:
            denoiser = MultiViewDenoiser(prior, views)
            guide = guide_towards(self, posterior, self.guidance, denoiser)
            return MotionState(denoiser, self.schedule, shape, guide)
        if posterior.likelihood is not None:
            raise UnsupportedPosterior(
                self.name,
                "is guided by evidence only where the views are orthographic and share their "
                f"noise, and perspective is {self.perspective}, shared_noise {self.shared_noise}",
                word="observations",
            )
        return SeparateViews(prior, self.cameras, views, self.schedule, shape, self.shared_noise)


@dataclass(frozen=True, eq=False)
class MultiViewTrace:
    """The estimates and noises of a run of MAS, to be seen from new views (MAS, appendix D).

    Parameters
    ----------
    sampler : MultiViewAncestral
        The run's settings.
    estimates : ndarray, (T − stop + 1, B, L, J, 3)
        X⁽ⁱ⁾, the triangulated estimate at each level from T down, normalised units.
    noises : ndarray, (T − stop + 1, B, L, J, 3)
        ε₃D⁽ⁱ⁾: the first state, then the noise that was added after each estimate but the last.
    scale : float
        Metres per normalised unit.
    """

    sampler: MultiViewAncestral
    estimates: np.ndarray
    noises: np.ndarray
    scale: float

    def replay(self, cameras: Cameras, level: int = 0) -> np.ndarray:
        """Return the noisy 2D motion at a level as new views would have carried it.

        Parameters
        ----------
        cameras : Cameras
            The new views.
        level : int
            From T, pure noise, to 0, the finished motion.

        Returns
        -------
        ndarray, (B, V, L, J, 2)
            Normalised units.

        Raises
        ------
        ValueError
            If the run did not come to that level.
        """
        sampler, schedule = self.sampler, self.sampler.schedule
        reached = [0, *range(sampler.stop_level, schedule.steps + 1)]
        if level not in reached:
            raise ValueError(
                f"level must be 0 or one from {sampler.stop_level} to {schedule.steps}, got {level}"
            )
        if level == 0:
            return self._see(cameras, self.estimates[-1])
        views = Views(cameras)
        x = views.project(self.noises[0])
        for i, t in enumerate(range(schedule.steps, level, -1)):
            step = schedule.posterior(t)
            power = 2 if sampler.variance_for_deviation else 1
            noise = step.deviation**power * views.project(self.noises[i + 1])
            x = step.clean * self._see(cameras, self.estimates[i]) + step.noisy * x + noise
        return x

    def _see(self, cameras: Cameras, motions: np.ndarray) -> np.ndarray:
        if cameras.orthographic:
            return Views(cameras).project(motions)
        return cameras.project(motions * self.scale) / self.scale
