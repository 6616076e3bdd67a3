"""SyncTweedies (Kim et al. 2024): synchronised views with deterministic steps."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import Denoises2D
from probmotion.samplers.diffusion.ancestral import AncestralSampler
from probmotion.samplers.diffusion.guidance import (
    AnyGuidance,
    WeightedTriangulation,
    guide_towards,
)
from probmotion.samplers.diffusion.integrators import DDIM
from probmotion.samplers.diffusion.noise_levels import AnyLevels, Cosine
from probmotion.samplers.diffusion.states import MotionState
from probmotion.samplers.diffusion.views import pools, view_sets

__all__ = ["SyncTweedies"]


@dataclass(frozen=True)
class SyncTweedies(AncestralSampler):
    """SyncTweedies (Kim et al. 2024, case 2): averages Tweedie estimates of views in DDIM steps.

    With orthographic views, this is MAS with a deterministic integrator: the canonical space is
    the 3D motion, and averaging is triangulation.

    Parameters
    ----------
    steps : int
        Number of noise levels T.
    n_views : int
        Number of views of learnt denoisers, evenly spaced in azimuth.
    elevation : float, optional
        Elevation of these views, radians; by default that of the prior's training. Exact denoisers
        hold for any view, and by default alternate between five sets of three orthogonal views.
    levels : AnyLevels
        Spacing of the noise levels.
    guidance : AnyGuidance
        Method of conditioning; by default observations are further views.
    batch : int
        Maximum batch size; does not affect the draws.
    """

    name: ClassVar[str] = "sync-tweedies"
    requires: ClassVar[tuple[type, ...]] = (Denoises2D,)
    integrator: ClassVar[DDIM] = DDIM()  # type: ignore[misc]

    steps: int = 100
    n_views: int = 5
    elevation: float | None = None
    levels: AnyLevels = field(default_factory=Cosine)
    guidance: AnyGuidance = field(default_factory=WeightedTriangulation)
    batch: int = 256

    def _state(self, posterior: MotionPosterior) -> MotionState:
        prior = posterior.prior
        assert isinstance(prior, Denoises2D)
        denoisers = pools(prior, view_sets(prior, self.n_views, self.elevation))
        guides = [guide_towards(self, posterior, self.guidance, each) for each in denoisers]
        shape = (posterior.frames, posterior.skeleton.n_joints, 3)
        return MotionState(denoisers, self.schedule, shape, guides)
