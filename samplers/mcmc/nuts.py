"""No-U-Turn sampling with NumPyro."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
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
    """No-U-Turn sampler (Hoffman and Gelman 2014) of NumPyro (Phan et al. 2019).

    Parameters
    ----------
    warmup : int
        Number of iterations before the first draw, which adapt step size and diagonal mass matrix.
    target_acceptance : float
        Target mean acceptance probability of step-size adaptation.
    max_tree_depth : int
        Maximum number of trajectory doublings (at most 2^max_tree_depth − 1 steps).
    thin : int
        Number of iterations per draw. Statistics of a draw are their mean ``acceptance_rate``,
        whether any was ``diverging``, their total number of leapfrog steps, ``n_steps``, and the
        ``energy`` of the last.
    candidates : int
        Number of prior draws per chain; the starting point is resampled from them by likelihood.

    Notes
    -----
    Chains run sequentially in float64, so that a chain is bit-identical for any number of chains.
    Compilation takes several seconds for each posterior and ``warmup``; ``seconds`` of the draws
    excludes it.
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
        for name in ("candidates", "warmup", "max_tree_depth", "thin"):
            check_count(name, getattr(self, name))
        if not 0 < self.target_acceptance < 1:
            raise ValueError(
                f"target_acceptance must be between 0 and 1, got {self.target_acceptance!r}"
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
        """Return ``draws`` states from each of ``chains`` chains.

        ``initial`` is an earlier run to continue without warm-up, or starting points, an array of
        shape (chains, dim).

        Raises
        ------
        UnsupportedPosterior
            If the posterior has no differentiable density.
        Interrupted
            On Ctrl-C, with the finished draws.
        """
        from probmotion.extras import jax

        check_count("draws", draws)
        require(self, posterior)
        for part in (posterior.prior, posterior.likelihood):
            if not getattr(part, "differentiable", True):
                raise UnsupportedPosterior(
                    self.name,
                    f"needs a differentiable density, which {type(part).__name__} does not have",
                    word="gradient",
                    others=suited(posterior),
                )
        with jax.enable_x64(True):
            kernel = compiled(posterior, self.warmup, self.target_acceptance, self.max_tree_depth)
            start = time.perf_counter()
            earlier = continued(self, kernel.log_densities, initial, chains, seed)
            densities = 0
            if earlier is None:
                shape = (chains, posterior.dim)
                points = starting_points(
                    posterior, kernel.log_likelihoods, initial, shape, seed, self.candidates
                )
                resampled = initial is None and posterior.likelihood is not None
                densities = chains * self.candidates if resampled and self.candidates > 1 else 0
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

    def _result(
        self, posterior: MotionPosterior, run: _Run, seed: int, start: float
    ) -> MotionDraws:
        statistics = dict(run.recorded)
        theta = statistics.pop("theta")
        log_density = statistics.pop("log_density")
        return MotionDraws.of(
            posterior,
            self,
            motions(posterior, theta, seed, first=run.first),
            seed=seed,
            seconds=time.perf_counter() - start,
            theta=theta,
            log_density=log_density,
            statistics=statistics,
            counts={"gradient": run.gradients, "density": run.densities},
            state=run.state(),
        )


@dataclass
class _Run:
    """Chains of one call to :meth:`NUTS.sample`, and the draws finished in all chains."""

    sampler: NUTS
    kernel: NutsKernel
    points: np.ndarray
    earlier: Mapping[str, np.ndarray] | None
    seed: int
    densities: int
    finished: int = 0
    gradients: int = 0
    recorded: dict[str, np.ndarray] = field(default_factory=dict)
    chains: list[Any] = field(default_factory=list)

    @property
    def first(self) -> int:
        """Index of the first draw in its chain."""
        return 0 if self.earlier is None else int(self.earlier["draws"])

    def sample(self, draws: int, progress: bool) -> None:
        """Warm up new chains, then draw chunks from all chains in turn."""
        chains, thin = len(self.points), self.sampler.thin
        warmup = self.sampler.warmup if self.earlier is None else 0
        with progress_bar(chains * (warmup + draws * thin), self.sampler.name, progress) as bar:
            states = [self._begin(chain) for chain in range(chains)]
            for chain in range(chains):
                for n in _chunks(warmup, 1):
                    states[chain], _ = self._advance(states[chain], n, 1)
                    bar.update(n)
            for n in _chunks(draws, thin):
                rows = []
                for chain in range(chains):
                    states[chain], row = self._advance(states[chain], n, thin)
                    rows.append(row)
                    bar.update(n * thin)
                chunk = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
                if self.recorded:
                    chunk = {k: np.concatenate([self.recorded[k], chunk[k]], 1) for k in chunk}
                self.recorded, self.chains = chunk, list(states)
                self.finished += n

    def state(self) -> dict[str, np.ndarray]:
        """Return the resumable state after the last finished draw."""
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
        finished = {name: np.asarray(values)[:draws] for name, values in rows.items()}
        self.gradients += int(finished["n_steps"].sum())
        return state, finished


def _chunks(draws: int, thin: int) -> list[int]:
    size = max(1, CHUNK // thin)
    return [min(size, draws - start) for start in range(0, draws, size)]
