"""Base class of samplers with independent draws."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from threadpoolctl import threadpool_limits

from probmotion.arrays import to_numpy
from probmotion.posteriors.draws import MotionDraws, check_same_run
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.sampling import Interrupted, batches, progress_bar, require
from probmotion.seeds import NormalStreams
from probmotion.threads import one_thread
from probmotion.validation import check_count

__all__ = ["Batches", "IndependentSampler"]


@dataclass
class Batches:
    """Function that draws a batch of motions, with its batch ``size`` and counts.

    ``draw(streams, tick)`` returns motions, (B, L, J, 3), in units of ``scale`` metres. It calls
    ``tick`` ``steps`` times and updates the evaluation ``counts``. It may append θ, (B, dim), to
    ``thetas``; the result then contains θ and log densities.
    """

    draw: Callable[[NormalStreams, Callable[[], Any]], np.ndarray]
    size: int
    steps: int = 1
    scale: float = 1.0
    counts: dict[str, int] = field(default_factory=dict)
    thetas: list[np.ndarray] = field(default_factory=list)


class IndependentSampler:
    """Base class of samplers with independent draws; subclasses are frozen dataclasses.

    Every draw has a separate random stream and does not depend on the number of draws or chains.
    """

    name: ClassVar[str]
    requires: ClassVar[tuple[Any, ...]]

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
        """Return ``chains`` × ``draws`` independent draws.

        ``initial`` is an earlier run to continue: draws have the numbers that follow its own.

        Raises
        ------
        UnsupportedPosterior
            If the sampler does not support the prior or the observations.
        ValueError
            If an argument is out of range, or training or optimisation diverges.
        Interrupted
            On Ctrl-C, with the finished draws.
        """
        require(self, posterior)
        check_count("draws", draws)
        check_count("chains", chains)
        first = 0
        if isinstance(initial, MotionDraws):
            check_same_run(self, initial, chains, seed)
            first = int(initial.state["draws"])
        elif initial is not None:
            raise ValueError(
                f"initial must be None or an earlier run, got {type(initial).__name__}: "
                f"{self.name} has no starting points"
            )
        source = self._batches(posterior, seed, progress)
        start = time.perf_counter()
        # Order by draw, so that an interrupted run has the same number of draws in every chain.
        numbers = range(first, first + draws)
        pairs = [(chain, draw) for draw in numbers for chain in range(chains)]
        done: list[np.ndarray] = []
        spent = dict(source.counts)

        def result() -> MotionDraws:
            motions = np.concatenate(done)
            motions = motions[: len(motions) // chains * chains]
            result = MotionDraws.of(
                posterior,
                self,
                motions.reshape(-1, chains, *motions.shape[1:]).swapaxes(0, 1),
                seed=seed,
                seconds=time.perf_counter() - start,
                counts=spent,
                state={"draws": np.array(first + len(motions) // chains)},
                independent=True,
            )
            thetas = source.thetas
            return _with_coordinates(result, posterior, thetas) if thetas else result

        bars = progress_bar(source.steps * -(-len(pairs) // source.size), self.name, progress)
        # Rounding of multithreaded matrix products depends on the batch size, and a hundred
        # denoising steps amplify the differences.
        try:
            with threadpool_limits(1, user_api="blas"), bars as bar:
                for batch in batches(pairs, source.size):
                    streams = NormalStreams.of_draws(seed, list(batch))
                    done.append(source.draw(streams, lambda: bar.update(1)) * source.scale)
                    spent = dict(source.counts)
        except KeyboardInterrupt as interrupt:
            if sum(map(len, done)) < chains:
                raise
            raise Interrupted(result()) from interrupt
        return result()

    def _batches(self, posterior: MotionPosterior, seed: int, progress: bool) -> Batches:
        raise NotImplementedError


def _with_coordinates(
    result: MotionDraws, posterior: MotionPosterior, thetas: Sequence[np.ndarray]
) -> MotionDraws:
    """Return the draws with θ and log densities added."""
    shape = (result.dataset.sizes["draw"], result.dataset.sizes["chain"])
    theta = np.concatenate(thetas)[: math.prod(shape)]
    # Evaluate row by row, because rounding of matrix products depends on the batch size.
    with one_thread():
        log_density = np.concatenate([to_numpy(posterior.log_density(row[None])) for row in theta])
    return MotionDraws(
        result.dataset.assign(
            theta=(("chain", "draw", "coordinate"), theta.reshape(*shape, -1).swapaxes(0, 1)),
            log_density=(("chain", "draw"), log_density.reshape(shape).T),
        ),
        result.likelihood,
    )
