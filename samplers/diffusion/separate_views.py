"""Sampling state of MAS with perspective views or independent noise per view."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from probmotion.geometry.cameras import Cameras
from probmotion.geometry.triangulation import triangulate
from probmotion.posteriors.noise_schedule import NoiseSchedule
from probmotion.posteriors.protocols import Denoises2D
from probmotion.posteriors.sampling import UnsupportedPosterior
from probmotion.samplers.diffusion.views import Views
from probmotion.seeds import NormalStreams

__all__ = ["SeparateViews"]


@dataclass
class SeparateViews:
    """State with V noisy views per draw, (B, V, L, J, 2); ``shape`` is (L, J, 3).

    All arrays are in normalised units. Shared noise is projected orthographically to ``views``.
    """

    prior: Denoises2D
    cameras: Cameras
    views: Views
    schedule: NoiseSchedule
    shape: tuple[int, ...]
    shared_noise: bool
    counts: dict[str, int] = field(default_factory=lambda: {"denoiser": 0})
    _last: np.ndarray | None = None  # Previous triangulation, the next initial value.

    def noise(self, streams: NormalStreams, t: int) -> np.ndarray:
        """Return unit noise in every view; level T starts a new batch."""
        if t == self.schedule.steps:
            self._last = None
        if self.shared_noise:
            return self.views.project(streams.normal(*self.shape))
        return streams.normal(self.views.n_views, *self.shape[:-1], 2)

    def estimate(self, x_t: np.ndarray, t: int) -> np.ndarray:
        """Return the triangulation of the denoised views, (B, L, J, 3)."""
        self.counts["denoiser"] += len(x_t) * self.views.n_views
        clean = self._denoise(x_t, float(self.schedule.alpha_bar[t]))
        if self.cameras.orthographic:
            return self.views.combine(clean)
        scale = self.prior.scale
        motions = triangulate(clean * scale, self.cameras, self.views.weights, initial=self._last)
        self._last = motions
        return motions / scale

    def embed(self, motions: np.ndarray) -> np.ndarray:
        """Return the projections of clean motions, (B, V, L, J, 2)."""
        if self.cameras.orthographic:
            return self.views.project(motions)
        scale = self.prior.scale
        return self.cameras.project(motions * scale) / scale

    def _denoise(self, x_t: np.ndarray, alpha_bar: float) -> np.ndarray:
        try:
            return self.prior.denoise(x_t, alpha_bar, self.cameras)
        except ValueError as error:
            if self.cameras.orthographic:
                raise
            raise UnsupportedPosterior(
                "mas",
                "with perspective views needs a denoiser that supports them, but "
                f"{type(self.prior).__name__} raised: {error}",
                word="perspective",
            ) from error
