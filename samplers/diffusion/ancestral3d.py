"""Ancestral sampling with a 3D denoiser."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import Denoises3D
from probmotion.samplers.diffusion.ancestral import AncestralSampler, MotionState
from probmotion.samplers.diffusion.guidance import AnyGuidance, MomentMatched, guide_towards
from probmotion.samplers.diffusion.views import MotionDenoiser

__all__ = ["Ancestral3D"]


@dataclass(frozen=True)
class Ancestral3D(AncestralSampler):
    """DDPM ancestral sampling (Ho et al. 2020, algorithm 2) with a 3D denoiser.

    With the same number of steps, draws of ``mas`` differ from those of this sampler by the error
    due to conditioning on single views.

    Parameters
    ----------
    steps : int
        Number of denoising steps T.
    trained_steps : int, optional
        Number of levels of the schedule from which T are selected; ``steps`` by default.
    schedule_power : int
        Power of the cosine schedule: 2 in Nichol and Dhariwal (2021), 4 in the code of MAS.
    guidance : AnyGuidance
        Method of conditioning on the observations.
    batch : int
        Maximum batch size; does not affect the draws.
    """

    name: ClassVar[str] = "ancestral3d"
    requires: ClassVar[tuple[type, ...]] = (Denoises3D,)

    steps: int = 100
    trained_steps: int | None = None
    schedule_power: int = 2
    guidance: AnyGuidance = field(default_factory=MomentMatched)
    batch: int = 256

    def _state(self, posterior: MotionPosterior) -> MotionState:
        assert isinstance(posterior.prior, Denoises3D)
        denoiser = MotionDenoiser(posterior.prior)
        shape = (posterior.frames, posterior.skeleton.n_joints, 3)
        guide = guide_towards(self, posterior, self.guidance, denoiser)
        return MotionState(denoiser, self.schedule, shape, guide)
