"""Affine-invariant ensemble sampling with emcee."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from probmotion import seeds
from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import HasLogDensity
from probmotion.posteriors.sampling import Interrupted, UnsupportedPosterior, progress_bar, suited
from probmotion.samplers.densities import Density, continued, motions, starting_points
from probmotion.samplers.mcmc.autocorrelation import autocorrelation_time
from probmotion.validation import check_count

__all__ = ["Ensemble"]

_MIN_RUN_LENGTH = 3
"""Minimum run length, in autocorrelation times, for a reliable estimate of that time."""


@dataclass(frozen=True)
class Ensemble:
    """Ensemble sampler of emcee, with the stretch move of Goodman and Weare (2010).

    A chain is one ensemble; its draws are the states of all walkers, in order of iteration. Walkers
    of an ensemble depend on each other, so R-hat and ESS of a chain are not valid; the
    autocorrelation time is reported instead. See Foreman-Mackey et al. (2013) for emcee.

    Parameters
    ----------
    walkers : int, optional
        Number of walkers per ensemble, at least twice the dimension; four times by default.
    warmup : int
        Number of iterations before the first draw.
    thin : int
        Number of iterations per recorded iteration.
    largest_dim : int
        Maximum dimension of the posterior. In high dimensions the stretch move mixes poorly, which
        diagnostics may not detect (Huijser et al. 2015).
    candidates : int
        Number of prior draws per ensemble; starting points are resampled from them by likelihood.
    """

    name: ClassVar[str] = "ensemble"
    requires: ClassVar[tuple[type, ...]] = (HasLogDensity,)
    effort: ClassVar[tuple[str, ...]] = ("thin", "warmup")

    walkers: int | None = None
    warmup: int = 1000
    thin: int = 50
    largest_dim: int = 20
    candidates: int = 1000

    def __post_init__(self) -> None:
        if self.walkers is not None:
            check_count("walkers", self.walkers, least=2)
        check_count("warmup", self.warmup, least=0)
        check_count("thin", self.thin)
        check_count("largest_dim", self.largest_dim)
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
        """Return ``draws`` walker states from each of ``chains`` ensembles.

        ``initial`` is an earlier run to continue without warm-up, or starting points, an array of
        shape (chains, walkers, dim).

        Raises
        ------
        UnsupportedPosterior
            If the posterior has no density or too many dimensions.
        ValueError
            If the number of walkers is below twice the dimension.
        Interrupted
            On Ctrl-C, with the finished draws.
        """
        check_count("draws", draws)
        start = time.perf_counter()
        density = Density(self, posterior)
        walkers = self._walkers(posterior)
        earlier = continued(self, posterior.log_density, initial, chains, seed)
        if earlier is None:
            shape = (chains, walkers, posterior.dim)
            points = starting_points(
                posterior, density.likelihood, initial, shape, seed, self.candidates
            )
            state = _State.begin(density, points, seed)
        else:
            state = _State.of_arrays(earlier)
        warmup = self.warmup if earlier is None else 0
        run = _Run(density, state, self.thin)
        iterations = -(-max(0, draws - state.unused) // walkers)
        try:
            with progress_bar(warmup + iterations * self.thin, self.name, progress) as bar:
                for _ in range(warmup):
                    for chain in run.chains:
                        next(chain)
                    bar.update(1)
                for _ in range(iterations):
                    run.record()
                    bar.update(self.thin)
        except KeyboardInterrupt as stop:
            if run.last is state:
                raise
            raise Interrupted(self._result(posterior, run, draws, seed, start)) from stop
        return self._result(posterior, run, draws, seed, start)

    def _walkers(self, posterior: MotionPosterior) -> int:
        dim = posterior.dim
        if dim > self.largest_dim:
            raise UnsupportedPosterior(
                self.name,
                f"supports at most {self.largest_dim} dimensions (largest_dim), got {dim}",
                word="dimension",
                others=suited(posterior),
            )
        walkers = 4 * dim if self.walkers is None else self.walkers
        if walkers < 2 * dim:
            raise ValueError(
                f"walkers must be at least {2 * dim}, twice the dimension, got {walkers}"
            )
        return walkers

    def _result(
        self, posterior: MotionPosterior, run: _Run, draws: int, seed: int, start: float
    ) -> MotionDraws:
        theta, log_density, state = run.draws(draws)
        first = state.draws - theta.shape[1]
        return MotionDraws.of(
            posterior,
            self,
            motions(posterior, theta, seed, first),
            seed=seed,
            seconds=time.perf_counter() - start,
            theta=theta,
            log_density=log_density,
            statistics=run.statistics(),
            counts={"density": run.density.evaluations},
            state=state.arrays(),
        )


class _State(NamedTuple):
    """State of all ensembles after an iteration; its last ``unused`` walkers are the next draws."""

    coordinates: np.ndarray
    log_density: np.ndarray
    random: np.ndarray
    unused: int
    draws: int

    @classmethod
    def begin(cls, density: Density, points: np.ndarray, seed: int) -> _State:
        chains, walkers, dim = points.shape
        log_density = density.at_start(points.reshape(-1, dim))[0].reshape(chains, walkers)
        sources = [np.random.MT19937(seeds.sequence(seed, "chain", k)) for k in range(chains)]
        random = np.stack([_words(np.random.RandomState(s).get_state()) for s in sources])
        return cls(points, log_density, random, unused=0, draws=0)

    @classmethod
    def of_arrays(cls, state: Mapping[str, np.ndarray]) -> _State:
        unused, draws = int(state["unused"]), int(state["draws"])
        return cls(state["coordinates"], state["log_density"], state["random"], unused, draws)

    def arrays(self) -> dict[str, np.ndarray]:
        counts = {"unused": self.unused, "draws": self.draws}
        return {**self._asdict(), **{k: np.array(v, dtype=np.int32) for k, v in counts.items()}}


class _Run:
    """emcee samplers and recorded iterations of all ensembles."""

    def __init__(self, density: Density, start: _State, thin: int) -> None:
        import emcee

        self.density = density
        self.start = start
        self.thin = thin
        self.recorded: list[tuple[np.ndarray, np.ndarray]] = []
        self.last = start
        self.chains: list[Iterator[Any]] = []
        for coordinates, log_density, words in zip(*start[:3], strict=True):
            sampler = emcee.EnsembleSampler(*coordinates.shape, density, vectorize=True)
            state = emcee.State(coordinates, log_density, random_state=_random_state(words))
            self.chains.append(
                sampler.sample(
                    state,
                    iterations=None,
                    store=False,
                    # emcee rejects linearly dependent walkers, which may occur in a resumed run.
                    skip_initial_state_check=start.draws > 0,
                )
            )
        self.trace: list[list[np.ndarray]] = []
        self.first_coordinates: list[list[np.ndarray]] = []

    def record(self) -> None:
        """Advance every ensemble by ``thin`` iterations and record the last iteration."""
        for iteration in range(self.thin):
            states = [next(chain) for chain in self.chains]
            # emcee modifies its arrays in place.
            self.first_coordinates.append([state.coords[:, 0].copy() for state in states])
            if iteration % self._stride == 0:
                self.trace.append([state.coords.copy() for state in states])
        coordinates = np.stack([state.coords for state in states])
        log_density = np.stack([state.log_prob for state in states])
        random = np.stack([_words(state.random_state) for state in states])
        self.recorded.append((coordinates, log_density))
        self.last = _State(coordinates, log_density, random, 0, len(self.recorded))

    def draws(self, n: int) -> tuple[np.ndarray, np.ndarray, _State]:
        """Return θ and log densities of at most ``n`` draws, and the state after them."""
        walkers = self.start.coordinates.shape[1]
        finished = self.last.draws if self.last is not self.start else 0
        begin = walkers - self.start.unused
        first = (self.start.coordinates[:, begin:], self.start.log_density[:, begin:])
        theta, log_density = (
            np.concatenate(parts, axis=1)
            for parts in zip(first, *self.recorded[:finished], strict=True)
        )
        n = min(n, theta.shape[1])
        state = self.last._replace(unused=theta.shape[1] - n, draws=self.start.draws + n)
        return theta[:, :n], log_density[:, :n], state

    def statistics(self) -> dict[str, np.ndarray]:
        """Return the acceptance rate and autocorrelation time of every ensemble.

        The time is the maximum over coordinates, in recorded iterations, at least 1. If the run is
        shorter than three times the estimate, the time is at least the number of recorded
        iterations, so that the run counts as one iteration of walkers, which are independent under
        the target (Goodman and Weare 2010). With fewer than four trace entries, the time is NaN and
        the acceptance rate is omitted.
        """
        if len(self.trace) < 4:
            return {"autocorrelation_time": np.full(len(self.chains), np.nan)}
        # An accepted stretch move changes every coordinate.
        accepted = np.diff(np.array(self.first_coordinates), axis=0) != 0
        traces = [np.array(trace) for trace in zip(*self.trace, strict=True)]
        slowest = np.array([autocorrelation_time(trace).max() for trace in traces])
        times = np.maximum(slowest * self._stride / self.thin, 1.0)
        too_short = len(self.trace) < _MIN_RUN_LENGTH * slowest
        times = np.where(too_short, np.maximum(times, len(self.recorded)), times)
        return {"acceptance_rate": accepted.mean(axis=(0, 2)), "autocorrelation_time": times}

    @property
    def _stride(self) -> int:
        """Number of iterations per entry of the trace."""
        return max(1, self.thin // 10)


def _words(state: Any) -> np.ndarray:
    """Return the state of a RandomState, without its cached normal, as signed 32-bit words."""
    _, key, position, *_ = state
    return np.append(key.view(np.int32), np.int32(position))


def _random_state(words: np.ndarray) -> tuple[Any, ...]:
    words = np.asarray(words, dtype=np.int32)
    return ("MT19937", words[:-1].view(np.uint32), int(words[-1]), 0, 0.0)
