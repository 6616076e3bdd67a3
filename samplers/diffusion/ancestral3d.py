"""`Ancestral3D`: DDPM ancestral sampling with a 3D denoiser.

Beside `mas` at the same number of steps it separates the error of the steps from the error of
conditioning on single views.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.noise_schedule import NoiseSchedule
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import Denoises3D
from probmotion.posteriors.sampling import require
from probmotion.samplers.diffusion.ancestral import MotionState, ancestral, cosine_schedule
from probmotion.samplers.diffusion.guidance import (
    AnyGuidance,
    MomentMatched,
    can_guide,
    guide_towards,
)
from probmotion.samplers.diffusion.views import MotionDenoiser
from probmotion.samplers.independent import draw_independently, refuse_initial
from probmotion.validation import check_count

__all__ = ["Ancestral3D"]


@dataclass(frozen=True)
class Ancestral3D:
    """Ancestral sampling (Ho et al. 2020, algorithm 2) of the 3D motion itself.

    A budget sets ``steps`` (:mod:`probmotion.comparison.results.budgets`).

    Parameters
    ----------
    steps : int
        Number of denoising steps T.
    trained_steps : int, optional
        Steps of the schedule that the T levels are taken from; ``steps`` by default.
    schedule_power : int
        Of the cosine schedule: 2 as published by Nichol and Dhariwal (2021), 4 in the MAS
        authors' code.
    guidance : AnyGuidance
        How evidence enters.
    batch : int
        Draws at a time; changes memory and speed, never the draws.
    """

    name: ClassVar[str] = "ancestral3d"
    requires: ClassVar[tuple[type, ...]] = (Denoises3D,)
    draws_from = staticmethod(can_guide)
    effort: ClassVar[tuple[str, ...]] = ("steps",)
    least_effort: ClassVar[int] = 2

    steps: int = 100
    trained_steps: int | None = None
    schedule_power: int = 2
    guidance: AnyGuidance = field(default_factory=MomentMatched)
    batch: int = 256

    def __post_init__(self) -> None:
        check_count("batch", self.batch)
        cosine_schedule(self.steps, self.trained_steps, self.schedule_power)

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

        Raises
        ------
        UnsupportedPosterior
            If the prior has no 3D denoiser, the evidence is not linear with Gaussian noise, or
            the guidance needs what the prior lacks.
        """
        require(self, posterior)
        refuse_initial(self, initial)
        assert isinstance(posterior.prior, Denoises3D)
        denoiser = MotionDenoiser(posterior.prior)
        shape = (posterior.frames, posterior.skeleton.n_joints, 3)
        guide = guide_towards(self, posterior, self.guidance, denoiser)
        state = MotionState(denoiser, self.schedule, shape, guide)
        return draw_independently(
            self,
            posterior,
            lambda streams, tick: ancestral(state, streams, tick),
            draws=draws,
            chains=chains,
            seed=seed,
            batch=self.batch,
            steps=self.steps,
            scale=posterior.prior.scale,
            counts=denoiser.counts,
            progress=progress,
        )
