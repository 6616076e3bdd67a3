"""`Ancestral2D`: DDPM ancestral sampling of one view, the upper bound of MAS's table 2.

A motion in 3D can be no better, seen from a side, than what the 2D denoiser draws by itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from threadpoolctl import threadpool_limits

from probmotion.geometry.cameras import Cameras
from probmotion.posteriors.noise_schedule import NoiseSchedule
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import Denoises2D
from probmotion.posteriors.sampling import UnsupportedPosterior, batches, progress_bar, suited
from probmotion.samplers.diffusion.ancestral import ancestral, cosine_schedule
from probmotion.seeds import NormalStreams
from probmotion.validation import check_count

__all__ = ["Ancestral2D"]


@dataclass(frozen=True)
class Ancestral2D:
    """Ancestral sampling (Ho et al. 2020, algorithm 2) of one view of a motion.

    It returns pictures, not motions, and therefore is no
    :class:`~probmotion.posteriors.sampling.Sampler` and not among the registered ones.

    Parameters
    ----------
    steps : int
        Number of denoising steps T.
    trained_steps : int, optional
        Steps of the schedule that the T levels are taken from; ``steps`` by default.
    schedule_power : int
        Of the cosine schedule: 2 as published by Nichol and Dhariwal (2021), 4 in the MAS
        authors' code.
    batch : int
        Draws at a time; changes memory and speed, never the draws.

    Raises
    ------
    ValueError
        If a number is out of range.
    """

    name: ClassVar[str] = "ancestral2d"

    steps: int = 100
    trained_steps: int | None = None
    schedule_power: int = 2
    batch: int = 256

    def __post_init__(self) -> None:
        check_count("batch", self.batch)
        cosine_schedule(self.steps, self.trained_steps, self.schedule_power)

    @property
    def schedule(self) -> NoiseSchedule:
        """The noise levels."""
        return cosine_schedule(self.steps, self.trained_steps, self.schedule_power)

    def sample_views(
        self,
        posterior: MotionPosterior,
        *,
        draws: int,
        seed: int = 0,
        camera: Cameras | None = None,
        progress: bool = True,
    ) -> np.ndarray:
        """Return independent draws of what one camera sees.

        Parameters
        ----------
        posterior : MotionPosterior
            A prior without evidence.
        draws : int
            Number of draws; draw i is the same however many there are.
        seed : int
            Of the noise.
        camera : Cameras, optional
            The one view, which a network ignores and an exact denoiser needs; by default
            orthographic, elevation π/16.
        progress : bool
            Show a bar.

        Returns
        -------
        ndarray, (draws, L, J, 2)
            Metres, x right and y down.

        Raises
        ------
        UnsupportedPosterior
            If the prior has no 2D denoiser, or there is evidence.
        ValueError
            If a number is out of range or ``camera`` has several views.
        """
        prior = self._prior(posterior)
        check_count("draws", draws)
        seen = Cameras.ring(1, elevation=math.pi / 16) if camera is None else camera
        if seen.n_views != 1:
            raise ValueError(f"camera has {seen.n_views} views, expected one")
        shape = (posterior.frames, posterior.skeleton.n_joints, 2)
        state = _ViewState(prior, seen, self.schedule, shape)
        bars = progress_bar(self.steps * -(-draws // self.batch), self.name, progress)
        done: list[np.ndarray] = []
        # How a product is split over threads depends on its size, and its rounding on the split.
        with threadpool_limits(1, user_api="blas"), bars as bar:

            def tick() -> None:
                bar.update(1)

            for some in batches([(0, draw) for draw in range(draws)], self.batch):
                streams = NormalStreams.of_draws(seed, list(some))
                done.append(ancestral(state, streams, tick) * prior.scale)
        return np.concatenate(done)

    def _prior(self, posterior: MotionPosterior) -> Denoises2D:
        prior = posterior.prior
        if not isinstance(prior, Denoises2D):
            raise UnsupportedPosterior(
                self.name,
                f"needs a prior with Denoises2D, which {type(prior).__name__} is not",
                word="Denoises2D",
            )
        if posterior.likelihood is not None:
            raise UnsupportedPosterior(
                self.name,
                "draws single views of a prior and has no place for evidence",
                word="observations",
                others=suited(posterior),
            )
        return prior


class _ViewState:
    """One noisy view per draw, (B, L, J, 2), normalised units."""

    def __init__(
        self, prior: Denoises2D, camera: Cameras, schedule: NoiseSchedule, shape: tuple[int, ...]
    ) -> None:
        self.prior = prior
        self.camera = camera
        self.schedule = schedule
        self.shape = shape
        self.counts = {"denoiser": 0}

    def noise(self, streams: NormalStreams, t: int) -> np.ndarray:
        """Return unit noise."""
        return streams.normal(*self.shape)

    def estimate(self, x_t: np.ndarray, t: int) -> np.ndarray:
        """Return the denoised view."""
        self.counts["denoiser"] += len(x_t)
        alpha_bar = float(self.schedule.alpha_bar[t])
        return self.prior.denoise(x_t[:, None], alpha_bar, self.camera)[:, 0]

    def embed(self, motions: np.ndarray) -> np.ndarray:
        """Return the views as they are."""
        return motions
