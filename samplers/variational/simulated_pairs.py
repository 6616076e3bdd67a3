"""Pairs (motion, evidence) that a posterior's own prior and likelihood make.

A network that learns from them learns the posterior without either density (amortised inference;
Cranmer, Brehmer and Louppe 2020, "The frontier of simulation-based inference"). It meets them in
principal coordinates; what those leave over is small noise, which
:class:`MotionCoordinates` gives back.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from probmotion import seeds
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import Likelihood, Samplable
from probmotion.posteriors.sampling import UnsupportedPosterior
from probmotion.validation import check_count

__all__ = [
    "MotionCoordinates",
    "PrincipalCoordinates",
    "SimulatedPairs",
    "observed_entries",
    "simulate_pairs",
]

_LEAST_FREEDOM = 2.0
_SAMPLER = "dvae"
_CHUNK = 2000
# Below this share of the largest variance a coordinate is rounding.
_NOTHING = 1e-12


@dataclass(frozen=True, eq=False)
class SimulatedPairs:
    """n motions and what was seen of each.

    Parameters
    ----------
    positions : ndarray, (n, L, J, 3)
        Draws from the prior, metres.
    observed : ndarray, (n, L, M)
        Evidence of each motion, the M numbers of every frame, in the likelihood's units; 0 where
        hidden; M = 0 without evidence.
    """

    positions: np.ndarray
    observed: np.ndarray


def observed_entries(likelihood: Likelihood | None, frames: int) -> np.ndarray:
    """Return the evidence as numbers, those of one frame in one row: (L, M); 0 where hidden.

    The pattern of what is hidden and the noise are a posterior's own, the same in all of its
    pairs, so that a network need not be told them.

    Parameters
    ----------
    likelihood : Likelihood or None
        With ``keypoints`` (V, L, J, 2) or ``joints`` (L, J, 3); ``None`` gives M = 0.
    frames : int
        L.

    Raises
    ------
    UnsupportedPosterior
        If the likelihood has neither, or its noise has no variance: a single outlier would then
        drown all that a network learns from.
    """
    if likelihood is None:
        return np.zeros((frames, 0))
    freedom = getattr(likelihood, "degrees_of_freedom", None)
    if freedom is not None and freedom <= _LEAST_FREEDOM:
        raise UnsupportedPosterior(
            _SAMPLER,
            f"learns from simulated evidence, which noise of {freedom:g} degrees of freedom "
            f"drowns; it needs more than {_LEAST_FREEDOM:g}",
            word="outliers",
        )
    if hasattr(likelihood, "keypoints"):
        return np.moveaxis(np.asarray(likelihood.keypoints), 1, 0).reshape(frames, -1)
    if hasattr(likelihood, "joints"):
        return np.asarray(likelihood.joints).reshape(frames, -1)
    raise UnsupportedPosterior(
        _SAMPLER,
        f"needs evidence of keypoints or joints to show its network, which "
        f"{type(likelihood).__name__} is not",
        word="observations",
    )


def simulate_pairs(posterior: MotionPosterior, seed: int, n: int) -> Iterator[SimulatedPairs]:
    """Yield n pairs, some thousands at a time: whole motions take more memory than what is kept.

    Parameters
    ----------
    posterior : MotionPosterior
        Whose prior is :class:`~probmotion.posteriors.protocols.Samplable`.
    seed : int
        The run's seed.
    n : int
        Number of pairs.

    Raises
    ------
    UnsupportedPosterior
        If the prior cannot be sampled, or the evidence is neither keypoints nor joints.
    """
    check_count("n", n)
    prior, likelihood = posterior.prior, posterior.likelihood
    if not isinstance(prior, Samplable):
        raise UnsupportedPosterior(
            _SAMPLER,
            f"needs a prior with Samplable, which {type(prior).__name__} is not",
            word="Samplable",
        )
    observed_entries(likelihood, posterior.frames)
    for number, start in enumerate(range(0, n, _CHUNK)):
        size = min(_CHUNK, n - start)
        positions = prior.sample(seeds.generator(seed, "pairs", number), size)
        rng = seeds.generator(seed, "pairs", number, "evidence")
        seen = [
            None if likelihood is None else likelihood.simulate(rng, motion) for motion in positions
        ]
        rows = [observed_entries(one, posterior.frames) for one in seen]
        yield SimulatedPairs(positions, np.stack(rows))


@dataclass(frozen=True, eq=False)
class PrincipalCoordinates:
    """The directions in which arrays vary most, each in units of its standard deviation.

    Parameters
    ----------
    mean : ndarray, (D,)
        Of the flattened arrays.
    axes : ndarray, (D, C)
        Orthonormal columns, the largest variance first.
    deviation : ndarray, (C,)
        Standard deviations along them.
    """

    mean: np.ndarray
    axes: np.ndarray
    deviation: np.ndarray

    @classmethod
    def of(cls, values: np.ndarray, most: int) -> PrincipalCoordinates:
        """Return at most ``most`` coordinates of arrays ``(n, …)``, those that vary at all."""
        from scipy.linalg import eigh

        flat = values.reshape(len(values), -1)
        mean = flat.mean(axis=0)
        D = flat.shape[1]
        if D == 0:
            return cls(mean, np.zeros((0, 0)), np.zeros(0))
        covariance = (flat - mean).T @ (flat - mean) / len(flat)
        variance, axes = eigh(covariance, subset_by_index=[max(0, D - most), D - 1])
        variance, axes = variance[::-1], axes[:, ::-1]
        varies = (variance > _NOTHING * variance[0]) & (variance > 0)
        return cls(mean, np.ascontiguousarray(axes[:, varies]), np.sqrt(variance[varies]))

    def coordinates(self, values: np.ndarray) -> np.ndarray:
        """Return the coordinates of arrays: ``(n, …) → (n, C)``."""
        return (values.reshape(len(values), -1) - self.mean) @ self.axes / self.deviation

    def values(self, coordinates: np.ndarray) -> np.ndarray:
        """Return the flattened arrays with these coordinates: ``(n, C) → (n, D)``."""
        return self.mean + (coordinates * self.deviation) @ self.axes.T

    def without(self, flat: np.ndarray) -> np.ndarray:
        """Return what the coordinates do not see of ``(n, D)``."""
        return flat - flat @ self.axes @ self.axes.T


@dataclass(frozen=True, eq=False)
class MotionCoordinates:
    """What a network learns of motions, and what it need not.

    A motion is a linear regression on its evidence, plus principal coordinates x of what that
    misses, plus a remainder: small noise, frame by frame Gaussian, whose mean is linear in what
    the evidence has that x does not explain. The network learns x alone; without the remainder
    draws would lack the small noise of the prior.

    Parameters
    ----------
    linear : ndarray, (1 + E, D)
        Regression of flattened motions on 1 and the evidence's coordinates y, metres.
    basis : PrincipalCoordinates
        Of what it misses.
    explained : ndarray, (1 + E + C, L·M)
        Regression of the evidence on 1, y and x.
    gain : ndarray, (L, M, 3J)
        Regression of the remainder on the rest of the evidence.
    root : ndarray, (L, 3J, 3J)
        Of the covariance that is left.
    """

    linear: np.ndarray
    basis: PrincipalCoordinates
    explained: np.ndarray
    gain: np.ndarray
    root: np.ndarray

    @classmethod
    def learn(cls, pairs: SimulatedPairs, y: np.ndarray, most: int) -> MotionCoordinates:
        """Return the least-squares fit to pairs, with at most ``most`` coordinates.

        Parameters
        ----------
        pairs : SimulatedPairs
            n of them.
        y : ndarray, (n, E)
            Coordinates of their evidence.
        most : int
            Of x.
        """
        n, L = pairs.observed.shape[:2]
        flat = pairs.positions.reshape(n, -1)
        linear = np.linalg.lstsq(_with_one(y), flat, rcond=None)[0]
        missed = flat - _with_one(y) @ linear
        basis = PrincipalCoordinates.of(missed, most)
        left = basis.without(missed - basis.mean).reshape(n, L, -1)
        known = _with_one(y, basis.coordinates(missed))
        explained = np.linalg.lstsq(known, pairs.observed.reshape(n, -1), rcond=None)[0]
        rest = pairs.observed - (known @ explained).reshape(pairs.observed.shape)
        fits = [np.linalg.lstsq(rest[:, k], left[:, k], rcond=1e-6)[0] for k in range(L)]
        gain = np.stack(fits)
        left = left - np.einsum("nlm,lmj->nlj", rest, gain, optimize=True)
        covariance = np.einsum("nli,nlj->lij", left, left, optimize=True) / n
        # A draw loses its share of the axes when they are taken out of it again.
        dim, axes = basis.axes.shape
        variance, directions = np.linalg.eigh(covariance * dim / max(1, dim - axes))
        root = directions * np.sqrt(np.maximum(variance, 0.0))[:, None, :]
        return cls(linear, basis, explained, gain, root)

    def coordinates(self, positions: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return x of motions with evidence y: ``(n, L, J, 3), (n, E) → (n, C)``."""
        flat = positions.reshape(len(positions), -1)
        return self.basis.coordinates(flat - _with_one(y) @ self.linear)

    def motions(
        self, x: np.ndarray, y: np.ndarray, observed: np.ndarray, normal: np.ndarray
    ) -> np.ndarray:
        """Return motions with these coordinates and a drawn remainder, flattened: (B, D), metres.

        Parameters
        ----------
        x : ndarray, (B, C)
            Of the motions.
        y : ndarray, (B, E)
            Of the evidence.
        observed : ndarray, (L, M)
            The evidence itself.
        normal : ndarray, (B, L, 3J)
            Standard normal numbers.
        """
        told = _with_one(y, x) @ self.explained
        rest = observed - told.reshape(len(x), *observed.shape)
        left = np.einsum("nlm,lmj->nlj", rest, self.gain, optimize=True)
        left += np.einsum("lij,nlj->nli", self.root, normal, optimize=True)
        noise = self.basis.without(left.reshape(len(x), -1))
        return _with_one(y) @ self.linear + self.basis.values(x) + noise


def _with_one(*parts: np.ndarray) -> np.ndarray:
    return np.concatenate([np.ones((len(parts[0]), 1)), *parts], axis=1)
