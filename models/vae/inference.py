"""`VAEEncoder`: amortised inference of motion from keypoints with the encoder of a motion VAE."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from probmotion.extras import torch
from probmotion.models.vae.network import MotionVAEModel
from probmotion.models.vae.observed_views import observed_view
from probmotion.posteriors.likelihoods import Keypoints2D
from probmotion.posteriors.protocols import Likelihood
from probmotion.seeds import RandomNumbers

__all__ = ["EncodedLatent", "VAEEncoder"]

_AVERAGED_DRAWS = 64  # number of draws averaged for a predicted motion


class VAEEncoder:
    """Encoder q(z | keypoints) of a motion VAE, for keypoints of one view.

    The weights are those of the prior, whose rigid path sets the subject's position; see
    :meth:`~probmotion.models.vae.motion_vae.MotionVAE.placed_by`.
    """

    def __repr__(self) -> str:
        """Return a summary for tables and stored draws."""
        return f"{type(self).__name__}()"

    def reads(self, likelihood: Likelihood | None) -> bool:
        """Return whether the observations are keypoints of one view."""
        return isinstance(likelihood, Keypoints2D) and likelihood.cameras.n_views == 1

    def on(
        self,
        prior: Any,
        likelihood: Keypoints2D,
        *,
        degrees_of_freedom: float | None = None,
        overlap: int = 0,
    ) -> EncodedLatent:
        """Return the approximate posterior q(z) of one track.

        ``degrees_of_freedom`` overrides those of the likelihood (``inf``: Gaussian noise);
        ``overlap`` is ignored, as a motion is one window. Raises ``ValueError`` if the prior is not
        a motion VAE, the observations are unsuitable, no joint of a frame is visible, or the path
        is beside or behind the camera.
        """
        if not isinstance(getattr(prior, "model", None), MotionVAEModel):
            raise ValueError(f"prior must be a MotionVAE, got {type(prior).__name__}")
        if degrees_of_freedom is not None:
            freedom = None if math.isinf(degrees_of_freedom) else degrees_of_freedom
            likelihood = replace(likelihood, degrees_of_freedom=freedom)
        return EncodedLatent(prior, likelihood, *_encoded(prior, likelihood))


class EncodedLatent:
    """Approximate posterior q(z) = N(μ, diag σ²) of one track, initialised by the encoder.

    ``mean`` and ``log_deviation`` are μ and log σ, (Z,) each, in double precision.
    """

    def __init__(
        self,
        prior: Any,
        likelihood: Keypoints2D,
        mean: torch.Tensor,
        log_deviation: torch.Tensor,
    ) -> None:
        self.prior = prior
        self.likelihood = likelihood
        self.mean = mean.detach().clone()
        self.log_deviation = log_deviation.detach().clone()

    def parameters(self) -> list[torch.Tensor]:
        """Enable gradients and return μ and log σ; the networks stay fixed."""
        return [self.mean.requires_grad_(True), self.log_deviation.requires_grad_(True)]

    def loss(
        self, rng: np.random.Generator, *, initial_entropy: bool = True, latent_weight: float = 1.0
    ) -> torch.Tensor:
        """Return minus the evidence lower bound at one draw: −log p(y | X(z)) + w KL(q ‖ p).

        ``latent_weight`` is w. ``initial_entropy`` is ignored because z includes the first pose.
        """
        noise = torch.as_tensor(rng.standard_normal(self.prior.dim))
        z = self.mean + torch.exp(self.log_deviation) * noise
        data = self.likelihood.log_density(self.prior.motion(z))
        return latent_weight * self.divergence() - data

    def divergence(self) -> torch.Tensor:
        """Return KL(q ‖ p(z)) (Ponymation, equation 6); for a mixture, an upper bound of it."""
        entropy = self.log_deviation.sum() + 0.5 * self.prior.dim * math.log(2 * math.pi * math.e)
        variance = torch.exp(2 * self.log_deviation)
        return -entropy - self.prior.codes.mean_log_density(self.mean, variance)

    def draw(self, streams: RandomNumbers, n: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Return draws (n, L, J, 3), metres, and their z (n, Z)."""
        mean, log_deviation = (part.detach().numpy() for part in (self.mean, self.log_deviation))
        theta = mean + np.exp(log_deviation) * streams.standard_normal((n, self.prior.dim))
        return self.prior.row_by_row(theta), theta

    def predict(self, rng: np.random.Generator, *, average: bool = True) -> np.ndarray:
        """Return the predicted motion, (L, J, 3), metres: the mean over draws, or the motion at μ.

        Averaging shortens bones where draws disagree; the motion at μ has the body's bone lengths.
        """
        if average:
            return self.draw(rng, _AVERAGED_DRAWS)[0].mean(axis=0)
        return self.prior.motion(self.mean.detach().numpy())


def _encoded(prior: Any, likelihood: Keypoints2D) -> tuple[torch.Tensor, torch.Tensor]:
    """Return μ and log σ of q(z | keypoints), (Z,) each, in double precision."""
    camera = likelihood.cameras
    distance = None
    if not camera.orthographic:
        # Training tracks are scaled to the mean root distance.
        distance = float(camera.depth(prior.rigid.translations[:, None]).mean())
    view = observed_view(likelihood, prior.skeleton, distance=distance)
    if view.keypoints.shape[0] != prior.frames:
        raise ValueError(
            f"likelihood must have the prior's {prior.frames} frames, got {view.keypoints.shape[0]}"
        )

    inputs = (view.keypoints[None], view.confidence[None], prior.body.rest_positions)
    tensors = (torch.as_tensor(values, dtype=torch.float32) for values in inputs)
    with torch.no_grad():
        mean, log_variance = prior.model.vae.encode(*tensors)
    return mean[0].double(), 0.5 * log_variance[0].double()
