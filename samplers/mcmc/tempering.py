"""Tempered densities p(θ) p(y | θ)^β and moves that leave them invariant."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import NotConjugate
from probmotion.posteriors.sampling import Sampler
from probmotion.samplers.densities import Density, not_conjugate
from probmotion.samplers.mcmc.split_gradients import SplitGradient, split_gradient

__all__ = [
    "Points",
    "TemperedDensity",
    "check_initial",
    "covariance_root",
    "move",
    "target_acceptance",
]

_JITTER = 0.2  # relative range of step sizes, against periodic trajectories
_LONGEST = 20  # maximum number of leapfrog steps
_DIVERGENT = 1000.0  # loss of log density, nats, at which a trajectory ends


class Points(NamedTuple):
    """Points θ with both parts of the log density and, unless there are none, their gradients."""

    theta: np.ndarray
    log_prior: np.ndarray
    log_likelihood: np.ndarray
    prior_gradient: np.ndarray
    likelihood_gradient: np.ndarray

    def log_density(self, power: np.ndarray) -> np.ndarray:
        """Return log p(θ) + β log p(y | θ) for the powers β, (n,)."""
        if self.log_likelihood.min() > -np.inf:
            return self.log_prior + power * self.log_likelihood
        # At β = 0 the likelihood has no effect, even where it is 0.
        with np.errstate(invalid="ignore"):
            tempered = np.where(power > 0, power * self.log_likelihood, 0.0)
        return self.log_prior + tempered

    def gradient(self, power: np.ndarray) -> np.ndarray:
        """Return the gradient of :meth:`log_density`, (n, dim)."""
        return self.prior_gradient + power[:, None] * self.likelihood_gradient

    def at(self, index: np.ndarray) -> Points:
        """Return the points with the given indices."""
        return Points(*(part[index] for part in self))

    def where(self, chosen: np.ndarray, others: Points) -> Points:
        """Return these points where ``chosen``, (n,), else the others."""
        parts = (
            np.where(chosen if mine.ndim == 1 else chosen[:, None], mine, other)
            for mine, other in zip(self, others, strict=True)
        )
        return Points(*parts)


class TemperedDensity(Density):
    """Log prior and log likelihood of a posterior, with counters of evaluations.

    ``gradients`` selects Hamiltonian moves if JAX or torch differentiates both parts.
    """

    def __init__(self, sampler: Sampler, posterior: MotionPosterior, gradients: bool) -> None:
        super().__init__(sampler, posterior)
        self.gradient_evaluations = 0
        self._split: SplitGradient | None = None
        if gradients:
            try:
                self._split = split_gradient(posterior)
            except NotConjugate as error:
                raise not_conjugate(sampler.name, error) from error

    @property
    def differentiable(self) -> bool:
        """Whether points have gradients."""
        return self._split is not None

    @property
    def counts(self) -> dict[str, int]:
        """Number of evaluations, by kind."""
        counts = {"density": self.evaluations, "gradient": self.gradient_evaluations}
        return counts if self.differentiable else {"density": self.evaluations}

    def points(self, theta: np.ndarray, power: np.ndarray, counted: bool = True) -> Points:
        """Return the points ``theta``, (n, dim), of replicas or particles with powers β, (n,).

        Raises
        ------
        ValueError
            If a density is NaN or +∞; names the point and its power.
        """
        if self._split is None:
            return self.values(theta, power, counted)
        self.gradient_evaluations += counted * len(theta)
        log_prior, log_likelihood, *gradients = self._split(theta)
        # The likelihood may be NaN where the prior is 0.
        log_likelihood = np.where(log_prior == -np.inf, -np.inf, log_likelihood)
        impossible = ~np.isfinite(log_prior + log_likelihood)
        if impossible.any():
            # Where the density is 0, gradients may be NaN and are not used.
            gradients = [np.where(impossible[:, None], 0.0, gradient) for gradient in gradients]
        return self._valid(Points(theta, log_prior, log_likelihood, *gradients), power)

    def values(self, theta: np.ndarray, power: np.ndarray, counted: bool = True) -> Points:
        """Return the points without gradients; otherwise as :meth:`points`."""
        self.evaluations += counted * len(theta)
        posterior, none = self.posterior, np.empty((len(theta), 0))
        log_prior = np.asarray(posterior.prior.log_density(theta))  # type: ignore[attr-defined]
        # The likelihood is not evaluated where the prior is 0.
        log_likelihood = np.where(log_prior == -np.inf, -np.inf, 0.0)
        possible = log_prior > -np.inf
        try:
            if posterior.truncated:
                log_density = posterior.log_density(theta[possible])
                log_likelihood[possible] = log_density - log_prior[possible]
            elif posterior.likelihood is not None and possible.any():
                log_likelihood[possible] = posterior.log_likelihood(theta[possible])
        except NotConjugate as error:
            raise not_conjugate(self.sampler.name, error) from error
        return self._valid(Points(theta, log_prior, log_likelihood, none, none), power)

    def _valid(self, points: Points, power: np.ndarray) -> Points:
        # NaN compares as false.
        valid = (points.log_prior < np.inf) & (points.log_likelihood < np.inf)
        if not valid.all():
            bad = int(np.flatnonzero(~valid)[0])
            total = points.log_prior + points.log_likelihood
            raise ValueError(
                f"log_density must be finite or -inf, got {total[bad]} at point {bad + 1} of "
                f"{len(power)}, with likelihood to the power {power[bad]:.3g}, theta "
                f"{points.theta[bad]}; return -inf where the density is 0"
            )
        return points


def check_initial(sampler: str, initial: object) -> None:
    """Raise ``ValueError`` if ``initial`` is neither ``None`` nor an earlier run."""
    if not (initial is None or isinstance(initial, MotionDraws)):
        raise ValueError(
            f"initial must be None or an earlier run, got {type(initial).__name__}: {sampler} "
            "starts at draws of the prior"
        )


def covariance_root(theta: np.ndarray, weights: np.ndarray, full: bool) -> np.ndarray:
    """Return a root of the covariance of points (n, dim) with weights (n,).

    It is a matrix, (1, dim, dim), if ``full``, else the standard deviations, (1, dim).
    """
    centred = theta - weights @ theta
    # The lower bound applies to points that coincide.
    variance = weights @ centred**2 + 1e-12
    if not full:
        return np.sqrt(variance)[None]
    n = 1 / (weights**2).sum()
    covariance = (centred * weights[:, None]).T @ centred
    # Shrunk towards the variances, as with 5 more points without correlation.
    shrunk = (n * covariance + 5 * np.diag(variance)) / (n + 5)
    return np.linalg.cholesky(shrunk)[None]


def target_acceptance(density: TemperedDensity) -> float:
    """Return the mean acceptance probability to which step sizes are adapted."""
    return 0.8 if density.differentiable else 0.234


def move(
    density: TemperedDensity,
    points: Points,
    power: np.ndarray,
    root: np.ndarray,
    step: np.ndarray,
    rng: np.random.Generator,
    prior_draw: np.ndarray | None = None,
) -> tuple[Points, np.ndarray]:
    """Move every point, leaving p(θ) p(y | θ)^β invariant.

    With gradients, a move is a Hamiltonian trajectory of a quarter period, at most 20 leapfrog
    steps (Neal 2011); without, a random walk of 1 + dim/4 steps.

    Parameters
    ----------
    density : TemperedDensity
        Density, with or without gradients.
    points : Points
        The n points.
    power : ndarray, (n,)
        Powers β of the likelihood.
    root : ndarray, (m, dim) or (m, dim, dim)
        Standard deviations, or roots C of the covariance, of each point or of all (m = 1).
    step : ndarray, (n,)
        Step sizes, relative to C.
    rng : numpy.random.Generator
        Source of random numbers.
    prior_draw : ndarray, (dim,), optional
        Draw of the prior that replaces the first point, whose power must be 0.

    Returns
    -------
    points : Points
        The moved points.
    acceptance : ndarray, (n,)
        Mean acceptance probability of each point.
    """
    fixed = np.zeros(len(power), dtype=bool)
    if prior_draw is not None:
        # A point with step 0 stays, and is evaluated with the others.
        fixed[0] = True
        points = points._replace(theta=np.where(fixed[:, None], prior_draw, points.theta))
    step = np.where(fixed, 0.0, step)
    if density.differentiable:
        return _trajectory(density, points, power, root, step, fixed, rng)
    acceptance = np.zeros(len(power))
    n_steps = 1 + points.theta.shape[1] // 4
    for _ in range(n_steps):
        noise = rng.standard_normal(points.theta.shape)
        proposed = density.points(points.theta + step[:, None] * _spread(root, noise), power)
        log_ratio = proposed.log_density(power) - points.log_density(power)
        points, accepted = _chosen(proposed, points, log_ratio, fixed, rng)
        acceptance += accepted / n_steps
    return points, acceptance


def _trajectory(
    density: TemperedDensity,
    points: Points,
    power: np.ndarray,
    root: np.ndarray,
    step: np.ndarray,
    fixed: np.ndarray,
    rng: np.random.Generator,
) -> tuple[Points, np.ndarray]:
    """Move every point that is not ``fixed`` along a Hamiltonian trajectory."""
    momentum = rng.standard_normal(points.theta.shape)
    size = (step * rng.uniform(1 - _JITTER, 1 + _JITTER, len(step)))[:, None]
    n_steps = int(np.clip(np.ceil(0.5 * math.pi / np.median(step[~fixed])), 1, _LONGEST))
    energy = points.log_density(power) - 0.5 * (momentum**2).sum(axis=1)
    now, going = points, np.ones(len(step), dtype=bool)
    momentum = momentum + 0.5 * size * _pulled(root, now.gradient(power))
    for i in range(n_steps):
        theta = now.theta + size * _spread(root, momentum)
        going &= np.isfinite(theta).all(axis=1)
        now = density.points(np.where(going[:, None], theta, points.theta), power)
        # The points of divergent trajectories stay where they were.
        going &= fixed | (now.log_density(power) > energy - _DIVERGENT)
        half = 0.5 if i == n_steps - 1 else 1.0
        kick = half * size * _pulled(root, now.gradient(power))
        momentum = np.where(going[:, None], momentum + kick, 0.0)
    log_ratio = now.log_density(power) - 0.5 * (momentum**2).sum(axis=1) - energy
    return _chosen(now, points, np.where(going, log_ratio, -np.inf), fixed, rng)


def _chosen(
    proposed: Points,
    points: Points,
    log_ratio: np.ndarray,
    fixed: np.ndarray,
    rng: np.random.Generator,
) -> tuple[Points, np.ndarray]:
    """Return accepted or earlier points, and acceptance probabilities; accept ``fixed`` points."""
    log_acceptance = np.where(fixed, 0.0, np.minimum(0.0, log_ratio))
    # −log U is standard exponential for U uniform on (0, 1].
    accepted = -rng.standard_exponential(len(fixed)) <= log_acceptance
    return proposed.where(accepted, points), np.exp(log_acceptance)


def _spread(root: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return C ε for every point."""
    if root.ndim == 2:
        return root * noise
    if len(root) == 1:
        return noise @ root[0].T
    return (root @ noise[..., None])[..., 0]


def _pulled(root: np.ndarray, gradient: np.ndarray) -> np.ndarray:
    """Return Cᵀ g for every point."""
    if root.ndim == 2:
        return root * gradient
    if len(root) == 1:
        return gradient @ root[0]
    return (gradient[:, None] @ root)[:, 0]
