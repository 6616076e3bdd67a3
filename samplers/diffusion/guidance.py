"""Guidance of denoisers by linear Gaussian observations.

Observations are y = A X + noise with precision W, in normalised units. Guidance maps the estimate D
of E[X₀ | X_t] to an estimate of E[X₀ | X_t, y].
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from probmotion.posteriors.noise_schedule import PosteriorStep
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import HasConditional, NotConjugate
from probmotion.posteriors.sampling import Sampler, UnsupportedPosterior, suited
from probmotion.samplers.diffusion.views import StateDenoiser, symmetric_power
from probmotion.validation import check_count, check_positive

__all__ = [
    "DPS", "AnyGuidance", "ExactGuidance", "Guide", "LinearObservations", "LinearisedObservations",
    "MomentMatched", "Replacement", "WeightedTriangulation", "can_guide", "guide_towards",
]  # fmt: skip

_ROWS = 64  # covariances of more rows would take hundreds of megabytes

Guide = Callable[[np.ndarray, float, np.ndarray, PosteriorStep], np.ndarray]
"""(x_t, ᾱ, estimate, posterior step) → the estimate given the observations, (B, L, J, 3)."""


def can_guide(posterior: MotionPosterior) -> bool:
    """Return whether the posterior has no observations or a linear Gaussian likelihood."""
    try:
        return posterior.likelihood is None or bool(_linear(posterior))
    except NotConjugate:
        return False


def _linear(posterior: MotionPosterior) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return A, y and W of the likelihood, metres."""
    if posterior.truncated:
        raise NotConjugate("the posterior is truncated")
    linear = getattr(posterior.likelihood, "linear", None)
    if linear is None:
        raise NotConjugate(f"{type(posterior.likelihood).__name__} has no method linear()")
    return linear()


@dataclass(frozen=True, eq=False)
class LinearObservations:
    """Linear Gaussian observations y_v = A_v X + noise with precision W, in normalised units.

    ``axes`` are A_v, (V, M, 3); ``target`` is y, (V, L, J, M); ``precision`` is W, (V, L, J), 0 for
    missing entries.
    """

    axes: np.ndarray
    target: np.ndarray
    precision: np.ndarray

    @classmethod
    def of(cls, sampler: Sampler, posterior: MotionPosterior) -> LinearObservations:
        """Return the observations of a posterior; raise an error if they are not linear."""
        try:
            axes, target, precision = _linear(posterior)
        except NotConjugate as error:
            raise UnsupportedPosterior(
                sampler.name,
                f"supports only linear Gaussian likelihoods, but {error}",
                word="observations",
                others=suited(posterior),
            ) from error
        scale = posterior.prior.scale  # type: ignore[attr-defined]
        return cls(axes, target / scale, precision * scale**2)

    @property
    def confidence(self) -> np.ndarray:
        """Precision divided by the largest precision, (V, L, J)."""
        top = self.precision.max(initial=0.0)
        return self.precision / top if top > 0 else self.precision

    def about(self, motions: np.ndarray) -> LinearObservations:
        """Return ``self``, as the observations are linear."""
        return self

    def rows(self, rows: slice) -> LinearObservations:
        """Return ``self``, as the observations are those of all motions."""
        return self

    def observe(self, motions: np.ndarray) -> np.ndarray:
        """Return A X: ``(B, L, J, 3) → (B, V, L, J, M)``."""
        return motions[:, None] @ self.axes.swapaxes(1, 2)[:, None]

    def adjoint(self, entries: np.ndarray) -> np.ndarray:
        """Return Aᵀ u: ``(B, V, L, J, M) → (B, L, J, 3)``."""
        return (entries @ self.axes[:, None]).sum(axis=1)

    def information(self, weight: np.ndarray) -> np.ndarray:
        """Return Σ_v w A_vᵀ A_v: ``(V, L, J) → (L, J, 3, 3)``."""
        return np.einsum("vlj,vmx,vmy->ljxy", weight, self.axes, self.axes)


@dataclass(frozen=True, eq=False)
class LinearisedObservations:
    """Observations of B motions, linearised about each, in normalised units.

    ``axes``, (…, K, 3), are the Jacobians of the K rows of an entry; ``target`` is y − π(X) + A X,
    (B, L, J, K, 1); ``precision`` is W, (L, J, K), 0 for missing entries.
    """

    axes: np.ndarray
    target: np.ndarray
    precision: np.ndarray

    def rows(self, rows: slice) -> LinearisedObservations:
        """Return the observations of some of the motions."""
        axes = self.axes if self.axes.ndim == 2 else self.axes[rows]
        return replace(self, axes=axes, target=self.target[rows])

    def observe(self, motions: np.ndarray) -> np.ndarray:
        """Return A X: ``(B, L, J, 3) → (B, L, J, K, 1)``."""
        return self.axes @ motions[..., None]

    def adjoint(self, entries: np.ndarray) -> np.ndarray:
        """Return Aᵀ u: ``(B, L, J, K, 1) → (B, L, J, 3)``."""
        return (self.axes.swapaxes(-1, -2) @ entries)[..., 0]


@dataclass(frozen=True)
class MomentMatched:
    """Mean of N(D, C) conditioned on y, with C from the denoiser's Jacobian (moment matching).

        D + C Aᵀ (A C Aᵀ + W⁻¹)⁻¹ (y − A D)

    Exact for a Gaussian prior with its exact 3D denoiser. The system is solved by conjugate
    gradients (Finzi et al. 2023; Boys et al. 2024).

    Parameters
    ----------
    steps : int
        Maximum number of conjugate-gradient steps, each with one product with C. Steps of a draw
        stop early if C is detectably not a covariance, which may occur with learnt denoisers.
    """

    kind: str = field(default="moment-matched", init=False)
    steps: int = 6

    def __post_init__(self) -> None:
        check_count("steps", self.steps)

    def prepare(self, observations: LinearObservations, denoiser: StateDenoiser) -> Guide:
        """Return the guide for one run."""

        def guide(
            x_t: np.ndarray, alpha_bar: float, clean: np.ndarray, step: PosteriorStep
        ) -> np.ndarray:
            return self.condition(observations, denoiser, x_t, alpha_bar, clean)[0]

        return guide

    def condition(
        self,
        observations: LinearObservations | LinearisedObservations,
        denoiser: StateDenoiser,
        x_t: np.ndarray,
        alpha_bar: float,
        clean: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the conditional mean and (y − A D)ᵀ (A C Aᵀ + W⁻¹)⁻¹ (y − A D), (B,)."""
        parts = [
            self._solve(
                denoiser.covariance(x_t[rows], alpha_bar), observations.rows(rows), clean[rows]
            )
            for rows in _parts(len(x_t))
        ]
        change, square = (np.concatenate(part) for part in zip(*parts, strict=True))
        if not np.isfinite(change).all():
            raise ValueError(
                f"guidance with steps={self.steps} diverged at alpha_bar={alpha_bar:.3g}, "
                "because the denoiser's Jacobian is not symmetric; use fewer steps"
            )
        return clean + change, square

    def _solve(
        self,
        covariance: Callable[[np.ndarray], np.ndarray],
        observations: LinearObservations | LinearisedObservations,
        clean: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the change of the mean, and the squared residual, (B,)."""
        root = np.sqrt(observations.precision)[..., None]

        def spread(entries: np.ndarray) -> np.ndarray:
            """Return C Aᵀ W^½ u."""
            return covariance(observations.adjoint(root * entries))

        def whiten(motions: np.ndarray) -> np.ndarray:
            """Return W^½ A X."""
            return root * observations.observe(motions)

        residual = root * (observations.target - observations.observe(clean))
        # Weight both sides by W^½, because W⁻¹ does not exist for missing entries.
        change = conjugate_gradients(spread, whiten, residual, self.steps)
        return change, _products(residual, residual - whiten(change))


@dataclass(frozen=True)
class DPS:
    """Diffusion posterior sampling: one gradient step on ‖y − A D(X_t)‖ per denoising step.

    This is algorithm 1 of Chung et al. (2023) with step sizes ζ_i = ζ/‖y − A D‖.

    Parameters
    ----------
    step_size : float
        Step size ζ.
    """

    kind: str = field(default="dps", init=False)
    step_size: float = 1.0

    def __post_init__(self) -> None:
        check_positive("step_size", self.step_size)

    def prepare(self, observations: LinearObservations, denoiser: StateDenoiser) -> Guide:
        """Return the guide for one run."""
        confidence = observations.confidence[..., None]
        half = symmetric_power(denoiser.gram, 0.5)
        inverse_half = symmetric_power(denoiser.gram, -0.5)

        def guide(
            x_t: np.ndarray, alpha_bar: float, clean: np.ndarray, step: PosteriorStep
        ) -> np.ndarray:
            residual = observations.target - observations.observe(clean)
            length = np.sqrt((confidence * residual**2).sum(axis=(1, 2, 3, 4), keepdims=True))
            adjoint = observations.adjoint(confidence * residual / np.maximum(length, 1e-300))
            # ∇‖y − A D‖ = −Jᵀ Aᵀ (y − A D)/‖y − A D‖ with J = √ᾱ/(1−ᾱ) M^(-½) C M^(½).
            vectors = adjoint @ inverse_half
            product = np.concatenate(
                [
                    denoiser.covariance(x_t[rows], alpha_bar)(vectors[rows])
                    for rows in _parts(len(x_t))
                ]
            )
            gradient = -(np.sqrt(alpha_bar) / (1 - alpha_bar)) * (product @ half)
            # The estimate has weight step.clean in x_{t−1}, which must change by −ζ ∇.
            return clean - (self.step_size / step.clean) * gradient

        return guide


@dataclass(frozen=True)
class Replacement:
    """Replacement of the observed coordinates of the estimate by the observations.

    Tevet et al. (2023, section 4.3) edit motions by replacement. Observations are treated as exact;
    inconsistent observations are averaged with weights proportional to their precision.
    """

    kind: str = field(default="replacement", init=False)

    def prepare(self, observations: LinearObservations, denoiser: StateDenoiser) -> Guide:
        """Return the guide for one run."""
        confidence = observations.confidence
        inverse = np.linalg.pinv(observations.information(confidence), hermitian=True)
        return _least_squares(observations, confidence, inverse)


@dataclass(frozen=True)
class WeightedTriangulation:
    """Least-squares triangulation of the view estimates, with observations as additional views.

    Parameters
    ----------
    weight : float
        Weight of the most precise observations; the views of the sampler have weight 1.
    """

    kind: str = field(default="weighted-triangulation", init=False)
    weight: float = 1.0

    def __post_init__(self) -> None:
        check_positive("weight", self.weight)

    def prepare(self, observations: LinearObservations, denoiser: StateDenoiser) -> Guide:
        """Return the guide for one run."""
        weight = self.weight * observations.confidence
        inverse = np.linalg.inv(denoiser.gram + observations.information(weight))
        return _least_squares(observations, weight, inverse)


@dataclass(frozen=True)
class ExactGuidance:
    """Exact denoiser of the posterior, from a prior with ``given(likelihood)``.

    The reference for other methods: with it, a sampler has no error of guidance. Networks cannot be
    conditioned in this way.
    """

    kind: str = field(default="exact", init=False)

    def condition(self, sampler: Sampler, posterior: MotionPosterior) -> MotionPosterior:
        """Return the posterior as a prior; raise :class:`UnsupportedPosterior` if impossible."""
        if posterior.likelihood is None:
            return posterior
        LinearObservations.of(sampler, posterior)
        if not isinstance(posterior.prior, HasConditional):
            raise UnsupportedPosterior(
                sampler.name,
                "with ExactGuidance() requires a prior with given(likelihood), got "
                f"{type(posterior.prior).__name__}; use MomentMatched()",
                word="HasConditional",
            )
        return posterior.conditioned()


def _least_squares(
    observations: LinearObservations, weight: np.ndarray, inverse: np.ndarray
) -> Guide:
    """Return the guide D + ``inverse`` Aᵀ w (y − A D)."""

    def guide(
        x_t: np.ndarray, alpha_bar: float, clean: np.ndarray, step: PosteriorStep
    ) -> np.ndarray:
        residual = weight[..., None] * (observations.target - observations.observe(clean))
        return clean + np.einsum("ljxy,bljy->bljx", inverse, observations.adjoint(residual))

    return guide


AnyGuidance = MomentMatched | DPS | Replacement | WeightedTriangulation | ExactGuidance


def guide_towards(
    sampler: Sampler, posterior: MotionPosterior, guidance: AnyGuidance, denoiser: StateDenoiser
) -> Guide | None:
    """Return the guide for a posterior, or ``None`` without observations.

    Raises :class:`UnsupportedPosterior` if the likelihood is not linear Gaussian, or the guidance
    requires the covariance of the denoiser and the prior does not provide it.
    """
    if posterior.likelihood is None:
        return None
    assert not isinstance(guidance, ExactGuidance)  # Its posteriors have no likelihood.
    observations = LinearObservations.of(sampler, posterior)
    protocol = denoiser.covariance_protocol
    if isinstance(guidance, MomentMatched | DPS) and not isinstance(posterior.prior, protocol):
        raise UnsupportedPosterior(
            sampler.name,
            f"with guidance {guidance.kind} requires a prior that implements {protocol.__name__}, "
            f"got {type(posterior.prior).__name__}; use replacement or weighted-triangulation",
            word=protocol.__name__,
        )
    return guidance.prepare(observations, denoiser)


def _parts(n: int) -> list[slice]:
    """Return the slices of rows whose covariances are in memory at a time."""
    return [slice(start, start + _ROWS) for start in range(0, n, _ROWS)]


def conjugate_gradients(
    spread: Callable[[np.ndarray], np.ndarray],
    whiten: Callable[[np.ndarray], np.ndarray],
    residual: np.ndarray,
    steps: int,
) -> np.ndarray:
    """Return ``spread(u)`` where u + ``whiten(spread(u))`` = ``residual``, (B, …).

    Entries of the first axis are independent systems. A system stops on convergence, or when its
    matrix is not the identity plus a covariance (:func:`_is_consistent`). Each step evaluates
    ``spread`` once.
    """
    size = _products(residual, residual)
    tolerance = 1e-28 * size
    active = np.ones(len(residual), dtype=bool)
    direction, before = residual, (np.zeros_like(residual), np.zeros(len(residual)))
    solution: np.ndarray | None = None
    for _ in range(steps):
        change = spread(direction)
        image = direction + whiten(change)
        curvature = _products(direction, image)
        active &= (size > tolerance) & _is_consistent(direction, image, curvature, *before)
        length = np.where(active, size / np.where(active, curvature, 1.0), 0.0)
        part = change * _rows(length, change)
        solution = part if solution is None else solution + part
        residual = residual - image * _rows(length, image)
        after = _products(residual, residual)
        ratio = np.where(active, after / np.where(active, size, 1.0), 0.0)
        before = direction, curvature
        direction = residual + direction * _rows(ratio, direction)
        size = after
    assert solution is not None
    return solution


_ROUNDING = 1e-9  # Relative rounding error of inner products.
_CONJUGATE = 0.3  # Maximum cosine between directions that count as conjugate.


def _is_consistent(
    direction: np.ndarray,
    image: np.ndarray,
    curvature: np.ndarray,
    before: np.ndarray,
    curvature_before: np.ndarray,
) -> np.ndarray:
    """Return whether A = I + K is consistent with a covariance K, for every system, (B,).

    If K is positive semidefinite, the direction d satisfies d · A d ≥ ‖d‖². If K is symmetric, the
    previous direction d′ satisfies d′ · A d = 0. Otherwise conjugate gradients may diverge.
    """
    square = _products(direction, direction)
    rounding = _ROUNDING * np.sqrt(square * _products(image, image))
    conjugacy_error = np.abs(_products(before, image))
    tolerance = _CONJUGATE * np.sqrt(np.maximum(curvature_before * curvature, 0.0))
    return (curvature >= square - rounding) & (conjugacy_error <= tolerance)


def _products(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return row-wise inner products, ``(B, …), (B, …) → (B,)``."""
    return (one * other).sum(axis=tuple(range(1, one.ndim)))


def _rows(values: np.ndarray, like: np.ndarray) -> np.ndarray:
    return values.reshape(-1, *(1,) * (like.ndim - 1))
