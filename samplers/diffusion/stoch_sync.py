"""StochSync (Yeo et al. 2025): synchronised views with maximal noise and alternating views."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np

from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import Denoises2D
from probmotion.samplers.diffusion.guidance import (
    Replacement,
    WeightedTriangulation,
    can_guide,
    guide_towards,
)
from probmotion.samplers.diffusion.noise_levels import AnyLevels, Karras, NoiseLevels, check_object
from probmotion.samplers.diffusion.views import MultiViewDenoiser, view_sets
from probmotion.samplers.independent import Batches, IndependentSampler
from probmotion.seeds import NormalStreams
from probmotion.validation import check_count

__all__ = ["StochSync"]

_Guidance = WeightedTriangulation | Replacement

_VIEWS, _RINGS = 3, 5  # views and alternating rings of learnt denoisers


@dataclass(frozen=True)
class StochSync(NoiseLevels, IndependentSampler):
    """StochSync (Yeo et al. 2025, algorithm 1).

    At each noise level new noise is added to the motion, every view is denoised by several DDIM
    steps of its own, and the views are triangulated. Views rotate from level to level.

    Parameters
    ----------
    steps : int
        Number of noise levels T.
    ode_steps : int
        Number of DDIM steps of a view at each level.
    levels : AnyLevels
        Spacing of the noise levels.
    guidance : WeightedTriangulation or Replacement
        Method of conditioning; by default observations are further views.
    batch : int
        Maximum batch size; does not affect the draws.
    """

    name: ClassVar[str] = "stoch-sync"
    requires: ClassVar[tuple[type, ...]] = (Denoises2D,)
    draws_from = staticmethod(can_guide)
    effort: ClassVar[tuple[str, ...]] = ("steps",)
    least_effort: ClassVar[int] = 2

    steps: int = 40
    ode_steps: int = 5
    levels: AnyLevels = field(default_factory=Karras)
    guidance: _Guidance = field(default_factory=WeightedTriangulation)
    batch: int = 256

    def __post_init__(self) -> None:
        super().__post_init__()
        check_count("ode_steps", self.ode_steps)
        check_object("guidance", self.guidance, _Guidance)

    def _batches(self, posterior: MotionPosterior, seed: int, progress: bool) -> Batches:
        prior, schedule, counts = posterior.prior, self.schedule, {"denoiser": 0}
        assert isinstance(prior, Denoises2D)
        sets = view_sets(prior, _VIEWS, None, rings=_RINGS)
        guide = guide_towards(self, posterior, self.guidance, MultiViewDenoiser(prior, sets[0]))
        shape = (posterior.frames, posterior.skeleton.n_joints, 3)

        def draw(streams: NormalStreams, tick: Callable[[], Any]) -> np.ndarray:
            motions = np.zeros((len(streams.generators), *shape))
            for t in range(schedule.steps, 0, -1):
                views = sets[t % len(sets)]
                below = np.geomspace(schedule.sigma(t), schedule.sigma(1), self.ode_steps)
                noisy = views.project(motions + below[0] * streams.normal(*shape))
                for now, after in pairwise([*below, 0.0]):
                    alpha_bar = 1 / (1 + now**2)
                    clean = prior.denoise(math.sqrt(alpha_bar) * noisy, alpha_bar, views.cameras)
                    counts["denoiser"] += len(noisy) * views.n_views
                    noisy = clean + after / now * (noisy - clean)
                motions = views.combine(noisy)
                if guide is not None:
                    motions = guide(motions, 1.0, motions, schedule.posterior(t))
                tick()
            return motions

        return Batches(draw, self.batch, self.steps, prior.scale, counts)
