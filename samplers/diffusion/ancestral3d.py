"""Ancestral sampling with a 3D denoiser."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import ClassVar

from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import Denoises3D
from probmotion.samplers.diffusion.ancestral import AncestralSampler
from probmotion.samplers.diffusion.guidance import AnyGuidance, MomentMatched, guide_towards
from probmotion.samplers.diffusion.integrators import AnyIntegrator, SecondOrderSDE
from probmotion.samplers.diffusion.noise_levels import AnyLevels, LogSNR
from probmotion.samplers.diffusion.states import MotionState
from probmotion.samplers.diffusion.views import MotionDenoiser

__all__ = ["Ancestral3D"]


@dataclass(frozen=True)
class Ancestral3D(AncestralSampler):
    """Diffusion sampling with a 3D denoiser.

    With the same steps, levels and integrator, draws of ``mas`` differ from those of this sampler
    by the error due to conditioning on single views.

    Parameters
    ----------
    steps : int
        Number of denoising steps T. With fewer than about 30, second-order steps overshoot, and the
        variance is too large.
    levels : AnyLevels
        Spacing of the noise levels.
    integrator : AnyIntegrator
        Integrator of the reverse diffusion.
    guidance : AnyGuidance
        Method of conditioning on the observations; by default moment matching with 12
        conjugate-gradient steps, as the covariance of a 3D denoiser has several large eigenvalues.
        It is exact for a Gaussian prior; for others, ``ExactGuidance()`` is, if the prior can be
        conditioned.
    batch : int
        Maximum batch size; does not affect the draws.
    """

    name: ClassVar[str] = "ancestral3d"
    requires: ClassVar[tuple[type, ...]] = (Denoises3D,)
    least_effort: ClassVar[int] = 30

    steps: int = 50
    levels: AnyLevels = field(default_factory=LogSNR)
    integrator: AnyIntegrator = field(default_factory=SecondOrderSDE)
    guidance: AnyGuidance = field(default_factory=partial(MomentMatched, steps=12))
    batch: int = 256

    def _state(self, posterior: MotionPosterior) -> MotionState:
        assert isinstance(posterior.prior, Denoises3D)
        denoiser = MotionDenoiser(posterior.prior)
        shape = (posterior.frames, posterior.skeleton.n_joints, 3)
        guide = guide_towards(self, posterior, self.guidance, denoiser)
        return MotionState([denoiser], self.schedule, shape, [guide])
