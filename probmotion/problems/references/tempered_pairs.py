"""`TemperedPairs`: what draws reference pose-pairs, by parallel tempering over single views.

The posterior over pose-pairs is a mean over views, and in each view the nearest annotation alone
counts: pairs that are like one annotation are far from those that are like another, and a random
walk stays where it began. Here the view is a part of the state,

    π(Θ, v) ∝ f(Θ) L(Θ_v; v),

whose sum over v is the posterior: a step asks one view of the likelihood in place of all. Levels
with L to a power between 0 and 1 stand below it, and neighbours exchange their states (Swendsen and
Wang 1986): at power 0 pairs move through the prior, and come back in other views and near other
annotations.
Exchanges take even and odd neighbours in turn, and powers are set so that all exchanges are
rejected alike (Syed et al. 2022).

Where the density is cut (eq. 11), f* ≤ f: one more state, of f*, exchanges with that of power 1.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Mapping
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from probmotion import seeds
from probmotion.arrays import logsumexp
from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import HasLogDensity
from probmotion.posteriors.sampling import progress_bar
from probmotion.posteriors.truncation import TruncatedPosterior
from probmotion.problems.references.chains import StoredChain
from probmotion.validation import check_count

if TYPE_CHECKING:
    from probmotion.problems.references.pair_densities import Physics, Sight
    from probmotion.problems.references.pair_moves import Body

__all__ = ["TemperedPairs"]

_ACCEPTED = 0.3
_FIRST_SIZE = 0.1
_LARGEST_SIZE = math.e
_FIRST_ROUND = 16
_SMALLEST_POWER = 1e-5
_STATE = (
    "poses", "parts", "seen", "views", "powers", "log_sizes", "tried", "taken", "rejected", "asked",
    "odd", "been_down", "round_trips", "evaluations",
)  # fmt: skip
_CUT_STATE = ("pose", "parts", "seen", "view", "log_share")


@dataclass(frozen=True)
class TemperedPairs:
    """Parallel tempering of pose-pairs and views; each chain has levels of its own.

    Parameters
    ----------
    levels : int
        Powers of the likelihood, from 0 to 1.
    steps : int
        Steps that a level takes between exchanges.
    warmup : int
        Exchanges before the first draw, in which powers and step sizes are set.
    thin : int
        Exchanges per draw.
    """

    name: ClassVar[str] = "tempered-pairs"
    requires: ClassVar[tuple[type, ...]] = (HasLogDensity,)

    levels: int = 24
    steps: int = 120
    warmup: int = 2000
    thin: int = 120

    def __post_init__(self) -> None:
        check_count("levels", self.levels, least=3)
        check_count("steps", self.steps)
        check_count("warmup", self.warmup, least=_FIRST_ROUND)
        check_count("thin", self.thin)

    def draws_from(self, posterior: MotionPosterior) -> bool:
        """Whether the prior is that of pose-pairs, with annotations of all of its joints."""
        # Compiled code is imported by those who use it.
        from probmotion.interaction.annotated_pairs import AnnotatedPairs
        from probmotion.models.pose_pairs.pose_pairs import PosePairPrior

        return (
            type(posterior) in (MotionPosterior, TruncatedPosterior)
            and type(posterior.prior) is PosePairPrior
            and type(posterior.likelihood) is AnnotatedPairs
            and _hidden(posterior) == 0
        )

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
        """Return ``draws`` states of each of ``chains`` chains; see the sampler's protocol.

        Where each chain is, is kept in ``unfinished`` and the chain's number, twice a minute: the
        same call goes on there after it was stopped. Whoever named it deletes these files.

        Chains run side by side on threads, one a processor, wherever this is called: each has
        random numbers of its own and shares nothing, so that bits do not depend on threads.
        The run counts steps as evaluations of the density, though most ask a part of it.

        Raises
        ------
        ValueError
            If the posterior is not :meth:`draws_from`'s, or ``initial`` is given.
        """
        if not self.draws_from(posterior):
            raise ValueError(
                f"posterior is a {type(posterior).__name__} of {type(posterior.prior).__name__} "
                f"and {type(posterior.likelihood).__name__} with {_hidden(posterior)} hidden "
                "joints, expected PosePairPrior and AnnotatedPairs with none"
            )
        if initial is not None:
            raise ValueError(
                f"initial is {type(initial).__name__}, expected None: chains start at the seeds"
            )
        check_count("draws", draws)
        check_count("chains", chains)
        start, stop = time.perf_counter(), Event()
        arrays = pair_arrays(posterior)
        with (
            progress_bar(chains * draws, self.name, progress) as bar,
            ThreadPoolExecutor(min(chains, os.cpu_count() or 1)) as threads,
        ):
            ladders = [
                _Ladder(self, posterior, arrays, seeds.generator(seed, "chain", chain), chain)
                for chain in range(chains)
            ]
            kept = [
                StoredChain(unfinished and unfinished.with_name(f"{unfinished.name}-{chain}.npz"))
                for chain in range(chains)
            ]
            try:
                waiting = [
                    threads.submit(ladder.draw, draws, bar, stop, own)
                    for ladder, own in zip(ladders, kept, strict=True)
                ]
                # One that fails stops all, not only those that were waited for before it.
                ended, _ = wait(waiting, return_when=FIRST_EXCEPTION)
                for each in ended:
                    each.result()
            finally:
                stop.set()
            found = [each.result() for each in waiting]
        return MotionDraws.of(
            posterior,
            self,
            np.stack(found)[:, :, None],
            seed=seed,
            seconds=time.perf_counter() - start,
            statistics={
                "round_trips": np.array([ladder.round_trips for ladder in ladders]),
                "rejected_exchanges": np.array([ladder.barrier for ladder in ladders]),
            },
            counts={"density": sum(ladder.evaluations for ladder in ladders)},
        )


class _Ladder:
    """The levels of one chain."""

    def __init__(
        self,
        sampler: TemperedPairs,
        posterior: MotionPosterior,
        arrays: tuple[Body, Physics, Sight],
        rng: np.random.Generator,
        chain: int,
    ) -> None:
        from probmotion.models.pose_pairs.pose_pairs import PosePairPrior
        from probmotion.problems.references.pair_densities import log_view, weigh
        from probmotion.problems.references.pair_moves import moves_of

        prior = posterior.prior
        assert isinstance(prior, PosePairPrior)
        self.sampler, self.arrays, self.rng = sampler, arrays, rng
        body, physics, sight = arrays
        levels = sampler.levels
        self.powers = np.concatenate([[0.0], np.geomspace(_SMALLEST_POWER, 1.0, levels - 1)])
        self.moves = moves_of(body)
        self.log_sizes = np.full((levels, len(self.moves)), math.log(_FIRST_SIZE))
        self.tried, self.taken = np.zeros_like(self.log_sizes), np.zeros_like(self.log_sizes)
        pose = prior.seed[chain % len(prior.seed)]
        self.poses = np.repeat(pose[None], levels, axis=0)
        self.parts = np.empty((levels, 2 + 2 * len(body.roots)))
        weigh(pose, body, physics, self.parts[0])
        self.parts[:] = self.parts[0]
        self.views = rng.integers(len(sight.vectors), size=levels)
        # log L_v of each level's view.
        self.seen = np.array([log_view(pose, view, body, sight) for view in self.views])
        self.cut = _Cut(self, posterior) if _is_cut(posterior) else None
        self.rejected, self.asked = np.zeros(levels - 1), 0
        self.odd = False
        # Whether a state has been at power 0 since it was last at power 1.
        self.been_down = np.zeros(levels, dtype=bool)
        self.round_trips = self.evaluations = 0

    @property
    def barrier(self) -> float:
        """Sum over neighbours of how often an exchange is rejected: Λ of Syed et al."""
        return float(self.rejected.sum() / max(self.asked, 1))

    def draw(self, draws: int, bar: Any, stop: Event, kept: StoredChain) -> np.ndarray:
        """Return the states at the top after a warm-up, ``thin`` exchanges apart: (draws, J, 3)."""
        found, done, held = np.empty((draws, *self.poses.shape[1:])), 0, kept.load()
        if held is None:
            self._warm_up(stop)
        else:
            done = len(held["draws"])
            found[:done] = held["draws"]
            self._go_on_from(held)
            bar.update(done)
        for draw in range(done, draws):
            for _ in range(self.sampler.thin):
                self._exchange_after_walking(stop)
            found[draw] = self.poses[-1] if self.cut is None else self.cut.pose
            bar.update(1)
            kept.save(partial(self._held, found[: draw + 1]))
        return found

    def _held(self, draws: np.ndarray) -> dict[str, np.ndarray]:
        """Return draws so far, all that exchanges change, and what the warm-up has set."""
        held = {name: np.asarray(getattr(self, name)) for name in _STATE}
        if self.cut is not None:
            held |= {f"cut_{name}": np.asarray(getattr(self.cut, name)) for name in _CUT_STATE}
        return held | {"draws": draws, "random": seeds.state_words(self.rng)}

    def _go_on_from(self, held: Mapping[str, np.ndarray]) -> None:
        for owner, names, prefix in ((self, _STATE, ""), (self.cut, _CUT_STATE, "cut_")):
            for name in names if owner is not None else ():
                value = held[f"{prefix}{name}"]
                setattr(owner, name, value if value.ndim else value.item())
        self.rng = seeds.resumed_generator(held["random"])

    def _warm_up(self, stop: Event) -> None:
        """Set step sizes after every exchange, and powers after rounds of growing length."""
        end_of_round, length = _FIRST_ROUND, _FIRST_ROUND
        for number in range(1, self.sampler.warmup + 1):
            self._exchange_after_walking(stop)
            tried = self.tried > 0
            surplus = self.taken / np.where(tried, self.tried, 1) - _ACCEPTED
            change = np.where(tried, 2 * surplus, 0.0) / math.sqrt(number)
            self.log_sizes = np.minimum(self.log_sizes + change, math.log(_LARGEST_SIZE))
            self.tried[:], self.taken[:] = 0, 0
            if number == end_of_round:
                self._set_powers()
                # The last round is not cut short: what it says is what powers are set by.
                length = (
                    2 * length
                    if end_of_round + 6 * length <= self.sampler.warmup
                    else (self.sampler.warmup - end_of_round)
                )
                end_of_round += length
        self.round_trips = 0
        if self.cut is not None:
            self.cut.check()

    def _set_powers(self) -> None:
        """Move the powers to where the rejected exchanges so far say that all reject alike."""
        rejected = np.maximum(self.rejected / self.asked, 1e-3)
        so_far = np.concatenate([[0.0], np.cumsum(rejected)])
        powers = np.interp(np.linspace(0.0, so_far[-1], len(so_far)), so_far, self.powers)
        for sizes in self.log_sizes.T:
            sizes[:] = np.interp(powers, self.powers, sizes)
        self.powers = powers
        self.rejected[:], self.asked = 0, 0

    def _exchange_after_walking(self, stop: Event) -> None:
        from probmotion.problems.references.pair_walk_kernels import walk

        if stop.is_set():
            raise KeyboardInterrupt
        sizes = np.exp(self.log_sizes)
        for level, power in enumerate(self.powers):
            self.views[level], self.seen[level] = walk(
                self.poses[level],
                self.parts[level],
                self.views[level],
                power,
                self.sampler.steps,
                self.moves,
                sizes[level],
                self.tried[level],
                self.taken[level],
                *self.arrays,
                self.rng,
            )
        self.evaluations += self.sampler.steps * len(self.poses)
        if self.cut is not None:
            self.cut.exchange(self)
        log_ratio = np.diff(self.powers) * (self.seen[:-1] - self.seen[1:])
        probability = np.exp(np.minimum(log_ratio, 0.0))
        self.rejected += 1 - probability
        self.asked += 1
        for level in range(int(self.odd), len(probability), 2):
            if self.rng.random() < probability[level]:
                pair = [level, level + 1]
                for held in (self.poses, self.parts, self.seen, self.views, self.been_down):
                    held[pair] = held[pair[::-1]]
        self.odd = not self.odd
        self.been_down[0] = True
        self.round_trips += int(self.been_down[-1])
        self.been_down[-1] = False


class _Cut:
    """One more state, of the density that is cut; it exchanges with that of power 1.

    f*/f is 0 below the floor, cap/f above the cap, else 1.
    """

    def __init__(self, ladder: _Ladder, posterior: MotionPosterior) -> None:
        assert isinstance(posterior, TruncatedPosterior)
        self.floor, self.cap = posterior.log_floor, posterior.log_cap
        self.pose, self.parts = ladder.poses[-1].copy(), ladder.parts[-1].copy()
        self.seen, self.view = ladder.seen[-1], ladder.views[-1]
        self.log_share = self._log_share(ladder)

    def exchange(self, ladder: _Ladder) -> None:
        """Exchange states with the top level, or not."""
        theirs = self._log_share(ladder)
        # Of two states without share neither is taken for the other: no number is below none.
        if not -ladder.rng.standard_exponential() < theirs - self.log_share:
            return
        for own, top in ((self.pose, ladder.poses[-1]), (self.parts, ladder.parts[-1])):
            own[:], top[:] = top.copy(), own.copy()
        self.seen, ladder.seen[-1] = ladder.seen[-1], self.seen
        self.view, ladder.views[-1] = ladder.views[-1], self.view
        self.log_share = theirs

    def check(self) -> None:
        """Raise ``ValueError`` if no state was met that the cut leaves."""
        if self.log_share == -math.inf:
            raise ValueError(
                f"posterior is cut at {self.floor:.4g} nats and nothing above that was met in the "
                "warm-up, expected a greater limit"
            )

    def _log_share(self, ladder: _Ladder) -> float:
        """Return log f*/f of the top level's state, f relative to the measure, its first part."""
        from probmotion.problems.references.pair_densities import log_prior, log_views

        body, physics, sight = ladder.arrays
        parts, logs = ladder.parts[-1], log_views(ladder.poses[-1], body, sight)
        log_f = log_prior(parts, physics) - parts[0] + logsumexp(logs) - math.log(len(logs))
        return min(0.0, self.cap - log_f) if log_f >= self.floor else -math.inf


def pair_arrays(posterior: MotionPosterior) -> tuple[Body, Physics, Sight]:
    """Return what compiled code reads of a posterior over pose-pairs."""
    from probmotion.interaction.annotated_pairs import AnnotatedPairs
    from probmotion.interaction.annotations.local_frames import chests, trees
    from probmotion.interaction.annotations.views import view_vectors
    from probmotion.models.pose_pairs.penetration import capsules_of
    from probmotion.models.pose_pairs.pose_pairs import PosePairPrior
    from probmotion.problems.references.pair_densities import Physics, Sight
    from probmotion.problems.references.pair_moves import Body

    prior, evidence = posterior.prior, posterior.likelihood
    assert isinstance(prior, PosePairPrior)
    assert isinstance(evidence, AnnotatedPairs)
    skeleton, limits, comparer = prior.skeleton, prior.joint_limits, evidence.comparer
    parents = np.array(skeleton.parents, dtype=np.int64)
    below = np.eye(skeleton.n_joints, dtype=bool)
    for joint in range(skeleton.n_joints):
        below[list(skeleton.ancestors(joint)), joint] = True
    roots = np.array(skeleton.roots)
    return (
        Body(
            parents=parents,
            below=below,
            roots=roots,
            chests=np.array(chests(skeleton)),
            person=np.searchsorted(roots, trees(skeleton)),
            seed=prior.seed[0],
            bone_noise=prior.bone_noise,
            root_noise=prior.root_noise,
        ),
        Physics(
            limits.trees,
            limits.arrays,
            *capsules_of(skeleton),
            prior.penetration_weight,
            prior.position_noise,
            prior.max_invalid,
        ),
        Sight(
            view_vectors(evidence.views),
            evidence.near,
            comparer.prepared,
            *comparer.options,
            evidence.noise,
        ),
    )


def _hidden(posterior: MotionPosterior) -> int:
    """Return how many annotated joints are hidden; 0 where there are none."""
    annotations = getattr(posterior.likelihood, "annotations", None)
    return 0 if annotations is None else int((~annotations.visible).sum())


def _is_cut(posterior: MotionPosterior) -> bool:
    return isinstance(posterior, TruncatedPosterior) and posterior.reshaped
