"""Simulated pairs of motions and observations, and their principal coordinates.

Simulation-based inference (Cranmer, Brehmer and Louppe 2020) learns the posterior from such pairs.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from probmotion import seeds
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import Likelihood, Samplable
from probmotion.posteriors.sampling import UnsupportedPosterior

__all__ = [
    "MotionCoordinates", "PrincipalCoordinates", "SimulatedPairs", "observed_entries",
    "simulate_pairs",
]  # fmt: skip

_CHUNK = 2000  # Number of pairs simulated at once.
# Minimum variance of a coordinate relative to the largest; smaller ones are rounding errors.
_ROUNDING = 1e-12


@dataclass(frozen=True, eq=False)
class SimulatedPairs:
    """Simulated pairs of n motions, (n, L, J, 3), metres, and observations, (n, L, M)."""

    positions: np.ndarray
    observed: np.ndarray


def observed_entries(likelihood: Likelihood | None, frames: int) -> np.ndarray:
    """Return the observations of L frames, (L, M), 0 for missing entries.

    Observations are ``keypoints``, (V, L, J, 2), or ``joints``, (L, J, 3), of the likelihood; M = 0
    without a likelihood.

    Raises
    ------
    UnsupportedPosterior
        If the likelihood has neither keypoints nor joints, or noise with infinite variance.
    """
    if likelihood is None:
        return np.zeros((frames, 0))
    freedom = getattr(likelihood, "degrees_of_freedom", None)
    if freedom is not None and freedom <= 2:
        raise UnsupportedPosterior(
            "dvae",
            "requires noise with more than 2 degrees of freedom to train on simulated "
            f"observations, got {freedom:g}",
            word="outliers",
        )
    if hasattr(likelihood, "keypoints"):
        return np.moveaxis(np.asarray(likelihood.keypoints), 1, 0).reshape(frames, -1)
    if hasattr(likelihood, "joints"):
        return np.asarray(likelihood.joints).reshape(frames, -1)
    raise UnsupportedPosterior(
        "dvae",
        f"needs observed keypoints or joints, got {type(likelihood).__name__}",
        word="observations",
    )


def simulate_pairs(posterior: MotionPosterior, seed: int, n: int) -> Iterator[SimulatedPairs]:
    """Yield n pairs in chunks, to limit memory use."""
    prior, likelihood = posterior.prior, posterior.likelihood
    assert isinstance(prior, Samplable)
    observed_entries(likelihood, posterior.frames)
    for number, start in enumerate(range(0, n, _CHUNK)):
        size = min(_CHUNK, n - start)
        positions = prior.sample(seeds.generator(seed, "pairs", number), size)
        rng = seeds.generator(seed, "pairs", number, "evidence")
        simulated = [
            None if likelihood is None else likelihood.simulate(rng, motion) for motion in positions
        ]
        rows = [observed_entries(one, posterior.frames) for one in simulated]
        yield SimulatedPairs(positions, np.stack(rows))


@dataclass(frozen=True, eq=False)
class PrincipalCoordinates:
    """Whitened principal coordinates of flattened arrays.

    ``mean`` is (D,), ``axes`` are orthonormal columns, (D, C), the largest variance first, and
    ``deviation`` the standard deviations along them, (C,).
    """

    mean: np.ndarray
    axes: np.ndarray
    deviation: np.ndarray

    @classmethod
    def of(cls, values: np.ndarray, max_coordinates: int) -> PrincipalCoordinates:
        """Compute up to ``max_coordinates`` non-constant coordinates of arrays ``(n, …)``."""
        from scipy.linalg import eigh

        flat = values.reshape(len(values), -1)
        mean = flat.mean(axis=0)
        D = flat.shape[1]
        if D == 0:
            return cls(mean, np.zeros((0, 0)), np.zeros(0))
        covariance = (flat - mean).T @ (flat - mean) / len(flat)
        variance, axes = eigh(covariance, subset_by_index=[max(0, D - max_coordinates), D - 1])
        variance, axes = variance[::-1], axes[:, ::-1]
        varies = (variance > _ROUNDING * variance[0]) & (variance > 0)
        return cls(mean, np.ascontiguousarray(axes[:, varies]), np.sqrt(variance[varies]))

    def coordinates(self, values: np.ndarray) -> np.ndarray:
        """Return the coordinates of arrays: ``(n, …) → (n, C)``."""
        return (values.reshape(len(values), -1) - self.mean) @ self.axes / self.deviation

    def values(self, coordinates: np.ndarray) -> np.ndarray:
        """Return the flattened arrays with these coordinates: ``(n, C) → (n, D)``."""
        return self.mean + (coordinates * self.deviation) @ self.axes.T

    def without(self, flat: np.ndarray) -> np.ndarray:
        """Return flattened arrays, (n, D), without their components along the axes."""
        return flat - flat @ self.axes @ self.axes.T


@dataclass(frozen=True, eq=False)
class MotionCoordinates:
    """Decomposition of motions into a linear prediction, coordinates x and a Gaussian remainder.

    A motion is its linear regression on the observations, plus the principal coordinates x of the
    residual, plus a remainder. The remainder is Gaussian and independent between frames; its mean
    is linear in the part of the observations that x does not explain. Only x is modelled by the
    network.

    Parameters
    ----------
    linear : ndarray, (1 + E, D)
        Regression of flattened motions, metres, on 1 and the observations' coordinates y.
    basis : PrincipalCoordinates
        Coordinates x of the residual.
    explained : ndarray, (1 + E + C, L·M)
        Regression of the observations on 1, y and x.
    gain : ndarray, (L, M, 3J)
        Regression of the remainder on the unexplained observations.
    root : ndarray, (L, 3J, 3J)
        Square root of the covariance of the remainder.
    """

    linear: np.ndarray
    basis: PrincipalCoordinates
    explained: np.ndarray
    gain: np.ndarray
    root: np.ndarray

    @classmethod
    def learn(cls, pairs: SimulatedPairs, y: np.ndarray, max_coordinates: int) -> MotionCoordinates:
        """Fit up to ``max_coordinates`` coordinates x to pairs with observations y, (n, E)."""
        n, L = pairs.observed.shape[:2]
        flat = pairs.positions.reshape(n, -1)
        linear = np.linalg.lstsq(_with_intercept(y), flat, rcond=None)[0]
        residual = flat - _with_intercept(y) @ linear
        basis = PrincipalCoordinates.of(residual, max_coordinates)
        remainder = basis.without(residual - basis.mean).reshape(n, L, -1)
        inputs = _with_intercept(y, basis.coordinates(residual))
        explained = np.linalg.lstsq(inputs, pairs.observed.reshape(n, -1), rcond=None)[0]
        unexplained = pairs.observed - (inputs @ explained).reshape(pairs.observed.shape)
        gain = np.stack(
            [np.linalg.lstsq(unexplained[:, k], remainder[:, k], rcond=1e-6)[0] for k in range(L)]
        )
        remainder = remainder - np.einsum("nlm,lmj->nlj", unexplained, gain, optimize=True)
        covariance = np.einsum("nli,nlj->lij", remainder, remainder, optimize=True) / n
        # Correct for the component along the axes, which is removed from every draw.
        dim, axes = basis.axes.shape
        variance, directions = np.linalg.eigh(covariance * dim / max(1, dim - axes))
        root = directions * np.sqrt(np.maximum(variance, 0.0))[:, None, :]
        return cls(linear, basis, explained, gain, root)

    def coordinates(self, positions: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return x of motions with observations y: ``(n, L, J, 3), (n, E) → (n, C)``."""
        flat = positions.reshape(len(positions), -1)
        return self.basis.coordinates(flat - _with_intercept(y) @ self.linear)

    def motions(
        self, x: np.ndarray, y: np.ndarray, observed: np.ndarray, normal: np.ndarray
    ) -> np.ndarray:
        """Return flattened motions with a random remainder, (B, D), metres.

        Motions have coordinates ``x``, (B, C), and observations ``observed``, (L, M), with
        coordinates ``y``, (B, E); ``normal``, (B, L, 3J), are standard normal draws.
        """
        explained = _with_intercept(y, x) @ self.explained
        unexplained = observed - explained.reshape(len(x), *observed.shape)
        remainder = np.einsum("nlm,lmj->nlj", unexplained, self.gain, optimize=True)
        remainder += np.einsum("lij,nlj->nli", self.root, normal, optimize=True)
        noise = self.basis.without(remainder.reshape(len(x), -1))
        return _with_intercept(y) @ self.linear + self.basis.values(x) + noise


def _with_intercept(*parts: np.ndarray) -> np.ndarray:
    return np.concatenate([np.ones((len(parts[0]), 1)), *parts], axis=1)
