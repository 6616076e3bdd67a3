"""Parallel tempering over pose pairs and single views.

The likelihood of a pose pair Θ is a mean over views, and the likelihood L(Θ_v; v) of view v depends
on its nearest annotation. Modes near different annotations are far apart. The view is therefore
part of the state: with the prior p, chains target

    π(Θ, v) ∝ p(Θ) L(Θ_v; v),

whose marginal is the posterior, and a step evaluates one view. Levels temper L by powers in [0, 1].
Neighbouring levels exchange states (Swendsen and Wang 1986), alternating even and odd pairs, and
the powers are tuned to equal rejection rates (Syed et al. 2022). If the posterior density f is
truncated to f* ≤ f (eq. 11), one more state targets f* and is exchanged with the state at power 1.

Physical lifts of an annotation are sampled likewise: they have one view, whose likelihood is a
power of the density of the bone lengths.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Mapping
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from typing import Any, ClassVar

import numpy as np

from probmotion import seeds
from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import HasWalks, Walks
from probmotion.posteriors.sampling import (
    Interrupted,
    UnsupportedPosterior,
    progress_bar,
    require,
    suited,
)
from probmotion.posteriors.truncation import TruncatedPosterior
from probmotion.samplers.mcmc.stored_chain import StoredChain
from probmotion.threads import only_one_thread
from probmotion.validation import check_count

__all__ = ["TemperedPairs"]

_TARGET_ACCEPTANCE = 0.3  # Target acceptance rate of the moves.
_INITIAL_SIZE = 0.1  # Initial step size of every move.
_MAX_SIZE = math.e  # Maximum step size.
_LOW_POWER = 0.03  # Power below which views change so often that fewer steps suffice.
_LOW_STEPS = 40  # Maximum number of steps per level of a low power.
_INITIAL_ROUND = 16  # Number of exchanges before the powers are first tuned.
_MIN_POWER = 1e-5  # Smallest positive power before tuning.
_STATE = (  # Stored attributes of a chain, and those of the truncated state.
    "poses", "parts", "seen", "views", "powers", "log_sizes", "tried", "taken", "rejected", "asked",
    "odd", "been_down", "round_trips", "evaluations",
)  # fmt: skip
_CUT_STATE = ("pose", "parts", "seen", "view", "log_share")


@dataclass(frozen=True)
class TemperedPairs:
    """Parallel tempering of pose pairs and views, with separate levels per chain.

    Parameters
    ----------
    levels : int
        Number of powers from 0 to 1.
    steps : int
        Number of Metropolis steps per level between exchanges; at most 40 at powers below 0.03.
    warmup : int
        Number of exchanges before the first draw, used to tune powers and step sizes.
    thin : int
        Number of exchanges per draw.
    """

    name: ClassVar[str] = "tempered-pairs"
    requires: ClassVar[tuple[type, ...]] = (HasWalks,)
    effort: ClassVar[tuple[str, ...]] = ("warmup", "thin")
    least_effort: ClassVar[int] = _INITIAL_ROUND

    levels: int = 20
    steps: int = 100
    warmup: int = 300
    thin: int = 30

    def __post_init__(self) -> None:
        check_count("levels", self.levels, least=3)
        check_count("steps", self.steps)
        check_count("warmup", self.warmup, least=_INITIAL_ROUND)
        check_count("thin", self.thin)

    @staticmethod
    def draws_from(posterior: MotionPosterior) -> bool:
        """Return whether the prior has walks for the likelihood."""
        return _walks_of(posterior) is not None

    def sample(
        self,
        posterior: MotionPosterior,
        *,
        draws: int = 1000,
        chains: int = 1,
        seed: int = 0,
        initial: MotionDraws | np.ndarray | None = None,
        progress: bool = True,
        unfinished: Path | None = None,
    ) -> MotionDraws:
        """Return ``draws`` states of each of ``chains`` chains; see the sampler protocol.

        The state of each chain is stored twice a minute in files named after ``unfinished``, from
        which the same call resumes; the caller deletes them. Results do not depend on the number of
        threads. Each step counts as one density evaluation, although most evaluate only part of it;
        proposals of another view or annotation are not counted.

        Raises
        ------
        UnsupportedPosterior
            If the prior has no walks for the likelihood.
        ValueError
            If ``initial`` is given.
        Interrupted
            On Ctrl-C, with the draws that all chains have finished.
        """
        require(self, posterior)
        walks = _walks_of(posterior)
        if walks is None:
            raise UnsupportedPosterior(
                self.name,
                f"needs annotations of all joints, got {type(posterior).__name__} with "
                f"{type(posterior.likelihood).__name__}",
                word="annotations",
                others=suited(posterior),
            )
        if initial is not None:
            raise ValueError(
                f"initial must be None, got {type(initial).__name__}: chains start at the seeds of "
                "the prior"
            )
        check_count("draws", draws)
        check_count("chains", chains)
        start, stop = time.perf_counter(), Event()
        cores = 1 if only_one_thread() else os.cpu_count() or 1
        total = chains * (self.warmup + draws * self.thin)
        ladders: list[_Ladder] = []
        try:
            with (
                progress_bar(total, self.name, progress) as bar,
                ThreadPoolExecutor(min(chains, cores)) as threads,
            ):
                ladders += [
                    _Ladder(self, posterior, walks, seeds.generator(seed, "chain", chain), chain)
                    for chain in range(chains)
                ]
                try:
                    futures = []
                    for chain, ladder in enumerate(ladders):
                        path = unfinished and unfinished.with_name(f"{unfinished.name}-{chain}.npz")
                        task = threads.submit(ladder.draw, draws, bar, stop, StoredChain(path))
                        futures.append(task)
                    # The first failure stops all chains.
                    for future in wait(futures, return_when=FIRST_EXCEPTION).done:
                        future.result()
                finally:
                    stop.set()
        except KeyboardInterrupt as interruption:
            if not ladders or not all(ladder.drawn for ladder in ladders):
                raise
            raise Interrupted(self._result(posterior, ladders, seed, start)) from interruption
        return self._result(posterior, ladders, seed, start)

    def _result(
        self, posterior: MotionPosterior, ladders: list[_Ladder], seed: int, start: float
    ) -> MotionDraws:
        """Return the draws that all chains have finished."""
        n = min(len(ladder.drawn) for ladder in ladders)
        return MotionDraws.of(
            posterior,
            self,
            np.stack([np.stack(ladder.drawn[:n]) for ladder in ladders])[:, :, None],
            seed=seed,
            seconds=time.perf_counter() - start,
            statistics={
                "round_trips": np.array([ladder.round_trips for ladder in ladders]),
                "rejected_exchanges": np.array([ladder.barrier for ladder in ladders]),
            },
            counts={"density": sum(ladder.evaluations for ladder in ladders)},
        )


def _walks_of(posterior: MotionPosterior) -> Walks | None:
    """Return the walks of the prior for the likelihood, if there are any."""
    plain = type(posterior) in (MotionPosterior, TruncatedPosterior)
    if not plain or not isinstance(posterior.prior, HasWalks):
        return None
    return posterior.prior.walks(posterior.likelihood)


class _Ladder:
    """Tempering levels of one chain."""

    def __init__(
        self,
        sampler: TemperedPairs,
        posterior: MotionPosterior,
        walks: Walks,
        rng: np.random.Generator,
        chain: int,
    ) -> None:
        starts = posterior.prior.seed  # type: ignore[attr-defined]
        self.sampler, self.walks, self.rng = sampler, walks, rng
        levels = sampler.levels
        self.powers = np.concatenate([[0.0], np.geomspace(_MIN_POWER, 1.0, levels - 1)])
        self.log_sizes = np.full((levels, len(walks.moves)), math.log(_INITIAL_SIZE))
        self.tried, self.taken = np.zeros_like(self.log_sizes), np.zeros_like(self.log_sizes)
        pose = starts[chain % len(starts)]
        self.poses = np.repeat(pose[None], levels, axis=0)
        self.parts = np.repeat(walks.terms(pose)[None], levels, axis=0)
        self.views = rng.integers(walks.n_views, size=levels)
        # Log likelihood of the view of each level.
        self.seen = np.array([walks.log_view(pose, view) for view in self.views])
        truncated = isinstance(posterior, TruncatedPosterior) and posterior.truncated
        self.cut = _TruncatedState(self, posterior) if truncated else None
        self.rejected, self.asked = np.zeros(levels - 1), 0
        self.odd = False
        # Whether a state has been at power 0 since it was last at power 1.
        self.been_down = np.zeros(levels, dtype=bool)
        self.round_trips = self.evaluations = 0
        self.drawn: list[np.ndarray] = []

    @property
    def barrier(self) -> float:
        """Communication barrier Λ of Syed et al.: the sum of rejection rates over neighbours."""
        return float(self.rejected.sum() / max(self.asked, 1))

    def draw(self, draws: int, bar: Any, stop: Event, file: StoredChain) -> None:
        """Draw states of the target density, ``thin`` exchanges apart, into ``drawn``."""
        stored, thin = file.load(), self.sampler.thin
        if stored is None:
            self._warm_up(stop, bar)
        else:
            self.drawn = list(stored["draws"])
            self._resume(stored)
            bar.update(self.sampler.warmup + thin * len(self.drawn))
        while len(self.drawn) < draws:
            for _ in range(thin):
                self._exchange_after_walking(stop)
            state = self.poses[-1] if self.cut is None else self.cut.pose
            self.drawn.append(state.copy())
            bar.update(thin)
            file.save(self._state)

    def _state(self) -> dict[str, np.ndarray]:
        """Return the draws so far and the complete state of the chain."""
        state = {
            prefix + name: np.asarray(getattr(owner, name))
            for owner, prefix, name in self._states()
        }
        return state | {"draws": np.stack(self.drawn), "random": seeds.state_words(self.rng)}

    def _resume(self, stored: Mapping[str, np.ndarray]) -> None:
        for owner, prefix, name in self._states():
            value = stored[prefix + name]
            setattr(owner, name, value if value.ndim else value.item())
        self.rng = seeds.resumed_generator(stored["random"])

    def _states(self) -> list[tuple[object, str, str]]:
        """Return owner, prefix in the file and name of each attribute of the state."""
        cut = [] if self.cut is None else [(self.cut, "cut_", name) for name in _CUT_STATE]
        return [*((self, "", name) for name in _STATE), *cut]

    def _warm_up(self, stop: Event, bar: Any) -> None:
        """Tune step sizes after every exchange and powers after rounds of growing length."""
        end_of_round = length = _INITIAL_ROUND
        for number in range(1, self.sampler.warmup + 1):
            self._exchange_after_walking(stop)
            tried = self.tried > 0
            surplus = self.taken / np.where(tried, self.tried, 1) - _TARGET_ACCEPTANCE
            change = np.where(tried, 2 * surplus, 0.0) / math.sqrt(number)
            self.log_sizes = np.minimum(self.log_sizes + change, math.log(_MAX_SIZE))
            self.tried[:], self.taken[:] = 0, 0
            bar.update(1)
            if number == end_of_round:
                self._set_powers()
                # Extend the last round, as the final powers depend on it.
                last = end_of_round + 6 * length > self.sampler.warmup
                length = self.sampler.warmup - end_of_round if last else 2 * length
                end_of_round += length
        self.round_trips = 0
        if self.cut is not None:
            self.cut.check()

    def _set_powers(self) -> None:
        """Move the powers to equalise the rejection rates."""
        rejected = np.maximum(self.rejected / self.asked, 1e-3)
        so_far = np.concatenate([[0.0], np.cumsum(rejected)])
        powers = np.interp(np.linspace(0.0, so_far[-1], len(so_far)), so_far, self.powers)
        for sizes in self.log_sizes.T:
            sizes[:] = np.interp(powers, self.powers, sizes)
        self.powers = powers
        self.rejected[:], self.asked = 0, 0

    def _exchange_after_walking(self, stop: Event) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        sizes, steps = np.exp(self.log_sizes), np.full(len(self.powers), self.sampler.steps)
        steps[self.powers < _LOW_POWER] = min(self.sampler.steps, _LOW_STEPS)
        for level, power in enumerate(self.powers):
            self.views[level], self.seen[level] = self.walks.walk(
                self.poses[level],
                self.parts[level],
                self.views[level],
                power,
                steps[level],
                sizes[level],
                self.tried[level],
                self.taken[level],
                self.rng,
            )
        self.evaluations += int(steps.sum())
        if self.cut is not None:
            self.cut.exchange(self)
        log_ratio = np.diff(self.powers) * (self.seen[:-1] - self.seen[1:])
        probability = np.exp(np.minimum(log_ratio, 0.0))
        self.rejected += 1 - probability
        self.asked += 1
        for level in range(int(self.odd), len(probability), 2):
            if self.rng.random() < probability[level]:
                pair = [level, level + 1]
                for values in (self.poses, self.parts, self.seen, self.views, self.been_down):
                    values[pair] = values[pair[::-1]]
        self.odd = not self.odd
        self.been_down[0] = True
        self.round_trips += int(self.been_down[-1])
        self.been_down[-1] = False


class _TruncatedState:
    """State that targets the truncated density f* and is exchanged with the state at power 1.

    The ratio f*/f is 0 for f below the floor, cap/f for f above the cap, and 1 otherwise.
    """

    def __init__(self, ladder: _Ladder, posterior: MotionPosterior) -> None:
        assert isinstance(posterior, TruncatedPosterior)
        self.floor, self.cap = posterior.log_floor, posterior.log_cap
        self.pose, self.parts = ladder.poses[-1].copy(), ladder.parts[-1].copy()
        self.seen, self.view = ladder.seen[-1], ladder.views[-1]
        self.log_share = self._log_ratio(ladder)

    def exchange(self, ladder: _Ladder) -> None:
        """Exchange states with the top level, accepted with the Metropolis probability."""
        log_ratio = self._log_ratio(ladder)
        # The comparison with NaN rejects if both densities are 0.
        if not -ladder.rng.standard_exponential() < log_ratio - self.log_share:
            return
        for cut, top in ((self.pose, ladder.poses[-1]), (self.parts, ladder.parts[-1])):
            cut[:], top[:] = top.copy(), cut.copy()
        self.seen, ladder.seen[-1] = ladder.seen[-1], self.seen
        self.view, ladder.views[-1] = ladder.views[-1], self.view
        self.log_share = log_ratio

    def check(self) -> None:
        """Raise ``ValueError`` if no state within the truncation was found."""
        if self.log_share == -math.inf:
            raise ValueError(
                "posterior must have states above its truncation at "
                f"{self.floor:.4g} nats, got none in warm-up; increase its limit"
            )

    def _log_ratio(self, ladder: _Ladder) -> float:
        """Return log f*/f of the top level, with f relative to the base measure."""
        log_f = ladder.walks.log_density(ladder.poses[-1], ladder.parts[-1])
        return min(0.0, self.cap - log_f) if log_f >= self.floor else -math.inf
