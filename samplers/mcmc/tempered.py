"""Parallel tempering with non-reversible swaps and an adapted ladder."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from probmotion import seeds
from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import HasLogDensity, Samplable
from probmotion.posteriors.sampling import Interrupted, progress_bar
from probmotion.samplers.densities import continued, motions
from probmotion.samplers.mcmc.annealing import ANNEALING_TICKS
from probmotion.samplers.mcmc.ladder import Ladder, LadderDraw
from probmotion.samplers.mcmc.tempering import TemperedDensity, check_initial
from probmotion.validation import check_count

__all__ = ["ParallelTempering"]


@dataclass(frozen=True)
class ParallelTempering:
    """Parallel tempering with non-reversible swaps (Syed et al. 2022).

    Replica k of a chain targets p(θ) p(y | θ)^β_k, 0 = β_0 < … < β_K = 1. Every sweep replaces the
    first replica by a draw of the prior, moves the others, and swaps pairs of neighbours, even and
    odd pairs in turn. The draws are the states of the last replica. A short annealing selects the
    powers, scales and starting points; warm-up adapts the powers so that all pairs are rejected
    equally often. The result counts the prior draws that arrived at β = 1 (``restarts``).

    Parameters
    ----------
    rungs : int, optional
        Number of replicas, at least 2; by default enough for frequent swaps.
    warmup : int
        Number of sweeps before the first draw.
    thin : int
        Number of sweeps per draw.
    particles : int
        Number of particles of the annealing.
    candidates : int
        Number of draws of the prior from which the particles are resampled.
    gradients : bool
        Use Hamiltonian moves if JAX or torch differentiates prior and likelihood; otherwise, moves
        are random walks.
    """

    name: ClassVar[str] = "tempered"
    requires: ClassVar[tuple[type, ...]] = (HasLogDensity, Samplable)
    effort: ClassVar[tuple[str, ...]] = ("thin", "warmup")

    rungs: int | None = None
    warmup: int = 500
    thin: int = 10
    particles: int = 64
    candidates: int = 2000
    gradients: bool = True

    def __post_init__(self) -> None:
        if self.rungs is not None:
            check_count("rungs", self.rungs, least=2)
        check_count("warmup", self.warmup, least=0)
        check_count("thin", self.thin)
        check_count("particles", self.particles, least=2)
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
        """Return ``draws`` states from each of ``chains`` chains, ``thin`` sweeps apart.

        ``initial`` is an earlier run to continue without warm-up.

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
        warmup = (ANNEALING_TICKS + self.warmup) * (earlier is None)
        finished: list[list[LadderDraw]] = []
        ladders: list[Ladder] = []
        states: list[dict[str, np.ndarray]] = []
        try:
            with progress_bar(chains * (warmup + draws * self.thin), self.name, progress) as bar:
                for chain in range(chains):
                    if earlier is None:
                        # A run stores equally long ladders of all chains.
                        rungs = ladders[0].rungs if ladders else self.rungs
                        rng = seeds.generator(seed, "chain", chain)
                        start_from = self.particles, self.candidates
                        ladder = Ladder.begin(density, rng, rungs, *start_from, bar.update)
                        ladder.warm_up(self.warmup, bar.update)
                    else:
                        ladder = Ladder.resume(density, earlier, chain)
                    ladders.append(ladder)
                for _ in range(draws):
                    row = []
                    for ladder in ladders:
                        row.append(ladder.advance(self.thin))
                        bar.update(self.thin)
                    latest = [ladder.state() for ladder in ladders]
                    # An interrupt finds both or neither.
                    finished.append(row)
                    states = latest
        except KeyboardInterrupt as stop:
            if not finished:
                raise
            raise Interrupted(self._result(density, finished, states, seed, start)) from stop
        return self._result(density, finished, states, seed, start)

    def _result(
        self,
        density: TemperedDensity,
        finished: list[list[LadderDraw]],
        states: list[dict[str, np.ndarray]],
        seed: int,
        start: float,
    ) -> MotionDraws:
        columns = {
            name: np.stack([[getattr(draw, name) for draw in row] for row in finished], axis=1)
            for name in LadderDraw._fields
        }
        theta, log_density = columns.pop("theta"), columns.pop("log_density")
        state = {name: np.stack([one[name] for one in states]) for name in states[0]}
        first = int(state["draws"][0]) - len(finished)
        return MotionDraws.of(
            density.posterior,
            self,
            motions(density.posterior, theta, seed, first),
            seed=seed,
            seconds=time.perf_counter() - start,
            theta=theta,
            log_density=log_density,
            statistics=columns,
            counts=density.counts,
            state=state,
        )
