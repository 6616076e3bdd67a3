"""`MetropolisHastings`: random walks with any proposal, all chains side by side."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from probmotion import seeds
from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import ComparesViews, HasLogDensity
from probmotion.posteriors.sampling import Interrupted, UnsupportedPosterior, progress_bar
from probmotion.samplers.densities import Density, continued, motions, starting_points
from probmotion.samplers.mcmc.proposals import AdaptiveCovariance, Proposal, ProposalState
from probmotion.validation import check_count

__all__ = ["MetropolisHastings"]


@dataclass(frozen=True)
class MetropolisHastings:
    """Metropolis et al. (1953), Hastings (1970); one density evaluation per chain and step.

    A budget sets ``thin`` and ``warmup`` (:mod:`probmotion.comparison.results.budgets`).

    Parameters
    ----------
    proposal : Proposal
        Where a chain might go next.
    warmup : int
        Steps before the first draw, in which the proposal learns.
    thin : int
        Steps from one draw to the next.
    candidates : int
        Draws from the prior per chain; it starts at one, chosen in proportion to its likelihood.
    pseudo_marginal : bool
        Draw views anew for every proposal and keep the estimate with the state: chains are then
        exact for the integral over views (Andrieu and Roberts 2009). By default annotated pairs
        are seen from the views that the likelihood fixed.
    """

    name: ClassVar[str] = "mh"
    requires: ClassVar[tuple[type, ...]] = (HasLogDensity,)
    effort: ClassVar[tuple[str, ...]] = ("thin", "warmup")

    proposal: Proposal = field(default_factory=AdaptiveCovariance)
    warmup: int = 5000
    thin: int = 20
    candidates: int = 1000
    pseudo_marginal: bool = False

    def __post_init__(self) -> None:
        if isinstance(self.proposal, type) or not hasattr(self.proposal, "propose"):
            raise ValueError(
                f"proposal is {self.proposal!r}, expected an object with settings such as "
                "Isotropic()"
            )
        check_count("candidates", self.candidates)
        check_count("warmup", self.warmup, least=0)
        check_count("thin", self.thin)

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
        """Return ``draws`` states of each of ``chains`` chains, ``thin`` steps apart.

        Parameters
        ----------
        posterior, draws, chains, seed, progress
            As in :class:`~probmotion.posteriors.sampling.Sampler`.
        initial : MotionDraws or ndarray, (chains, dim), optional
            An earlier run, to go on from as if it had not stopped (without a warm-up); or points
            to start from, such as any kept draw's θ. One of ``candidates`` draws
            from the prior by default.

        Raises
        ------
        UnsupportedPosterior
            If the posterior has no density, or has no views where the settings ask for them.
        Interrupted
            On Ctrl-C; it carries the draws that were finished.
        """
        check_count("draws", draws)
        start = time.perf_counter()
        density = Density(self, posterior)
        self._require_views(posterior)
        earlier = continued(self, posterior.log_density, initial, chains, seed)
        warmup = self.warmup if earlier is None else 0
        kept = _Kept(chains, draws, posterior.dim)
        try:
            with progress_bar(warmup + draws * self.thin, self.name, progress) as bar:
                if earlier is None:
                    shape = (chains, posterior.dim)
                    points = starting_points(
                        posterior, density.likelihood, initial, shape, seed, self.candidates
                    )
                    walk = _Walk.begin(self, density, points, seed)
                    walk.warm_up(warmup, bar.update)
                else:
                    walk = _Walk.resume(self, density, earlier)
                for _ in range(draws):
                    kept.add(walk, walk.advance(self.thin))
                    bar.update(self.thin)
        except KeyboardInterrupt as stop:
            if not kept.last[0]:
                raise
            result = self._result(posterior, kept, density, seed, start)
            raise Interrupted(result) from stop
        return self._result(posterior, kept, density, seed, start)

    def _require_views(self, posterior: MotionPosterior) -> None:
        wanting = "pseudo_marginal=True" if self.pseudo_marginal else type(self.proposal).__name__
        if not (self.pseudo_marginal or self.proposal.guided):
            return
        if not isinstance(posterior.likelihood, ComparesViews):
            raise UnsupportedPosterior(
                self.name,
                f"with {wanting} needs evidence that compares views with annotations, and "
                + (
                    "there is no evidence"
                    if posterior.likelihood is None
                    else f"{type(posterior.likelihood).__name__} does not"
                ),
                word="views",
            )

    def _result(
        self, posterior: MotionPosterior, kept: _Kept, density: Density, seed: int, start: float
    ) -> MotionDraws:
        n, state = kept.last
        theta = kept.theta[:, :n]
        positions = motions(posterior, theta, seed, first=int(state["draws"]) - n)
        return MotionDraws.of(
            posterior,
            self,
            positions,
            seed=seed,
            seconds=time.perf_counter() - start,
            theta=theta,
            log_density=kept.log_density[:, :n],
            statistics={
                "acceptance": kept.acceptance[:, :n],
                **posterior.draw_statistics(theta, kept.log_density[:, :n]),
            },
            counts={"density": density.evaluations},
            state=state,
        )


class _Walk:
    """Chains that walk side by side; nothing that one does depends on another."""

    log_density: np.ndarray
    guide: np.ndarray

    def __init__(
        self,
        sampler: MetropolisHastings,
        density: Density,
        generators: list[np.random.Generator],
        theta: np.ndarray,
        memory: ProposalState,
        draws: int,
    ) -> None:
        self.proposal = sampler.proposal
        self.fresh_views = sampler.pseudo_marginal
        self.density = density
        self.generators = generators
        self.theta = theta
        self.memory = memory
        self.draws = draws

    @classmethod
    def begin(
        cls, sampler: MetropolisHastings, density: Density, theta: np.ndarray, seed: int
    ) -> _Walk:
        generators = [seeds.generator(seed, "chain", chain) for chain in range(len(theta))]
        walk = cls(sampler, density, generators, theta, sampler.proposal.begin(theta), draws=0)
        walk.log_density, walk.guide = density.at_start(theta, *walk._how())
        return walk

    @classmethod
    def resume(
        cls, sampler: MetropolisHastings, density: Density, state: Mapping[str, np.ndarray]
    ) -> _Walk:
        memory = {
            name.removeprefix(_MEMORY): values
            for name, values in state.items()
            if name.startswith(_MEMORY)
        }
        generators = [seeds.resumed_generator(words) for words in state["random"]]
        walk = cls(sampler, density, generators, state["theta"], memory, int(state["draws"]))
        walk.log_density = state["log_density"]
        walk.guide = state.get("guide", np.empty((len(walk.theta), 0)))
        return walk

    def state(self) -> dict[str, np.ndarray]:
        """Return all that :meth:`resume` needs."""
        memory = self.proposal.settled(self.memory)
        return {
            "theta": self.theta,
            "log_density": self.log_density,
            # netCDF holds no array without width.
            **({"guide": self.guide} if self.proposal.guided else {}),
            # An estimate does not tell which posterior it is of.
            **({"fixed": self.density(self.theta)} if self.fresh_views else {}),
            "random": np.stack([seeds.state_words(rng) for rng in self.generators]),
            "draws": np.array(self.draws, dtype=np.int32),
            **{_MEMORY + name: values for name, values in memory.items()},
        }

    def warm_up(self, steps: int, tick: Callable[[], Any]) -> None:
        """Take steps from which the proposal learns."""
        for _ in range(steps):
            acceptance = self._step()
            self.memory = self.proposal.learn(self.memory, self.theta, acceptance)
            tick()

    def advance(self, steps: int) -> np.ndarray:
        """Take the steps to the next draw; return their mean acceptance, (chains,)."""
        acceptance = np.mean([self._step() for _ in range(steps)], axis=0)
        self.draws += 1
        return acceptance

    def _step(self) -> np.ndarray:
        """Take one step; return its probability of acceptance, (chains,)."""
        proposed = self.proposal.propose(self.generators, self.theta, self.guide, self.memory)
        log_density, guide = self.density.evaluate(proposed, *self._how())
        log_ratio = self.proposal.log_ratio(self.theta, self.guide, proposed, guide, self.memory)
        log_acceptance = np.minimum(0.0, log_density - self.log_density + log_ratio)
        # −log of a number uniform on (0, 1].
        level = np.array([rng.standard_exponential() for rng in self.generators])
        accepted = -level < log_acceptance
        self.theta = np.where(accepted[:, None], proposed, self.theta)
        self.log_density = np.where(accepted, log_density, self.log_density)
        self.guide = np.where(accepted[:, None], guide, self.guide)
        return np.exp(log_acceptance)

    def _how(self) -> tuple[list[np.random.Generator] | None, bool]:
        """How the density is to be evaluated: with which generators, and whether for a guide."""
        return (self.generators if self.fresh_views else None), self.proposal.guided


_MEMORY = "proposal_"


class _Kept:
    """The draws so far and the state after the last; an interrupt between two leaves it whole."""

    def __init__(self, chains: int, draws: int, dim: int) -> None:
        self.theta = np.empty((chains, draws, dim))
        self.log_density = np.empty((chains, draws))
        self.acceptance = np.empty((chains, draws))
        self.last: tuple[int, dict[str, np.ndarray]] = (0, {})

    def add(self, walk: _Walk, acceptance: np.ndarray) -> None:
        """Keep where the chains are."""
        draw, _ = self.last
        self.theta[:, draw] = walk.theta
        self.log_density[:, draw] = walk.log_density
        self.acceptance[:, draw] = acceptance
        self.last = (draw + 1, walk.state())
