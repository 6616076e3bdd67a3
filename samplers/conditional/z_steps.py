"""Draws of the auxiliary motion z of split Gibbs sampling, given the motion x and observations.

The likelihood of z is chosen so that x has the likelihood of the observations after
z ~ N(x, ρ² I) is integrated out. For linear Gaussian observations it is Gaussian. For others it is

    L(y | z) = N(y; π(z), Σ − ρ² A Aᵀ),   A = ∂π/∂z,   Σ = W⁻¹,

exact for linear π. For perspective cameras the error is of order ρ² times the second derivative of
π, (ρ/depth)² of the image, and not of order ρ². Where less than a tenth of Σ would be left, less
than ρ² is subtracted. Student-t noise is Gaussian given precision factors w, which are drawn
together with z. Frames and joints are independent given x, so that each is accepted separately.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

import numpy as np

from probmotion.samplers.conditional.coupling import Coupling, Quadratic, times
from probmotion.samplers.conditional.keypoints import Linearised, Observations
from probmotion.seeds import NormalStreams

__all__ = ["Auxiliary", "GaussianStep", "MetropolisStep", "ZStep"]

_BEHIND = -1e300  # finite, so that differences of log densities are defined
_NEAR = 0.5  # ρ suits joints at this part of the depth of the centre


class Auxiliary(NamedTuple):
    """Auxiliary motion z, (B, L, J, 3), and precision factors w, (B, L, J, K) or broadcast."""

    z: np.ndarray
    weight: np.ndarray


class ZStep(Protocol):
    """Conditional distribution of the auxiliary motion; ``noise`` is the smallest σ_y."""

    noise: float

    def coupling(self, z: np.ndarray, rho: float, streams: NormalStreams) -> Coupling:
        """Return the coupling linearised about z, (B, L, J, 3), at level ρ."""

    def draw(
        self, x: np.ndarray, rho: float, streams: NormalStreams, before: Auxiliary | None
    ) -> Auxiliary:
        """Return the next z given x, (B, L, J, 3), and the previous one."""


class GaussianStep:
    """Exact draws of z | x for linear Gaussian observations."""

    def __init__(self, likelihood: Quadratic) -> None:
        self._likelihood = likelihood
        self.noise = 1 / math.sqrt(likelihood.sizes.max())

    def coupling(self, z: np.ndarray, rho: float, streams: NormalStreams) -> Coupling:
        """Return the coupling at level ρ, the same for all z."""
        return Coupling(self._likelihood, rho, self._likelihood.gains(rho))

    def draw(
        self, x: np.ndarray, rho: float, streams: NormalStreams, before: Auxiliary | None
    ) -> Auxiliary:
        """Return a draw of z | x."""
        coupling = self.coupling(x, rho, streams)
        return Auxiliary(coupling.draw(x, streams.normal(*x.shape[1:])), np.ones(1))


class MetropolisStep:
    """Metropolis-Hastings steps of z | x for perspective cameras or Student-t noise.

    Proposals are w | x, then z from the coupling linearised about x. For linear π all are accepted.
    """

    def __init__(self, observations: Observations, centre: np.ndarray) -> None:
        self._observations = observations
        at_centre = np.broadcast_to(centre, (1, *observations.precision.shape[:2], 3))
        precision = observations.largest_weight * observations.precision
        sizes = observations.linearise(at_centre).quadratic(precision, at_centre).sizes
        self.noise = (1 if observations.linear else _NEAR) / math.sqrt(sizes.max())

    def coupling(self, z: np.ndarray, rho: float, streams: NormalStreams) -> Coupling:
        """Return the coupling linearised about z, given precision factors drawn given z."""
        local = self._observations.linearise(z)
        likelihood = self._likelihood(local, self._weights(local, streams), z)
        return Coupling(likelihood, rho, likelihood.gains(rho))

    def _weights(self, local: Linearised, streams: NormalStreams) -> np.ndarray:
        return self._observations.weights(local.residual, streams)

    def _likelihood(self, local: Linearised, weight: np.ndarray, at: np.ndarray) -> Quadratic:
        return local.quadratic(weight * self._observations.precision, at)

    def _proposal(
        self, local: Linearised, weight: np.ndarray, x: np.ndarray, rho: float
    ) -> Coupling:
        likelihood = self._likelihood(local, weight, x)
        return Coupling(likelihood, rho, likelihood.bounded_gains(rho)[1])

    def draw(
        self, x: np.ndarray, rho: float, streams: NormalStreams, before: Auxiliary | None
    ) -> Auxiliary:
        """Return z and w after one step, or the proposal if there is no previous one."""
        local = self._observations.linearise(x)
        weight = self._weights(local, streams)
        coupling = self._proposal(local, weight, x, rho)
        proposed = Auxiliary(coupling.draw(x, streams.normal(*x.shape[1:])), weight)
        if before is None or self._observations.linear:
            return proposed
        gain = self.log_importance(proposed, x, rho) - self.log_importance(before, x, rho)
        accepted = (np.log1p(-streams.uniform(*gain.shape[1:])) < gain)[..., None]
        return Auxiliary(
            *(np.where(accepted, new, old) for new, old in zip(proposed, before, strict=True))
        )

    def log_importance(self, auxiliary: Auxiliary, x: np.ndarray, rho: float) -> np.ndarray:
        """Return log p(z, w | x, y) minus that of the proposal, up to a constant, (B, L, J)."""
        z, weight = auxiliary
        precision = weight * self._observations.precision
        at_x, at_z = self._observations.linearise(x), self._observations.linearise(z)
        likelihood = self._likelihood(at_z, weight, z)
        subtracted, gains = likelihood.bounded_gains(rho)
        # (Σ − ρ² A Aᵀ)⁻¹ = W + ρ² W A S Aᵀ W with S = (I − ρ² G)⁻¹; its determinant is |W| |S|.
        slope = at_z.slope(precision)
        extra = (slope * times(likelihood.power(subtracted * gains), slope)).sum(axis=-1)
        squares = (precision * (at_x.residual**2 - at_z.residual**2)).sum(axis=-1)
        coupled = ((z - x) ** 2).sum(axis=-1) / rho**2
        log_target = 0.5 * (squares - extra - coupled + np.log(gains).sum(axis=-1))
        proposal = self._proposal(at_x, weight, x, rho)
        log_importance: np.ndarray = np.where(
            self._observations.in_front(z), log_target - proposal.log_density(z, x), _BEHIND
        )
        return log_importance
