"""Metropolis-Hastings with interchangeable proposals."""

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
    """Metropolis-Hastings (Metropolis et al. 1953, Hastings 1970), vectorised over chains.

    Parameters
    ----------
    proposal : Proposal
        Proposal distribution.
    warmup : int
        Number of adaptation steps before the first draw.
    thin : int
        Number of steps per draw.
    candidates : int
        Number of prior draws per chain; the starting point is resampled from them by likelihood.
    pseudo_marginal : bool
        Estimate the likelihood of every proposed point from random views and store the estimate
        with the state, so that chains target the integral over views (Andrieu and Roberts 2009).
        By default the views of the likelihood are fixed.
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
                f"proposal must be a proposal object such as Isotropic(), got {self.proposal!r}"
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
        """Return ``draws`` states from each of ``chains`` chains, ``thin`` steps apart.

        ``initial`` is an earlier run to continue without warm-up, or starting points, an array of
        shape (chains, dim).

        Raises
        ------
        UnsupportedPosterior
            If the posterior has no density, or the settings require views that it does not have.
        Interrupted
            On Ctrl-C, with the finished draws.
        """
        check_count("draws", draws)
        start = time.perf_counter()
        density = Density(self, posterior)
        self._require_views(posterior)
        earlier = continued(self, posterior.log_density, initial, chains, seed)
        warmup = self.warmup if earlier is None else 0
        finished: list[_Draw] = []
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
                    finished.append(walk.advance(self.thin))
                    bar.update(self.thin)
        except KeyboardInterrupt as stop:
            if not finished:
                raise
            result = self._result(posterior, finished, density, seed, start)
            raise Interrupted(result) from stop
        return self._result(posterior, finished, density, seed, start)

    def _require_views(self, posterior: MotionPosterior) -> None:
        if not (self.pseudo_marginal or self.proposal.guided):
            return
        if not isinstance(posterior.likelihood, ComparesViews):
            name = type(self.proposal).__name__
            setting = "pseudo_marginal=True" if self.pseudo_marginal else name
            raise UnsupportedPosterior(
                self.name,
                f"with {setting} requires a likelihood that implements ComparesViews, got "
                f"{type(posterior.likelihood).__name__}",
                word="views",
            )

    def _result(
        self,
        posterior: MotionPosterior,
        finished: list[_Draw],
        density: Density,
        seed: int,
        start: float,
    ) -> MotionDraws:
        *values, states = zip(*finished, strict=True)
        theta, log_density, acceptance = (np.stack(rows, axis=1) for rows in values)
        state = states[-1]
        first = int(state["draws"]) - len(finished)
        return MotionDraws.of(
            posterior,
            self,
            motions(posterior, theta, seed, first),
            seed=seed,
            seconds=time.perf_counter() - start,
            theta=theta,
            log_density=log_density,
            statistics={
                "acceptance_rate": acceptance,
                **posterior.draw_statistics(theta, log_density),
            },
            counts={"density": density.evaluations},
            state=state,
        )


_Draw = tuple[np.ndarray, np.ndarray, np.ndarray, dict[str, np.ndarray]]
"""θ, log density and mean acceptance of all chains, and the resumable state."""


@dataclass
class _Walk:
    """Current states of all chains; the chains are independent of each other."""

    sampler: MetropolisHastings
    density: Density
    generators: list[np.random.Generator]
    theta: np.ndarray
    adaptation: ProposalState
    draws: int = 0
    log_density: np.ndarray = field(init=False)
    guide: np.ndarray = field(init=False)

    @classmethod
    def begin(
        cls, sampler: MetropolisHastings, density: Density, theta: np.ndarray, seed: int
    ) -> _Walk:
        generators = [seeds.generator(seed, "chain", chain) for chain in range(len(theta))]
        walk = cls(sampler, density, generators, theta, sampler.proposal.begin(theta))
        walk.log_density, walk.guide = density.at_start(theta, *walk._evaluation())
        return walk

    @classmethod
    def resume(
        cls, sampler: MetropolisHastings, density: Density, state: Mapping[str, np.ndarray]
    ) -> _Walk:
        adaptation = {
            name.removeprefix(_PREFIX): values
            for name, values in state.items()
            if name.startswith(_PREFIX)
        }
        generators = [seeds.resumed_generator(words) for words in state["random"]]
        walk = cls(sampler, density, generators, state["theta"], adaptation, int(state["draws"]))
        walk.log_density = state["log_density"]
        walk.guide = state.get("guide", np.empty((len(walk.theta), 0)))
        return walk

    @property
    def proposal(self) -> Proposal:
        return self.sampler.proposal

    def state(self) -> dict[str, np.ndarray]:
        """Return the arrays required by :meth:`resume`."""
        adaptation = self.proposal.settled(self.adaptation)
        return {
            "theta": self.theta,
            "log_density": self.log_density,
            # netCDF cannot store arrays with zero columns.
            **({"guide": self.guide} if self.proposal.guided else {}),
            # A deterministic density identifies the posterior; an estimate does not.
            **({"fixed": self.density(self.theta)} if self.sampler.pseudo_marginal else {}),
            "random": np.stack([seeds.state_words(rng) for rng in self.generators]),
            "draws": np.array(self.draws, dtype=np.int32),
            **{_PREFIX + name: values for name, values in adaptation.items()},
        }

    def warm_up(self, steps: int, tick: Callable[[], Any]) -> None:
        """Advance all chains and adapt the proposal after each step."""
        for _ in range(steps):
            acceptance = self._step()
            self.adaptation = self.proposal.learn(self.adaptation, self.theta, acceptance)
            tick()

    def advance(self, steps: int) -> _Draw:
        """Advance all chains by ``steps`` and return the next draw."""
        acceptance = np.mean([self._step() for _ in range(steps)], axis=0)
        self.draws += 1
        return self.theta, self.log_density, acceptance, self.state()

    def _step(self) -> np.ndarray:
        """Advance all chains by one step and return the acceptance probabilities, (chains,)."""
        proposed = self.proposal.propose(self.generators, self.theta, self.guide, self.adaptation)
        log_density, guide = self.density.evaluate(proposed, *self._evaluation())
        log_ratio = self.proposal.log_ratio(
            self.theta, self.guide, proposed, guide, self.adaptation
        )
        log_acceptance = np.minimum(0.0, log_density - self.log_density + log_ratio)
        # −log U is standard exponential for U uniform on (0, 1].
        threshold = np.array([rng.standard_exponential() for rng in self.generators])
        accepted = -threshold < log_acceptance
        self.theta = np.where(accepted[:, None], proposed, self.theta)
        self.log_density = np.where(accepted, log_density, self.log_density)
        self.guide = np.where(accepted[:, None], guide, self.guide)
        return np.exp(log_acceptance)

    def _evaluation(self) -> tuple[list[np.random.Generator] | None, bool]:
        """Return the ``generators`` and ``guided`` arguments of :meth:`Density.evaluate`."""
        return (self.generators if self.sampler.pseudo_marginal else None), self.proposal.guided


_PREFIX = "proposal_"  # Prefix of the adaptive arrays of the proposal in the stored state.
