"""Annealing of particles from the prior to the posterior."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import brentq

from probmotion.samplers.mcmc.tempering import (
    Points,
    TemperedDensity,
    covariance_root,
    move,
    target_acceptance,
)

__all__ = ["ANNEALING_TICKS", "Level", "Population"]

_CONDITIONAL_ESS = 0.97  # of the particles, between successive powers
_PER_DIMENSION = 4  # particles from which correlations are estimated
_POSSIBLE = 10  # draws of the prior with a positive likelihood, at least
_RESAMPLED = 0.5  # effective fraction of the particles below which they are resampled
_LOG_RANGE = 60.0  # range of the logarithm of a rise
_PAIRS = 256  # pairs of points for which a rejection is estimated
_RATE = 0.8  # of the adaptation of the step size

ANNEALING_TICKS = 100
"""Number of ticks of a progress bar per annealing."""


class Level(NamedTuple):
    """One power β of an annealing, after the moves at that power.

    ``root`` and ``step`` are those of the moves, ``theta`` (dim,) is one particle, and
    ``rejection`` is the probability that a swap with the previous level would be rejected.
    """

    power: float
    root: np.ndarray
    step: float
    theta: np.ndarray
    rejection: float


@dataclass
class Population:
    """Particles at one power of the likelihood, with their moves.

    The particles are draws of the prior at first. :meth:`anneal` takes them to the posterior
    (Del Moral et al. 2006); :meth:`move` then is a Markov chain of each particle.
    """

    density: TemperedDensity
    rng: np.random.Generator
    points: Points
    root: np.ndarray
    step: float
    power: float = 0.0
    log_evidence: float = 0.0

    @classmethod
    def of_prior(cls, density: TemperedDensity, rng: np.random.Generator, draws: int) -> Population:
        """Return draws of the prior, without gradients.

        Raises
        ------
        ValueError
            If the likelihood is 0 at all draws but a few.
        """
        points = density.values(density.posterior.initial(rng, draws), np.zeros(draws))
        possible = int(np.isfinite(points.log_likelihood).sum())
        if possible < min(_POSSIBLE, draws):
            # Fewer would be taken for the whole posterior.
            raise ValueError(
                f"likelihood must be positive at {min(_POSSIBLE, draws)} or more draws of the "
                f"prior, got {possible} of {draws}; use more candidates or another prior"
            )
        step = 0.5 if density.differentiable else 2.38 / math.sqrt(density.posterior.dim)
        return cls(density, rng, points, np.empty(0), step)

    @property
    def size(self) -> int:
        """Number of particles."""
        return len(self.points.theta)

    def anneal(self, particles: int, moves: int, tick: Callable[[int], Any]) -> list[Level]:
        """Take the draws of the prior to ``particles`` draws of the posterior; return the levels.

        Successive powers have a conditional effective sample size of 97 % (Zhou et al. 2016). At
        low powers, draws of the prior are weighted. When their effective sample size falls to
        ``particles``, so many are resampled, and ``moves`` moves of all follow each power. ``tick``
        is called with parts of ``ANNEALING_TICKS``.
        """
        full = particles >= _PER_DIMENSION * self.points.theta.shape[1]
        weights = np.full(self.size, 1 / self.size)
        self.root = covariance_root(self.points.theta, weights, full)
        levels, done = [self._level(weights, 0.0)], 0
        weighted = True
        while self.power < 1 or weighted:
            if weighted and (self.power == 1 or _effective(weights) <= particles):
                chosen = self.points.theta[_resampled(weights, particles, self.rng)]
                self.points = self.density.points(chosen, np.full(particles, self.power))
                weights, weighted = np.full(particles, 1 / particles), False
                continue
            earlier, before = weights, self.points.log_likelihood
            weights, rise = self._reweight(weights)
            if weighted:
                # As many points as at higher powers, to save time.
                chosen = self.points.theta[_resampled(weights, particles, self.rng)]
                self.root = covariance_root(chosen, np.full(particles, 1 / particles), full)
            else:
                self.root = covariance_root(self.points.theta, weights, full)
                depleted = _effective(weights) < _RESAMPLED * particles or not weights.all()
                if self.power == 1 or depleted:
                    self.points = self.points.at(_resampled(weights, particles, self.rng))
                    weights = np.full(particles, 1 / particles)
                for _ in range(moves):
                    surplus = self.move().mean() - target_acceptance(self.density)
                    # Longer steps than a quarter period of the posterior do not help.
                    self.step = min(0.5 * math.pi, self.step * math.exp(_RATE * surplus))
            pairs = zip((before, self.points.log_likelihood), (earlier, weights), strict=True)
            low, high = (self.rng.choice(values, _PAIRS, p=each) for values, each in pairs)
            rejection = 1 - np.exp(np.minimum(0, rise * (low - high))).mean()
            levels.append(self._level(weights, float(rejection)))
            part = int(ANNEALING_TICKS * self.power**0.25)
            tick(part - done)
            done = part
        # Copies of a particle are neighbours after resampling.
        self.points = self.points.at(self.rng.permutation(particles))
        return levels

    def move(self) -> np.ndarray:
        """Move all particles and return their acceptance probabilities, (particles,)."""
        power, step = np.full(self.size, self.power), np.full(self.size, self.step)
        self.points, acceptance = move(self.density, self.points, power, self.root, step, self.rng)
        return acceptance

    def _reweight(self, weights: np.ndarray) -> tuple[np.ndarray, float]:
        """Raise the power; return the new weights and the increase of the power."""
        log_likelihood = self.points.log_likelihood
        rise = _rise(log_likelihood, weights, self.power)
        self.power = 1.0 if rise == 1 - self.power else self.power + rise
        top = log_likelihood.max()
        raised = weights * np.exp(rise * (log_likelihood - top))
        self.log_evidence += rise * float(top) + math.log(raised.sum())
        return raised / raised.sum(), rise

    def _level(self, weights: np.ndarray, rejection: float) -> Level:
        theta = self.points.theta[self.rng.choice(self.size, p=weights)]
        return Level(self.power, self.root, self.step, theta, rejection)


def _effective(weights: np.ndarray) -> float:
    """Return the effective sample size."""
    return 1 / float((weights**2).sum())


def _rise(log_likelihood: np.ndarray, weights: np.ndarray, power: float) -> float:
    """Return the increase of the power, at most to 1, with a conditional ESS of 97 %."""
    # Points of likelihood 0 are lost at any power above 0.
    possible = log_likelihood > -np.inf
    excess = log_likelihood[possible] - log_likelihood[possible].max()
    weights = weights[possible] / weights[possible].sum()

    def surplus(log_rise: float) -> float:
        ratio = np.exp(math.exp(log_rise) * excess)
        return float((weights @ ratio) ** 2 / (weights @ ratio**2)) - _CONDITIONAL_ESS

    longest = math.log(1 - power)
    if surplus(longest) >= 0:
        return 1 - power
    return math.exp(brentq(surplus, longest - _LOG_RANGE, longest, xtol=1e-3))


def _resampled(weights: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    """Return n indices by systematic resampling, in increasing order."""
    cumulative = np.cumsum(weights)
    levels = (np.arange(n) + rng.random()) / n * cumulative[-1]
    return np.minimum(np.searchsorted(cumulative, levels, side="right"), len(weights) - 1)
