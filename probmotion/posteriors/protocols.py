"""What a prior over motions can do, as small protocols.

A sampler lists the protocols it requires; a prior implements those it can. Neither imports the
other. Diffusion works in normalised units: a motion in metres divided by the prior's ``scale``.
"""

from __future__ import annotations

from collections.abc import Sequence
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
    "HasCoordinateSpeeds",
    "HasExactPosterior",
    "HasInferenceNetwork",
    "HasLogDensity",
    "HasSeeds",
    "InferenceNetwork",
    "Likelihood",
    "Marginalises",
    "MotionInference",
    "MotionPrior",
    "NotConjugate",
    "Samplable",
]


class NotConjugate(ValueError):  # noqa: N818 (a condition, not a fault)
    """The posterior has no closed form; the message says which part of the likelihood is why."""


@runtime_checkable
class Likelihood(Protocol):
    """log p(y | X) for one observed y."""

    def log_density(self, positions: Array) -> Array:
        """Return log p(y | X): ``(…, L, J, 3) → (…)``."""

    def simulate(self, rng: np.random.Generator, positions: np.ndarray) -> Likelihood:
        """Return the likelihood of evidence drawn from p(y | X), X of shape (L, J, 3)."""


@runtime_checkable
class ComparesViews(Protocol):
    """Evidence that compares a pose's views with annotations, and knows how those move."""

    def evaluate(
        self, positions: np.ndarray, generators: Sequence[np.random.Generator] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return log L and the closest annotations: ``(…, L, J, 3) → (…), (…, m)``.

        With generators, one per pose, log L is of views that each draws anew.
        """

    def joint_speeds(self, closest: np.ndarray) -> np.ndarray:
        """Return joints' mean squared turn and stretch there: ``(…, m) → (…, J, 2)``."""


@runtime_checkable
class MotionPrior(Protocol):
    """A belief about motions of one skeleton, L frames long.

    θ is a flat unconstrained vector of length ``dim``.
    """

    @property
    def skeleton(self) -> Skeleton:
        """The J joints."""

    @property
    def frames(self) -> int:
        """Number of frames L."""

    @property
    def fps(self) -> float:
        """Frames per second."""

    @property
    def dim(self) -> int:
        """Length of θ."""

    def motion(self, theta: Array) -> Array:
        """Return the positions at θ: ``(…, dim) → (…, L, J, 3)``, metres."""


@runtime_checkable
class Samplable(Protocol):
    """Independent draws from the prior."""

    def sample(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Return n motions, (n, L, J, 3), metres."""


@runtime_checkable
class HasLogDensity(Protocol):
    """The prior's log density in θ, and points to start a chain from.

    It is normalised where it can be. A prior or likelihood without a gradient says so by an
    attribute ``differentiable = False``.
    """

    def log_density(self, theta: Array) -> Array:
        """Return log p(θ): ``(…, dim) → (…)``."""

    def initial(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Return n points to start at, (n, dim): draws from the prior unless it `HasSeeds`."""


@runtime_checkable
class HasSeeds(Protocol):
    """A prior that cannot be drawn from, and says itself where chains start."""

    def seed_coordinates(self) -> np.ndarray:
        """Return θ of the seeds, (S, dim); chain k starts at the k-th, and so on round."""


@runtime_checkable
class HasCoordinateSpeeds(Protocol):
    """What joints' movement in a picture means for θ."""

    def coordinate_speeds(self, joint_speeds: np.ndarray) -> np.ndarray:
        """Return each coordinate's mean squared step: ``(…, J, 2) → (…, dim)``.

        ``joint_speeds`` holds the squared turns, radians², and stretches, metres², of joints.
        """


@runtime_checkable
class ChecksObservations(Protocol):
    """A prior that knows of evidence it cannot have."""

    def check_observations(self, likelihood: Likelihood) -> None:
        """Raise ``ValueError`` if no motion of the prior can have made the evidence."""


@runtime_checkable
class Marginalises(Protocol):
    """A prior whose θ leaves variables integrated out (a style, a yaw, small noise).

    Its likelihood is then not a function of one motion, and a motion at θ is a draw.
    """

    def log_likelihood(self, theta: Array, likelihood: Likelihood) -> Array:
        """Return log p(y | θ), everything else integrated out: ``(…, dim) → (…)``."""

    def complete(
        self, rng: RandomNumbers, theta: np.ndarray, likelihood: Likelihood | None
    ) -> np.ndarray:
        """Return one draw of p(X | θ, y) per θ: ``(n, dim) → (n, L, J, 3)``, metres.

        The i-th draw must use the i-th rows of what ``rng`` gives, and nothing else.
        """


@runtime_checkable
class Denoises2D(Protocol):
    """The posterior mean of clean 2D views, given noisy ones."""

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
            The V views. The exact prior needs their elevation; a network trained on views of
            unknown cameras ignores them.
        """


@runtime_checkable
class Denoises3D(Protocol):
    """The posterior mean of the clean motion, given a noisy one."""

    @property
    def scale(self) -> float:
        """Metres per normalised unit."""

    def denoise_motion(self, x_t: np.ndarray, alpha_bar: float) -> np.ndarray:
        """Return E[X₀ | X_t]: ``(B, L, J, 3) → (B, L, J, 3)``, normalised units."""


@runtime_checkable
class DenoisesCoordinates(HasLogDensity, Protocol):
    """The posterior mean of θ, given a noisy θ; and a log density in the same coordinates.

    A prior with θ ~ N(0, I) has it exactly: √ᾱ θ_t.
    """

    def denoise_coordinates(self, theta_t: Array, alpha_bar: float) -> Array:
        """Return E[θ | θ_t], θ_t = √ᾱ θ + √(1−ᾱ) ε: ``(…, dim) → (…, dim)``.

        NumPy or torch arrays; ᾱ is in (0, 1].
        """


@runtime_checkable
class DenoiserCovariance2D(Protocol):
    """Products with Cov[x₀ | x_t], which is the 2D denoiser's Jacobian times (1−ᾱ)/√ᾱ."""

    def view_covariance_product(
        self, x_t: np.ndarray, alpha_bar: float, cameras: Cameras, vectors: np.ndarray
    ) -> np.ndarray:
        """Return Cov[x₀ | x_t] v for each view; all arrays (B, V, L, J, 2), normalised units."""


@runtime_checkable
class DenoiserCovariance3D(Protocol):
    """Products with Cov[X₀ | X_t], which is the 3D denoiser's Jacobian times (1−ᾱ)/√ᾱ."""

    def motion_covariance_product(
        self, x_t: np.ndarray, alpha_bar: float, vectors: np.ndarray
    ) -> np.ndarray:
        """Return Cov[X₀ | X_t] v; all arrays (B, L, J, 3), normalised units."""


class ExactPosterior(Protocol):
    """A distribution over motions in closed form."""

    def sample(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Return n independent draws, (n, L, J, 3), metres."""

    def log_density(self, positions: Array) -> Array:
        """Return the normalised log density: ``(…, L, J, 3) → (…)``."""


class MotionInference(Protocol):
    """Networks that have read one recording, and may be fitted to it alone."""

    def parameters(self) -> list[Any]:
        """Return the torch parameters that may be fitted."""

    def loss(self, rng: np.random.Generator, *, initial_entropy: bool, latent_weight: float) -> Any:
        """Return minus the evidence lower bound, summed over windows, at one draw: a tensor."""

    def draw(self, streams: RandomNumbers, n: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Return draws (n, L, J, 3), metres, and their θ (n, dim) where they have one.

        The i-th draw uses the i-th rows of what ``streams`` gives, and nothing else.
        """

    def predict(self, rng: np.random.Generator, *, average: bool) -> np.ndarray:
        """Return the predicted motion (L, J, 3), metres; of q's means where not ``average``."""


@runtime_checkable
class InferenceNetwork(Protocol):
    """Networks trained to infer motion from evidence, in one prior."""

    def reads(self, likelihood: Likelihood | None) -> bool:
        """Whether evidence of this kind can be read."""

    def on(
        self,
        prior: Any,
        likelihood: Any,
        *,
        degrees_of_freedom: float | None,
        overlap: int,
    ) -> MotionInference:
        """Return the inference of one recording; ``prior`` may be of its length and body."""


@runtime_checkable
class HasInferenceNetwork(Protocol):
    """A prior beside which an inference network was trained."""

    @property
    def inference_network(self) -> InferenceNetwork | None:
        """The network, if there is one."""


@runtime_checkable
class HasExactPosterior(Protocol):
    """The posterior in closed form, where the likelihood allows one."""

    def exact_posterior(self, likelihood: Likelihood | None) -> ExactPosterior:
        """Return p(X | y).

        Raises
        ------
        NotConjugate
            If the likelihood is not linear in the positions with Gaussian noise.
        """
