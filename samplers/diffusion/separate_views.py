"""Sampling state of MAS with perspective views or independent noise per view."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from probmotion.geometry.cameras import Cameras
from probmotion.geometry.triangulation import triangulate
from probmotion.posteriors.noise_schedule import NoiseSchedule
from probmotion.posteriors.protocols import Denoises2D, OrthographicOnly
from probmotion.posteriors.sampling import UnsupportedPosterior
from probmotion.samplers.diffusion.views import Views
from probmotion.seeds import NormalStreams

__all__ = ["SeparateViews"]


@dataclass
class SeparateViews:
    """State with V noisy views per draw, (B, V, L, J, 2); ``shape`` is (L, J, 3).

    All arguments and results are in normalised units. Shared noise is projected orthographically to
    ``views``. ``weights`` w_v of the views; 1 by default.
    """

    prior: Denoises2D
    cameras: Cameras
    weights: tuple[float, ...] | None
    schedule: NoiseSchedule
    shape: tuple[int, ...]
    shared_noise: bool
    counts: dict[str, int] = field(default_factory=lambda: {"denoiser": 0})
    views: Views = field(init=False)
    # Previous triangulation, metres; initial value of the next one.
    _last: np.ndarray | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        self.views = Views(self.cameras, self.weights)

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
        self._last = triangulate(clean * scale, self.cameras, self.weights, initial=self._last)
        return self._last / scale

    def embed(self, motions: np.ndarray) -> np.ndarray:
        """Return the projections of clean motions, (B, V, L, J, 2)."""
        if self.cameras.orthographic:
            return self.views.project(motions)
        scale = self.prior.scale
        return self.cameras.project(motions * scale) / scale

    def _denoise(self, x_t: np.ndarray, alpha_bar: float) -> np.ndarray:
        try:
            return self.prior.denoise(x_t, alpha_bar, self.cameras)
        except OrthographicOnly as error:
            raise UnsupportedPosterior(
                "mas",
                "with perspective views needs a denoiser that supports them, but "
                f"{type(self.prior).__name__} raised: {error}",
                word="perspective",
            ) from error
