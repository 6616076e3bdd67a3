"""Guidance: how evidence corrects a denoiser's estimate of the clean motion.

Evidence y = A X + noise of precision W, in normalised units. A guidance sees the estimate D of
E[X₀ | X_t] and returns one of E[X₀ | X_t, y].
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from probmotion.posteriors.noise_schedule import PosteriorStep
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import NotConjugate
from probmotion.posteriors.sampling import Sampler, UnsupportedPosterior, suited
from probmotion.samplers.diffusion.ancestral import Guide, StateDenoiser
from probmotion.samplers.diffusion.views import symmetric_power
from probmotion.validation import check_count, check_positive

__all__ = [
    "DPS",
    "AnyGuidance",
    "Evidence",
    "MomentMatched",
    "Replacement",
    "WeightedTriangulation",
    "can_guide",
    "conjugate_gradients",
    "guide_towards",
]


def can_guide(posterior: MotionPosterior) -> bool:
    """Return whether there is no evidence, or such as a guidance can follow."""
    try:
        return posterior.likelihood is None or bool(_linear(posterior))
    except NotConjugate:
        return False


def _linear(posterior: MotionPosterior) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return A, y and W of the evidence, metres."""
    linear = getattr(posterior.likelihood, "linear", None)
    if linear is None:
        raise NotConjugate(f"{type(posterior.likelihood).__name__} does not offer linear()")
    return linear()


@dataclass(frozen=True, eq=False)
class Evidence:
    """Linear Gaussian evidence in normalised units: y_v = A_v X + noise of precision W.

    Parameters
    ----------
    axes : ndarray, (V, M, 3)
        A_v.
    target : ndarray, (V, L, J, M)
        y.
    precision : ndarray, (V, L, J)
        W; 0 hides an entry.
    """

    axes: np.ndarray
    target: np.ndarray
    precision: np.ndarray

    @classmethod
    def of(cls, sampler: Sampler, posterior: MotionPosterior) -> Evidence:
        """Return the posterior's evidence, metres turned into normalised units.

        Raises
        ------
        UnsupportedPosterior
            If it is not linear in the positions with Gaussian noise.
        """
        try:
            axes, target, precision = _linear(posterior)
        except NotConjugate as error:
            raise UnsupportedPosterior(
                sampler.name,
                f"is guided by linear evidence with Gaussian noise, but {error}",
                word="observations",
                others=suited(posterior),
            ) from error
        scale = posterior.prior.scale  # type: ignore[attr-defined]
        return cls(axes, target / scale, precision * scale**2)

    @property
    def confidence(self) -> np.ndarray:
        """Precision relative to the surest entry, (V, L, J)."""
        top = self.precision.max(initial=0.0)
        return self.precision / top if top > 0 else self.precision

    def observe(self, motions: np.ndarray) -> np.ndarray:
        """Return A X: ``(B, L, J, 3) → (B, V, L, J, M)``."""
        return motions[:, None] @ self.axes.swapaxes(1, 2)[:, None]

    def adjoint(self, entries: np.ndarray) -> np.ndarray:
        """Return Aᵀ u: ``(B, V, L, J, M) → (B, L, J, 3)``."""
        return (entries @ self.axes[:, None]).sum(axis=1)

    def information(self, weight: np.ndarray) -> np.ndarray:
        """Return Σ_v w A_vᵀ A_v: ``(V, L, J) → (L, J, 3, 3)``."""
        return np.einsum("vlj,vmx,vmy->ljxy", weight, self.axes, self.axes)


@dataclass(frozen=True)
class MomentMatched:
    """X₀ | X_t as the Gaussian N(D, C), C from the denoiser's Jacobian, conditioned on y.

        D + C Aᵀ (A C Aᵀ + W⁻¹)⁻¹ (y − A D)

    Exact for a Gaussian prior with its exact 3D denoiser. The system is solved by conjugate
    gradients from products with C alone (Finzi et al. 2023; Boys et al. 2024).

    Parameters
    ----------
    steps : int
        Conjugate-gradient steps, one product with C each. The method supposes that C is a
        covariance, which a learnt denoiser's Jacobian is not quite: a draw's system is left as it
        is where that shows, so that more steps than the default bring such draws nothing.
    """

    kind: str = field(default="moment-matched", init=False)
    steps: int = 6

    def __post_init__(self) -> None:
        check_count("steps", self.steps)

    def prepare(self, evidence: Evidence, denoiser: StateDenoiser) -> Guide:
        """Return the guide of one run."""
        root = np.sqrt(evidence.precision)[..., None]

        def guide(
            x_t: np.ndarray, alpha_bar: float, clean: np.ndarray, step: PosteriorStep
        ) -> np.ndarray:
            def spread(entries: np.ndarray) -> np.ndarray:
                """C Aᵀ W^½ u."""
                pulled = evidence.adjoint(root * entries)
                return denoiser.covariance_product(x_t, alpha_bar, pulled)

            def whiten(motions: np.ndarray) -> np.ndarray:
                """W^½ A X."""
                return root * evidence.observe(motions)

            residual = root * (evidence.target - evidence.observe(clean))
            # W^½ on both sides keeps hidden entries (W = 0) in the system at no cost.
            guided = clean + conjugate_gradients(spread, whiten, residual, self.steps)
            if not np.isfinite(guided).all():
                raise ValueError(
                    f"guidance with steps {self.steps} diverged at alpha_bar {alpha_bar:.3g}, "
                    "expected fewer steps: the denoiser's Jacobian is not symmetric"
                )
            return guided

        return guide


@dataclass(frozen=True)
class DPS:
    """A step down the gradient of ‖y − A D(X_t)‖ after every denoising step.

    Diffusion posterior sampling (Chung et al. 2023, algorithm 1, ζ_i = ζ/‖y − A D‖).

    Parameters
    ----------
    step_size : float
        ζ.
    """

    kind: str = field(default="dps", init=False)
    step_size: float = 1.0

    def __post_init__(self) -> None:
        check_positive("step_size", self.step_size)

    def prepare(self, evidence: Evidence, denoiser: StateDenoiser) -> Guide:
        """Return the guide of one run."""
        confidence = evidence.confidence[..., None]
        half = symmetric_power(denoiser.gram, 0.5)
        inverse_half = symmetric_power(denoiser.gram, -0.5)

        def guide(
            x_t: np.ndarray, alpha_bar: float, clean: np.ndarray, step: PosteriorStep
        ) -> np.ndarray:
            residual = evidence.target - evidence.observe(clean)
            length = np.sqrt((confidence * residual**2).sum(axis=(1, 2, 3, 4), keepdims=True))
            pulled = evidence.adjoint(confidence * residual / np.maximum(length, 1e-300))
            # ∇‖y − A D‖ = −Jᵀ Aᵀ (y − A D)/‖y − A D‖ with J = √ᾱ/(1−ᾱ) M^(-½) C M^(½).
            product = denoiser.covariance_product(x_t, alpha_bar, pulled @ inverse_half)
            gradient = -(np.sqrt(alpha_bar) / (1 - alpha_bar)) * (product @ half)
            # Moving x_{t−1} by −ζ ∇ is moving the estimate by −ζ ∇ over its weight in x_{t−1}.
            return clean - (self.step_size / step.clean) * gradient

        return guide


@dataclass(frozen=True)
class Replacement:
    """The observed coordinates of the estimate are overwritten by the evidence.

    As motion diffusion models edit motions (Tevet et al. 2023, section 4.3); noise in y is
    ignored, but where entries disagree they are averaged by precision.
    """

    kind: str = field(default="replacement", init=False)

    def prepare(self, evidence: Evidence, denoiser: StateDenoiser) -> Guide:
        """Return the guide of one run."""
        confidence = evidence.confidence
        inverse = np.linalg.pinv(evidence.information(confidence), hermitian=True)

        def guide(
            x_t: np.ndarray, alpha_bar: float, clean: np.ndarray, step: PosteriorStep
        ) -> np.ndarray:
            residual = confidence[..., None] * (evidence.target - evidence.observe(clean))
            return clean + np.einsum("ljxy,bljy->bljx", inverse, evidence.adjoint(residual))

        return guide


@dataclass(frozen=True)
class WeightedTriangulation:
    """The evidence enters the triangulation as further views, M⁻¹ Σ P_vᵀ x̂_v being the others.

    Parameters
    ----------
    weight : float
        Of an observed entry of highest confidence; the sampler's own views have 1 each.
    """

    kind: str = field(default="weighted-triangulation", init=False)
    weight: float = 1.0

    def __post_init__(self) -> None:
        check_positive("weight", self.weight)

    def prepare(self, evidence: Evidence, denoiser: StateDenoiser) -> Guide:
        """Return the guide of one run."""
        weight = self.weight * evidence.confidence
        inverse = np.linalg.inv(denoiser.gram + evidence.information(weight))

        def guide(
            x_t: np.ndarray, alpha_bar: float, clean: np.ndarray, step: PosteriorStep
        ) -> np.ndarray:
            residual = weight[..., None] * (evidence.target - evidence.observe(clean))
            return clean + np.einsum("ljxy,bljy->bljx", inverse, evidence.adjoint(residual))

        return guide


AnyGuidance = MomentMatched | DPS | Replacement | WeightedTriangulation


def guide_towards(
    sampler: Sampler, posterior: MotionPosterior, guidance: AnyGuidance, denoiser: Any
) -> Guide | None:
    """Return the guide to the posterior's evidence; ``None`` where there is none.

    Raises
    ------
    UnsupportedPosterior
        If the evidence is not linear with Gaussian noise, or the guidance needs products with the
        denoiser's covariance and the prior has none.
    """
    if posterior.likelihood is None:
        return None
    evidence = Evidence.of(sampler, posterior)
    protocol = denoiser.covariance_protocol
    if isinstance(guidance, MomentMatched | DPS) and not isinstance(posterior.prior, protocol):
        raise UnsupportedPosterior(
            sampler.name,
            f"with guidance {guidance.kind} needs a prior with {protocol.__name__}, which "
            f"{type(posterior.prior).__name__} is not; expected one, or guidance replacement or "
            "weighted-triangulation",
            word=protocol.__name__,
        )
    return guidance.prepare(evidence, denoiser)


def conjugate_gradients(
    spread: Callable[[np.ndarray], np.ndarray],
    whiten: Callable[[np.ndarray], np.ndarray],
    residual: np.ndarray,
    steps: int,
) -> np.ndarray:
    """Return ``spread(u)`` where u + ``whiten(spread(u))`` = ``residual``.

    One system per row of the first axis, solved side by side; a row that has converged stays. So
    does one whose system shows that it comes of no covariance: it is smaller than the identity
    along a direction, or directions are not conjugate (:func:`_of_covariance`).

    Parameters
    ----------
    spread, whiten : callable
        Linear maps whose product ``whiten(spread(·))`` is symmetric and not negative.
    residual : ndarray, (B, …)
        Right-hand sides.
    steps : int
        Steps, one ``spread`` each.
    """
    size = _products(residual, residual)
    enough = 1e-28 * size
    active = np.ones(len(residual), dtype=bool)
    direction, before = residual, (np.zeros_like(residual), np.zeros(len(residual)))
    answer: np.ndarray | None = None
    for _ in range(steps):
        moved = spread(direction)
        image = direction + whiten(moved)
        curvature = _products(direction, image)
        active &= (size > enough) & _of_covariance(direction, image, curvature, *before)
        length = np.where(active, size / np.where(active, curvature, 1.0), 0.0)
        part = moved * _rows(length, moved)
        answer = part if answer is None else answer + part
        residual = residual - image * _rows(length, image)
        after = _products(residual, residual)
        ratio = np.where(active, after / np.where(active, size, 1.0), 0.0)
        before = direction, curvature
        direction = residual + direction * _rows(ratio, direction)
        size = after
    assert answer is not None
    return answer


_ROUNDING = 1e-9
_CONJUGATE = 0.3


def _of_covariance(
    direction: np.ndarray,
    image: np.ndarray,
    curvature: np.ndarray,
    before: np.ndarray,
    curvature_before: np.ndarray,
) -> np.ndarray:
    """Return of which rows the system A = I + K may be one with a covariance K, (B,).

    d · A d is |d|² at least where K is not negative, and the direction before is conjugate,
    d′ · A d = 0, where K is symmetric. With a learnt denoiser's Jacobian neither holds for sure,
    and steps of conjugate gradients may grow without end.
    """
    square = _products(direction, direction)
    rounding = _ROUNDING * np.sqrt(square * _products(image, image))
    crossed = np.abs(_products(before, image))
    beside = _CONJUGATE * np.sqrt(np.maximum(curvature_before * curvature, 0.0))
    return (curvature >= square - rounding) & (crossed <= beside)


def _products(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the inner product of each row, ``(B, …), (B, …) → (B,)``."""
    return (one * other).sum(axis=tuple(range(1, one.ndim)))


def _rows(values: np.ndarray, like: np.ndarray) -> np.ndarray:
    return values.reshape(-1, *(1,) * (like.ndim - 1))
