"""`VAEEncoder`: a motion VAE's encoder as the network that infers a motion from keypoints."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch

from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.models.vae.model import MotionVAEModel
from probmotion.models.vae.observed_views import picture_of
from probmotion.models.vae.rigid_paths import RigidPath
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.likelihoods import Keypoints2D
from probmotion.posteriors.protocols import Likelihood
from probmotion.seeds import RandomNumbers

__all__ = ["SeenLatent", "VAEEncoder"]

_AVERAGED = 64


@runtime_checkable
class EncodesKeypoints(Protocol):
    """What the encoder reads of its :class:`~probmotion.models.vae.motion_vae.MotionVAE`."""

    skeleton: Skeleton
    frames: int
    dim: int
    body: ArticulatedBody
    model: MotionVAEModel
    rigid: RigidPath

    def motion(self, theta: Any) -> Any:
        """Return the positions at θ: ``(…, dim) → (…, L, J, 3)``, metres."""

    def row_by_row(self, theta: np.ndarray) -> np.ndarray:
        """Return the positions of each row of θ, decoded alone: the same bits in any batch."""


class VAEEncoder:
    """The encoder q(z | keypoints) of a motion VAE; it has no weights but the prior's.

    It reads keypoints of one view. The prior's rigid path says where the subject is: see
    :meth:`~probmotion.models.vae.motion_vae.MotionVAE.placed_by`.
    """

    def __repr__(self) -> str:
        """What tables and saved draws say of it."""
        return f"{type(self).__name__}()"

    def reads(self, likelihood: Likelihood | None) -> bool:
        """Whether the network can read some evidence: keypoints of one view."""
        return isinstance(likelihood, Keypoints2D) and likelihood.cameras.n_views == 1

    def on(
        self,
        prior: EncodesKeypoints,
        likelihood: Keypoints2D,
        *,
        degrees_of_freedom: float | None = None,
        overlap: int = 0,
    ) -> SeenLatent:
        """Return the inference of one track.

        Parameters
        ----------
        prior : MotionVAE
            The posterior's prior.
        likelihood : Keypoints2D
            Keypoints of one view.
        degrees_of_freedom : float, optional
            Of the noise that is supposed in a fit; ``inf`` for Gaussian. By default the evidence's
            own.
        overlap : int
            Not used: a motion of the prior is one window.

        Raises
        ------
        ValueError
            If the prior is no motion VAE, the evidence cannot be read, a whole frame of it is
            hidden, or the prior's rigid path is beside or behind the camera.
        """
        if not isinstance(prior, EncodesKeypoints):
            raise ValueError(
                f"prior must be the MotionVAE whose encoder this is, got {type(prior).__name__}"
            )
        if degrees_of_freedom is not None:
            freedom = None if math.isinf(degrees_of_freedom) else degrees_of_freedom
            likelihood = replace(likelihood, degrees_of_freedom=freedom)
        return SeenLatent(prior, likelihood, *_encoded(prior, likelihood))


class SeenLatent:
    """q(z) = N(μ, diag σ²) of one track, as the encoder answers or fitted to it alone.

    Parameters
    ----------
    prior : MotionVAE
        Decodes.
    likelihood : Keypoints2D
        What was seen.
    mean, log_deviation : Tensor, (Z,)
        μ and log σ, double precision.
    """

    def __init__(
        self,
        prior: EncodesKeypoints,
        likelihood: Keypoints2D,
        mean: torch.Tensor,
        log_deviation: torch.Tensor,
    ) -> None:
        self.prior = prior
        self.likelihood = likelihood
        self.mean = mean.detach().clone()
        self.log_deviation = log_deviation.detach().clone()

    def parameters(self) -> list[torch.Tensor]:
        """Return μ and log σ, from now on with gradients; the networks stay as they are."""
        return [self.mean.requires_grad_(True), self.log_deviation.requires_grad_(True)]

    def loss(
        self, rng: np.random.Generator, *, initial_entropy: bool = True, latent_weight: float = 1.0
    ) -> torch.Tensor:
        """Return minus the evidence lower bound at one draw: −log p(y | X(z)) + w KL(q ‖ N(0, I)).

        Parameters
        ----------
        rng : numpy.random.Generator
            Of the draw.
        initial_entropy : bool
            Not used: one code is of all frames, there is no first pose apart.
        latent_weight : float
            w, of the divergence.
        """
        noise = torch.as_tensor(rng.standard_normal(self.prior.dim))
        z = self.mean + torch.exp(self.log_deviation) * noise
        data = self.likelihood.log_density(self.prior.motion(z))
        return latent_weight * self.divergence() - data

    def divergence(self) -> torch.Tensor:
        """Return KL(q ‖ N(0, I)) = −½ Σ (log σ² − σ² − μ² + 1) (equation 6)."""
        log_variance = 2 * self.log_deviation
        return -0.5 * (log_variance - torch.exp(log_variance) - self.mean**2 + 1).sum()

    def draw(self, streams: RandomNumbers, n: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Return draws (n, L, J, 3), metres, and their z (n, Z)."""
        mean, log_deviation = (part.detach().numpy() for part in (self.mean, self.log_deviation))
        theta = mean + np.exp(log_deviation) * streams.standard_normal((n, self.prior.dim))
        return self.prior.row_by_row(theta), theta

    def predict(self, rng: np.random.Generator, *, average: bool = True) -> np.ndarray:
        """Return the motion predicted, (L, J, 3), metres: the mean over draws, or that of μ.

        A mean of motions has shorter bones where they disagree; that of μ has the body's.
        """
        if average:
            return self.draw(rng, _AVERAGED)[0].mean(axis=0)
        return self.prior.motion(self.mean.detach().numpy())


def _encoded(prior: EncodesKeypoints, likelihood: Keypoints2D) -> tuple[torch.Tensor, torch.Tensor]:
    """Return μ and log σ of q(z | keypoints), (Z,), double precision."""
    camera = likelihood.cameras
    distance = None
    if not camera.orthographic:
        # The root's own distance, on average over frames, as in the pictures that it learnt from.
        distance = float(camera.depth(prior.rigid.translations[:, None]).mean())
    picture = picture_of(likelihood, prior.skeleton, distance=distance)
    if picture.keypoints.shape[0] != prior.frames:
        raise ValueError(
            f"likelihood has {picture.keypoints.shape[0]} frames, expected the prior's "
            f"{prior.frames}"
        )

    def tensor(values: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(values, dtype=torch.float32)

    with torch.no_grad():
        mean, log_variance = prior.model.vae.encode(
            tensor(picture.keypoints)[None],
            tensor(picture.confidence)[None],
            tensor(prior.body.rest_positions),
        )
    return mean[0].double(), 0.5 * log_variance[0].double()
