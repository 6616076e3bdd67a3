"""`Ensemble`: emcee's affine-invariant walkers on a posterior's log density."""

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

_TIMES_TO_TELL = 3
"""Autocorrelation times that a run has to be long for its own to be believed."""


@dataclass(frozen=True)
class Ensemble:
    """The affine-invariant stretch move (Goodman and Weare 2010) of emcee (Foreman-Mackey 2013).

    A chain is one ensemble of walkers, independent of the other chains. Its draws are the walkers
    in turn, one iteration after the other: walkers of one ensemble depend on each other, so that
    neither R-hat nor ESS of a chain is valid, and its autocorrelation time is stored instead.

    A budget sets ``thin`` and ``warmup`` (:mod:`probmotion.comparison.results.budgets`).

    Parameters
    ----------
    walkers : int, optional
        Walkers per ensemble, at least twice the dimension; four times by default.
    warmup : int
        Iterations before the first draw.
    thin : int
        Iterations from one kept to the next.
    largest_dim : int
        A posterior of more dimensions is refused: there the stretch move hardly moves and its
        draws look right when they are not (Huijser et al. 2015).
    candidates : int
        Draws from the prior per ensemble; its walkers start at some of them, chosen in proportion
        to their likelihood.
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
        """Return ``draws`` states of walkers of each of ``chains`` ensembles.

        Parameters
        ----------
        posterior, draws, chains, seed, progress
            As in :class:`~probmotion.posteriors.sampling.Sampler`.
        initial : MotionDraws or ndarray, (chains, walkers, dim), optional
            An earlier run, to go on from as if it had not stopped (without a warm-up); or the
            walkers' starting points. Some of ``candidates`` draws from the prior by
            default.

        Raises
        ------
        UnsupportedPosterior
            If the posterior has no density or too many dimensions.
        ValueError
            If there are fewer walkers than twice the dimension.
        Interrupted
            On Ctrl-C; it carries the draws that were finished.
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
            rest = _Rest.begin(density, points, seed)
        else:
            rest = _Rest.of_state(earlier)
        warmup = self.warmup if earlier is None else 0
        run = _Run(density, rest, self.thin)
        iterations = -(-max(0, draws - rest.unused) // walkers)
        try:
            with progress_bar(warmup + iterations * self.thin, self.name, progress) as bar:
                for _ in range(warmup):
                    run.warm_up()
                    bar.update(1)
                for _ in range(iterations):
                    run.keep()
                    bar.update(self.thin)
        except KeyboardInterrupt as stop:
            if run.last is rest:
                raise
            raise Interrupted(self._result(posterior, run, draws, seed, start)) from stop
        return self._result(posterior, run, draws, seed, start)

    def _walkers(self, posterior: MotionPosterior) -> int:
        dim = posterior.dim
        if dim > self.largest_dim:
            raise UnsupportedPosterior(
                self.name,
                f"is for at most {self.largest_dim} dimensions (largest_dim), and the posterior "
                f"has {dim}",
                word="dimension",
                others=suited(posterior),
            )
        walkers = 4 * dim if self.walkers is None else self.walkers
        if walkers < 2 * dim:
            raise ValueError(
                f"walkers is {walkers}, expected at least {2 * dim}, twice the posterior's "
                "dimension"
            )
        return walkers

    def _result(
        self, posterior: MotionPosterior, run: _Run, draws: int, seed: int, start: float
    ) -> MotionDraws:
        theta, log_density, rest = run.draws(draws)
        first = rest.draws - theta.shape[1]
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
            state=rest.state(),
        )


class _Rest(NamedTuple):
    """Ensembles between two iterations, and how many of their walkers are draws not given out.

    The draws of an ensemble are one stream, all walkers at each kept iteration; a run takes as
    many as it was asked for and leaves the others to the run that goes on.
    """

    coordinates: np.ndarray
    log_density: np.ndarray
    random: np.ndarray
    unused: int
    draws: int

    @classmethod
    def begin(cls, density: Density, points: np.ndarray, seed: int) -> _Rest:
        chains, walkers, dim = points.shape
        log_density = density.at_start(points.reshape(-1, dim))[0].reshape(chains, walkers)
        sources = [np.random.MT19937(seeds.sequence(seed, "chain", k)) for k in range(chains)]
        random = np.stack([_words(np.random.RandomState(s).get_state()) for s in sources])
        return cls(points, log_density, random, unused=0, draws=0)

    @classmethod
    def of_state(cls, state: Mapping[str, np.ndarray]) -> _Rest:
        unused, draws = int(state["unused"]), int(state["draws"])
        return cls(state["coordinates"], state["log_density"], state["random"], unused, draws)

    def state(self) -> dict[str, np.ndarray]:
        counts = {"unused": self.unused, "draws": self.draws}
        return {**self._asdict(), **{k: np.array(v, dtype=np.int32) for k, v in counts.items()}}


class _Run:
    """Ensembles that emcee advances in turn, and what they have kept."""

    def __init__(self, density: Density, start: _Rest, thin: int) -> None:
        import emcee

        self.density = density
        self.start = start
        self.thin = thin
        self.kept: list[tuple[np.ndarray, np.ndarray]] = []
        self.last = start
        self.chains: list[Iterator[Any]] = []
        for coordinates, log_density, words in zip(*start[:3], strict=True):
            sampler = emcee.EnsembleSampler(*coordinates.shape, density, vectorize=True)
            state = emcee.State(coordinates, log_density, random_state=_random_state(words))
            # The walkers of a run that goes on need not pass emcee's check a second time.
            unchecked = start.draws > 0
            self.chains.append(
                sampler.sample(
                    state, iterations=None, store=False, skip_initial_state_check=unchecked
                )
            )
        self.trace: list[list[np.ndarray]] = []
        self.first_coordinates: list[list[np.ndarray]] = []

    def warm_up(self) -> None:
        """Move every ensemble once and remember nothing."""
        for chain in self.chains:
            next(chain)

    def keep(self) -> None:
        """Move every ensemble ``thin`` times and keep where its walkers are then.

        An interrupt between two kept iterations loses neither.
        """
        for iteration in range(self.thin):
            states = [next(chain) for chain in self.chains]
            # emcee moves walkers in place: what is remembered is a copy.
            self.first_coordinates.append([state.coords[:, 0].copy() for state in states])
            if iteration % self._stride == 0:
                self.trace.append([state.coords.copy() for state in states])
        coordinates = np.stack([state.coords for state in states])
        log_density = np.stack([state.log_prob for state in states])
        random = np.stack([_words(state.random_state) for state in states])
        self.kept.append((coordinates, log_density))
        self.last = _Rest(coordinates, log_density, random, 0, len(self.kept))

    def draws(self, wanted: int) -> tuple[np.ndarray, np.ndarray, _Rest]:
        """Return θ, log densities and what is left, once all or some iterations are kept."""
        walkers = self.start.coordinates.shape[1]
        n = self.last.draws if self.last is not self.start else 0
        begin = walkers - self.start.unused
        first = (self.start.coordinates[:, begin:], self.start.log_density[:, begin:])
        theta, log_density = (
            np.concatenate(parts, axis=1) for parts in zip(first, *self.kept[:n], strict=True)
        )
        given = min(wanted, theta.shape[1])
        rest = self.last._replace(unused=theta.shape[1] - given, draws=self.start.draws + given)
        return theta[:, :given], log_density[:, :given], rest

    def statistics(self) -> dict[str, np.ndarray]:
        """Return per ensemble the share of moves accepted and the autocorrelation time.

        The latter is the slowest coordinate's, in draws: 1 where kept iterations are independent,
        NaN after too few iterations to tell, which have no share of moves either. Of a run that is
        not three times as long, which its own estimate is too short for, it is all kept
        iterations: then one of them counts, whose walkers the target has independent of each other
        (Goodman and Weare 2010). Whether they have come there, R-hat of several ensembles tells.
        """
        if len(self.trace) < 4:
            return {"autocorrelation_time": np.full(len(self.chains), np.nan)}
        # A stretch is never by a factor of exactly 1: a walker that moved has changed.
        moved = np.diff(np.array(self.first_coordinates), axis=0) != 0
        traces = zip(*self.trace, strict=True)
        slowest = np.array([autocorrelation_time(np.array(trace)).max() for trace in traces])
        times = np.maximum(slowest * self._stride / self.thin, 1.0)
        too_short = len(self.trace) < _TIMES_TO_TELL * slowest
        times = np.where(too_short, np.maximum(times, len(self.kept)), times)
        return {"acceptance": moved.mean(axis=(0, 2)), "autocorrelation_time": times}

    @property
    def _stride(self) -> int:
        """Iterations from one entry of the trace to the next."""
        return max(1, self.thin // 10)


def _words(state: Any) -> np.ndarray:
    """Return a RandomState's state as signed 32-bit words, all that netCDF can hold.

    emcee's stretch move draws no normal numbers, so that none is ever in store.
    """
    _, key, position, *_ = state
    return np.append(key.view(np.int32), np.int32(position))


def _random_state(words: np.ndarray) -> tuple[Any, ...]:
    words = np.asarray(words, dtype=np.int32)
    return ("MT19937", words[:-1].view(np.uint32), int(words[-1]), 0, 0.0)
