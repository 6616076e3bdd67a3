"""Ancestral sampling of a single view with a 2D denoiser."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from threadpoolctl import threadpool_limits

from probmotion.geometry.cameras import Cameras
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import Denoises2D
from probmotion.posteriors.sampling import (
    UnsupportedPosterior,
    batches,
    progress_bar,
    require,
    suited,
)
from probmotion.samplers.diffusion.ancestral import ancestral, check_integrator
from probmotion.samplers.diffusion.integrators import DDPM, AnyIntegrator
from probmotion.samplers.diffusion.noise_levels import (
    AnyLevels,
    Cosine,
    NoiseLevels,
)
from probmotion.samplers.diffusion.states import MotionState
from probmotion.seeds import NormalStreams
from probmotion.validation import check_count

__all__ = ["Ancestral2D"]


@dataclass(frozen=True)
class Ancestral2D(NoiseLevels):
    """Diffusion sampling of one view with a 2D denoiser, the upper bound in table 2 of MAS.

    Returns 2D motions and is therefore not a :class:`~probmotion.posteriors.sampling.Sampler`.

    Parameters
    ----------
    steps : int
        Number of denoising steps T.
    levels : AnyLevels
        Spacing of the noise levels.
    integrator : AnyIntegrator
        Integrator of the reverse diffusion.
    batch : int
        Maximum batch size; does not affect the draws.
    """

    name: ClassVar[str] = "ancestral2d"
    requires: ClassVar[tuple[type, ...]] = (Denoises2D,)

    steps: int = 100
    levels: AnyLevels = field(default_factory=Cosine)
    integrator: AnyIntegrator = field(default_factory=DDPM)
    batch: int = 256

    def __post_init__(self) -> None:
        super().__post_init__()
        check_integrator(self.integrator, self.schedule.steps)

    def sample_views(
        self,
        posterior: MotionPosterior,
        *,
        draws: int,
        seed: int = 0,
        camera: Cameras | None = None,
        progress: bool = True,
    ) -> np.ndarray:
        """Return independent draws of one view.

        Parameters
        ----------
        posterior : MotionPosterior
            Posterior without observations.
        draws : int
            Number of draws; individual draws do not depend on it.
        seed : int
            Seed of the noise.
        camera : Cameras, optional
            View for exact denoisers; networks ignore it. Orthographic with elevation π/16 by
            default.
        progress : bool
            Show a progress bar.

        Returns
        -------
        ndarray, (draws, L, J, 2)
            2D motions in metres, x right and y down.

        Raises
        ------
        UnsupportedPosterior
            If the prior has no 2D denoiser or the posterior has observations.
        ValueError
            If ``camera`` has several views.
        """
        require(self, posterior)  # type: ignore[arg-type]
        prior = posterior.prior
        assert isinstance(prior, Denoises2D)
        if posterior.likelihood is not None:
            raise UnsupportedPosterior(
                self.name,
                "does not support observations",
                word="observations",
                others=suited(posterior),
            )
        check_count("draws", draws)
        view = Cameras.ring(1, elevation=math.pi / 16) if camera is None else camera
        if view.n_views != 1:
            raise ValueError(f"camera must have one view, got {view.n_views}")
        shape = (posterior.frames, posterior.skeleton.n_joints, 2)
        state = MotionState([_ViewDenoiser(prior, view)], self.schedule, shape)
        bars = progress_bar(self.steps * -(-draws // self.batch), self.name, progress)
        done: list[np.ndarray] = []
        # Rounding of multithreaded matrix products depends on the batch size.
        with threadpool_limits(1, user_api="blas"), bars as bar:
            for batch in batches([(0, draw) for draw in range(draws)], self.batch):
                streams = NormalStreams.of_draws(seed, list(batch))
                drawn = ancestral(state, streams, lambda: bar.update(1), self.integrator)
                done.append(drawn * prior.scale)
        return np.concatenate(done)


class _ViewDenoiser:
    """2D denoiser E[x₀ | x_t] of one view, with a count of evaluations."""

    def __init__(self, prior: Denoises2D, camera: Cameras) -> None:
        self.prior = prior
        self.camera = camera
        self.counts = {"denoiser": 0}

    def denoise(self, x_t: np.ndarray, alpha_bar: float) -> np.ndarray:
        """Return E[x₀ | x_t]: ``(B, L, J, 2) → (B, L, J, 2)``."""
        self.counts["denoiser"] += len(x_t)
        return self.prior.denoise(x_t[:, None], alpha_bar, self.camera)[:, 0]
