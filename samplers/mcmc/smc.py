"""Sequential Monte Carlo: particles annealed from the prior to the posterior."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import numpy as np

from probmotion import seeds
from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import HasLogDensity, Samplable
from probmotion.posteriors.sampling import Interrupted, progress_bar
from probmotion.samplers.densities import continued, motions
from probmotion.samplers.mcmc.annealing import ANNEALING_TICKS, Population
from probmotion.samplers.mcmc.tempering import TemperedDensity, check_initial
from probmotion.validation import check_count

__all__ = ["SequentialMonteCarlo"]


@dataclass(frozen=True)
class SequentialMonteCarlo:
    """Annealed sequential Monte Carlo (Neal 2001, Del Moral et al. 2006).

    Draws of the prior are weighted by the likelihood to increasing powers, resampled and moved, so
    that they represent the modes that draws of the prior reach, approximately in proportion to
    their mass. A chain is one population of particles. Its draws are the particles after ``thin``
    moves, then again after ``thin`` more. They share ancestors: the effective sample size of a
    chain is too large, and only R-hat of several populations detects wrong proportions of modes.
    The result contains a consistent estimate of the log marginal likelihood (``log_evidence``) and
    the number of powers (``levels``) of each chain.

    Parameters
    ----------
    particles : int
        Number of particles per population.
    moves : int
        Number of moves of every particle at each power.
    thin : int
        Number of moves between successive uses of the particles as draws.
    candidates : int
        Number of draws of the prior per population, from which the particles are resampled at the
        first powers.
    gradients : bool
        Use Hamiltonian moves if JAX or torch differentiates prior and likelihood; otherwise, moves
        are random walks.
    """

    name: ClassVar[str] = "smc"
    requires: ClassVar[tuple[type, ...]] = (HasLogDensity, Samplable)
    effort: ClassVar[tuple[str, ...]] = ("particles",)
    least_effort: ClassVar[int] = 16

    particles: int = 256
    moves: int = 1
    thin: int = 5
    candidates: int = 2000
    gradients: bool = True

    def __post_init__(self) -> None:
        check_count("particles", self.particles, least=2)
        check_count("moves", self.moves)
        check_count("thin", self.thin)
        check_count("candidates", self.candidates)

    def sample(
        self,
        posterior: MotionPosterior,
        *,
        draws: int = 1000,
        chains: int = 1,
        seed: int = 0,
        initial: MotionDraws | np.ndarray | None = None,
        progress: bool = True,
    ) -> MotionDraws:
        """Return ``draws`` particles from each of ``chains`` populations.

        ``initial`` is an earlier run to continue without annealing.

        Raises
        ------
        UnsupportedPosterior
            If the prior has no density or cannot be sampled.
        ValueError
            If the likelihood is 0 at all draws of the prior, or a density is NaN or +∞.
        Interrupted
            On Ctrl-C, with the finished draws.
        """
        check_count("draws", draws)
        density = TemperedDensity(self, posterior, self.gradients)
        start = time.perf_counter()
        check_initial(self.name, initial)
        earlier = continued(self, posterior.log_density, initial, chains, seed)
        runs: list[_Run] = []
        new = draws if earlier is None else draws - int(earlier["unused"])
        iterations = -(-max(0, new) // self.particles)
        total = chains * (iterations * self.thin + ANNEALING_TICKS * (earlier is None))
        try:
            with progress_bar(total, self.name, progress) as bar:
                for chain in range(chains):
                    if earlier is None:
                        runs.append(_Run.begin(self, density, seed, chain, bar.update))
                    else:
                        runs.append(_Run.resume(density, earlier, chain))
                for _ in range(iterations):
                    for run in runs:
                        run.record(self.thin)
                        bar.update(self.thin)
        except KeyboardInterrupt as stop:
            if len(runs) < chains or not all(run.recorded for run in runs):
                raise
            raise Interrupted(self._result(density, runs, draws, seed, start)) from stop
        return self._result(density, runs, draws, seed, start)

    def _result(
        self, density: TemperedDensity, runs: list[_Run], draws: int, seed: int, start: float
    ) -> MotionDraws:
        iterations = min(len(run.recorded) for run in runs)
        theta, log_density = (
            np.stack([run.values(part, iterations) for run in runs])[:, :draws]
            for part in ("theta", "log_density")
        )
        n = theta.shape[1]
        states = [run.recorded[iterations - 1] if iterations else run.start for run in runs]
        first = runs[0].draws
        unused = runs[0].unused + iterations * self.particles - n
        state = {
            "theta": np.stack([state.theta for state in states]),
            "random": np.stack([state.random for state in states]),
            "root": np.stack([run.population.root for run in runs]),
            "step": np.array([run.population.step for run in runs]),
            "log_evidence": np.array([run.population.log_evidence for run in runs]),
            "levels": np.array([run.levels for run in runs], dtype=np.int32),
            "unused": np.array(unused, dtype=np.int32),
            "draws": np.array(first + n, dtype=np.int32),
        }
        statistics = {name: state[name] for name in ("log_evidence", "levels")}
        if iterations:
            rates = [[state.acceptance for state in run.recorded[:iterations]] for run in runs]
            statistics["acceptance_rate"] = np.mean(rates, axis=1)
        return MotionDraws.of(
            density.posterior,
            self,
            motions(density.posterior, theta, seed, first),
            seed=seed,
            seconds=time.perf_counter() - start,
            theta=theta,
            log_density=log_density,
            statistics=statistics,
            counts=density.counts,
            state=state,
        )


class _Record(NamedTuple):
    """Particles after an iteration, and the random generator's state."""

    theta: np.ndarray
    log_density: np.ndarray
    random: np.ndarray
    acceptance: float


@dataclass
class _Run:
    """One population; the last ``unused`` particles of ``start`` are its first draws."""

    population: Population
    levels: int
    draws: int = 0
    unused: int = 0
    start: _Record = field(init=False)
    recorded: list[_Record] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.start = self._record(math.nan)

    @classmethod
    def begin(
        cls,
        sampler: SequentialMonteCarlo,
        density: TemperedDensity,
        seed: int,
        chain: int,
        tick: Callable[[int], Any],
    ) -> _Run:
        rng = seeds.generator(seed, "chain", chain)
        draws = max(sampler.candidates, sampler.particles)
        population = Population.of_prior(density, rng, draws)
        levels = population.anneal(sampler.particles, sampler.moves, tick)
        return cls(population, len(levels) - 1)

    @classmethod
    def resume(cls, density: TemperedDensity, state: Mapping[str, np.ndarray], chain: int) -> _Run:
        theta = state["theta"][chain]
        population = Population(
            density,
            seeds.resumed_generator(state["random"][chain]),
            density.points(theta, np.ones(len(theta)), counted=False),
            state["root"][chain],
            float(state["step"][chain]),
            power=1.0,
            log_evidence=float(state["log_evidence"][chain]),
        )
        levels, draws, unused = state["levels"][chain], state["draws"], state["unused"]
        return cls(population, int(levels), int(draws), int(unused))

    def record(self, moves: int) -> None:
        """Move all particles ``moves`` times and record them."""
        acceptance = np.mean([self.population.move() for _ in range(moves)])
        self.recorded.append(self._record(float(acceptance)))

    def values(self, part: str, iterations: int) -> np.ndarray:
        """Return θ or log densities of the unused and of all recorded particles."""
        records = (self.start, *self.recorded[:iterations])
        values = np.concatenate([getattr(record, part) for record in records])
        return values[len(self.start.theta) - self.unused :]

    def _record(self, acceptance: float) -> _Record:
        points = self.population.points
        log_density = points.log_density(np.ones(self.population.size))
        random = seeds.state_words(self.population.rng)
        return _Record(points.theta, log_density, random, acceptance)
