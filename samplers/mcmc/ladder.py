"""Ladder of replicas at increasing powers of the likelihood, with non-reversible swaps."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from probmotion import seeds
from probmotion.samplers.mcmc.annealing import Level, Population
from probmotion.samplers.mcmc.tempering import Points, TemperedDensity, move, target_acceptance

__all__ = ["Ladder", "LadderDraw", "equal_rejection"]

_RUNGS = 16  # the default number of rungs is a multiple
_RUNGS_PER_REJECTION = 1.5  # rungs per expected rejection over the whole ladder
_FIRST_WINDOW = 25  # sweeps of the first window of warm-up; each window doubles


class LadderDraw(NamedTuple):
    """State of the last replica, and means or numbers of the sweeps since the previous draw."""

    theta: np.ndarray
    log_density: float
    acceptance_rate: float
    swap_rate: float
    restarts: int


@dataclass
class Ladder:
    """Replicas of one chain, in order of increasing power.

    ``started`` marks states that began as a draw of the prior and have not arrived at β = 1;
    ``even`` is whether the next swaps are those of replicas 0 and 1, 2 and 3, …
    """

    density: TemperedDensity
    rng: np.random.Generator
    points: Points
    powers: np.ndarray
    root: np.ndarray
    step: np.ndarray
    started: np.ndarray
    even: bool = True
    draws: int = 0
    levels: Sequence[Level] = ()

    @classmethod
    def begin(
        cls,
        density: TemperedDensity,
        rng: np.random.Generator,
        rungs: int | None,
        particles: int,
        candidates: int,
        tick: Callable[[int], Any],
    ) -> Ladder:
        """Return a ladder from an annealing of ``particles`` of at least ``candidates`` draws.

        By default, the number of rungs is 1.5 times the expected number of rejections over all
        powers, and a multiple of 16.
        """
        population = Population.of_prior(density, rng, max(candidates, particles))
        levels = population.anneal(particles, 1, tick)
        rejection = np.array([level.rejection for level in levels[1:]])
        if rungs is None:
            needed = _RUNGS_PER_REJECTION * rejection.sum() + 1
            rungs = _RUNGS * math.ceil(needed / _RUNGS)
        powers = equal_rejection(np.array([level.power for level in levels]), rejection, rungs)
        chosen = _levels_at(levels, powers)
        points = density.points(np.stack([level.theta for level in chosen]), powers)
        root = np.concatenate([level.root for level in chosen])
        step = np.array([level.step for level in chosen])
        return cls(density, rng, points, powers, root, step, np.arange(rungs) == 0, levels=levels)

    @classmethod
    def resume(
        cls, density: TemperedDensity, state: Mapping[str, np.ndarray], chain: int
    ) -> Ladder:
        """Return the ladder of a chain from the ``state`` of all chains."""
        own = {name: values[chain] for name, values in state.items()}
        return cls(
            density,
            seeds.resumed_generator(own["random"]),
            density.points(own["theta"], own["powers"], counted=False),
            own["powers"],
            own["root"],
            own["step"],
            started=own["started"].astype(bool),
            even=bool(own["even"]),
            draws=int(own["draws"]),
        )

    @property
    def rungs(self) -> int:
        """Number of replicas."""
        return len(self.powers)

    def state(self) -> dict[str, np.ndarray]:
        """Return the arrays required by :meth:`resume`."""
        return {
            "theta": self.points.theta,
            "powers": self.powers,
            "root": self.root,
            "step": self.step,
            "started": self.started.astype(np.int8),
            "even": np.array(self.even, dtype=np.int8),
            "random": seeds.state_words(self.rng),
            "draws": np.array(self.draws, dtype=np.int32),
        }

    def warm_up(self, sweeps: int, tick: Callable[[int], Any]) -> None:
        """Adapt the step sizes, and the powers at the end of windows of 25, 50, 100, … sweeps."""
        target, window = target_acceptance(self.density), _FIRST_WINDOW
        rejection, n = np.zeros(self.rungs - 1), 0
        for _ in range(sweeps):
            acceptance, rejected, _ = self.sweep()
            n += 1
            rejection += rejected
            # Longer steps than a quarter period do not help.
            step = self.step * np.exp((acceptance - target) * n**-0.6)
            self.step = np.minimum(0.5 * math.pi, step)
            if n == window:
                self.powers = equal_rejection(self.powers, rejection / n, self.rungs)
                chosen = _levels_at(self.levels, self.powers)
                self.root = np.concatenate([level.root for level in chosen])
                rejection, n, window = np.zeros(self.rungs - 1), 0, 2 * window
            tick(1)

    def advance(self, sweeps: int) -> LadderDraw:
        """Return the next draw, ``sweeps`` sweeps later."""
        acceptance, rejected, arrived = zip(*(self.sweep() for _ in range(sweeps)), strict=True)
        self.draws += 1
        return LadderDraw(
            self.points.theta[-1].copy(),
            float(self.points.log_density(self.powers)[-1]),
            float(np.mean([row[-1] for row in acceptance])),
            1 - float(np.mean(rejected)),
            sum(arrived),
        )

    def sweep(self) -> tuple[np.ndarray, np.ndarray, bool]:
        """Move and swap all replicas.

        Returns the acceptance probabilities of the moves, (rungs,), the rejection probabilities of
        the swaps of all neighbours, (rungs − 1,), and whether a draw of the prior arrived at β = 1.
        """
        prior_draw = self.density.posterior.initial(self.rng, 1)[0]
        self.points, acceptance = move(
            self.density, self.points, self.powers, self.root, self.step, self.rng, prior_draw
        )
        self.started[0] = True
        log_ratio = np.diff(self.powers) * -np.diff(self.points.log_likelihood)
        log_acceptance = np.minimum(0.0, log_ratio)
        swapped = -self.rng.standard_exponential(self.rungs - 1) < log_acceptance
        swapped[int(self.even) :: 2] = False
        order = np.arange(self.rungs)
        first = np.flatnonzero(swapped)
        order[first], order[first + 1] = first + 1, first
        self.points, self.started = self.points.at(order), self.started[order]
        self.even = not self.even
        arrived = bool(self.started[-1])
        self.started[-1] = False
        return acceptance, 1 - np.exp(log_acceptance), arrived


def equal_rejection(powers: np.ndarray, rejection: np.ndarray, rungs: int) -> np.ndarray:
    """Return powers between which swaps are rejected equally often.

    The expected rejections between successive ``powers``, (n,), are ``rejection``, (n − 1,). Their
    cumulative sum, the communication barrier, is inverted at equal distances (Syed et al. 2022); it
    is interpolated in log β, and in β between the first two powers.
    """
    # The small constant spaces powers equally where nothing is rejected.
    barrier = np.concatenate([[0.0], np.cumsum(rejection + 1e-6)])
    levels = np.linspace(0, barrier[-1], rungs)
    first = powers[1] * levels / barrier[1]
    others = np.exp(np.interp(levels, barrier[1:], np.log(powers[1:])))
    spaced = np.where(levels < barrier[1], first, others)
    spaced[-1] = 1.0
    return spaced


def _levels_at(levels: Sequence[Level], powers: np.ndarray) -> list[Level]:
    """Return the levels with the smallest powers that are at least ``powers``."""
    known = np.array([level.power for level in levels])
    return [levels[min(i, len(levels) - 1)] for i in np.searchsorted(known, powers)]
