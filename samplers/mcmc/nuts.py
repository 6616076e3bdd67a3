"""`NUTS`: the No-U-Turn sampler of NumPyro on a posterior's log density."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from probmotion import seeds
from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import HasLogDensity
from probmotion.posteriors.sampling import (
    Interrupted,
    UnsupportedPosterior,
    progress_bar,
    require,
    suited,
)
from probmotion.samplers.densities import continued, motions, starting_points
from probmotion.samplers.mcmc.nuts_kernel import CHUNK, NutsKernel, compiled
from probmotion.validation import check_count

__all__ = ["NUTS"]


@dataclass(frozen=True)
class NUTS:
    """The No-U-Turn sampler (Hoffman and Gelman 2014), NumPyro's (Phan et al. 2019).

    A budget sets ``thin`` and ``warmup`` (:mod:`probmotion.comparison.results.budgets`).

    Parameters
    ----------
    warmup : int
        Iterations before the first draw, which adapt the step size and the diagonal mass matrix.
    target_acceptance : float
        Mean acceptance that the step size is adapted towards.
    max_tree_depth : int
        A trajectory has at most 2^max_tree_depth − 1 steps.
    thin : int
        Iterations per draw. Of those that a draw stands for, ``acceptance`` is the mean,
        ``divergent`` whether any was, ``steps`` the sum.
    candidates : int
        Draws from the prior per chain; it starts at one, chosen in proportion to its likelihood.

    Notes
    -----
    Chains run one after the other with the same compiled code, so that chain k is the same to the
    last bit however many there are. Everything runs in float64, whatever JAX is set to elsewhere.
    ``seconds`` of the draws leave out compiling: some seconds, once per posterior in a process.
    Another ``warmup`` is compiled again.
    """

    name: ClassVar[str] = "nuts"
    requires: ClassVar[tuple[type, ...]] = (HasLogDensity,)
    needs_gradient: ClassVar[bool] = True
    effort: ClassVar[tuple[str, ...]] = ("thin", "warmup")

    warmup: int = 500
    target_acceptance: float = 0.8
    max_tree_depth: int = 10
    thin: int = 1
    candidates: int = 1000

    def __post_init__(self) -> None:
        check_count("candidates", self.candidates)
        check_count("warmup", self.warmup)
        check_count("max_tree_depth", self.max_tree_depth)
        check_count("thin", self.thin)
        if not 0 < self.target_acceptance < 1:
            raise ValueError(
                f"target_acceptance is {self.target_acceptance!r}, expected a number between 0 "
                "and 1"
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
    ) -> MotionDraws:
        """Return ``draws`` states of each of ``chains`` chains.

        Parameters
        ----------
        posterior, draws, chains, seed, progress
            As in :class:`~probmotion.posteriors.sampling.Sampler`.
        initial : MotionDraws or ndarray, (chains, dim), optional
            An earlier run, to go on from as if it had not stopped (without a warm-up); or points
            to start from. One of ``candidates`` draws from the prior by default.

        Raises
        ------
        UnsupportedPosterior
            If the posterior has no density, or one without a gradient.
        Interrupted
            On Ctrl-C; it carries the draws that were finished.
        """
        import jax

        check_count("draws", draws)
        require(self, posterior)
        self._require_gradient(posterior)
        with jax.enable_x64(True):
            # What the compiled code does not depend on is the same for all.
            kernel = compiled(replace(self, thin=1, candidates=1), posterior)
            start = time.perf_counter()
            earlier = continued(self, kernel.log_densities, initial, chains, seed)
            densities = 0
            if earlier is None:
                shape = (chains, posterior.dim)
                points = starting_points(
                    posterior, kernel.log_likelihoods, initial, shape, seed, self.candidates
                )
                chosen = initial is None and posterior.likelihood is not None
                densities = chains * self.candidates if chosen and self.candidates > 1 else 0
            else:
                points = earlier["theta"]
            run = _Run(self, kernel, points, earlier, seed, densities)
            try:
                run.sample(draws, progress)
            except KeyboardInterrupt as stop:
                if not run.finished:
                    raise
                raise Interrupted(self._result(posterior, run, seed, start)) from stop
            return self._result(posterior, run, seed, start)

    def _require_gradient(self, posterior: MotionPosterior) -> None:
        for part in (posterior.prior, posterior.likelihood):
            if not getattr(part, "differentiable", True):
                raise UnsupportedPosterior(
                    self.name,
                    f"needs a density with a gradient, which {type(part).__name__} has not",
                    word="gradient",
                    others=suited(posterior),
                )

    def _result(
        self, posterior: MotionPosterior, run: _Run, seed: int, start: float
    ) -> MotionDraws:
        n = run.finished
        kept = {name: values[:, :n] for name, values in run.kept.items()}
        theta = kept.pop("theta")
        log_density = kept.pop("log_density")
        return MotionDraws.of(
            posterior,
            self,
            motions(posterior, theta, seed, first=run.first),
            seed=seed,
            seconds=time.perf_counter() - start,
            theta=theta,
            log_density=log_density,
            statistics=kept,
            counts={"gradient": run.gradients, "density": run.densities},
            state=run.state(),
        )


class _Run:
    """The chains of one call: where each is, and the draws that all of them have finished."""

    def __init__(
        self,
        sampler: NUTS,
        kernel: NutsKernel,
        points: np.ndarray,
        earlier: Mapping[str, np.ndarray] | None,
        seed: int,
        densities: int,
    ) -> None:
        self.sampler = sampler
        self.kernel = kernel
        self.densities = densities
        self.earlier = earlier
        self.first = 0 if earlier is None else int(earlier["draws"])
        self.finished = 0
        self.gradients = 0
        self.kept: dict[str, np.ndarray] = {}
        self.points = points
        self.seed = seed
        self.chains: list[Any] = []

    def sample(self, draws: int, progress: bool) -> None:
        """Warm up all chains, unless they go on, then draw with each in turn, chunk by chunk."""
        chains, thin = len(self.points), self.sampler.thin
        warmup = self.sampler.warmup if self.earlier is None else 0
        with progress_bar(chains * (warmup + draws * thin), self.sampler.name, progress) as bar:
            states = [self._begin(chain) for chain in range(chains)]
            for chain in range(chains):
                for some in _chunks(warmup, 1):
                    states[chain], _ = self._advance(states[chain], some, 1)
                    bar.update(some)
            for some in _chunks(draws, thin):
                rows = []
                for chain in range(chains):
                    states[chain], kept = self._advance(states[chain], some, thin)
                    rows.append(kept)
                    bar.update(some * thin)
                self._keep(rows, list(states))

    def state(self) -> dict[str, np.ndarray]:
        """Return all that going on needs, after the last draw that all chains have finished."""
        leaves = [self.kernel.leaves(state) for state in self.chains]
        stacked = {f"leaf_{i}": np.stack(rows) for i, rows in enumerate(zip(*leaves, strict=True))}
        theta = np.stack([np.asarray(state.z) for state in self.chains])
        draws = np.array(self.first + self.finished, dtype=np.int32)
        return {"theta": theta, "draws": draws, **stacked}

    def _begin(self, chain: int) -> Any:
        if self.earlier is not None:
            n = sum(name.startswith("leaf_") for name in self.earlier)
            leaves = [self.earlier[f"leaf_{i}"][chain] for i in range(n)]
            return self.kernel.restore(leaves, self.points[chain])
        self.gradients += 1
        return self.kernel.begin(seeds.jax_key(self.seed, "chain", chain), self.points[chain])

    def _advance(self, state: Any, draws: int, thin: int) -> tuple[Any, dict[str, np.ndarray]]:
        state, rows = self.kernel.advance(state, draws, thin)
        kept = {name: np.asarray(values)[:draws] for name, values in rows.items()}
        self.gradients += int(kept["steps"].sum())
        return state, kept

    def _keep(self, rows: list[dict[str, np.ndarray]], states: list[Any]) -> None:
        """Take in one chunk of every chain."""
        grown = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
        if self.kept:
            grown = {name: np.concatenate([self.kept[name], grown[name]], 1) for name in grown}
        self.kept, self.chains, self.finished = grown, states, grown["log_density"].shape[1]


def _chunks(draws: int, thin: int) -> list[int]:
    most = max(1, CHUNK // thin)
    return [min(most, draws - start) for start in range(0, draws, most)]
