"""Protocols of priors, likelihoods and inference networks.

A sampler lists the protocols that it requires of a prior. Denoisers of motions and views use
normalised units: metres divided by the prior's ``scale``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np

from probmotion.arrays import Array
from probmotion.geometry.cameras import Cameras
from probmotion.motion.skeleton import Skeleton
from probmotion.seeds import RandomNumbers

__all__ = [
    "ChecksObservations",
    "ComparesViews",
    "DenoiserCovariance2D",
    "DenoiserCovariance3D",
    "Denoises2D",
    "Denoises3D",
    "DenoisesCoordinates",
    "ExactPosterior",
    "HasConditional",
    "HasCoordinateSpeeds",
    "HasExactPosterior",
    "HasInferenceNetwork",
    "HasLogDensity",
    "HasManifold",
    "HasMotionDensity",
    "HasSeeds",
    "HasStyles",
    "HasWalks",
    "InferenceNetwork",
    "Likelihood",
    "Marginalises",
    "MotionInference",
    "MotionPrior",
    "NotConjugate",
    "OrthographicOnly",
    "Samplable",
    "Walks",
]


class NotConjugate(ValueError):  # noqa: N818 (a condition, not a fault)
    """Error for a posterior without closed form; the message is the reason."""


class OrthographicOnly(ValueError):  # noqa: N818 (a condition, not a fault)
    """Error for perspective cameras where only orthographic views are supported."""


@runtime_checkable
class Likelihood(Protocol):
    """Likelihood p(y | X) of one observed y."""

    def log_density(self, positions: Array) -> Array:
        """Return log p(y | X): ``(…, L, J, 3) → (…)``."""

    def simulate(self, rng: np.random.Generator, positions: np.ndarray) -> Likelihood:
        """Return the likelihood of observations drawn from p(y | X), X of shape (L, J, 3)."""


@runtime_checkable
class ComparesViews(Protocol):
    """Likelihood that compares a pose's views with annotations of known joint speeds."""

    def evaluate(
        self, positions: np.ndarray, generators: Sequence[np.random.Generator] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return log L and the closest annotations: ``(…, L, J, 3) → (…), (…, m)``.

        With generators, one per pose, log L is evaluated on randomly drawn views.
        """

    def joint_speeds(self, closest: np.ndarray) -> np.ndarray:
        """Return mean squared rotation and stretch per joint: ``(…, m) → (…, J, 2)``."""


@runtime_checkable
class MotionPrior(Protocol):
    """Distribution of motions of one skeleton and L frames, with unconstrained parameters θ."""

    @property
    def skeleton(self) -> Skeleton:
        """Skeleton of the J joints."""

    @property
    def frames(self) -> int:
        """Number of frames L."""

    @property
    def fps(self) -> float:
        """Frames per second."""

    @property
    def dim(self) -> int:
        """Dimension of θ."""

    def motion(self, theta: Array) -> Array:
        """Return the positions at θ: ``(…, dim) → (…, L, J, 3)``, metres."""


@runtime_checkable
class Samplable(Protocol):
    """A prior that can be sampled independently."""

    def sample(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Return n motions, (n, L, J, 3), metres."""


@runtime_checkable
class HasLogDensity(Protocol):
    """A prior with a log density in θ, normalised if possible, and initial points of chains.

    A prior or likelihood without a gradient sets ``differentiable = False``.
    """

    def log_density(self, theta: Array) -> Array:
        """Return log p(θ): ``(…, dim) → (…)``."""

    def initial(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Return n initial points, (n, dim): seeds of a `HasSeeds` prior, else draws."""


@runtime_checkable
class HasMotionDensity(HasLogDensity, Protocol):
    """A prior whose log density is computed from the motion, which the likelihood needs too."""

    def density_and_motion(self, theta: Array) -> tuple[Array, Array]:
        """Return log p(θ) and the motion: ``(…, dim) → (…), (…, L, J, 3)``."""


@runtime_checkable
class HasSeeds(Protocol):
    """A prior that provides initial points because it cannot be sampled."""

    def seed_coordinates(self) -> np.ndarray:
        """Return θ of the seeds, (S, dim); chain k starts at seed k mod S."""


class Walks(Protocol):
    """Markov kernels over poses and single views v of a likelihood that is a mean over views.

    They target p(X, v) ∝ p(X) L(X; v)^β for powers β in [0, 1]; at β = 1, poses are draws of the
    posterior. ``terms`` are those of the log prior of a pose, stored with it.
    """

    @property
    def n_views(self) -> int:
        """Number of views."""

    @property
    def moves(self) -> np.ndarray:
        """One row per kind of move, (n_moves, …)."""

    def terms(self, pose: np.ndarray) -> np.ndarray:
        """Return the terms of the log prior, (…,), of a pose (J, 3)."""

    def log_view(self, pose: np.ndarray, view: int) -> float:
        """Return log L(X; v)."""

    def log_density(self, pose: np.ndarray, terms: np.ndarray) -> float:
        """Return the log posterior density relative to the base measure."""

    def walk(
        self,
        pose: np.ndarray,
        terms: np.ndarray,
        view: int,
        power: float,
        steps: int,
        sizes: np.ndarray,
        tried: np.ndarray,
        taken: np.ndarray,
        rng: np.random.Generator,
    ) -> tuple[int, float]:
        """Take Metropolis steps at a power; return the view and its log likelihood.

        ``sizes`` (n_moves,) scale the moves. ``pose``, ``terms`` and the numbers of tried and taken
        moves (n_moves,) are updated in place.
        """


@runtime_checkable
class HasWalks(Protocol):
    """A prior with walks over poses of one frame for some likelihoods."""

    @property
    def seed(self) -> np.ndarray:
        """Poses at which walks start, (S, J, 3), metres."""

    def walks(self, likelihood: Likelihood | None) -> Walks | None:
        """Return the walks, or None if the likelihood is not supported."""


@runtime_checkable
class HasCoordinateSpeeds(Protocol):
    """A prior that converts joint speeds in an image to steps of θ."""

    def coordinate_speeds(self, joint_speeds: np.ndarray) -> np.ndarray:
        """Return each coordinate's mean squared step: ``(…, J, 2) → (…, dim)``.

        ``joint_speeds`` are squared rotations, radians², and stretches, metres².
        """


@runtime_checkable
class ChecksObservations(Protocol):
    """A prior that rejects some observations."""

    def check_observations(self, likelihood: Likelihood) -> None:
        """Raise ``ValueError`` if no motion of the prior explains the observations."""


@runtime_checkable
class Marginalises(Protocol):
    """A prior that marginalises variables not in θ (a style, a yaw, small noise).

    θ determines a distribution of motions; ``complete`` draws one, given θ and the observations.
    """

    def log_likelihood(self, theta: Array, likelihood: Likelihood) -> Array:
        """Return log p(y | θ), marginalised: ``(…, dim) → (…)``."""

    def complete(
        self, rng: RandomNumbers, theta: np.ndarray, likelihood: Likelihood | None
    ) -> np.ndarray:
        """Return one draw of p(X | θ, y) per θ: ``(n, dim) → (n, L, J, 3)``, metres.

        The i-th draw must use only the i-th rows of the arrays that ``rng`` returns.
        """


@runtime_checkable
class HasStyles(Protocol):
    """A prior over motions of K styles."""

    @property
    def styles(self) -> Sequence[str]:
        """Names of the K styles."""

    def style_responsibilities(self, positions: np.ndarray) -> np.ndarray:
        """Return p(style | X): ``(n, L, J, 3) → (n, K)``."""


@runtime_checkable
class HasManifold(Protocol):
    """A prior concentrated around a manifold."""

    def off_manifold(self, positions: np.ndarray) -> np.ndarray:
        """Return the ratio of off-manifold variance to its expectation: ``(n, L, J, 3) → (n,)``."""


@runtime_checkable
class Denoises2D(Protocol):
    """2D denoiser: posterior mean of clean views given noisy views.

    A learnt denoiser should have the attribute ``view_elevation``, the elevation of its training
    views in radians; without it, samplers also use views from above, as for exact denoisers.
    """

    @property
    def scale(self) -> float:
        """Metres per normalised unit."""

    def denoise(self, x_t: np.ndarray, alpha_bar: float, cameras: Cameras) -> np.ndarray:
        """Return E[x₀ | x_t] view by view.

        Parameters
        ----------
        x_t : ndarray, (B, V, L, J, 2)
            √ᾱ x₀ + √(1−ᾱ) ε in normalised units.
        alpha_bar : float
            ᾱ, in (0, 1].
        cameras : Cameras
            The V views. The exact prior uses their elevation; trained networks ignore them.

        Raises
        ------
        OrthographicOnly
            If the cameras are perspective and the denoiser does not support them.
        """


@runtime_checkable
class Denoises3D(Protocol):
    """3D denoiser: posterior mean of the clean motion given a noisy motion."""

    @property
    def scale(self) -> float:
        """Metres per normalised unit."""

    def denoise_motion(self, x_t: np.ndarray, alpha_bar: float) -> np.ndarray:
        """Return E[X₀ | X_t]: ``(B, L, J, 3) → (B, L, J, 3)``, normalised units."""


@runtime_checkable
class DenoisesCoordinates(HasLogDensity, Protocol):
    """A prior with a denoiser of θ and a log density in θ."""

    def denoise_coordinates(self, theta_t: Array, alpha_bar: float) -> Array:
        """Return E[θ | θ_t], θ_t = √ᾱ θ + √(1−ᾱ) ε: ``(…, dim) → (…, dim)``.

        Accepts NumPy or torch arrays; ᾱ is in (0, 1]. The mean is √ᾱ θ_t if θ ~ N(0, I).
        """


@runtime_checkable
class DenoiserCovariance2D(Protocol):
    """Cov[x₀ | x_t] as an operator, which is the 2D denoiser's Jacobian times (1−ᾱ)/√ᾱ."""

    def view_covariance(
        self, x_t: np.ndarray, alpha_bar: float, cameras: Cameras
    ) -> Callable[[np.ndarray], np.ndarray]:
        """Return v ↦ Cov[x₀ | x_t] v for each view; arrays (B, V, L, J, 2), normalised units."""


@runtime_checkable
class DenoiserCovariance3D(Protocol):
    """Cov[X₀ | X_t] as an operator, which is the 3D denoiser's Jacobian times (1−ᾱ)/√ᾱ."""

    def motion_covariance(
        self, x_t: np.ndarray, alpha_bar: float
    ) -> Callable[[np.ndarray], np.ndarray]:
        """Return v ↦ Cov[X₀ | X_t] v; arrays (B, L, J, 3), normalised units."""


class ExactPosterior(Protocol):
    """A closed-form distribution over motions."""

    def sample(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Return n independent draws, (n, L, J, 3), metres."""

    def log_density(self, positions: Array) -> Array:
        """Return the normalised log density: ``(…, L, J, 3) → (…)``."""


class MotionInference(Protocol):
    """Inference of one recording, with parameters that may be fine-tuned to it."""

    def parameters(self) -> list[Any]:
        """Return the torch parameters to optimise."""

    def loss(self, rng: np.random.Generator, *, initial_entropy: bool, latent_weight: float) -> Any:
        """Return the negative ELBO, summed over windows and estimated from one draw: a tensor."""

    def draw(self, streams: RandomNumbers, n: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Return n draws (n, L, J, 3), metres, and their θ (n, dim) if available.

        The i-th draw uses only the i-th rows of the arrays that ``streams`` returns.
        """

    def predict(self, rng: np.random.Generator, *, average: bool) -> np.ndarray:
        """Return the average motion, or else the motion at the means of q: (L, J, 3), metres."""


@runtime_checkable
class InferenceNetwork(Protocol):
    """Networks trained to infer a prior's motions from observations."""

    def reads(self, likelihood: Likelihood | None) -> bool:
        """Return whether the network supports this kind of observations."""

    def on(
        self,
        prior: Any,
        likelihood: Any,
        *,
        degrees_of_freedom: float | None,
        overlap: int,
    ) -> MotionInference:
        """Return the inference of one recording; ``prior`` may be adapted to the recording."""


@runtime_checkable
class HasInferenceNetwork(Protocol):
    """A prior with an optional inference network."""

    @property
    def inference_network(self) -> InferenceNetwork | None:
        """The network, if one was trained."""


@runtime_checkable
class HasExactPosterior(Protocol):
    """A prior with a closed-form posterior for conjugate likelihoods."""

    def exact_posterior(self, likelihood: Likelihood | None) -> ExactPosterior:
        """Return p(X | y); raise `NotConjugate` unless y is linear in X with Gaussian noise."""


@runtime_checkable
class HasConditional(Protocol):
    """A prior that can be conditioned on observations, with exact denoisers of the posterior."""

    def given(self, likelihood: Likelihood) -> MotionPrior:
        """Return p(X | y) as a prior; raise `NotConjugate` as ``exact_posterior`` does."""
