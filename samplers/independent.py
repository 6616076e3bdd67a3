"""Shared code of samplers with independent draws: batches, random streams, provenance."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from probmotion.arrays import to_numpy
from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.sampling import Interrupted, Sampler, batches, progress_bar
from probmotion.seeds import NormalStreams
from probmotion.threads import one_thread
from probmotion.validation import check_count

__all__ = ["draw_independently", "refuse_initial"]

DrawBatch = Callable[[NormalStreams, Callable[[], Any]], np.ndarray]
"""(streams, tick) → motions (B, L, J, 3), normalised; calls ``tick()`` once per step."""


def draw_independently(
    sampler: Sampler,
    posterior: MotionPosterior,
    draw_batch: DrawBatch,
    *,
    draws: int,
    chains: int,
    seed: int,
    batch: int,
    steps: int,
    scale: float,
    counts: Mapping[str, int],
    progress: bool,
    thetas: Sequence[np.ndarray] = (),
) -> MotionDraws:
    """Return ``chains`` × ``draws`` independent draws, computed in batches of at most ``batch``.

    ``draw_batch`` ticks ``steps`` times per batch, updates the evaluation ``counts``, and may
    append θ, (B, dim), to ``thetas``; the result then has θ and log densities. ``scale`` is in
    metres per normalised unit. Ctrl-C raises :class:`Interrupted` with the finished batches.
    """
    check_count("draws", draws)
    check_count("chains", chains)
    start = time.perf_counter()
    # Ordered by draw, so that an interrupted run has the same number of draws in every chain.
    pairs = [(chain, draw) for draw in range(draws) for chain in range(chains)]
    done: list[np.ndarray] = []
    spent = dict(counts)

    def result() -> MotionDraws:
        motions = np.concatenate(done)
        whole = motions[: len(motions) // chains * chains]
        result = MotionDraws.of(
            posterior,
            sampler,
            whole.reshape(-1, chains, *whole.shape[1:]).swapaxes(0, 1),
            seed=seed,
            seconds=time.perf_counter() - start,
            counts=spent,
            independent=True,
        )
        return _with_coordinates(result, posterior, thetas) if thetas else result

    bars = progress_bar(steps * -(-len(pairs) // batch), sampler.name, progress)
    # Multithreaded products round differently for different batch sizes, and a hundred steps
    # amplify the difference.
    try:
        with threadpool_limits(1, user_api="blas"), bars as bar:
            for some in batches(pairs, batch):
                streams = NormalStreams.of_draws(seed, list(some))
                done.append(draw_batch(streams, lambda: bar.update(1)) * scale)
                spent = dict(counts)
    except KeyboardInterrupt as interrupt:
        if sum(map(len, done)) < chains:
            raise
        raise Interrupted(result()) from interrupt
    return result()


def _with_coordinates(
    result: MotionDraws, posterior: MotionPosterior, thetas: Sequence[np.ndarray]
) -> MotionDraws:
    """Return draws with θ and log densities added."""
    sizes = result.dataset.sizes
    shape = (sizes["draw"], sizes["chain"])
    theta = np.concatenate(thetas)[: math.prod(shape)]
    # Row by row: the rounding of a product depends on its batch.
    with one_thread():
        log_density = np.concatenate([to_numpy(posterior.log_density(row[None])) for row in theta])
    log_density = log_density.reshape(shape).T
    theta = theta.reshape(*shape, -1).swapaxes(0, 1)
    return MotionDraws(
        result.dataset.assign(
            theta=(("chain", "draw", "coordinate"), theta),
            log_density=(("chain", "draw"), log_density),
        )
    )


def refuse_initial(sampler: Sampler, initial: object) -> None:
    """Raise ``ValueError`` if ``initial`` is not None."""
    if initial is not None:
        raise ValueError(
            f"initial must be None, got {type(initial).__name__}: {sampler.name} has no starting "
            "points"
        )
